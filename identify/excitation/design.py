"""Excitation design: reference trajectories that condition the base regressor well (thesis section 2.3.5).

The trajectory is a sequence of point-to-point moves within the limits, or a finite Fourier sum per joint. Waypoints and
paces, or coefficients, are improved by random search on the information in the base regressor, weighted by the torque
noise of each joint:
the smallest geometric mean of the standard deviations, with a condition number under
`armident.identify.excitation.point_to_point.CONDITION`.
The condition number alone would choose slow moves, whose gravity torques are as small as their inertial ones.

With an aim the search looks for the smallest standard deviations of the linear parameters of one effect instead, or of
two effects beside each other, and keeps the base parameters in sight.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import butter, sosfiltfilt

from armident.configs import ConfigError, RobotConfig, Trajectory
from armident.identify.effects.terms import arm_model
from armident.identify.excitation.fourier_series import FourierSearch
from armident.identify.excitation.objective import EffectObjective, effect_objective
from armident.identify.excitation.point_to_point import (
    CUTOFF,
    SEARCH_RATE,
    PointToPointSearch,
    equations_of,
    sample_trajectory,
    slow_share,
)
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.chain import Floats
from armident.identify.signals.decimate import design

Shape = Literal["moves", "fourier"]
C = TypeVar("C")

PERIOD = 1e-3
"""A designed trajectory is judged at this period, s."""

ASSUMED_NOISE = 0.02
"""Torque noise below the cut-off that is supposed where nothing is known, relative to the torque limit."""


@dataclass(frozen=True, eq=False)
class Design:
    """A designed trajectory and what it promises.

    Parameters
    ----------
    trajectory
        The reference, within the limits of the robot.
    condition
        Condition number of the filtered, weighted base regressor along it.
    std
        Predicted standard deviation of each base parameter, shape (b,), in its unit; ``None`` if the noise is
        neither known nor supposed.
    slow_share
        Share of the samples of each joint, shape (n,), slower than
        `armident.identify.excitation.point_to_point.SLOW` of its velocity limit: they say little about its friction.
    """

    trajectory: Trajectory
    condition: float
    std: Floats | None
    slow_share: Floats
    torque: Floats | None = None
    """Predicted torques along it, (N, n) at `PERIOD`; ``None`` where the robot's parameters are unknown."""
    wanted: dict[str, float] | None = None
    """Predicted standard deviations of the linear parameters of wanted effects; ``None`` as for ``std``."""


