"""Random search over point-to-point trajectories within the limits of a robot."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armident.arrays import Array
from armident.configs import ConfigError, RobotConfig, Trajectory
from armident.configs.schema.trajectory import RAMP_SHARE, Move
from armident.identify.excitation.collision import CollisionModel
from armident.identify.excitation.objective import EffectObjective, weighted_rows
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.motion import Motion
from armident.identify.signals.decimate import Decimation, design

PEAK_VELOCITY = 1.0 / (1.0 - RAMP_SHARE)
"""Peak velocity of a move of unit length and duration."""

PEAK_ACCELERATION = PEAK_VELOCITY * np.pi / (2.0 * RAMP_SHARE)
"""Peak acceleration of a move of unit length and duration."""

SHORTEST_MOVE = 0.3
"""Shortest move, s: shorter ones mainly excite the dynamics of the closed loop."""

REACH = (0.15, 0.6)
"""Length of a move as a share of the range: short moves accelerate more, long ones are faster."""

FEWEST_MOVES = 3
"""Moves that fit the duration at full pace: ranges of two turns would take all of it for one move."""

SLOWEST_PACE = 1.8
"""Slowest pace, as a multiple of the shortest duration: ``fv`` and ``fc`` are separated by different speeds."""

CONDITION = 190.0
"""Condition number of the weighted base regressor without penalty: below the 200 of thesis section B.4."""

SLOW = 0.025
"""Share of a joint's velocity limit below which a sample counts as slow."""

SLOW_SHARE = 0.12
"""Share of slow samples without penalty."""

SEARCH_RATE = 100.0
"""Sampling rate of the regressor during the search, Hz."""

CUTOFF = 20.0
"""Cut-off frequency of the regression, Hz."""

AIM_FACTOR = 4
"""Oversampling of effects, which may vary faster than the motion, before they are filtered."""

AIM_REACH = (0.02, 0.9)
AIM_SLOWEST_PACE = 6.0
"""`REACH` and `SLOWEST_PACE` of a design for an effect, which may need small, slow or single-joint moves."""

STEPS, AIM_STEPS = (0.05, 0.2, 0.5), (0.01, 0.05, 0.2, 0.5)
"""Standard deviations of the changes of waypoints, over the range; the latter for an effect."""

BASE_WEIGHT = 0.05
"""Weight of the precision of the base parameters in a design for an effect."""

COLLISION_RATE = 1000.0
"""Sampling rate of distances between bodies, Hz."""

MOVE_SAMPLES = 100
"""Samples of the way of one move at which its distances are computed."""

TRIES = 30
"""Number of waypoints to draw until the move to one of them touches nothing."""

HOMES = 1000
"""Number of random postures among which the start is sought where that at zero touches something."""

MISS_UNIT = 0.01
"""Distance (m) missing to the clearance that counts as much as a torque of twice the limit."""


class Rank(NamedTuple):
    """Rank of a candidate, smaller is better: relative excess over the limits first, then mean log std."""

    violation: float
    cost: float


WORST = Rank(np.inf, np.inf)


def slow_share(robot: RobotConfig, qd: Array) -> Array:
    """Return the share (n,) of samples with a velocity below `SLOW` of its limit."""
    limit = SLOW * np.array([joint.limits.velocity for joint in robot.joints])
    result: Array = (np.abs(qd) < limit).mean(axis=0)
    return result


@dataclass(frozen=True)
class PointToPoint:
    """Candidate: waypoints (K, n), rad or m, and paces (K,), durations over the shortest possible ones."""

    points: Array
    paces: Array


