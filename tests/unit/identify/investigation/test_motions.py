"""Motions of an investigation: within the limits, at rest at both ends, slow at first contact."""

import numpy as np
import pytest

from armident.configs import RobotConfig, load_robot
from armident.identify.investigation.motions import (
    FAMILIES,
    FASTER,
    FIRST_CONTACT,
    ConstantSpeeds,
    MotionFamily,
    Reach,
    Reversals,
    reach_of,
)

PERIOD = 1e-3


@pytest.fixture(scope="module")
def tx40() -> RobotConfig:
    return load_robot("tx40")


def full_reach(robot: RobotConfig) -> Reach:
    limits = [joint.limits for joint in robot.joints]
    speeds, accelerations = (np.array([getattr(x, name) for x in limits]) for name in ("velocity", "acceleration"))
    return reach_of(robot, np.zeros(robot.n), speeds, accelerations)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_every_motion_keeps_the_limits_and_begins_and_ends_at_home(family: MotionFamily, tx40: RobotConfig) -> None:
    reach = full_reach(tx40)
    for size in family.sizes:
        trajectory = family.trajectory(reach, 1, size, 2)
        trajectory.check(tx40)
        q = trajectory.sample(PERIOD)
        np.testing.assert_allclose(q[[0, -1]], [reach.home, reach.home], atol=1e-4)
        assert np.abs(np.diff(q[[0, 1, -2, -1]], axis=0)[[0, 2]]).max() < 1e-4
        rests = [3] if family.name in ("two_joints", "other_loads") else [0, 2, 3, 4, 5]
        if family.name != "other_loads":
            assert np.ptp(q[:, rests], axis=0).max() == 0.0


def test_a_joint_that_never_moved_moves_slowly_and_others_hardly_faster_than_before(tx40: RobotConfig) -> None:
    speeds = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    reach = reach_of(tx40, np.zeros(6), speeds, speeds)
    limits = np.array([joint.limits.velocity for joint in tx40.joints])
    np.testing.assert_allclose(reach.velocity[[0, 2, 3, 4, 5]], FIRST_CONTACT * limits[[0, 2, 3, 4, 5]])
    assert reach.velocity[1] == pytest.approx(FASTER)
    q = ConstantSpeeds().trajectory(reach, 0, 0.15).sample(PERIOD)
    assert np.abs(np.diff(q[:, 0]) / PERIOD).max() <= FIRST_CONTACT * limits[0] * (1.0 + 1e-6)


def test_constant_speeds_are_constant_for_most_of_a_pass_and_span_two_decades(tx40: RobotConfig) -> None:
    q = ConstantSpeeds().trajectory(full_reach(tx40), 1, 0.4).sample(PERIOD)[:, 1]
    speed = np.abs(np.diff(q) / PERIOD)
    level = speed[1:][(np.abs(np.diff(speed)) < 1e-9) & (speed[1:] > 1e-4)]
    assert level.size > 0.4 * speed.size
    assert np.quantile(level, 0.98) > 50.0 * level.min()


def test_reversals_grow_from_small_to_large(tx40: RobotConfig) -> None:
    q = Reversals().trajectory(full_reach(tx40), 1, 0.1).sample(PERIOD)[:, 1]
    at = np.flatnonzero(np.diff(np.sign(np.diff(q))) != 0)
    strokes = np.abs(np.diff(q[at]))
    assert strokes.max() > 20.0 * strokes[strokes > 1e-6].min()
