"""``armident commission`` with a virtual arm on a real bus, under the guard."""

from pathlib import Path

import pytest

from armident.daq.recording import read_recording
from armident.identify.documents.commissioning import CommissioningDocument
from armident.identify.documents.files import load_document
from tests.fixtures.processes import armident
from tests.integration.test_reidentify_vcan import QUICK, arm
from tests.statistics.weeks import cell_file

pytestmark = [pytest.mark.vcan, pytest.mark.slow, pytest.mark.nightly]


def test_a_new_arm_is_commissioned_on_its_bus(vcan_bus: str, tmp_path: Path) -> None:
    config = cell_file(tmp_path, vcan_bus, "new", shipped="emps_cell.yaml", **QUICK)
    out = tmp_path / "first_day"
    with arm(config):
        process = armident("commission", config, "--yes", "--out", out)
        _, err = process.communicate(timeout=500)
    assert process.returncode == 0, err
    document = load_document(out / "commissioning.json", CommissioningDocument)
    assert document.outcome == "trusted"
    for number, one in enumerate(document.motions, 1):
        session = read_recording(Path(str(one.recording.path))).session
        assert session is not None
        assert session.setpoints is not None
        assert session.setpoints.trajectory == out / f"motion_{number}.yaml"
    assert "joint_1 slowly to both sides" in err
