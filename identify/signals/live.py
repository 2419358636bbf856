"""Online estimation of velocities and accelerations: a causal Kalman filter on measured positions.

White noise drives the highest derivative, as in the smoother (thesis section 5.1.2). The state is that at the sampling
instant: no shift by half a sample. The units are one sample and the measurement noise, so that the noise-variance ratio
is the only parameter, the same as in :mod:`armident.identify.signals.irwsm`: the spectrum is ``NVR / w^(2 order)``.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armident.arrays import Array
from armident.compiled import compiled
from armident.configs import DataError

PRIOR = 1e10
"""Prior variance of the derivatives at the first sample, in units of the variance of the measurement noise."""


@dataclass(frozen=True)
class LiveDerivatives:
    """Filtered positions and derivatives (M, n); NaN before a joint's first measurement, ``qdd`` also for order 2."""

    q: Array
    qd: Array
    qdd: Array


@dataclass(frozen=True)
class LiveState:
    """State of the filter after the last sample (n,); NaN as in `LiveDerivatives`.

    Standard deviations are those of the innovations so far (5.16); NaN up to ``order`` measurements.
    """

    q: Array
    qd: Array
    qdd: Array
    q_std: Array
    qd_std: Array
    qdd_std: Array
    measured: NDArray[np.int64]


class VelocityFilter:
    """Causal filter for velocities and accelerations of n joints, sample by sample or batch by batch.

    ``nvr``: as for the smoother, for instance ``automatic_nvr(q[:, j], order)`` of an earlier recording. ``order`` 3:
    acceleration too, no lag while it is constant. ``F``, ``H``, ``Q``, ``R``: filterpy's notation, time in samples.
    """

    _saved = ("_x", "_p", "_squares", "_measured")

    def __init__(self, n: int, dt: float, nvr: ArrayLike, order: int = 3) -> None:
        ratios = np.asarray(nvr, dtype=np.float64)
        if order not in (2, 3):
            raise DataError(f"order of the velocity filter: expected 2 or 3, got {order}")
        if not dt > 0:
            raise DataError(f"sampling period: expected a positive number of seconds, got {dt}")
        if ratios.ndim > 1 or ratios.size not in (1, n) or not (ratios > 0).all():
            raise DataError(f"nvr: expected one positive number or {n}, got {nvr!r}")
        self.n, self.dt, self.order = n, dt, order
        self.nvr: Array = np.broadcast_to(ratios, (n,)).copy()
        self.reset()

    @property
    def F(self) -> Array:  # noqa: N802
        """State transition matrix over one sample, (order, order)."""
        return np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])[: self.order, : self.order]

    @property
    def H(self) -> Array:  # noqa: N802
        """Measurement matrix, (1, order)."""
        return np.eye(self.order)[:1]

    @property
    def Q(self) -> Array:  # noqa: N802
        """Covariance of the process noise over one sample, relative to that of the measurement, (n, order, order)."""
        return self.nvr[:, None, None] * _driven(self.order)

    @property
    def R(self) -> Array:  # noqa: N802
        """Covariance of the measurement noise, (1, 1): one, by the choice of units."""
        return np.eye(1)

    def reset(self) -> None:
        """Reset the state: the next measurement is treated as the first."""
        self._x = np.full((self.n, self.order), np.nan)
        self._p = np.zeros((self.n, self.order, self.order))
        self._squares = np.zeros(self.n)
        self._measured = np.zeros(self.n, dtype=np.int64)

    def handle(self, samples: ArrayLike) -> LiveDerivatives:
        """Filter one sample (n,) or a batch (M, n) in the order of time; NaN: not measured, its value is predicted."""
        y = np.atleast_2d(np.asarray(samples, dtype=np.float64))
        if y.ndim != 2 or y.shape[1] != self.n:
            raise DataError(f"positions of shape {y.shape} for a velocity filter of {self.n} joints")
        if np.isinf(y).any():
            k, j = np.argwhere(np.isinf(y))[0]
            raise DataError(f"position of joint {j + 1} is infinite at sample {k} of the batch")
        out = np.full((3, *y.shape), np.nan)
        if y.size:
            _filter(
                np.ascontiguousarray(y), self.nvr, _driven(self.order), self._x, self._p,
                self._squares, self._measured, out,
            )  # fmt: skip
        return LiveDerivatives(out[0], out[1] / self.dt, out[2] / self.dt**2)

    def result(self) -> LiveState:
        """Return the state after the last sample, with standard deviations."""
        known = self._measured > self.order
        variance = np.full(self.n, np.nan)
        variance[known] = self._squares[known] / (self._measured[known] - self.order)
        state, std = np.full((3, self.n), np.nan), np.full((3, self.n), np.nan)
        for i in range(self.order):
            state[i] = self._x[:, i] / self.dt**i
            std[i] = np.sqrt(variance * self._p[:, i, i]) / self.dt**i
        return LiveState(state[0], state[1], state[2], std[0], std[1], std[2], self._measured.copy())


