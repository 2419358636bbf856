"""Equations of the rigid arm for any assignment and scale of the signals, at a rate that suits the motion."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import DataError, RobotConfig
from armident.identify.robot.arm import ArmModel
from armident.identify.setup.torque_equations import ODD, Columns, Rows, columns_of, friction_terms, make_room
from armident.identify.signals.bandwidth import motion_bandwidth
from armident.identify.signals.decimate import Decimation, design
from armident.identify.signals.experiments import Experiment

CUTOFF = 2.0
"""Cut-off of the equations in closed-loop bandwidths (thesis 2.3.1: ``w_Fp >= 2 w_dyn``)."""

WORKING_RATE = 8.0
"""Rate of the derivatives over the cut-off: central differences then err by 0.5 % at a fifth of the cut-off."""

MOST_ROWS = 600
"""Largest number of instants: 600 of each joint determine the 130 parameters of seven joints."""

LEAST_ROWS = 40
"""Least number of instants for any comparison."""

LEAST_SAMPLES = 200
"""Least number of samples: ten per period of twenty periods of a motion."""

AT_REST = 0.05
"""Share of a joint's largest velocity below which it counts as at rest: the motion does not determine its dry friction
there, nor the torque that holds it."""

LEAST_MOVING = 0.1
"""Least share of the instants at which all joints move, for only those to be used."""

MOST_KEPT = 128
"""Largest number of assignments of positions whose normal equations are kept, 0.4 MB each for seven joints: a step of
the search that changes torques alone needs those of the step before."""

GENERIC = np.array([3.1, -5.3, -7.6])
"""Direction of gravity, m/s^2, without any symmetry: its base parameters serve for every direction."""


@dataclass(frozen=True)
class Segment:
    """Signals (W, n) of one experiment at the working rate: rad or m, s, N m or N; ``begin``: time of the first, s."""

    q: Array
    qd: Array
    qdd: Array
    tau: Array
    dt: float
    q_ref: Array | None = None
    begin: float = 0.0
    experiment: int = 0


@dataclass(eq=False)
class Bench:
    """Signals of a set of recordings, and a cache of their equations.

    ``model``: with base parameters for gravity in any direction. ``moving`` (n,): joints that move. ``period``: of the
    recordings, s; ``bandwidth``: of the motion, Hz. ``rows_kept``: largest number of instants. ``at_rest``: equations
    at all instants instead of those at which all joints move. ``shifts``: those of the torques that were estimated.
    """

    model: ArmModel
    robot: RobotConfig
    segments: tuple[Segment, ...]
    decimation: Decimation
    moving: NDArray[np.bool_]
    period: float
    bandwidth: float
    rows_kept: int = MOST_ROWS
    at_rest: bool = False
    shifts: dict[bytes, Any] = field(default_factory=dict, repr=False)
    _rows: dict[bytes, Rows] = field(default_factory=dict, repr=False)
    _torques: dict[bytes, tuple[Array, Array]] = field(default_factory=dict, repr=False)
    _models: dict[bytes, ArmModel] = field(default_factory=dict, repr=False)
    _regressors: dict[bytes, Array] = field(default_factory=dict, repr=False)

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.model.n

    @cached_property
    def instants_used(self) -> tuple[NDArray[np.int64], ...]:
        """Instants of the equations in each segment, at most `rows_kept`; all where the joints seldom move at once."""
        moves = [
            np.all(np.abs(self.decimation(s.qd))[:, self.moving] > AT_REST * self._fastest[self.moving], axis=1)
            for s in self.segments
        ]
        moving, every = (sum(count) for count in zip(*((int(m.sum()), m.size) for m in moves), strict=True))
        if self.at_rest or moving < max(2 * LEAST_ROWS, LEAST_MOVING * every):
            moves = [np.ones_like(m) for m in moves]
        stride = max(1, -(-sum(int(m.sum()) for m in moves) // self.rows_kept))
        return tuple(np.flatnonzero(m)[::stride] for m in moves)

    def times(self) -> tuple[NDArray[np.int64], Array]:
        """Number of the experiment, and time since its recording began, s, of every instant of the rows, (M,) each."""
        parts = [
            (np.full(kept.size, s.experiment), s.begin + self.decimation.instants(s.q.shape[0])[kept] * s.dt)
            for s, kept in zip(self.segments, self.instants_used, strict=True)
        ]
        return np.concatenate([number for number, _ in parts]), np.concatenate([time for _, time in parts])

    @property
    def _fastest(self) -> Array:
        """Largest recorded velocities, (n,), rad/s or m/s."""
        return np.asarray(np.max([np.abs(s.qd).max(axis=0) for s in self.segments], axis=0))

    @property
    def rigid(self) -> int:
        """Number of base parameters: the first columns of the regressors."""
        return self.model.base.b

    @cached_property
    def recorded(self) -> tuple[Array, Array, Array]:
        """Recorded positions, velocities and torques after filtering, at all instants, (W, n) each."""
        q, qd, tau = (
            np.concatenate([self.decimation(getattr(s, x)) for s in self.segments]) for x in ("q", "qd", "tau")
        )
        return q, qd, tau

    @cached_property
    def limits(self) -> Array:
        """Largest configured positions, velocities and torques, (3, n)."""
        limits = [joint.limits for joint in self.robot.joints]
        return np.array([[max(map(abs, one.position)), one.velocity, one.torque] for one in limits], np.float64).T

    @cached_property
    def peaks(self) -> Array:
        """Largest magnitudes of the recorded positions, velocities and torques after filtering, (3, n)."""
        return np.array([np.abs(x).max(axis=0) for x in self.recorded])

    def under(self, gravity: Array) -> ArmModel:
        """Return the model under a gravity (3,), m/s^2."""
        key = gravity.tobytes()
        if key not in self._models:
            make_room(self._models, MOST_KEPT)
            self._models[key] = self.model.with_gravity(gravity)
        return self._models[key]

    @cached_property
    def columns(self) -> Columns:
        """Structure of the equations."""
        return columns_of(self.model)

    def coarse(self, rows: int) -> "Bench":
        """Return the same signals with fewer instants. ``rows``: largest number of instants."""
        return self._with(rows, self.at_rest)

    @cached_property
    def everywhere(self) -> "Bench":
        """The same signals with equations at all instants, also at those at which a joint is at rest."""
        return self._with(self.rows_kept, True)

    def moved(self, offsets: Array) -> "Bench":
        """Return the bench with other zeros of the positions. ``offsets`` (n,): true less recorded ones, rad or m."""
        segments = tuple(
            replace(s, q=s.q + offsets, q_ref=None if s.q_ref is None else s.q_ref + offsets) for s in self.segments
        )
        return replace(self, segments=segments, _rows={}, _torques={}, _models={}, _regressors={})

    def slopes(self, position: Array, gravity: Array, values: Array, step: float) -> Array:
        """Torques (n, n, M) by each joint's position, per rad or m, under ``gravity`` (3,): joint moved, joint, row.

        ``values`` (c,): parameters. ``step``: half the difference of positions, rad or m.
        """
        q, qd, qdd = (x @ position.T for x in self._motion)
        model, base = self.under(gravity), values[: self.rigid]
        ends = [
            [(model.rigid_regressor(q + sign * offset, qd, qdd) @ base).T for sign in (1.0, -1.0)]
            for offset in step * np.eye(self.n)
        ]
        return np.stack([(plus - minus) / (2.0 * step) for plus, minus in ends])

    def _with(self, rows: int, at_rest: bool) -> "Bench":
        signals = (self.model, self.robot, self.segments, self.decimation, self.moving, self.period, self.bandwidth)
        return Bench(*signals, rows, at_rest)

    def column(self, name: str) -> int:
        """Column of a standard parameter that is a base parameter, possibly with others regrouped into it."""
        return self.columns.named[name]

    @cached_property
    def _motion(self) -> tuple[Array, Array, Array]:
        """Recorded positions, velocities and accelerations at the instants of the rows, (M, n) each."""
        q, qd, qdd = (self.kept([getattr(s, x) for s in self.segments]) for x in ("q", "qd", "qdd"))
        return q, qd, qdd

    def torque(self, shift: Array) -> Array:
        """Recorded torques (M, n) at the instants of the rows, moved earlier by ``shift`` (n,), s."""
        return self._torque(shift)[0]

    def power(self, shift: Array) -> Array:
        """Power (n,) of these torques."""
        return self._torque(shift)[1]

    def _torque(self, shift: Array) -> tuple[Array, Array]:
        key = np.round(shift, 9).tobytes()
        if key not in self._torques:
            make_room(self._torques, MOST_KEPT)
            torque = self.kept([_shifted(s.tau, shift / s.dt) for s in self.segments])
            self._torques[key] = torque, np.maximum((torque**2).sum(axis=0), 1e-300)
        return self._torques[key]

    def rows(self, position: Array) -> Rows:
        """Equations with the joint positions ``position @ q_recorded``: signs, permutation and scale, (n, n)."""
        key = np.round(position, 9).tobytes()
        if key not in self._rows:
            make_room(self._rows, MOST_KEPT)
            q, qd, qdd = (x @ position.T for x in self._motion)
            self._rows[key] = Rows(
                self.columns, self.under, self.moving, q, qd, qdd, self._friction_of(position), key, self._regressors
            )
        return self._rows[key]

    def kept(self, signals: Sequence[Array]) -> Array:
        """Signals (W, ...) of each segment at the instants of the rows, filtered, (M, ...)."""
        pairs = zip(signals, self.instants_used, strict=True)
        return np.concatenate([self.decimation(x)[instants] for x, instants in pairs])

    def _friction_of(self, position: Array) -> Array:
        """Friction terms (M, n, 4) of positions ``position @ q_recorded``; a sign turns the odd ones."""
        taken = np.abs(position).argmax(axis=1)
        if np.count_nonzero(position) == self.n and np.unique(taken).size == self.n:
            signs = np.sign(position[np.arange(self.n), taken])
            return np.asarray(self._recorded_friction[:, taken] * np.where(ODD, signs[:, None], 1.0))
        top = np.maximum(np.max([np.abs(s.qd @ position.T).max(axis=0) for s in self.segments], axis=0), 1e-12)
        return self.kept([friction_terms(s.qd @ position.T, top) for s in self.segments])

    @cached_property
    def _recorded_friction(self) -> Array:
        top = np.maximum(self._fastest, 1e-12)
        return self.kept([friction_terms(s.qd, top) for s in self.segments])


def make_bench(
    experiments: Sequence[Experiment],
    robot: RobotConfig,
    moving: NDArray[np.bool_],
    working_rate: float = WORKING_RATE,
    known: Bench | None = None,
) -> Bench:
    """Filter and differentiate recordings of one rate (SI, joint side); ``known``: another bench of arm and motion."""
    dt = experiments[0].dt
    bandwidth = motion_bandwidth([e.q for e in experiments], dt) if known is None else known.bandwidth
    cutoff = min(CUTOFF * bandwidth, 0.45 / dt)
    first_factor = max(1, int(1.0 / (dt * working_rate * cutoff)))
    working = dt * first_factor
    first = design(dt, 0.4 / working, first_factor) if first_factor > 1 else design(dt, 0.5 / dt, 1)
    second = design(working, cutoff, max(1, int(0.5 / (working * cutoff) + 1e-9)))
    segments = []
    for number, e in enumerate(experiments):
        if second.count(first.count(e.q.shape[0])) < 4:
            continue
        q = first(e.q)
        qd = np.gradient(q, working, axis=0)
        qdd = np.gradient(qd, working, axis=0)
        q_ref = None if e.q_ref is None else first(e.q_ref)
        segments.append(
            Segment(
                q,
                qd,
                qdd,
                first(_shifted(e.tau, np.full(robot.n, e.torque_shift - 0.5))),
                working,
                q_ref,
                e.start + first.margin * dt,
                number,
            )
        )
    count = sum(second.count(s.q.shape[0]) for s in segments)
    samples = sum(e.q.shape[0] for e in experiments)
    if count < LEAST_ROWS or samples < LEAST_SAMPLES:
        raise DataError(
            f"the recordings are too short for a check of the set-up: {samples} samples, {count} after filtering; "
            f"at least {LEAST_SAMPLES} and {LEAST_ROWS} are needed: record longer"
        )
    if known is None:
        model = ArmModel.from_config(robot.model_copy(update={"gravity": tuple(GENERIC), "effects": ()}))
    else:
        model = known.model
    return Bench(model, robot, tuple(segments), second, moving, dt, bandwidth)


def _shifted(x: Array, samples: Array) -> Array:
    """Signals (N, n) moved to earlier times by numbers of samples (n,), linearly interpolated."""
    if not samples.any():
        return x
    t = np.arange(x.shape[0], dtype=np.float64)
    return np.stack([np.interp(t + s, t, column) for s, column in zip(samples, x.T, strict=True)], axis=1)
