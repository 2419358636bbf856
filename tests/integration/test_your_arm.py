"""An arm that nobody configured, from URDF and table to a model in MuJoCo: the commands of docs/your-arm.md.

The arm is simulated by MuJoCo (`tests.fixtures.mujoco_arm`), so that no code of armident made the measurements.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import savgol_filter

from tests.fixtures.mujoco_arm import LINKS, column, write_table, write_urdf

pytestmark = [pytest.mark.slow, pytest.mark.nightly]

WINDOW, ORDER = 61, 4
"""Samples and order of the polynomials that differentiate the positions for MuJoCo, 1 kHz."""


def armident(folder: Path, *words: str) -> None:
    """Run a command in a folder."""
    done = subprocess.run(
        [sys.executable, "-m", "armident.daq.cli", *words],
        cwd=folder, capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Configuration, model, prediction and MJCF, made by the commands that a new user types."""
    pytest.importorskip("mujoco")
    place = tmp_path_factory.mktemp("arm")
    write_urdf(place / "gantry.urdf")
    for seed, name in ((1, "monday"), (2, "tuesday")):
        write_table(place / "gantry.urdf", place / f"{name}.csv", seed)
    armident(place, "init", "gantry.urdf", "--recording", "monday.csv", "--out", "arm")
    for name in ("monday", "tuesday"):
        armident(place, "import", f"{name}.csv", "--config", "arm/robot.yaml", "--out", f"{name}.mcap")
    armident(place, "check", "monday.mcap")
    armident(place, "identify", "monday.mcap", "--out", "model")
    armident(place, "predict", "tuesday.mcap", "--model", "model", "--out", "prediction")
    armident(place, "export-model", "model", "--format", "mjcf", "--config", "arm/robot.yaml", "--out", "gantry.xml")
    return place


def test_rotors_and_friction_are_those_of_the_simulator(folder: Path) -> None:
    document = json.loads((folder / "model" / "identification.json").read_text(encoding="utf-8"))
    found = {p["name"]: p["value"] for p in document["parameters"]}
    for j, link in enumerate(LINKS, start=1):
        assert found[f"fv{j}"] == pytest.approx(link.viscous, rel=0.03), link.name
        assert found[f"fc{j}"] == pytest.approx(link.dry, rel=0.03), link.name
    # The rotors of the first three axes cannot be distinguished from the links.
    assert [found[f"ia{j}"] for j in (4, 5, 6)] == pytest.approx(column("rotor")[3:], rel=0.05)


def test_another_motion_is_predicted(folder: Path) -> None:
    prediction = json.loads((folder / "prediction" / "prediction.json").read_text(encoding="utf-8"))
    assert prediction["held_out"] is True
    assert prediction["relative_error_pct"] < 0.5


def test_the_exported_model_has_the_measured_torques_in_mujoco(folder: Path) -> None:
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(folder / "gantry.xml"))
    state = mujoco.MjData(model)
    table = np.loadtxt(folder / "tuesday.csv", delimiter=",", skiprows=1)
    n, dt = len(LINKS), float(table[1, 0] - table[0, 0])

    def smooth(values: np.ndarray, order: int = 0) -> np.ndarray:
        return savgol_filter(values, WINDOW, ORDER, deriv=order, delta=dt, axis=0)

    q, qd, qdd = (smooth(table[:, 1 : n + 1], order) for order in range(3))
    held = table[:, n + 1 : 2 * n + 1]
    measured = smooth(np.vstack([held[:1], (held[:-1] + held[1:]) / 2]))  # held from one sample to the next
    errors = []
    for k in range(WINDOW, len(q) - WINDOW, 10):
        state.qpos[:], state.qvel[:], state.qacc[:] = q[k], qd[k], qdd[k]
        mujoco.mj_forward(model, state)  # friction and offsets are the forces of actuators with an input of zero
        passive = state.qfrc_actuator.copy()
        state.qacc[:] = qdd[k]
        mujoco.mj_inverse(model, state)
        errors.append(state.qfrc_inverse - passive - measured[k])
    assert np.linalg.norm(errors) < 0.015 * np.linalg.norm(measured[WINDOW:-WINDOW:10])