class PointToPointSearch:
    """Search space of point-to-point trajectories, and the cost of a trajectory.

    ``sigma``: standard deviation (n,) of the torque noise; ``margin``: usable share of each limit; ``aim``: effects to
    make visible, ``None``: base parameters only. Raises ConfigError if no posture is free of collisions.
    """

    def __init__(
        self,
        robot: RobotConfig,
        model: ArmModel,
        duration: float,
        sigma: Array,
        margin: float,
        theta: ArrayLike | None,
        aim: EffectObjective | None,
        rng: np.random.Generator,
        collision: CollisionModel | None = None,
    ) -> None:
        limits = [joint.limits for joint in robot.joints]
        bounds = np.array([limit.position for limit in limits])
        middle, half = bounds.mean(axis=1), bounds[:, 1] - bounds.mean(axis=1)
        self.low, self.high = middle - margin * half, middle + margin * half
        self.velocity = margin * np.array([limit.velocity for limit in limits])
        self.acceleration = margin * np.array([limit.acceleration for limit in limits])
        self.torque = margin * np.array([limit.torque for limit in limits])
        self.collision = collision
        self.home = self._free_home(np.clip(0.0, self.low, self.high))
        self.model, self.duration, self.sigma, self.theta, self.rng = model, duration, sigma, theta, rng
        self.aim, self.anchored = aim, model if theta is None else model.anchored(theta)
        self.decimation = design(1.0 / (AIM_FACTOR * SEARCH_RATE), CUTOFF, AIM_FACTOR)

    def random(self) -> PointToPoint:
        """Return random waypoints within `REACH` of each other, as many as fit the duration; the last one is home."""
        time = self.duration / FEWEST_MOVES
        most = np.minimum(time * self.velocity / PEAK_VELOCITY, time**2 * self.acceleration / PEAK_ACCELERATION)
        reach = self.rng.uniform(*REACH) * (self.high - self.low) if self.aim is None else None
        points: list[Array] = []
        paces: list[float] = []
        here, left = self.home, self.duration
        while True:
            way = self._far() if reach is None else reach
            point = self._waypoint(here, np.minimum(way, most))
            pace = float(self._pace(1)[0])
            left -= pace * max(float(self._shortest((point - here)[None, :])[0]), SHORTEST_MOVE)
            if left < 0.0 and points:
                break
            points.append(point)
            paces.append(pace)
            here = point
        if len(points) == 1:
            points, paces = [*points, self.home], [1.0, 1.0]
        points[-1] = self.home
        return PointToPoint(np.array(points), np.array(paces))

    def _waypoint(self, here: Array, way: Array) -> Array:
        """Return a random waypoint (n,), if possible one that a straight move in joint space reaches freely."""
        for _ in range(TRIES):
            point: Array = np.clip(here + self.rng.uniform(-way, way), self.low, self.high)
            if self.collision is None:
                break
            if self.collision.shortfall(np.linspace(here, point, MOVE_SAMPLES)) == 0.0:
                break
        return point

    def _free_home(self, home: Array) -> Array:
        """Return the free posture (n,) nearest to ``home`` of some random ones; it depends on no seed."""
        collision = self.collision
        if collision is None or collision.shortfall(home[None]) == 0.0:
            return home
        postures = np.random.default_rng(0).uniform(self.low, self.high, (HOMES, home.size))
        far = np.linalg.norm((postures - home) / (self.high - self.low), axis=1)
        for posture in postures[np.argsort(far)]:
            if collision.shortfall(posture[None]) == 0.0:
                return np.asarray(np.round(posture, 4))
        closest = collision.closest(home[None])
        raise ConfigError(
            f"collision: none of {HOMES} postures keeps a clearance of {collision.clearance:g} m; at zero: {closest}. "
            "Check collision.radius, capsules and boxes"
        )

    def _far(self) -> Array:
        """Return the reach (n,) of one move, drawn for each joint, so that single joints may move alone."""
        share = np.exp(self.rng.uniform(np.log(AIM_REACH[0]), np.log(AIM_REACH[1]), self.low.size))
        far: Array = share * (self.high - self.low)
        return far

    def neighbour(self, candidate: PointToPoint) -> PointToPoint:
        """Return the candidate with a few coordinates changed."""
        points, paces = candidate.points.copy(), candidate.paces.copy()
        change = self.rng.random(points.shape) < self.rng.choice([0.03, 0.1, 0.3])
        sizes = STEPS if self.aim is None else AIM_STEPS
        step = self.rng.normal(0.0, self.rng.choice(sizes), points.shape) * (self.high - self.low)
        points = np.where(change, np.clip(points + step, self.low, self.high), points)
        points[-1] = self.home
        change_pace = self.rng.random(paces.shape) < 0.1
        return PointToPoint(points, np.where(change_pace, self._pace(paces.size), paces))

    def trajectory(self, candidate: PointToPoint) -> Trajectory:
        """Return the trajectory of a candidate; durations are whole milliseconds with the given sum."""
        durations = self._durations(candidate)
        ends = np.round(np.cumsum(durations), 3)
        ends[-1] = round(self.duration, 3)
        times = np.diff(ends, prepend=0.0)
        moves = tuple(
            Move(to=tuple(float(f"{v:.4f}") for v in point), duration=float(f"{time:.3f}"))
            for point, time in zip(candidate.points, times, strict=True)
        )
        return Trajectory(schema="armident/trajectory/1", start=tuple(float(v) for v in self.home), moves=moves)

    def rank(self, candidate: PointToPoint, best: Rank) -> Rank:
        """Return the rank of a candidate; distances are computed only if it can beat ``best``."""
        durations = self._durations(candidate)
        lengths = np.diff(np.vstack([self.home, candidate.points]), axis=0)
        if (durations < np.maximum(self._shortest(lengths), SHORTEST_MOVE)).any():
            return WORST
        return self.trajectory_rank(self.trajectory(candidate), best)

    def trajectory_rank(self, trajectory: Trajectory, best: Rank) -> Rank:
        """Return the rank of a trajectory within the limits of motion; ``best`` as for `rank`."""
        factor = 1 if self.aim is None else AIM_FACTOR
        period = 1.0 / (factor * SEARCH_RATE)
        q, qd, qdd = sample_trajectory(trajectory, period)
        violation = 0.0
        if self.theta is not None:
            torque = np.abs(predicted_torque(self.model, self.theta, q, qd, qdd, period))
            violation = max(0.0, float((torque / self.torque).max()) - 1.0)
        if violation > best.violation:
            return Rank(violation, np.inf)
        cost = self._cost(q, qd, qdd, period)
        if self.collision is None or (violation, cost) >= best:
            return Rank(violation, cost)
        missing = self.collision.shortfall(trajectory.sample(1.0 / COLLISION_RATE))
        return Rank(violation + missing / MISS_UNIT, cost)

    def _cost(self, q: Array, qd: Array, qdd: Array, period: float) -> float:
        """Return the mean log standard deviation with penalties for conditioning and slowness; infinite if singular."""
        if self.aim is None:
            x = weighted_rows(self.model.base_regressor(q, qd, qdd, dt=period), self.sigma)
            return self._base_cost(x, qd, slow=True)
        motion = self.anchored.motion(q, qd, qdd, period)
        x, decimation, sigma = equations_of(self.anchored, motion, self.decimation, self.sigma)
        base = self._base_cost(x, qd, slow=False)
        return base if np.isinf(base) else self.aim.cost(motion, x, decimation, sigma) + BASE_WEIGHT * base

    def _base_cost(self, x: Array, qd: Array, *, slow: bool) -> float:
        """Return the cost of the base parameters from their weighted regressor (R, b)."""
        eigenvalues = np.linalg.eigvalsh(x.T @ x)
        if not eigenvalues[0] > 0.0:
            return np.inf
        condition = np.sqrt(eigenvalues[-1] / eigenvalues[0])
        slowness = np.maximum(0.0, slow_share(self.model.robot, qd) - SLOW_SHARE).sum() if slow else 0.0
        return float(-0.5 * np.log(eigenvalues).mean() + max(0.0, np.log(condition / CONDITION)) + slowness)

    def _pace(self, count: int) -> Array:
        """Return paces (count,): uniform, or log-uniform in a design for an effect."""
        if self.aim is None:
            return self.rng.uniform(1.0, SLOWEST_PACE, count)
        return np.exp(self.rng.uniform(0.0, np.log(AIM_SLOWEST_PACE), count))

    def _durations(self, candidate: PointToPoint) -> Array:
        lengths = np.diff(np.vstack([self.home, candidate.points]), axis=0)
        wanted = np.maximum(self._shortest(lengths), SHORTEST_MOVE) * candidate.paces
        result: Array = wanted * self.duration / wanted.sum()
        return result

    def _shortest(self, lengths: Array) -> Array:
        by_velocity = np.abs(lengths) * PEAK_VELOCITY / self.velocity
        by_acceleration = np.sqrt(np.abs(lengths) * PEAK_ACCELERATION / self.acceleration)
        result: Array = np.maximum(by_velocity, by_acceleration).max(axis=1)
        return result


