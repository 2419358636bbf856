"""The programs of docs/how-to/robot-program.md: the arm in MuJoCo end to end, the conversions of the others."""

import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import armident
from armident.configs.schema.robot import Effect

EXAMPLES = Path(__file__).resolve().parents[2] / "configs" / "examples"


def program(name: str) -> dict[str, Any]:
    """Names that a program defines; it moves nothing unless it is the main one."""
    return runpy.run_path(str(next(EXAMPLES.glob(f"*/{name}"))))


@pytest.mark.slow
def test_the_torques_of_the_mujoco_arm_are_those_of_its_parameters(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    t = np.arange(0.0, 12.0, 1e-3)
    q = np.column_stack([1.2 * np.sin(0.9 * t) * np.sin(2.1 * t), 1.6 * np.sin(1.3 * t) * np.sin(0.7 * t)])
    np.savetxt(tmp_path / "motion.csv", np.column_stack([t, q]), delimiter=",", header="t,qr1,qr2", comments="")
    command = [
        sys.executable,
        *map(str, (EXAMPLES / "mujoco" / "mujoco_robot.py", tmp_path / "motion.csv", tmp_path / "answer.csv")),
    ]
    subprocess.run(command, check=True)
    # Without what the configuration does not know of, the spring of 6 N m/rad is missing.
    robot = armident.load_robot(EXAMPLES / "mujoco" / "mujoco_arm.yaml")
    recording = armident.import_recording(tmp_path / "answer.csv", robot)
    spring = Effect.model_validate({"effect": "joint_spring", "joint": "elbow"})
    fitted = armident.identify(recording, robot.model_copy(update={"effects": (spring,)}))
    found = {p.name: p.value for p in fitted.document.parameters}
    true = {"mx2": 0.3, "ia2": 0.1, "fv1": 4.0, "fv2": 1.5, "fc1": 3.0, "fc2": 1.5, "ks2": 6.0}
    assert {name: found[name] for name in true} == pytest.approx(true, rel=0.1)
    assert found["ks2"] == pytest.approx(6.0, rel=0.02)


def test_joint_states_of_ros_2_become_columns_in_the_order_of_the_joints_at_the_times_of_the_motion() -> None:
    made = program("ros2_robot.py")
    names = list(made["JOINTS"])[::-1]

    def state(k: int) -> SimpleNamespace:
        stamp = SimpleNamespace(sec=7 + k // 500, nanosec=2_000_000 * (k % 500))
        values = [100.0 * j + 0.002 * k for j in range(len(names))][::-1]
        efforts = [-value for value in values]
        return SimpleNamespace(header=SimpleNamespace(stamp=stamp), name=names, position=values, effort=efforts)

    t = np.arange(0.0, 1.9, 1e-3)
    table = made["answer"](t, [state(k) for k in range(1000)])
    np.testing.assert_allclose(table[:, 0], t)
    np.testing.assert_allclose(table[:, 1:7], 100.0 * np.arange(6) + t[:, None], atol=1e-9)
    np.testing.assert_allclose(table[:, 7:], -table[:, 1:7])
    without = state(0)
    without.effort = []
    with pytest.raises(SystemExit, match="no efforts"):
        made["answer"](t, [without])


def test_currents_of_lerobot_have_their_sign_and_samples_even_times() -> None:
    made = program("lerobot_robot.py")
    q = np.radians([10.0, -20.0, 30.0, -40.0, 50.0])
    action = made["action"](q)
    assert action["elbow_flex.pos"] == pytest.approx(30.0)
    counts = dict(zip(made["JOINTS"], [100, 100 + 2**15, 0, 1, 2**15 + 1], strict=True))
    row = made["sample"](action, counts)
    np.testing.assert_allclose(row[:5], q)
    np.testing.assert_allclose(row[5:], [0.65, -0.65, 0.0, 0.0065, -0.0065])
    late = np.cumsum([0.0, 0.02, 0.021, 0.027, 0.019, 0.02])
    table = made["even"](np.column_stack([late, *np.outer(row, 1.0 + late)]))
    np.testing.assert_allclose(np.diff(table[:, 0]), 0.02)
    np.testing.assert_allclose(table[:, 1:], np.outer(1.0 + table[:, 0], row), atol=1e-12)
