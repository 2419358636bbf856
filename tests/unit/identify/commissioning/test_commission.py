"""Commissioning from nothing to a trusted model, mistakes that stop it, and what a kill leaves."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import armident
from armident.configs import DataError, RobotConfig, Trajectory, load_robot
from armident.identify.commissioning.small_motion import SmallMotion, wrong_answer
from armident.identify.excitation.point_to_point import sample_trajectory
from armident.identify.identification.from_recording import experiments_of, joint_positions, joint_torques
from armident.identify.investigation.choice import home_of
from armident.identify.investigation.motions import FIRST_CONTACT, reach_of
from armident.identify.signals.experiments import Experiment
from armident.virtual_robot.twin import complete

pytestmark = pytest.mark.slow

PICKER = complete(load_robot("configs/examples/integration_test/picker.yaml"))[0]
"""A lift, a shoulder and an elbow, with masses in the URDF and the drives that a virtual arm assumes."""
PERIOD = 1e-3
ELBOW = 2


class Arm:
    """A virtual arm whose recorded columns may be in another order, or some signals of the wrong sign."""

    def __init__(
        self, robot: str | RobotConfig, orders: Sequence[Sequence[int]] = (), turned: Sequence[str] = ()
    ) -> None:
        self.robot, self.orders, self.turned, self.asked = robot, orders, turned, list[Trajectory]()

    def __call__(self, trajectory: Trajectory) -> armident.Recording:
        self.asked.append(trajectory)
        made = armident.simulate_recording(self.robot, trajectory, seed=len(self.asked), period=PERIOD)
        if self.orders:
            q = joint_positions(made.samples, "position", made.robot)[:, self.orders[0]]
            tau = joint_torques(made.samples, made.robot)[:, self.orders[1]]
            return armident.Recording.from_arrays(PERIOD * np.arange(len(q)), q, tau, robot=made.robot)
        raw = {name: -x if name in self.turned else x for name, x in made.samples.raw.items()}
        return replace(made, streams={**made.streams, "samples": replace(made.samples, raw=raw)})


def test_a_new_arm_becomes_a_trusted_model_without_a_step_in_the_dark(tmp_path: Path) -> None:
    arm, robot, lines = Arm(PICKER), PICKER, list[str]()
    found = armident.commission(PICKER, arm, out=tmp_path, say=lines.append)
    assert found.outcome == "trusted", found
    assert len(lines) == len(found.document.stages) == 4
    assert found.identification is not None
    assert found.identification.verdict == "trustworthy"
    assert max(found.document.held_out_error_pct_by_joint.values()) < 100 / 3
    # Each joint alone, then all: nothing is faster than the share that has passed before.
    limits = [(each.limits.velocity, each.limits.acceleration) for each in robot.joints]
    allowed = [*[FIRST_CONTACT] * (robot.n + 1), 0.5, 0.9, 0.9, 0.9]
    for k, (trajectory, share) in enumerate(zip(arm.asked, allowed, strict=True)):
        _, qd, qdd = sample_trajectory(trajectory, PERIOD)
        used = np.abs([qd, qdd]).max(axis=1).T / limits
        assert used.max() <= 1.001 * share
        assert k >= robot.n or np.flatnonzero(used.max(axis=1)).tolist() == [k]
    assert armident.load_identification(tmp_path / "model").verdict == "trustworthy"
    # A commissioning that has ended asks for nothing.
    again = armident.commission(None, arm, resume=tmp_path)
    assert again.document == found.document
    assert len(arm.asked) == len(allowed)


@pytest.mark.parametrize(
    ("orders", "asked", "line"),
    [
        (([0, 1, 2], [0, 2, 1]), 2, "joint: shoulder, other: elbow, parameters: {torque: 1, joint_side: 1}"),
        (
            ([1, 0, 2], [1, 0, 2]),
            1,
            "joint: lift, other: shoulder, parameters: {position: 1, torque: 1, joint_side: 1}",
        ),
    ],
)
def test_exchanged_joints_stop_at_the_first_one_that_shows_it(
    orders: tuple[list[int], list[int]], asked: int, line: str
) -> None:
    arm = Arm(PICKER, orders)
    found = armident.commission(PICKER, arm)
    assert found.outcome == "set_up"
    assert list(found.document.stages) == ["configuration", "small motions"]
    assert len(arm.asked) == asked
    assert found.document.next_step == f"effects: [{{effect: joint_order, {line}}}]"


@pytest.mark.parametrize("turned", [["position"], ["voltage"], ["position", "voltage"]])
def test_a_wrong_sign_stops_and_its_line_corrects_the_recordings_of_before(tmp_path: Path, turned: list[str]) -> None:
    arm = Arm("emps", turned=turned)
    found = armident.commission("emps", arm, out=tmp_path)
    assert found.outcome == "set_up"
    assert len(arm.asked) == 1
    signals = ", ".join(f"{signal.replace('voltage', 'torque')}: 1" for signal in turned)
    line = f"{{effect: sign_error, joint: joint_1, parameters: {{{signals}, joint_side: 1}}}}"
    assert found.document.next_step == f"effects: [{line}]"
    corrected = yaml.safe_load((tmp_path / "robot.yaml").read_text()) | yaml.safe_load(found.document.next_step)
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(corrected), encoding="utf-8")

    def ends(trajectory: Trajectory) -> armident.Recording:
        raise DataError("enough")

    again = armident.commission(None, ends, resume=tmp_path)
    assert again.outcome == "stopped"
    assert "every joint moves as asked" in again.document.stages["small motions"]
    assert "enough" in again.document.stages["scale"]


def _answer(factor: float) -> tuple[np.ndarray, list[Experiment]]:
    """Positions of the elbow that were asked for, and a recording whose revolute positions have a wrong factor."""
    robot = PICKER
    still = np.zeros(robot.n)
    trajectory = SmallMotion().trajectory(reach_of(robot, home_of(robot), still, still), ELBOW, 0.1)
    recording = armident.simulate_recording(PICKER, trajectory, seed=1, period=PERIOD)
    recorded, _ = experiments_of([recording], robot, name_files=False)
    scale = np.array([1.0, factor, factor])
    return trajectory.sample(PERIOD)[:, ELBOW], [replace(e, q=e.q * scale) for e in recorded]


@pytest.mark.parametrize(
    ("factor", "message", "remedy"),
    [
        (180.0 / np.pi, "the positions are in degrees", "{position: 0.0174533}"),
        (2.0, "elbow made 2 times the motion", "counts_per_unit: 2 times the present one"),
        (0.001, "no position changed", "release brakes"),
    ],
)
def test_a_wrong_unit_is_named_by_the_motion_that_was_asked_for(factor: float, message: str, remedy: str) -> None:
    mistake = wrong_answer(PICKER, ELBOW, *_answer(factor))
    assert mistake is not None
    assert message in mistake.message
    assert remedy in mistake.remedy
    assert wrong_answer(PICKER, ELBOW, *_answer(1.0)) is None


def test_a_kill_loses_only_the_motion_that_runs(tmp_path: Path) -> None:
    arm = Arm("emps")

    def killed(trajectory: Trajectory) -> armident.Recording:
        if len(arm.asked) == 2:
            raise KeyboardInterrupt
        return arm(trajectory)

    with pytest.raises(KeyboardInterrupt):
        armident.commission("emps", killed, out=tmp_path)
    found = armident.commission(None, arm, resume=tmp_path)
    assert found.outcome == "trusted"
    assert len(arm.asked) == len(found.document.motions) == 6
    with pytest.raises(armident.ConfigError, match="--continue"):
        armident.commission("emps", arm, out=tmp_path)


def test_a_refused_motion_stops_with_the_reason() -> None:
    def refuses(trajectory: Trajectory) -> armident.Recording:
        raise DataError("the brake is closed")

    found = armident.commission("emps", refuses)
    assert found.outcome == "stopped"
    assert found.document.motions == []
    assert "the brake is closed" in found.document.stages["small motions"]
