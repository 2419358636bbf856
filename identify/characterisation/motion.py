"""One joint that moves alone: its signals, and the stretches of constant speed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.identify.effects.free_shapes import hats
from armident.identify.identification.equations import aligned_torque
from armident.identify.signals.differentiate import differentiate
from armident.identify.signals.experiments import Experiment

WINDOW_S = 0.05
"""Time over which a speed is averaged, s: a position known to 0.01 mrad gives it to 0.3 mrad/s."""
CONSTANT = 0.01
"""Relative change of a constant speed within `WINDOW_S`, and of the speeds of a pair: 1 % of viscous friction."""
RESTING = 1e-3
"""Speed of a resting joint over its limit, or over the joint's own top speed where it has none."""
SHORTEST_S = 0.1
"""Shortest stretch of constant speed, s: two independent speeds."""
SLOWEST = 1e-3
"""Slowest speed over the joint's top speed: below it the joint counts as resting."""
KNOTS = (0.0, 0.01, 0.03, 0.1)
"""Speeds over the top speed between which dry friction is linear; above them it is constant."""


@dataclass(frozen=True, eq=False)
class Alone:
    """Signals (N,) of a joint in one experiment; SI, joint side. ``alone``: True where all other joints rest.

    ``speed``: mean speed over `WINDOW_S` of the reference, or of the position where there is none.
    """

    q: Array
    qd: Array
    qdd: Array
    tau: Array
    speed: Array
    alone: NDArray[np.bool_]
    dt: float
    revolute: bool

    def rigid(self) -> Array:
        """Return acceleration, offset and gravity per unit of their parameters, (N, 2) or (N, 4).

        A serial arm whose other joints rest: inertia is constant, and gravity turns with a revolute joint.
        """
        columns = [self.qdd, np.ones(self.q.size)]
        if self.revolute:
            columns += [np.cos(self.q), np.sin(self.q)]
        return np.stack(columns, axis=1)

    @property
    def turns(self) -> NDArray[np.bool_]:
        """Mask (N,) of the samples at which the mean speed has changed its sign."""
        return np.append(False, self.speed[1:] * self.speed[:-1] < 0.0)

    @property
    def travel(self) -> Array:
        """Distance since the last reversal, (N,), rad or m."""
        turned = np.maximum.accumulate(np.where(self.turns, np.arange(self.q.size), 0))
        return np.asarray(np.abs(self.q - self.q[turned]))

    def block(self, rate_hz: float) -> int:
        """Return the samples of one block mean."""
        return max(round(1.0 / (rate_hz * self.dt)), 1)

    def friction(self, top: float) -> Array:
        """Return dry friction per unit of that at each of `KNOTS`, (N, k); ``top``: top speed, rad/s or m/s."""
        return hats(np.abs(self.qd), top * np.array(KNOTS))


@dataclass(frozen=True, eq=False)
class Plateau:
    """Rows of an experiment in which the joint moves at a constant speed, rad/s or m/s; negative backwards."""

    motion: Alone
    rows: NDArray[np.intp]
    speed: float


def alone(experiments: Sequence[Experiment], robot: RobotConfig, joint: int) -> list[Alone]:
    """Return the signals of a joint."""
    found = []
    limits = np.array([each.limits.velocity for each in robot.joints])
    for e in experiments:
        signals = differentiate(e.q[:, [joint]], e.dt)
        speeds = _mean_speed(e.q if e.q_ref is None else e.q_ref, e.dt)
        least = RESTING * np.where(np.isfinite(limits), limits, np.abs(speeds[:, joint]).max())
        others = np.asarray(np.delete(np.abs(speeds) <= least, joint, axis=1).all(axis=1))
        revolute = robot.joints[joint].type == "revolute"
        found.append(
            Alone(
                signals.q[:, 0],
                signals.qd[:, 0],
                signals.qdd[:, 0],
                aligned_torque(e.tau, e.torque_shift)[:, joint],
                speeds[:, joint],
                others,
                e.dt,
                revolute,
            )
        )
    return found


def plateaus(motions: Sequence[Alone]) -> list[tuple[Plateau, ...]]:
    """Return the stretches of constant speed, slowest first: pairs at one speed over the same positions, and others."""
    found: list[tuple[Plateau, ...]] = []
    for one in motions:
        width, v = _width(one.dt), one.speed
        change = maximum_filter1d(v, width) - minimum_filter1d(v, width)
        steady = one.alone & (change <= CONSTANT * np.abs(v)) & (np.abs(v) > SLOWEST * np.abs(v).max())
        rows = np.flatnonzero(steady)
        runs = np.split(rows, np.flatnonzero((np.diff(rows) > 1) | (np.diff(np.sign(v[rows])) != 0)) + 1)
        found += _paired(
            [
                Plateau(one, run, float(v[run].mean()))
                for run in runs
                if _long(run, one) and np.ptp(v[run]) <= CONSTANT * np.abs(v[run]).min()
            ]
        )
    return sorted(found, key=lambda group: abs(group[0].speed))


def _paired(left: list[Plateau]) -> list[tuple[Plateau, ...]]:
    """Return the plateaus of an experiment in pairs where there are two, each at the positions of both."""
    out: list[tuple[Plateau, ...]] = []
    while left:
        one = left.pop(0)
        pair: tuple[Plateau, ...] = (one,)
        for other in left:
            if abs(one.speed + other.speed) <= CONSTANT * abs(one.speed):
                both = [one.motion.q[each.rows] for each in (one, other)]
                low, high = max(float(q.min()) for q in both), min(float(q.max()) for q in both)
                kept = [each.rows[(q >= low) & (q <= high)] for each, q in zip((one, other), both, strict=True)]
                if all(_long(rows, one.motion) for rows in kept):
                    left.remove(other)
                    pair = Plateau(one.motion, kept[0], one.speed), Plateau(one.motion, kept[1], other.speed)
                    break
        out.append(pair)
    return out


def _long(rows: NDArray[np.intp], motion: Alone) -> bool:
    return rows.size * motion.dt >= SHORTEST_S


def _mean_speed(q: Array, dt: float) -> Array:
    """Return mean speeds (N, n) over `WINDOW_S` about each sample; at the ends those of the nearest whole window."""
    width = _width(dt)
    if q.shape[0] <= width:
        return np.zeros_like(q)
    inner = (q[width:] - q[:-width]) / (width * dt)
    return np.pad(inner, ((width // 2, width - width // 2), (0, 0)), mode="edge")


def _width(dt: float) -> int:
    return max(round(WINDOW_S / dt), 2)
