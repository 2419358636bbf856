"""Online estimation of velocities and accelerations: a causal Kalman filter on measured positions.

White noise drives the highest derivative, as in the smoother (thesis section 5.1.2). The state is that at the sampling
instant: no shift by half a sample. The units are one sample and the measurement noise, so that the noise-variance ratio
is the only parameter, the same as in :mod:`armident.identify.signals.irwsm`: the spectrum is ``NVR / w^6``.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armident.arrays import Array
from armident.compiled import compiled
from armident.configs import DataError

PRIOR = 1e10
"""Prior variance of the derivatives at the first sample, in units of the variance of the measurement noise."""


_DRIVEN = np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])
"""Covariance from unit white noise on the third derivative over one sample."""


@dataclass(frozen=True)
class LiveDerivatives:
    """Filtered positions and derivatives (M, n); NaN before a joint's first measurement."""

    q: Array
    qd: Array
    qdd: Array


class VelocityFilter:
    """Causal filter for velocities and accelerations of n joints; no lag while the acceleration is constant.

    ``dt``: sampling period, s. ``nvr``: one or (n,), as for the smoother of third order.
    """

    _saved = ("_x", "_p", "_measured")

    def __init__(self, n: int, dt: float, nvr: ArrayLike) -> None:
        ratios = np.asarray(nvr, dtype=np.float64)
        if not dt > 0:
            raise DataError(f"sampling period: expected a positive number of seconds, got {dt}")
        if ratios.ndim > 1 or ratios.size not in (1, n) or not (ratios > 0).all():
            raise DataError(f"nvr: expected one positive number or {n}, got {nvr!r}")
        self.n, self.dt = n, dt
        self.nvr: Array = np.broadcast_to(ratios, (n,)).copy()
        self.reset()

    def reset(self) -> None:
        """Reset the state: the next measurement is treated as the first."""
        self._x = np.full((self.n, 3), np.nan)
        self._p = np.zeros((self.n, 3, 3))
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
            _filter(np.ascontiguousarray(y), self.nvr, _DRIVEN, self._x, self._p, self._measured, out)
        return LiveDerivatives(out[0], out[1] / self.dt, out[2] / self.dt**2)


@compiled("f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], i8[::1], f8[:, :, ::1]", nogil=False)
def _filter(y: Array, nvr: Array, driven: Array, x: Array, p: Array, measured: NDArray[np.int64], out: Array) -> None:
    """Predict and update every joint at every sample; ``x`` (n, 3), ``p`` (n, 3, 3) in place."""
    half = np.empty((3, 3))
    gain = np.empty(3)
    for j in range(y.shape[1]):
        for k in range(y.shape[0]):
            value = y[k, j]
            if measured[j] == 0:
                if np.isnan(value):
                    continue
                # The first measurement determines the position; the derivatives have the prior variance.
                x[j] = 0.0
                x[j, 0] = value
                for a in range(3):
                    for b in range(3):
                        p[j, a, b] = 0.0
                    p[j, a, a] = 1.0 if a == 0 else PRIOR
                measured[j] = 1
            else:
                _predict(x[j], p[j], nvr[j], driven, half)
                if not np.isnan(value):
                    _update(x[j], p[j], value - x[j, 0], p[j, 0, 0] + 1.0, gain)
            for a in range(3):
                out[a, k, j] = x[j, a]


@compiled(nogil=False)
def _predict(x: Array, p: Array, nvr: float, driven: Array, half: Array) -> None:
    """``x = F x``, ``P = F P F' + nvr driven`` for the transition of one sample."""
    x[0] += x[1] + 0.5 * x[2]
    x[1] += x[2]
    for b in range(3):
        half[0, b] = p[0, b] + p[1, b] + 0.5 * p[2, b]
        half[1, b] = p[1, b] + p[2, b]
        half[2, b] = p[2, b]
    for a in range(3):
        p[a, 0] = half[a, 0] + half[a, 1] + 0.5 * half[a, 2]
        p[a, 1] = half[a, 1] + half[a, 2]
        p[a, 2] = half[a, 2]
        for b in range(3):
            p[a, b] += nvr * driven[a, b]


@compiled(nogil=False)
def _update(x: Array, p: Array, innovation: float, variance: float, gain: Array) -> None:
    """Measurement update in Joseph's form, which keeps the covariance symmetric and positive."""
    for a in range(3):
        gain[a] = p[a, 0] / variance
        x[a] += gain[a] * innovation
    first = p[0, 0]
    row = p[0].copy()
    for a in range(3):
        for b in range(a, 3):
            value = p[a, b] - gain[a] * row[b] - gain[b] * row[a] + gain[a] * gain[b] * (first + 1.0)
            p[a, b] = value
            p[b, a] = value
