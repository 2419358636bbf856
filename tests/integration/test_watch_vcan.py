"""More friction of one joint, seen by ``armident watch`` on the live stream of a capture."""

import json
import signal
from pathlib import Path
from typing import Any

import pytest
import yaml

from armident.configs import config_path
from armident.identify.documents.files import to_json
from tests.fixtures import arms
from tests.fixtures.processes import ForkedProcess, armident
from tests.integration.test_capture_vcan import session_file
from tests.integration.test_reidentify_vcan import arm

pytestmark = [pytest.mark.vcan, pytest.mark.slow, pytest.mark.nightly, pytest.mark.timeout(600)]

WORN = "joint_2"
SEEN_WITHIN_S = 60.0


def captured(session: Path, folder: Path) -> None:
    """Capture the motion of a session."""
    process = armident("capture", "--config", session, "--out", folder)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 0, err


def ended(watch: ForkedProcess, output: Path) -> tuple[list[dict[str, Any]], str]:
    """Documents and log of a watch that ends at a signal."""
    watch.send_signal(signal.SIGTERM)
    _, err = watch.communicate(timeout=120)
    return [json.loads(line) for line in output.read_text().splitlines()], err


def test_a_tenth_more_friction_is_seen_within_a_minute_of_motion(vcan_bus: str, tmp_path: Path) -> None:
    """A healthy capture, then one with a worn joint, watched by two runs with one saved state."""
    setpoints = {"rpdo": 1, "every": 5, "trajectory": str(config_path("trajectories/tx40_1.yaml")), "repeat": 8}
    session = session_file(tmp_path, vcan_bus, "watched", sync={"period_us": 1000}, setpoints=setpoints)
    (tmp_path / "reference.json").write_text(to_json(arms.tx40_baseline()))
    worn = {"schema": "armident/scenario/1", "effects": [
        {"effect": "friction_scale", "joint": WORN, "parameters": {"factor": 1.1}},
    ]}  # fmt: skip
    (tmp_path / "worn.yaml").write_text(yaml.safe_dump(worn))
    command = ["watch", "--config", session, "--reference", tmp_path / "reference.json"]
    command += ["--state", tmp_path / "state.npz", "--json"]
    results = []
    for k, options in enumerate([(), ("--scenario", str(tmp_path / "worn.yaml"))]):
        output = tmp_path / f"watch{k}.json"
        with output.open("w") as file:
            watch = armident(*command, stdout=file)
        assert watch.stderr is not None
        assert any("watch: ready" in line for line in watch.stderr)
        with arm(session, "--seed", str(k + 1), *options):
            captured(session, tmp_path / f"out{k}")
        documents, err = ended(watch, output)
        assert watch.returncode == (4 if options else 0), (err, documents[-1:])
        assert "blocks" not in err
        results.append(documents)
    before, after = results[0][-1], results[1][-1]
    assert {joint["state"] for joint in before["joints"] if joint["joint"] != "joint_6"} == {"unchanged"}
    alarms = {joint["joint"]: joint["alarm"] for joint in after["joints"] if joint["alarm"] is not None}
    assert alarms.keys() == {WORN}
    assert alarms[WORN]["motion_s"] - before["motion_s"] < SEEN_WITHIN_S
    assert alarms[WORN]["change"] == pytest.approx(0.1, abs=0.06)
