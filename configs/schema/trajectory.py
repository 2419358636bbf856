"""Schema of a trajectory: point-to-point moves with smoothed trapezoidal velocities (B.4), or Fourier series."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from armident.arrays import Array
from armident.configs.errors import ConfigError
from armident.configs.schema.base import FrozenModel
from armident.configs.schema.robot import RobotConfig

RAMP_SHARE = 0.4
"""Usual share of a move's duration spent accelerating, and again decelerating; the rest is at constant speed."""

SHORTEST_S = 1e-6
"""Shortest move, s; no drive takes positions as fast."""

LONGEST_S = 3600.0
"""Longest trajectory, s; its set points are kept in memory while it is played."""

REST_TOLERANCE = 1e-4
"""Largest initial velocity and acceleration of a Fourier series, relative to those of its harmonics."""


class Move(FrozenModel):
    """Synchronous point-to-point move of all joints.

    Parameters
    ----------
    to
        Target, rad or m, length n.
    duration
        Duration of the move, s; at least `SHORTEST_S`.
    dwell
        Time at rest after the move, s.
    ramp
        Share of the duration spent accelerating, and again decelerating; the rest is at constant speed.
    """

    to: tuple[float, ...]
    duration: Annotated[float, Field(ge=SHORTEST_S)]
    dwell: Annotated[float, Field(ge=0)] = 0.0
    ramp: Annotated[float, Field(gt=0, le=0.5)] = RAMP_SHARE


class Fourier(FrozenModel):
    """Finite Fourier series, periodic and smooth (Swevers et al. 1997).

    ``q(t) = start + sum over l of sine[l-1] sin(l w t) + cosine[l-1] (cos(l w t) - 1)``, ``w = 2 pi frequency``.

    Parameters
    ----------
    frequency
        Frequency of the first harmonic, Hz.
    sine, cosine
        Coefficients (rad or m), one row per harmonic, one column per joint. ``sum l sine_l`` and ``sum l^2 cosine_l``
        are zero: the motion begins and ends at rest.
    periods
        Number of periods.
    """

    frequency: Annotated[float, Field(gt=0)]
    sine: Annotated[tuple[tuple[float, ...], ...], Field(min_length=1)]
    cosine: Annotated[tuple[tuple[float, ...], ...], Field(min_length=1)]
    periods: Annotated[int, Field(ge=1)] = 1

    @model_validator(mode="after")
    def _at_rest(self) -> Self:
        if len(self.sine) != len(self.cosine):
            raise ValueError(f"fourier: {len(self.sine)} rows of sine, {len(self.cosine)} of cosine")
        if len({len(row) for row in self.sine + self.cosine}) != 1:
            raise ValueError("fourier: rows of sine and cosine have one number per joint")
        order = np.arange(1.0, len(self.sine) + 1)
        for name, rows, weight in (("sine", self.sine, order), ("cosine", self.cosine, order**2)):
            terms = weight[:, None] * np.array(rows)
            if (np.abs(terms.sum(axis=0)) > REST_TOLERANCE * np.abs(terms).sum(axis=0) + 1e-12).any():
                power = "l" if name == "sine" else "l^2"
                raise ValueError(f"fourier: the sum of {power} {name}_l is not zero: it would not begin at rest")
        return self

    def sample(self, t: Array) -> Array:
        """Displacement from the start.

        Parameters
        ----------
        t
            Times, s, shape (N,).

        Returns
        -------
        ndarray
            Displacement, rad or m, shape (N, n).
        """
        angle = 2 * np.pi * self.frequency * t[:, None] * np.arange(1.0, len(self.sine) + 1)
        away: Array = np.sin(angle) @ np.array(self.sine) + (np.cos(angle) - 1.0) @ np.array(self.cosine)
        return away


