"""Optimal experiment design: exciting trajectories (thesis section 2.3.5).

A random search improves point-to-point moves, or the Fourier series of each joint. The criterion is D-optimality: the
smallest geometric mean of the standard deviations of the base parameters, weighted by the torque noise of each joint.
Violations of limits rank behind everything else. The condition number is only a bound (`CONDITION`): as criterion it
would prefer slow moves, whose gravity torques are as small as their inertial ones. With an `EffectObjective` the
criterion is that of the effect; the base parameters have a small weight.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import butter, sosfiltfilt

from armident.arrays import Array
from armident.configs import ConfigError, RobotConfig, Trajectory
from armident.identify.effects.terms import arm_model
from armident.identify.excitation.collision import ClosestApproach, CollisionModel
from armident.identify.excitation.fourier_series import FourierSearch
from armident.identify.excitation.objective import EffectObjective, effect_objective
from armident.identify.excitation.point_to_point import (
    CUTOFF,
    SEARCH_RATE,
    WORST,
    PointToPointSearch,
    Rank,
    equations_of,
    predicted_torque,
    sample_trajectory,
    slow_share,
)
from armident.identify.excitation.trajectory_options import Shape
from armident.identify.robot.arm import ArmModel
from armident.identify.signals.decimate import design

C = TypeVar("C")

PERIOD = 1e-3
"""Sampling period of the predicted precision, s."""

ASSUMED_NOISE = 0.02
"""Assumed torque noise below the cut-off where none is known, relative to the torque limit."""

DEVIATIONS = 2.0
"""Standard deviations of a predicted torque by which it may be larger: by more in one case of 44 (normal)."""


@dataclass(frozen=True, eq=False)
class Design:
    """Trajectory and its predicted precision.

    ``condition``: condition number of the filtered, weighted base regressor. ``std``: predicted standard deviations
    (b,); ``None`` if the noise is unknown. ``slow_share``: share of the samples of each joint (n,) slower than `SLOW`
    of its limit. ``torque``: (N, n) at `PERIOD`, ``None`` without parameters. ``wanted``: standard deviations of the
    wanted effects. ``closest``: smallest distance between bodies; ``None`` if there are none to compare.
    ``torque_std``: standard deviations (N, n) of the torques; ``None`` if those of the parameters are unknown.
    """

    trajectory: Trajectory
    condition: float
    std: Array | None
    slow_share: Array
    torque: Array | None = None
    wanted: dict[str, float] | None = None
    closest: ClosestApproach | None = None
    torque_std: Array | None = None


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
    collision: CollisionModel | None = None,
    progress: Callable[[float], None] | None = None,
) -> Design:
    """Design an exciting trajectory by random search; the same seed gives the same trajectory.

    ``duration`` (s) is met within a millisecond. ``noise``: standard deviations (n,) of the filtered torque noise, the
    weight; by default proportional to the torque limits. ``evaluations``: number of candidates. ``margin``: usable
    share of each limit. ``theta``: standard or base parameters, so that torques stay within limits. ``aim``: effects to
    make visible. ``shape``: trapezoidal ``moves`` or a ``fourier`` series of ``harmonics``. Raises ConfigError if no
    move or no candidate keeps the limits.
    """
    robot.check_movable()
    model = arm_model(robot)
    if any(term.depends_on_torque for term in model.terms):
        # Without parameters, the torques on which these terms depend are not known.
        model = model.without_terms() if theta is None else model.anchored(theta)
    limits = [joint.limits for joint in robot.joints]
    sigma = np.array([limit.torque for limit in limits]) if noise is None else np.asarray(noise, dtype=np.float64)
    if sigma.shape != (robot.n,) or not (sigma > 0.0).all():
        raise ConfigError(f"noise: expected {robot.n} positive numbers for {robot.name}")
    search = PointToPointSearch(
        robot, model, duration, sigma, margin, theta, aim, np.random.default_rng(seed), collision
    )
    if shape == "fourier":
        trajectory, rank = _search(FourierSearch(search, harmonics), evaluations, progress)
    elif harmonics is not None:
        raise ConfigError("harmonics: only for Fourier series; choose the shape fourier")
    else:
        trajectory, rank = _search(search, evaluations, progress)
    trajectory.check(robot, "designed trajectory")
    found = predict_precision(
        model, trajectory, sigma, known_noise=noise is not None, theta=theta, aim=aim, collision=collision
    )
    # The search samples torques more coarsely: those of a candidate that kept its share are compared with the limits.
    excess = excesses(robot, found, collision, margin if rank.violation > 0.0 else 1.0)
    if excess:
        raise ConfigError(
            f"no trajectory found that keeps all limits: the best of {evaluations + 1} candidates has "
            f"{'; '.join(excess)}. "
            "Next: more --evaluations, another --seed, a longer --duration, or narrower limits.position"
        )
    return found


def excesses(robot: RobotConfig, design: Design, collision: CollisionModel | None, share: float = 1.0) -> list[str]:
    """Return the violated limits of torque (times ``share``) and distance of a trajectory, in words."""
    found = []
    if design.torque is not None:
        part = f", {100 * share:.0f} % of limits.torque" if share < 1.0 else ""
        known = design.torque_std is not None
        spread = np.zeros_like(design.torque) if design.torque_std is None else DEVIATIONS * design.torque_std
        peaks = (np.abs(design.torque) + spread).argmax(axis=0)
        for j, (joint, k) in enumerate(zip(robot.joints, peaks, strict=True)):
            torque, more, allowed = abs(design.torque[k, j]), spread[k, j], share * joint.limits.torque
            if torque + more > allowed:
                words = f"{torque:.1f} ± {more:.1f}" if known else f"{torque:.1f}"
                unit = "N m" if joint.type == "revolute" else "N"
                found.append(f"a torque of {words} {unit} at {joint.name} (allowed {allowed:.1f}{part})")
    if collision is not None and design.closest is not None and design.closest.distance < collision.clearance:
        time = design.closest.sample * PERIOD
        found.append(f"a distance of {design.closest} at {time:.2f} s (clearance {collision.clearance:g})")
    return found


class _Candidates(Protocol[C]):
    """Search space: candidates, their neighbours and cost."""

    def random(self) -> C: ...

    def neighbour(self, candidate: C) -> C: ...

    def rank(self, candidate: C, best: Rank) -> Rank:
        """Return the rank of a candidate. ``best``: rank that it must beat."""

    def trajectory(self, candidate: C) -> Trajectory: ...


def _search(
    among: _Candidates[C], evaluations: int, progress: Callable[[float], None] | None
) -> tuple[Trajectory, Rank]:
    """Return the best trajectory found and its rank; one that violates a limit is repaired before it is improved."""
    best = among.random()
    rank = among.rank(best, WORST)
    for count in range(evaluations):
        # The first fifth explores, the rest improves the best candidate.
        candidate = among.random() if count < evaluations // 5 else among.neighbour(best)
        candidate_rank = among.rank(candidate, rank)
        if candidate_rank < rank:
            best, rank = candidate, candidate_rank
        if progress is not None and count % 50 == 0:
            progress(count / evaluations)
    return among.trajectory(best), rank


def with_objective(
    robot: RobotConfig, wanted: str | None, joint: str | None, against: str | None, theta: ArrayLike | None = None
) -> EffectObjective | None:
    """Return the objective of the options ``--for``, ``--joint`` and ``--against``; ``None`` without ``--for``."""
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
    known_noise: bool = True,
    theta: ArrayLike | None = None,
    aim: EffectObjective | None = None,
    collision: CollisionModel | None = None,
) -> Design:
    """Predict condition number and standard deviations of an identification along a trajectory.

    ``noise``: of the filtered torques (n,), N m or N; without ``known_noise`` only a weight, so no standard deviations.
    After the low-pass, one sample per independent interval is kept (thesis section 2.3.2).
    """
    period = PERIOD
    q, qd, qdd = sample_trajectory(trajectory, period)
    torque = None if theta is None else predicted_torque(model, theta, q, qd, qdd, period)
    x = model.base_regressor(q, qd, qdd, dt=period)
    keep = max(1, round(0.5 / (CUTOFF * period)))
    sections = butter(4, 2.0 * CUTOFF * period, output="sos")
    x = sosfiltfilt(sections, x, axis=0)[keep // 2 :: keep] / np.asarray(noise, dtype=np.float64)[:, None]
    flat = x.reshape(-1, x.shape[2])
    _, singular, right = np.linalg.svd(flat, full_matrices=False)
    std = np.sqrt(((right / singular[:, None]) ** 2).sum(axis=0)) if known_noise else None
    wanted = None
    if aim is not None and known_noise:
        decimation = design(period, CUTOFF, keep)
        motion = (model if theta is None else model.anchored(theta)).motion(q, qd, qdd, period)
        wanted = aim.std(motion, *equations_of(model, motion, decimation, np.asarray(noise, dtype=np.float64)))
    closest = None if collision is None else collision.closest(q)
    condition = float(singular[0] / singular[-1])
    return Design(trajectory, condition, std, slow_share(model.robot, qd), torque, wanted, closest)
