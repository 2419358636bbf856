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
    document = load_document(out / "commissioning.json", CommissioningDocument)
    assert len(document.stages) == 4, err
    assert document.held_out_error_pct_by_joint["joint_1"] < 5.0
    # At 500 Hz the residuals at reversals are serially correlated: the verdict is doubtful there.
    trusted = document.verdict == "trustworthy"
    assert document.outcome == ("trusted" if trusted else "not_trusted")
    assert process.returncode == (0 if trusted else 4), err
    for number, one in enumerate(document.motions, 1):
        session = read_recording(Path(str(one.recording.path))).session
        assert session is not None
        assert session.setpoints is not None
        assert session.setpoints.trajectory == out / f"motion_{number}.yaml"
    assert "joint_1 slowly to both sides" in err