class Trajectory(FrozenModel):
    """Reference trajectory: either a sequence of synchronous point-to-point moves or a Fourier series.

    Parameters
    ----------
    schema_
        Key ``schema``: version of the file format.
    start
        Start position, rad or m, length n.
    moves
        Moves, one after the other.
    fourier
        Fourier series in place of moves.
    """

    schema_: Literal["armident/trajectory/1"] = Field(alias="schema")
    start: tuple[float, ...]
    moves: tuple[Move, ...] = ()
    fourier: Fourier | None = None

    @model_validator(mode="after")
    def _same_length(self) -> Self:
        if bool(self.moves) == (self.fourier is not None):
            raise ValueError("expected either moves or fourier")
        if not self.duration <= LONGEST_S:
            raise ValueError(f"takes {self.duration:.6g} s; expected at most {LONGEST_S:g}, a session can repeat it")
        if self.fourier is not None and len(self.fourier.sine[0]) != len(self.start):
            raise ValueError(f"fourier: expected rows of {len(self.start)} numbers")
        for k, move in enumerate(self.moves):
            if len(move.to) != len(self.start):
                raise ValueError(f"moves[{k}].to: expected {len(self.start)} numbers")
        return self

    @property
    def duration(self) -> float:
        """Duration of the whole trajectory, s."""
        if self.fourier is not None:
            return self.fourier.periods / self.fourier.frequency
        return sum(move.duration + move.dwell for move in self.moves)

    def sample(self, period: float) -> Array:
        """Positions at ``0, period, 2 period, ...`` up to the end.

        Parameters
        ----------
        period
            Sampling period, s.

        Returns
        -------
        ndarray
            Positions, rad or m, shape (N, n).
        """
        t: Array = np.arange(round(self.duration / period) + 1, dtype=np.float64) * period
        if self.fourier is not None:
            return np.array(self.start) + self.fourier.sample(t)
        q = np.empty((t.size, len(self.start)))
        origin, begin = np.array(self.start), 0.0
        for move in self.moves:
            target = np.array(move.to)
            inside = t >= begin - 1e-12
            q[inside] = origin + _smooth_step((t[inside] - begin) / move.duration, move.ramp)[:, None] * (
                target - origin
            )
            origin, begin = target, begin + move.duration + move.dwell
        return q

    def check(self, robot: RobotConfig, where: str = "trajectory") -> None:
        """Refuse a trajectory that exceeds the limits of the robot.

        Parameters
        ----------
        robot
            Robot with limits of position, velocity and acceleration.
        where
            Name of the trajectory in messages.

        Raises
        ------
        ConfigError
            If a limit is exceeded or not known; names joint, limit and value.
        """
        period = 1e-3
        check_motion(self.sample(period), period, robot, where)


def check_motion(q: Array, period: float, robot: RobotConfig, where: str) -> None:
    """Refuse sampled positions that exceed the limits of a robot.

    Parameters
    ----------
    q
        Positions, rad or m, shape (N, n).
    period
        Sampling period, s.
    robot
        Robot with limits of position, velocity and acceleration.
    where
        Name of the motion in messages.

    Raises
    ------
    ConfigError
        If a limit is exceeded or not known; names joint, limit and value.
    """
    robot.check_movable(where)
    if q.shape[1] != robot.n:
        raise ConfigError(f"{where}: {q.shape[1]} joints, but {robot.name} has {robot.n}")
    with np.errstate(over="ignore", invalid="ignore"):  # such a motion is refused below
        qd = np.diff(q, axis=0) / period
        qdd = np.diff(qd, axis=0) / period
    for j, joint in enumerate(robot.joints):
        low, high = joint.limits.position
        if q[:, j].min() < low or q[:, j].max() > high:
            raise ConfigError(
                f"{where}: {joint.name} moves over [{q[:, j].min():.3f}, {q[:, j].max():.3f}], "
                f"allowed is [{low:.3f}, {high:.3f}]"
            )
        for label, values, limit in (
            ("velocity", qd[:, j], joint.limits.velocity),
            ("acceleration", qdd[:, j], joint.limits.acceleration),
        ):
            peak = float(np.abs(values).max(initial=0.0))
            if not np.isfinite(peak) or peak > limit * (1 + 1e-6):
                raise ConfigError(f"{where}: {joint.name} reaches {label} {peak:.3f}, allowed is {limit:.3f}")


def _smooth_step(s: Array, a: float) -> Array:
    """Step from 0 to 1 for ``s`` in [0, 1]; the ramps of its trapezoidal velocity are half cosines of length ``a``."""
    v = 1.0 / (1.0 - a)
    s = np.clip(s, 0.0, 1.0)
    rising = v * (s / 2 - a / (2 * np.pi) * np.sin(np.pi * s / a))
    falling = 1.0 - v * ((1 - s) / 2 - a / (2 * np.pi) * np.sin(np.pi * (1 - s) / a))
    level = v * (s - a / 2)
    step: Array = np.where(s < a, rising, np.where(s > 1 - a, falling, level))
    return step
