"""How an arm really stands: the direction of gravity in its base frame, from torques.

An arm bolted a degree askew feels its own weight about axes that the configuration takes for vertical. The torques that
causes follow no parameter of an upright arm, and the fit spreads them over friction and inertias.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from configs import DataError, RobotConfig
from identify.estimators.idim_ls import idim_ls
from identify.experiment import Experiment
from identify.methods import decimation_of
from identify.model.arm import ArmModel
from identify.preparation import equations, least_rows
from identify.signals.bandwidth import motion_bandwidth
from identify.signals.decimate import Decimation
from identify.signals.differentiate import Derivatives, differentiate

ITERATIONS = 20
"""Most Gauss-Newton steps; torques are nearly linear in a small tilt, so a few are enough."""

SETTLED = 1e-2
"""Step in standard deviations of the tilt that ends the iterations."""

LARGEST_STEP = 0.1
"""Longest step, rad: further away the torques are not linear in the tilt any more."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Mounting:
    """How an arm stands.

    Parameters
    ----------
    gravity
        Acceleration of gravity in the base frame, m/s^2, as long as the configured one.
    tilt
        Angle between it and the configured one, rad.
    std
        Standard deviation of the tilt about each of the two axes across gravity, rad; of residuals taken for white.
    """

    gravity: tuple[float, float, float]
    tilt: float
    std: tuple[float, float]

    def applied(self, robot: RobotConfig) -> RobotConfig:
        """The robot's configuration with this gravity."""
        return robot.model_copy(update={"gravity": self.gravity})


def mounting(experiments: Sequence[Experiment], robot: RobotConfig) -> Mounting:
    """Direction of gravity that explains the torques best, together with the base parameters.

    Weighted least squares (2.23) on the equations of IDIM-LS with two more unknowns, by Gauss-Newton: given the base
    parameters, the derivative of the torque with respect to a tilt is one more column of the regressor.

    Parameters
    ----------
    experiments
        Recordings of the arm on one and the same mounting.
    robot
        Its configuration; its gravity is the start.

    Raises
    ------
    DataError
        If there is no experiment, sampling rates differ, the motion does not determine parameters and tilt, or the
        iterations do not settle.
    """
    if not experiments:
        raise DataError("no experiment to find the mounting from")
    if any(e.dt != experiments[0].dt for e in experiments):
        raise DataError("the experiments have different sampling rates")
    with threadpool_limits(1):  # type: ignore[no-untyped-call]
        return _mounting(experiments, robot)


def _mounting(experiments: Sequence[Experiment], robot: RobotConfig) -> Mounting:
    dt = experiments[0].dt
    bandwidth = robot.bandwidth_hz or motion_bandwidth([e.q for e in experiments], dt)
    signals = [differentiate(e.q, dt) for e in experiments]
    samples, rows = [e.q.shape[0] for e in experiments], least_rows(ArmModel.from_config(robot))
    decimation = decimation_of("idim-ls", dt, bandwidth, None, samples=samples, rows=rows)
    gravity = np.array(robot.gravity)
    for _ in range(ITERATIONS):
        axes = _across(gravity)
        model = ArmModel.from_config(robot.model_copy(update={"gravity": _triple(gravity)}))
        blocks = equations(model, experiments, signals, decimation)
        theta = model.standard_from_base(idim_ls(blocks, model.base.names).theta)
        columns = _derivatives(model, axes, theta, signals, decimation)
        extended = [replace(b, x=np.concatenate([b.x, c], axis=2)) for b, c in zip(blocks, columns, strict=True)]
        estimate = idim_ls(extended, (*model.base.names, "tilt_1", "tilt_2"))
        step, std = estimate.theta[-2:], estimate.std[-2:]
        gravity = _turned(gravity, axes, step * min(1.0, LARGEST_STEP / max(float(np.linalg.norm(step)), 1e-300)))
        if np.all(np.abs(step) <= SETTLED * std):
            return Mounting(_triple(gravity), _angle(gravity, np.array(robot.gravity)), (float(std[0]), float(std[1])))
    raise DataError(f"the tilt of the mounting does not settle within {ITERATIONS} iterations")


def _derivatives(
    model: ArmModel, axes: Array, theta: Array, signals: Sequence[Derivatives], decimation: Decimation
) -> list[Array]:
    """Torque per rad of tilt along both axes at fixed standard parameters, decimated, shape (M, n, 2) each.

    The torque is linear in gravity, so this is the torque of a gravity along each axis and nothing else.
    """
    size = np.linalg.norm(model.chain.gravity)
    sideways = [replace(model, chain=model.chain._replace(gravity=size * axis)) for axis in axes]
    weightless = replace(model, chain=model.chain._replace(gravity=np.zeros(3)))
    columns = []
    for s in signals:
        still = np.zeros_like(s.q)
        none = weightless.inverse_dynamics(theta, s.q, still, still)
        columns.append(
            decimation(np.stack([m.inverse_dynamics(theta, s.q, still, still) - none for m in sideways], axis=2))
        )
    return columns


def _across(gravity: Array) -> Array:
    """Two unit vectors at right angles to gravity and to each other, shape (2, 3)."""
    size = float(np.linalg.norm(gravity))
    if size == 0.0:
        raise DataError("the configuration has no gravity, so no direction of it can be found")
    _, _, rows = np.linalg.svd(gravity[None, :] / size)
    across: Array = rows[1:]
    return across


def _turned(gravity: Array, axes: Array, tilt: Array) -> Array:
    """Gravity of the same size, moved by ``tilt`` (2,), rad, along the axes."""
    size = np.linalg.norm(gravity)
    moved = gravity / size + tilt @ axes
    turned: Array = size * moved / np.linalg.norm(moved)
    return turned


def _angle(one: Array, other: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other))


def _triple(gravity: Array) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in gravity)
    return x, y, z
