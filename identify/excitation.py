"""Excitation design: reference trajectories that condition the base regressor well (thesis section 2.3.5).

The trajectory is a sequence of point-to-point moves within the limits. Waypoints and paces are improved by
random search on the information in the base regressor, weighted by the torque noise of each joint:
the smallest geometric mean of the standard deviations, with a condition number under `CONDITION`. The condition
number alone would choose slow moves, whose gravity torques are as small as their inertial ones.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import butter, sosfiltfilt

from configs import ConfigError, RobotConfig, Trajectory
from configs.trajectory import RAMP_SHARE, Move
from identify.model.arm import ArmModel
from identify.model.chain import Floats

PEAK_VELOCITY = 1.0 / (1.0 - RAMP_SHARE)
"""Peak velocity of a move of unit length and duration."""

PEAK_ACCELERATION = PEAK_VELOCITY * np.pi / (2.0 * RAMP_SHARE)
"""Peak acceleration of a move of unit length and duration."""

SHORTEST_MOVE = 0.3
"""Moves shorter than this (s) excite little but the closed loop's own dynamics."""

REACH = (0.15, 0.6)
"""How far a move may go, as a share of the range: short moves accelerate harder, long ones run faster."""

SLOWEST_PACE = 1.8
"""Slowest pace, as a multiple of the shortest duration: speeds must differ to tell ``fv`` from ``fc``."""

CONDITION = 190.0
"""Condition number of the weighted base regressor that is good enough: under the 200 of thesis section B.4."""

SLOW = 0.025
"""Share of a joint's velocity limit under which a sample is slow."""

SLOW_SHARE = 0.12
"""Share of slow samples that costs nothing."""

SEARCH_RATE = 100.0
"""Sampling rate of the regressor during the search, Hz."""


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
        unknown.
    slow_share
        Share of the samples of each joint, shape (n,), slower than `SLOW` of its velocity limit: they say little
        about its friction.
    """

    trajectory: Trajectory
    condition: float
    std: Floats | None
    slow_share: Floats


def design_trajectory(
    robot: RobotConfig,
    duration: float = 7.5,
    seed: int = 0,
    *,
    noise: ArrayLike | None = None,
    evaluations: int = 2000,
    margin: float = 0.9,
    theta: ArrayLike | None = None,
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
    progress
        Called with the share done, 0 to 1.

    Raises
    ------
    ConfigError
        If the robot cannot make a single move in that time.
    """
    model = ArmModel.from_config(robot)
    limits = [joint.limits for joint in robot.joints]
    sigma = np.array([limit.torque for limit in limits]) if noise is None else np.asarray(noise, dtype=np.float64)
    if sigma.shape != (robot.n,) or not (sigma > 0.0).all():
        raise ConfigError(f"noise: expected {robot.n} positive numbers for {robot.name}")
    search = _Search(robot, model, duration, sigma, margin, theta, np.random.default_rng(seed))
    best = search.random()
    cost = search.cost(best)
    for count in range(evaluations):
        # The first fifth looks around, the rest improves the best so far.
        candidate = search.random() if count < evaluations // 5 else search.neighbour(best)
        candidate_cost = search.cost(candidate)
        if candidate_cost < cost:
            best, cost = candidate, candidate_cost
        if progress is not None and count % 50 == 0:
            progress(count / evaluations)
    trajectory = search.trajectory(best)
    trajectory.check(robot, "designed trajectory")
    return assess(model, trajectory, sigma, known_noise=noise is not None)