def _driven(order: int) -> Array:
    """Covariance from unit white noise on the highest derivative over one sample, (order, order)."""
    if order == 2:
        return np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    return np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])


@compiled("f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[::1], i8[::1], f8[:, :, ::1]", nogil=False)
def _filter(y, nvr, driven, x, p, squares, measured, out):  # type: ignore[no-untyped-def]
    """Predict and update every joint at every sample; ``x`` (n, order), ``p`` (n, order, order) in place."""
    order = driven.shape[0]
    half = np.empty((order, order))
    gain = np.empty(order)
    for j in range(y.shape[1]):
        for k in range(y.shape[0]):
            value = y[k, j]
            if measured[j] == 0:
                if np.isnan(value):
                    continue
                # The first measurement determines the position; the derivatives have the prior variance.
                x[j] = 0.0
                x[j, 0] = value
                for a in range(order):
                    for b in range(order):
                        p[j, a, b] = 0.0
                    p[j, a, a] = 1.0 if a == 0 else PRIOR
                measured[j] = 1
            else:
                _predict(x[j], p[j], nvr[j], driven, half)
                if not np.isnan(value):
                    innovation = value - x[j, 0]
                    variance = p[j, 0, 0] + 1.0
                    measured[j] += 1
                    if measured[j] > order:
                        squares[j] += innovation * innovation / variance
                    _update(x[j], p[j], innovation, variance, gain)
            for a in range(order):
                out[a, k, j] = x[j, a]


@compiled(nogil=False)
def _predict(x, p, nvr, driven, half):  # type: ignore[no-untyped-def]
    """``x = F x``, ``P = F P F' + nvr driven`` for the transition of one sample."""
    order = x.size
    if order == 3:
        x[0] += x[1] + 0.5 * x[2]
        x[1] += x[2]
    else:
        x[0] += x[1]
    for b in range(order):
        if order == 3:
            half[0, b] = p[0, b] + p[1, b] + 0.5 * p[2, b]
            half[1, b] = p[1, b] + p[2, b]
            half[2, b] = p[2, b]
        else:
            half[0, b] = p[0, b] + p[1, b]
            half[1, b] = p[1, b]
    for a in range(order):
        if order == 3:
            p[a, 0] = half[a, 0] + half[a, 1] + 0.5 * half[a, 2]
            p[a, 1] = half[a, 1] + half[a, 2]
            p[a, 2] = half[a, 2]
        else:
            p[a, 0] = half[a, 0] + half[a, 1]
            p[a, 1] = half[a, 1]
        for b in range(order):
            p[a, b] += nvr * driven[a, b]


@compiled(nogil=False)
def _update(x, p, innovation, variance, gain):  # type: ignore[no-untyped-def]
    """Measurement update in Joseph's form, which keeps the covariance symmetric and positive."""
    order = x.size
    for a in range(order):
        gain[a] = p[a, 0] / variance
        x[a] += gain[a] * innovation
    first = p[0, 0]
    row = p[0].copy()
    for a in range(order):
        for b in range(a, order):
            value = p[a, b] - gain[a] * row[b] - gain[b] * row[a] + gain[a] * gain[b] * (first + 1.0)
            p[a, b] = value
            p[b, a] = value
