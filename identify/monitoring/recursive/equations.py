"""Filtered and decimated equations of the stream, in pieces of fixed length: as the batch method makes them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import DataError
from armident.identify.identification.equations import LS_CUTOFF
from armident.identify.identification.torque_delay import HELD
from armident.identify.monitoring.recursive.kernels import first_order_lag, low_pass
from armident.identify.monitoring.recursive.settings import RecursiveSettings
from armident.identify.robot.arm import ArmModel
from armident.identify.signals.decimate import design
from armident.identify.signals.live import VelocityFilter

ROWS = 8
"""Decimated rows per piece of the stream."""
SLOWEST_LAG_S = 0.5
"""Upper limit of the lag of a drive behind its reference, s: a position loop with a gain of 2 1/s, where drives have 5
and more. It bounds the first estimates, of few samples."""
SHORTEST_RATE = 10.0
"""Least sampling rate, in closed-loop bandwidths (thesis section 2.3.1)."""
EARLIER = 2
"""Rows kept before those that are computed: a torque may lead its position by up to so many samples."""


@dataclass(frozen=True)
class Instant:
    """Equations of all joints at one decimated instant; ``moving`` (n,): share of the low-pass window.

    ``x``, ``z`` (n, b): regressor, measured and predicted by the reference; ``y`` (n,): torques, N m or N.
    """

    x: Array
    z: Array
    y: Array
    moving: Array


class StreamEquations:
    """Turns rows of the stream into equations; a gap starts the filters anew.

    Measured and reference positions pass the same live filter, whose delay all quantities get. A first-order lag behind
    the reference is estimated per joint; without a reference the regressor is the instrument. ``lead``: torque k
    belongs to ``k + lead`` samples, 0.5 if held. Raises DataError if the rate is too low.
    """

    _saved = (
        "live", "planned", "piece", "count", "next_sync", "settled", "history", "seen", "done", "rows",
        "lag_state", "lag_sums", "instants", "restarts",
    )  # fmt: skip

    def __init__(
        self,
        model: ArmModel,
        dt: float,
        bandwidth_hz: float,
        with_reference: bool,
        settings: RecursiveSettings,
        take: Callable[[Instant], None],
        lead: float = HELD,
    ) -> None:
        if 1.0 / dt < SHORTEST_RATE * bandwidth_hz:
            raise DataError(f"{1.0 / dt:.4g} samples/s are too few for a bandwidth of {bandwidth_hz:.4g} Hz")
        n, b = model.n, model.base.b
        self._model, self._dt, self._take = model, dt, take
        self.with_reference = with_reference
        self.decimation = design(dt, LS_CUTOFF * bandwidth_hz)
        self._settings = settings
        band = min(settings.velocity_band * bandwidth_hz, settings.highest_band / dt)
        nvr = (2 * np.pi * band * dt) ** 6
        self.live, self.planned = VelocityFilter(n, dt, nvr), VelocityFilter(n, dt, nvr)
        self.delay = acceleration_delay(nvr)
        self._lead = lead
        self._slow = slow_velocity(model, settings)
        self._kept = _present_columns(model)
        self.piece = np.zeros((ROWS * self.decimation.factor, (3 if with_reference else 2) * n))
        open_rows = -(-self.decimation.taps.size // self.decimation.factor) + ROWS + 1
        width = self._kept.size * (2 if with_reference else 1) + 2 * n
        self.rows = np.zeros((open_rows, width))
        self.history = np.zeros((EARLIER + int(self.delay) + 1, (7 if with_reference else 4) * n))
        self._shape = (n, b)
        self.lag_sums = np.zeros((2, n))
        self.instants, self.restarts = 0, 0
        self.restart()

    def restart(self) -> None:
        """Start the filters anew, after a gap."""
        n = self._model.n
        self.live.reset()
        self.planned.reset()
        self.count, self.next_sync, self.settled, self.seen, self.done = 0, -1, 0, 0, 0
        self.rows[:] = 0.0
        self.lag_state = np.zeros((3, n))

    @property
    def rate_hz(self) -> float:
        """Rate of the equations, 1/s."""
        return 1.0 / (self._dt * self.decimation.factor)

    @property
    def lag_s(self) -> Array:
        """Lag (n,) of each joint behind its reference, s."""
        error, speed = self.lag_sums
        lag: Array = np.where(speed > 0, error / np.where(speed > 0, speed, 1.0), 0.0)
        return np.clip(lag, 0.0, SLOWEST_LAG_S)

    def add(self, sync: NDArray[np.int64], values: Array) -> None:
        """Take over SYNC numbers (N,) and values (N, w): position, torque, reference; compute complete pieces."""
        begin = 0
        if sync.size and int(sync[0]) != self.next_sync >= 0:
            self._cut()
        for cut in [*(np.flatnonzero(np.diff(sync) != 1) + 1).tolist(), sync.size]:
            self._add_even(values[begin:cut])
            if cut < sync.size:
                self._cut()
            begin = cut
        if sync.size:
            self.next_sync = int(sync[-1]) + 1

    def _cut(self) -> None:
        self.restarts += 1
        self.restart()

    def _add_even(self, values: Array) -> None:
        size = self.piece.shape[0]
        while values.shape[0]:
            fits = min(size - self.count, values.shape[0])
            self.piece[self.count : self.count + fits] = values[:fits]
            self.count += fits
            values = values[fits:]
            if self.count == size:
                self.count = 0
                self._compute()

    def _compute(self) -> None:
        """Compute a complete piece: the same arrays for every cutting of the stream into blocks."""
        n = self._model.n
        piece = self.piece
        q, tau = np.ascontiguousarray(piece[:, :n]), piece[:, n : 2 * n]
        measured = self.live.handle(q)
        parts = [q, measured.qd, tau]
        accelerations = [measured.qdd]
        if self.with_reference:
            q_ref = np.ascontiguousarray(piece[:, 2 * n :])
            planned = self.planned.handle(q_ref)
            self._estimate_lag(q_ref - q, measured.qd)
            lagged = (q_ref, planned.qd.copy(), planned.qdd.copy())
            share = -np.expm1(-self._dt / np.maximum(self.lag_s, 1e-3 * self._dt))
            for signal, state in zip(lagged, self.lag_state, strict=True):
                if self.settled <= 1:
                    state[:] = signal[0]
                first_order_lag(signal, share, state)
            parts += [lagged[0], lagged[1]]
            accelerations.append(lagged[2])
        self._filter(np.hstack([*parts, *accelerations]))

    def _estimate_lag(self, error: Array, speed: Array) -> None:
        if self.settled == 0:
            return
        keep = np.exp(-self.piece.shape[0] * self._dt / self._settings.following_memory_s)
        self.lag_sums = keep * self.lag_sums + np.stack([(error * speed).sum(axis=0), (speed * speed).sum(axis=0)])

    def _filter(self, signals: Array) -> None:
        """Align, compute both regressors, and filter them with the torque."""
        n = self._model.n
        delay = self.history.shape[0]
        joined = np.vstack([self.history, signals])
        self.history = joined[-delay:].copy()
        self.settled += 1
        if self.settled == 1:
            # The live filter settles within the first piece.
            return
        size = signals.shape[0]
        whole = int(self.delay)
        share = self.delay - whole
        last = 5 if self.with_reference else 3
        now = joined[EARLIER : EARLIER + size]
        after = joined[EARLIER + whole :]
        later = (1 - share) * after[:size] + share * after[1 : 1 + size]
        column = [now[:, i * n : (i + 1) * n] for i in range(last)]
        qdd = later[:, last * n : (last + 1) * n]
        x = self._regressor(column[0], column[1], qdd)
        data = [x]
        if self.with_reference:
            data.append(self._regressor(column[3], column[4], later[:, (last + 1) * n :]))
        moving = (np.abs(column[1]) > self._slow).astype(np.float64)
        low_pass(
            np.ascontiguousarray(np.hstack([*data, self._torque(joined, size), moving])),
            self.decimation.taps, self.decimation.factor, self.seen, self.done, self.rows,
        )  # fmt: skip
        self.seen += size
        self._hand_over()

    def _torque(self, joined: Array, size: int) -> Array:
        """Torque at the instants of the positions, (size, n), between two samples."""
        n = self._model.n
        tau = joined[:, 2 * n : 3 * n]
        begin = EARLIER - int(np.floor(self._lead)) - 1
        share = self._lead - np.floor(self._lead)
        return np.asarray((1 - share) * tau[begin + 1 : begin + 1 + size] + share * tau[begin : begin + size])

    def _regressor(self, q: Array, qd: Array, qdd: Array) -> Array:
        full = self._model.rigid_regressor(q, qd, qdd)
        return np.asarray(full.reshape(full.shape[0], -1)[:, self._kept])

    def _hand_over(self) -> None:
        n, (joints, b) = self._model.n, self._shape
        complete = self.decimation.count(self.seen) - self.done
        for row in self.rows[:complete].copy():
            x, z = np.zeros(joints * b), np.zeros(joints * b)
            k = self._kept.size
            x[self._kept] = row[:k]
            z[self._kept] = row[k : 2 * k] if self.with_reference else row[:k]
            y, moving = row[-2 * n : -n].copy(), row[-n:].copy()
            self.instants += 1
            self._take(Instant(x.reshape(joints, b), z.reshape(joints, b), y, moving))
        kept = self.rows.shape[0] - complete
        self.rows[:kept] = self.rows[complete:].copy()
        self.rows[kept:] = 0.0
        self.done += complete


def slow_velocity(model: ArmModel, settings: RecursiveSettings) -> Array:
    """Velocity (n,) above which each joint counts as moving, rad/s or m/s."""
    slow: Array = np.tan(settings.moving_sign * np.pi / 2) / model.smoothing
    configured = model.robot.friction.velocity_threshold
    return slow if configured is None else np.maximum(slow, np.asarray(configured))


def acceleration_delay(nvr: float) -> float:
    """Delay of the acceleration of the live filter of order 3 at low frequencies, samples.

    In steady state it follows ``k^3 / 6`` with a constant delay of the acceleration, but none of velocity and position.
    """
    length = int(40 / nvr ** (1 / 6)) + 40
    k = np.arange(length, dtype=np.float64)
    followed = VelocityFilter(1, 1.0, nvr).handle((k**3 / 6)[:, None])
    return float(k[-1] - followed.qdd[-1, 0])


def _present_columns(model: ArmModel) -> NDArray[np.int64]:
    """Indices of the entries of the flat regressor (n b) that are not zero for every motion."""
    generator = np.random.default_rng(0)
    q, qd, qdd = generator.uniform(-1.0, 1.0, (3, 50, model.n))
    full = np.abs(model.rigid_regressor(q, qd, qdd)).reshape(50, -1)
    return np.flatnonzero(full.max(axis=0) > 0)
