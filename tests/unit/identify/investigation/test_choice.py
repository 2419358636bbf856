"""Choice of motions: limits by an uncertain torque, the first motion of an arm, and what would tell in their place."""

import re
from pathlib import Path

import numpy as np
import pytest

from armident.configs import load_robot, load_trajectory
from armident.identify.documents.diagnosis import Explanation
from armident.identify.documents.investigation import InvestigationDocument, MotionChoice
from armident.identify.effects.terms import arm_model
from armident.identify.excitation.collision import CollisionModel
from armident.identify.excitation.point_to_point import sample_trajectory
from armident.identify.investigation.choice import Chosen, excluded, first_motion
from armident.identify.investigation.investigate import _no_motion
from armident.identify.report.investigation_report import investigation_report

ARM = Path(__file__).resolve().parents[4] / "configs" / "examples" / "mujoco" / "mujoco_arm.yaml"
MASS, VISCOUS, DRY = 95.0, 200.0, 20.0
"""Parameters of the EMPS, kg, N s/m, N (Janot, Gautier, Brunot 2019)."""


def test_an_uncertain_mass_bars_a_motion_that_the_estimate_allows() -> None:
    robot, nothing = load_robot("emps"), CollisionModel(load_robot("emps"), [])
    trajectory = load_trajectory("trajectories/emps_excitation.yaml")
    names = arm_model(robot).base.names
    values = {"m1": MASS, "fv1": VISCOUS, "fc1": DRY}
    theta = np.array([values.get(name, 0.0) for name in names])
    std = MASS
    covariance = np.diag([std**2 if name == "m1" else 0.0 for name in names])
    assert excluded(robot, trajectory, theta, nothing) is None
    assert excluded(robot, trajectory, theta, nothing, 1e-6 * covariance) is None
    reason = excluded(robot, trajectory, theta, nothing, covariance)
    assert reason is not None
    pattern = r"needs a torque of ([\d.]+) ± ([\d.]+) N at joint_1 \(allowed 316\.8, 90 % of limits\.torque\)"
    found = re.fullmatch(pattern, reason)
    assert found is not None, reason
    _, qd, qdd = (each[:, 0] for each in sample_trajectory(trajectory, 1e-3))
    torque = MASS * qdd + VISCOUS * qd + DRY * np.sign(qd)
    assert sum(map(float, found.groups())) == pytest.approx(np.max(np.abs(torque) + 2.0 * std * np.abs(qdd)), abs=0.2)


def test_the_first_motion_of_an_arm_with_a_wide_range_moves_all_its_joints() -> None:
    robot = load_robot(ARM)
    chosen = first_motion(robot, CollisionModel(robot, []))
    assert chosen.trajectory is not None
    assert (np.ptp(chosen.trajectory.sample(1e-2), axis=0) > 0.1).all()


def motion(gain: float, reason: str | None = None) -> MotionChoice:
    return MotionChoice(motion="steps", words="joint_1", duration_s=1.0, expected_gain=gain, excluded=reason)


def test_an_end_without_a_motion_names_the_limit_or_the_signal_that_would_tell() -> None:
    names = {"backlash": 0.5, "stribeck_friction": 0.3, "nothing": 0.2}
    doubtful = [Explanation(joint="joint_1", names=names, likely=list(names))]
    barred = _no_motion(Chosen("", (motion(0.5, "needs a torque of 9.0 N m"),)), doubtful)
    assert barred == "the motion that would tell most (joint_1) is not allowed: needs a torque of 9.0 N m"
    alike = _no_motion(Chosen("", (motion(0.01, "needs a torque of 9.0 N m"), motion(0.02))), doubtful)
    assert alike == (
        "no motion of the list tells them apart: the best one promises 0.02 nats. These would show it: backlash by an "
        "encoder on the joint side; stribeck friction by slow motion in both directions"
    )


def test_an_arm_that_its_first_recording_decides_has_a_report_without_questions() -> None:
    statement = "backlash at joint_1, probability 99.0 %."
    document = InvestigationDocument(
        robot="emps", recordings=[], experiments=1, minutes=1.0, outcome="named", statement=statement, versions={}
    )
    page = investigation_report(document, (), load_robot("emps"))
    assert statement in page
    assert "Round 1" not in page
