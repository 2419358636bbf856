"""The direction of gravity in the base frame is found from torques, and an upright arm is found upright."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from configs import DataError, RobotConfig, load_robot
from identify.experiment import Experiment
from identify.model.arm import ArmModel
from identify.mounting import mounting

ROBOT = load_robot("kuka_lwr4")
DT = 5e-3
SECONDS = 20.0
NOISE = 0.2
"""Standard deviation of the torque noise, N m."""
LINK = {"m": 2.0, "mx": 0.05, "my": 0.1, "mz": 0.2, "xx": 0.06, "yy": 0.05, "zz": 0.03, "fv": 1.0, "fc": 0.5}

Floats = NDArray[np.float64]


def motion(t: Floats, moving: int) -> tuple[Floats, Floats, Floats]:
    """Two sines per joint, none in the others, with velocity and acceleration."""
    rng = np.random.default_rng(1)
    w = 2 * np.pi * rng.uniform(0.1, 0.7, (2, ROBOT.n))
    amplitude = np.where(np.arange(ROBOT.n) < moving, rng.uniform(0.4, 0.8, (2, ROBOT.n)), 0.0)
    angle = t[:, None, None] * w + rng.uniform(0, 2 * np.pi, (2, ROBOT.n))
    q = np.sum(amplitude * np.sin(angle), axis=1)
    qd = np.sum(amplitude * w * np.cos(angle), axis=1)
    qdd = np.sum(-amplitude * w**2 * np.sin(angle), axis=1)
    return q, qd, qdd


def experiment(robot: RobotConfig, *, moving: int = ROBOT.n, seed: int = 0) -> Experiment:
    """Of an arm that stands as ``robot`` says; a torque is held from one sample to the next."""
    model = ArmModel.from_config(robot)
    theta = np.array([LINK.get(name.rstrip("0123456789"), 0.0) for name in model.names])
    t = np.asarray(np.arange(round(SECONDS / DT)) * DT, dtype=np.float64)
    tau = model.inverse_dynamics(theta, *motion(t + DT / 2, moving))
    tau += NOISE * np.random.default_rng(seed).standard_normal(tau.shape)
    q = motion(t, moving)[0] + 1e-5 * np.random.default_rng(seed + 1).standard_normal(tau.shape)
    return Experiment(q, tau, None, DT)


@pytest.mark.parametrize("across", [(0.2, -0.1), (-1.0, 2.0), (0.0, 0.0)])
def test_tilt_of_an_arm_is_found_within_its_uncertainty(across: tuple[float, float]) -> None:
    gravity = np.array([*across, -np.sqrt(9.81**2 - np.sum(np.square(across)))])
    real = ROBOT.model_copy(update={"gravity": tuple(gravity.tolist())})
    found = mounting([experiment(real, seed=k) for k in (10, 20)], ROBOT)
    assert np.linalg.norm(found.gravity) == pytest.approx(9.81)
    # 2 degrees of freedom: 5 standard deviations are exceeded four times in a million.
    miss = np.linalg.norm(np.array(found.gravity) - gravity) / 9.81
    assert miss < 5 * max(found.std)
    assert max(found.std) < np.radians(0.05)
    assert found.tilt == pytest.approx(np.arccos(-gravity[2] / 9.81), abs=5 * max(found.std))
    assert found.applied(ROBOT).gravity == found.gravity


def test_tilt_that_the_motion_does_not_show_is_refused() -> None:
    with pytest.raises(DataError, match="does not determine"):
        mounting([experiment(ROBOT, moving=1)], ROBOT)


def test_an_arm_without_gravity_is_refused() -> None:
    weightless = ROBOT.model_copy(update={"gravity": (0.0, 0.0, 0.0)})
    with pytest.raises(DataError, match="no gravity"):
        mounting([experiment(weightless)], weightless)


def test_experiments_that_do_not_belong_together_are_refused() -> None:
    one = experiment(ROBOT)
    with pytest.raises(DataError, match="different sampling rates"):
        mounting([one, replace(one, dt=2 * DT)], ROBOT)
    with pytest.raises(DataError, match="no experiment"):
        mounting([], ROBOT)