def equations_of(
    model: ArmModel, motion: Motion, decimation: Decimation, sigma: Array
) -> tuple[Array, Decimation, Array]:
    """Return the arguments of `EffectObjective.cost`: weighted base regressor (R, b), decimation and noise."""
    kept = decimation.instants(motion.samples)
    x = model.rigid_regressor(motion.q[kept], motion.qd[kept], motion.qdd[kept])
    if model.terms:
        x = np.concatenate([x, decimation(model.term_regressor(motion))], axis=2)
    return weighted_rows(x, sigma), decimation, sigma


def predicted_torque(model: ArmModel, theta: ArrayLike, q: Array, qd: Array, qdd: Array, period: float) -> Array:
    """Return the joint torques along a motion with those of the model's terms, (N, n), N m or N."""
    torque = model.inverse_dynamics(theta, q, qd, qdd)
    if model.terms:
        torque += model.term_torque(model.anchored(theta).motion(q, qd, qdd, period), np.asarray(theta)[-model.e :])
    return torque


def torque_deviation(model: ArmModel, covariance: Array, q: Array, qd: Array, qdd: Array, period: float) -> Array:
    """Return standard deviations (N, n) of predicted torques, N m or N; ``covariance`` (b, b) of the parameters."""
    x = model.base_regressor(q, qd, qdd, dt=period)
    result: Array = np.sqrt(np.maximum(np.einsum("kjb,kjb->kj", x @ covariance, x), 0.0))
    return result


def sample_trajectory(trajectory: Trajectory, period: float) -> tuple[Array, Array, Array]:
    """Return positions, velocities and accelerations (N, n) along a trajectory by finite differences."""
    q = trajectory.sample(period)
    qd = np.gradient(q, period, axis=0)
    return q, qd, np.gradient(qd, period, axis=0)