def design_trajectory(
    robot: RobotConfig,
    duration: float = 7.5,
    seed: int = 0,
    *,
    noise: ArrayLike | None = None,
    evaluations: int = 2000,
    margin: float = 0.9,
    theta: ArrayLike | None = None,
    aim: EffectObjective | None = None,
    shape: Shape = "moves",
    harmonics: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> Design:
    """Design an exciting trajectory by random search.

    Parameters
    ----------
    duration
        Length in s, met within a millisecond.
    seed
        Of the search: the same seed gives the same trajectory.
    noise
        Standard deviation of the torque noise of each joint after the low-pass filter, (n,), N m or N; it
        weights the regressor. By default proportional to the torque limits.
    evaluations
        Number of candidates to try.
    margin
        Share of each limit that may be used.
    theta
        Standard or base parameters as far as they are known: torques along the trajectory then stay within
        their limits too.
    aim
        Effects that the trajectory is to show; those that depend on torques need ``theta``.
    shape, harmonics
        Point-to-point moves with trapezoidal velocities, or Fourier sums of so many harmonics.
    progress
        Called with the share done, 0 to 1.

    Raises
    ------
    ConfigError
        If the robot cannot make a single move in that time.
    """
    model = arm_model(robot)
    limits = [joint.limits for joint in robot.joints]
    sigma = np.array([limit.torque for limit in limits]) if noise is None else np.asarray(noise, dtype=np.float64)
    if sigma.shape != (robot.n,) or not (sigma > 0.0).all():
        raise ConfigError(f"noise: expected {robot.n} positive numbers for {robot.name}")
    search = PointToPointSearch(robot, model, duration, sigma, margin, theta, aim, np.random.default_rng(seed))
    if shape == "fourier":
        trajectory = _search(FourierSearch(search, harmonics), evaluations, progress)
    elif harmonics is not None:
        raise ConfigError("harmonics: only Fourier sums have them; choose the shape fourier")
    else:
        trajectory = _search(search, evaluations, progress)
    trajectory.check(robot, "designed trajectory")
    return predict_precision(model, trajectory, sigma, known_noise=noise is not None, theta=theta, aim=aim)


class _Candidates(Protocol[C]):
    """What is searched: candidates, their neighbours, their cost."""

    def random(self) -> C: ...

    def neighbour(self, candidate: C) -> C: ...

    def cost(self, candidate: C) -> float: ...

    def trajectory(self, candidate: C) -> Trajectory: ...


def _search(among: _Candidates[C], evaluations: int, progress: Callable[[float], None] | None) -> Trajectory:
    """The best trajectory found."""
    best = among.random()
    cost = among.cost(best)
    for count in range(evaluations):
        # The first fifth looks around, the rest improves the best so far.
        candidate = among.random() if count < evaluations // 5 else among.neighbour(best)
        candidate_cost = among.cost(candidate)
        if candidate_cost < cost:
            best, cost = candidate, candidate_cost
        if progress is not None and count % 50 == 0:
            progress(count / evaluations)
    return among.trajectory(best)


def with_objective(
    robot: RobotConfig, wanted: str | None, joint: str | None, against: str | None, theta: ArrayLike | None = None
) -> EffectObjective | None:
    """The aim that a user writes with ``--for``, ``--joint`` and ``--against``; ``None`` without ``--for``.

    Speeds and loads for which the effect is to be visible are those of a usual trajectory of the robot.

    Raises
    ------
    ConfigError
        See `armident.identify.excitation.objective.effect_objective`; or if ``joint`` or ``against`` stand alone.
    """
    if wanted is None:
        for option, value in (("--joint", joint), ("--against", against)):
            if value is not None:
                raise ConfigError(f"{option} {value}: needs --for EFFECT")
        return None
    model = arm_model(robot)
    usual = design_trajectory(robot, seed=0, evaluations=0).trajectory
    period = 1.0 / SEARCH_RATE
    motion = (model if theta is None else model.anchored(theta)).motion(*sample_trajectory(usual, period), period)
    return effect_objective(robot, wanted, joint, against, motion)


def predict_precision(
    model: ArmModel,
    trajectory: Trajectory,
    noise: ArrayLike,
    *,
    cutoff_hz: float = CUTOFF,
    known_noise: bool = True,
    theta: ArrayLike | None = None,
    aim: EffectObjective | None = None,
) -> Design:
    """What a trajectory promises: conditioning and standard deviations after the low-pass filter.

    Parameters
    ----------
    noise
        Standard deviation of the filtered torque noise of each joint, (n,).
    cutoff_hz
        Of the zero-phase low-pass; one sample per independent interval is kept (2.3.2, ``decimate``).
    theta, aim
        As for `design_trajectory`.
    """
    period = PERIOD
    q, qd, qdd = sample_trajectory(trajectory, period)
    torque = None if theta is None else model.inverse_dynamics(theta, q, qd, qdd)
    x = model.base_regressor(q, qd, qdd, dt=period)
    keep = max(1, round(0.5 / (cutoff_hz * period)))
    sections = butter(4, 2.0 * cutoff_hz * period, output="sos")
    x = sosfiltfilt(sections, x, axis=0)[keep // 2 :: keep] / np.asarray(noise, dtype=np.float64)[:, None]
    flat = x.reshape(-1, x.shape[2])
    _, singular, right = np.linalg.svd(flat, full_matrices=False)
    std = np.sqrt(((right / singular[:, None]) ** 2).sum(axis=0)) if known_noise else None
    wanted = None
    if aim is not None and known_noise:
        decimation = design(period, cutoff_hz, keep)
        motion = (model if theta is None else model.anchored(theta)).motion(q, qd, qdd, period)
        wanted = aim.std(motion, *equations_of(model, motion, decimation, np.asarray(noise, dtype=np.float64)))
    return Design(trajectory, float(singular[0] / singular[-1]), std, slow_share(model.robot, qd), torque, wanted)