def assess(
    model: ArmModel, trajectory: Trajectory, noise: ArrayLike, *, cutoff_hz: float = 20.0, known_noise: bool = True
) -> Design:
    """What a trajectory promises: conditioning and standard deviations after the low-pass filter.

    Parameters
    ----------
    noise
        Standard deviation of the filtered torque noise of each joint, (n,).
    cutoff_hz
        Of the zero-phase low-pass; one sample per independent interval is kept (2.3.2, ``decimate``).
    """
    period = 1e-3
    q, qd, qdd = _motion(trajectory, period)
    x = model.base_regressor(q, qd, qdd, dt=period)
    keep = max(1, round(0.5 / (cutoff_hz * period)))
    sections = butter(4, 2.0 * cutoff_hz * period, output="sos")
    x = sosfiltfilt(sections, x, axis=0)[keep // 2 :: keep] / np.asarray(noise, dtype=np.float64)[:, None]
    flat = x.reshape(-1, x.shape[2])
    _, singular, right = np.linalg.svd(flat, full_matrices=False)
    std = np.sqrt(((right / singular[:, None]) ** 2).sum(axis=0)) if known_noise else None
    return Design(trajectory, float(singular[0] / singular[-1]), std, slow_share(model.robot, qd))


def slow_share(robot: RobotConfig, qd: Floats) -> Floats:
    """Share of the samples ``qd`` (N, n) of each joint that are slower than `SLOW` of its velocity limit."""
    limit = SLOW * np.array([joint.limits.velocity for joint in robot.joints])
    result: Floats = (np.abs(qd) < limit).mean(axis=0)
    return result


@dataclass(frozen=True)
class _Candidate:
    """Waypoints (K, n) and paces (K,): how much slower than the limits each move is."""

    points: Floats
    paces: Floats


class _Search:
    """Candidates within the limits, and their cost."""

    def __init__(
        self,
        robot: RobotConfig,
        model: ArmModel,
        duration: float,
        sigma: Floats,
        margin: float,
        theta: ArrayLike | None,
        rng: np.random.Generator,
    ) -> None:
        limits = [joint.limits for joint in robot.joints]
        bounds = np.array([limit.position for limit in limits])
        middle, half = bounds.mean(axis=1), bounds[:, 1] - bounds.mean(axis=1)
        self.low, self.high = middle - margin * half, middle + margin * half
        self.velocity = margin * np.array([limit.velocity for limit in limits])
        self.acceleration = margin * np.array([limit.acceleration for limit in limits])
        self.torque = margin * np.array([limit.torque for limit in limits])
        self.home = np.clip(0.0, self.low, self.high)
        self.model, self.duration, self.sigma, self.theta, self.rng = model, duration, sigma, theta, rng

    def random(self) -> _Candidate:
        """Waypoints within reach of each other, the last one home, as many as fit the duration."""
        reach = self.rng.uniform(*REACH) * (self.high - self.low)
        points: list[Floats] = []
        paces: list[float] = []
        here, left = self.home, self.duration
        while True:
            point = np.clip(here + self.rng.uniform(-reach, reach), self.low, self.high)
            pace = self.rng.uniform(1.0, SLOWEST_PACE)
            left -= pace * max(float(self._shortest((point - here)[None, :])[0]), SHORTEST_MOVE)
            if left < 0.0 and points:
                break
            points.append(point)
            paces.append(float(pace))
            here = point
        points[-1] = self.home
        return _Candidate(np.array(points), np.array(paces))

    def neighbour(self, candidate: _Candidate) -> _Candidate:
        """The candidate with a few coordinates changed."""
        points, paces = candidate.points.copy(), candidate.paces.copy()
        change = self.rng.random(points.shape) < self.rng.choice([0.03, 0.1, 0.3])
        step = self.rng.normal(0.0, self.rng.choice([0.05, 0.2, 0.5]), points.shape) * (self.high - self.low)
        points = np.where(change, np.clip(points + step, self.low, self.high), points)
        points[-1] = self.home
        change_pace = self.rng.random(paces.shape) < 0.1
        return _Candidate(points, np.where(change_pace, self.rng.uniform(1.0, SLOWEST_PACE, paces.shape), paces))

    def trajectory(self, candidate: _Candidate) -> Trajectory:
        """The moves of a candidate, their durations in whole milliseconds and adding up."""
        durations = self._durations(candidate)
        ends = np.round(np.cumsum(durations), 3)
        ends[-1] = round(self.duration, 3)
        times = np.diff(ends, prepend=0.0)
        moves = tuple(
            Move(to=tuple(float(f"{v:.4f}") for v in point), duration=float(f"{time:.3f}"))
            for point, time in zip(candidate.points, times, strict=True)
        )
        return Trajectory(schema="armident/trajectory/1", start=tuple(float(v) for v in self.home), moves=moves)

    def cost(self, candidate: _Candidate) -> float:
        """Mean logarithm of the standard deviations, raised where conditioning is poor or joints are slow.

        Infinite where a limit is exceeded.
        """
        durations = self._durations(candidate)
        lengths = np.diff(np.vstack([self.home, candidate.points]), axis=0)
        if (durations < np.maximum(self._shortest(lengths), SHORTEST_MOVE)).any():
            return np.inf
        q, qd, qdd = _motion(self.trajectory(candidate), 1.0 / SEARCH_RATE)
        if self.theta is not None:
            torque = self.model.inverse_dynamics(self.theta, q, qd, qdd)
            if (np.abs(torque) > self.torque).any():
                return np.inf
        x = (self.model.base_regressor(q, qd, qdd, dt=1.0 / SEARCH_RATE) / self.sigma[:, None]).reshape(-1, self.model.base.b)
        eigenvalues = np.linalg.eigvalsh(x.T @ x)
        if not eigenvalues[0] > 0.0:
            return np.inf
        condition = np.sqrt(eigenvalues[-1] / eigenvalues[0])
        slow = np.maximum(0.0, slow_share(self.model.robot, qd) - SLOW_SHARE).sum()
        return float(-0.5 * np.log(eigenvalues).mean() + max(0.0, np.log(condition / CONDITION)) + slow)

    def _durations(self, candidate: _Candidate) -> Floats:
        lengths = np.diff(np.vstack([self.home, candidate.points]), axis=0)
        wanted = np.maximum(self._shortest(lengths), SHORTEST_MOVE) * candidate.paces
        result: Floats = wanted * self.duration / wanted.sum()
        return result

    def _shortest(self, lengths: Floats) -> Floats:
        by_velocity = np.abs(lengths) * PEAK_VELOCITY / self.velocity
        by_acceleration = np.sqrt(np.abs(lengths) * PEAK_ACCELERATION / self.acceleration)
        result: Floats = np.maximum(by_velocity, by_acceleration).max(axis=1)
        return result


def _motion(trajectory: Trajectory, period: float) -> tuple[Floats, Floats, Floats]:
    q = trajectory.sample(period)
    qd = np.gradient(q, period, axis=0)
    return q, qd, np.gradient(qd, period, axis=0)
