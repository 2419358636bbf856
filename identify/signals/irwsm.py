"""Integrated-random-walk smoother (IRWSM) in its exact banded form (thesis section 5.1.2).

The fixed-interval smoother of an integrated random walk of order ``d`` minimises ``sum (y - x)^2 + (1/NVR) sum (D
x)^2`` with the d-th difference D. The solution is ``x = y - D' V^-1 D y`` with the banded ``V = NVR I + D D'``. The
concentrated likelihood (5.16, 5.21) needs only the factors of ``V``. All computations are O(N).

The likelihood assumes accelerations with white increments. Those of a robot are smoother: at a signal-to-noise ratio of
100 dB its ratio is too large and passes noise (as in thesis section 5.3.1). Cross-validation needs white noise, but no
model of the motion (Craven and Wahba 1979; Wahba 1985 compares the two). Both err towards too little smoothing:
:func:`automatic_nvr` takes the smaller of the ratios from cross-validation and from the likelihood of third order.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from armident.arrays import Array
from armident.compiled import compiled
from armident.configs import DataError

LOG10_NVR_RANGE = {2: (-12.0, 4.0), 3: (-14.0, 4.0)}
"""Search range of log10(NVR) for each order; third-order factors lose definiteness at about 1e-16."""

SETTLED = 40.0
"""Time constants, ``NVR^(-1 / (2 order))`` samples, after which the factors of the band are constant to rounding."""

_STENCIL = {2: np.array([1.0, -2.0, 1.0]), 3: np.array([-1.0, 3.0, -3.0, 1.0])}


@dataclass(frozen=True)
class Smoothed:
    """Smoothed series ``level`` (N,), its first difference ``slope`` (N - 1,) per sample, and the ratio ``nvr`` used.

    Element k of ``slope`` belongs to the instant k + 1/2.
    """

    level: Array
    slope: Array
    nvr: float


def irwsm(y: Array, order: int, nvr: float) -> Smoothed:
    """Smooth a series (N,), N > 2 ``order``, with the ratio ``nvr = var(kappa) / var(e)``.

    ``order`` 2: level and slope (IRWSM 1, 5.23); 3: and curvature (IRWSM 2, 5.24). Raises DataError if it is too short.
    """
    y = _checked(y, order)
    if not nvr > 0:
        raise ValueError(f"nvr: expected a positive number, got {nvr}")
    level = y - _correction(np.diff(y, n=order), _band(order, nvr), _STENCIL[order], _transient(order, nvr))
    return Smoothed(level=level, slope=np.diff(level), nvr=nvr)


def negative_log_likelihood(w: Array, order: int, nvr: float) -> float:
    """Concentrated ``-2 log L`` of the noise-variance ratio, up to a constant (thesis 5.16, 5.21); diffuse start.

    It is ``(N - order) log(s2) + sum log nu(k)``. ``w``: ``numpy.diff(y, n=order)``, shape (N - order,).
    """
    return float(_profile(w, _band(order, nvr), _transient(order, nvr)))


def optimal_nvr(y: Array, order: int, tolerance: float = 0.02) -> float:
    """Noise-variance ratio of maximum likelihood, by a bounded search on ``log10(NVR)`` (thesis 5.16, 5.21).

    It may follow the noise of measured positions too closely (5.3.1); see :func:`automatic_nvr`. ``tolerance``: final
    bracket, decades; the optimum is flat over a few hundredths. 1.0 for a series whose differences are all zero.
    """
    w = _scaled_differences(y, order)
    if w is None:
        return 1.0
    return _search(lambda nvr: negative_log_likelihood(w, order, nvr), order, tolerance)


def cross_validation(w: Array, order: int, nvr: float) -> float:
    """Logarithm of the generalised cross-validation score of a noise-variance ratio (Craven and Wahba 1979).

    ``log(|y - x|^2 / N) - 2 log(tr(I - A) / N)`` with ``x = A y`` and the trace of a long series. For white noise: the
    mean square error of predicting each sample from the others, up to a constant. ``w`` as in
    :func:`negative_log_likelihood`.
    """
    squares = float(_residual_sum(w, _band(order, nvr), _STENCIL[order], _transient(order, nvr)))
    return float(np.log(squares) - 2 * np.log(1 - kept_share(order, nvr)))


def cross_validated_nvr(y: Array, order: int, tolerance: float = 0.02) -> float:
    """Noise-variance ratio of least generalised cross-validation score; the search is that of :func:`optimal_nvr`.

    It assumes white measurement noise: quantisation noise is, if the position changes by several counts per sample.
    """
    w = _scaled_differences(y, order)
    if w is None:
        return 1.0
    return _search(lambda nvr: cross_validation(w, order, nvr), order, tolerance)


def automatic_nvr(y: Array, order: int, tolerance: float = 0.02) -> float:
    """Noise-variance ratio for positions with unknown noise: the smaller of those of two criteria.

    Cross-validation is optimal for white noise, and too large for coloured noise. The likelihood of the third-order
    random walk depends less on the colour. Order 2 has its half-power frequency, ``NVR^(1 / (2 order))``.
    """
    validated = cross_validated_nvr(y, order, tolerance)
    likeliest = optimal_nvr(y, 3, tolerance)
    return float(min(validated, likeliest ** (order / 3)))


def kept_share(order: int, nvr: float) -> float:
    """Degrees of freedom per sample of the smoother ``x = A y`` for a long series, ``tr(A) / N``.

    It is the mean over frequency of ``NVR / (NVR + (2 - 2 cos w)^order)``, by partial fractions.
    """
    poles = nvr ** (1 / order) * np.exp(1j * np.pi * (2 * np.arange(order) + 1) / order)
    return float(np.sum(-poles / (np.sqrt(-poles) * np.sqrt(4 - poles))).real / order)


def _scaled_differences(y: Array, order: int) -> Array | None:
    """Differences of a series (N - order,) scaled to a maximum of 1; ``None`` if all are zero."""
    w = np.diff(_checked(y, order), n=order)
    return w / np.abs(w).max() if np.any(w) else None


def _search(criterion: Callable[[float], float], order: int, tolerance: float) -> float:
    """Minimise a criterion of the ratio on a grid of two decades, then by golden section around the best point."""
    low, high = LOG10_NVR_RANGE[order]
    grid = np.arange(low, high + 1e-9, 2.0)
    best = int(np.argmin([criterion(10.0**g) for g in grid]))
    a, b = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, grid.size - 1)])
    share = (np.sqrt(5.0) - 1) / 2
    x1, x2 = b - share * (b - a), a + share * (b - a)
    f1, f2 = criterion(10.0**x1), criterion(10.0**x2)
    while b - a > tolerance:
        if f1 < f2:
            b, x2, f2 = x2, x1, f1
            x1 = b - share * (b - a)
            f1 = criterion(10.0**x1)
        else:
            a, x1, f1 = x1, x2, f2
            x2 = a + share * (b - a)
            f2 = criterion(10.0**x2)
    return float(10.0 ** ((a + b) / 2))


def _checked(y: Array, order: int) -> Array:
    if order not in _STENCIL:
        raise ValueError(f"order: expected 2 or 3, got {order}")
    y = np.ascontiguousarray(y, dtype=np.float64)
    if y.ndim != 1 or y.size <= 2 * order:
        raise DataError(f"smoothing needs a series of more than {2 * order} samples, got shape {y.shape}")
    if not np.isfinite(y).all():
        raise DataError(f"smoothing: sample {int(np.argmin(np.isfinite(y)))} is not a finite number")
    return y


def _band(order: int, nvr: float) -> Array:
    """First row of the symmetric Toeplitz band of ``V = NVR I + D D'``, shape (order + 1,)."""
    stencil = _STENCIL[order]
    band = np.array([stencil[k:] @ stencil[: stencil.size - k] for k in range(order + 1)])
    band[0] += nvr
    return band


def _transient(order: int, nvr: float) -> int:
    """Samples after which the factors of the Toeplitz band no longer change: they converge as ``exp(-k / tau)``."""
    return int(SETTLED * nvr ** (-0.5 / order)) + 10


@compiled()
def _row(band, d, low, i, p):  # type: ignore[no-untyped-def]
    """Row i of ``V = L diag(d) L'``: fill ``low[i % (p + 1)]`` (distances 1..p), return d_i; ring buffers of p + 1."""
    for j in range(min(p, i), 0, -1):
        value = band[j]
        for k in range(j + 1, min(p, i) + 1):
            value -= low[i % (p + 1), k] * low[(i - j) % (p + 1), k - j] * d[(i - k) % (p + 1)]
        low[i % (p + 1), j] = value / d[(i - j) % (p + 1)]
    pivot = band[0]
    for k in range(1, min(p, i) + 1):
        pivot -= low[i % (p + 1), k] ** 2 * d[(i - k) % (p + 1)]
    return pivot


@compiled("f8[::1], f8[::1], i8")
def _profile(w, band, transient):  # type: ignore[no-untyped-def]
    """``m log(w' V^-1 w) + log|V|`` in one forward sweep; after ``transient`` rows the factors are constant."""
    m, p = w.size, band.size - 1
    d, low, z = np.zeros(p + 1), np.zeros((p + 1, p + 1)), np.zeros(p + 1)
    quadratic, logdet, pivot, i = 0.0, 0.0, 1.0, 0
    while i < min(m, transient):
        pivot = _row(band, d, low, i, p)
        d[i % (p + 1)] = pivot
        value = w[i]
        for k in range(1, min(p, i) + 1):
            value -= low[i % (p + 1), k] * z[(i - k) % (p + 1)]
        z[i % (p + 1)] = value
        quadratic += value * value / pivot
        logdet += np.log(pivot)
        i += 1
    if i < m:
        row = low[(i - 1) % (p + 1)]
        l1, l2 = row[1], row[2]
        l3 = row[3] if p == 3 else 0.0
        z1, z2 = z[(i - 1) % (p + 1)], z[(i - 2) % (p + 1)]
        z3 = z[(i - 3) % (p + 1)] if p == 3 else 0.0
        squares = 0.0
        for k in range(i, m):
            value = w[k] - l1 * z1 - l2 * z2 - l3 * z3
            squares += value * value
            z3, z2, z1 = z2, z1, value
        quadratic += squares / pivot
        logdet += (m - i) * np.log(pivot)
    return m * np.log(quadratic) + logdet


@compiled()
def _forward(w, band, transient):  # type: ignore[no-untyped-def]
    """``L^-1 w`` with ``V = L diag(d) L'``, and the first rows of L and d; all later rows equal the last one."""
    m, p = w.size, band.size - 1
    d, low, z = np.zeros(p + 1), np.zeros((p + 1, p + 1)), np.empty(m)
    last = min(m, transient) - 1
    pivots, rows = np.empty(last + 1), np.zeros((last + 1, p + 1))
    for i in range(last + 1):
        pivots[i] = _row(band, d, low, i, p)
        d[i % (p + 1)] = pivots[i]
        value = w[i]
        for k in range(1, min(p, i) + 1):
            rows[i, k] = low[i % (p + 1), k]
            value -= rows[i, k] * z[i - k]
        z[i] = value
    if last + 1 < m:
        l1, l2 = rows[last, 1], rows[last, 2]
        l3 = rows[last, 3] if p == 3 else 0.0
        z1, z2 = z[last], z[last - 1]
        z3 = z[last - 2] if p == 3 else 0.0
        for i in range(last + 1, m):
            value = w[i] - l1 * z1 - l2 * z2 - l3 * z3
            z[i] = value
            z3, z2, z1 = z2, z1, value
    return z, rows, pivots


@compiled("f8[::1], f8[::1], f8[::1], i8")
def _correction(w, band, stencil, transient):  # type: ignore[no-untyped-def]
    """``D' V^-1 w``, shape (m + order,); after ``transient`` rows the factors are constant."""
    m, p = w.size, band.size - 1
    z, rows, pivots = _forward(w, band, transient)
    last = pivots.size - 1
    out = np.zeros(m + p)
    # Backward substitution: u1, u2, u3 are the next three elements of the solution, zero beyond the end.
    u1 = u2 = u3 = 0.0
    for i in range(m - 1, -1, -1):
        value = z[i] / pivots[min(i, last)] - rows[min(i + 1, last), 1] * u1 - rows[min(i + 2, last), 2] * u2
        if p == 3:
            value -= rows[min(i + 3, last), 3] * u3
        for k in range(p + 1):
            out[i + k] += stencil[k] * value
        u3, u2, u1 = u2, u1, value
    return out


@compiled("f8[::1], f8[::1], f8[::1], i8")
def _residual_sum(w, band, stencil, transient):  # type: ignore[no-untyped-def]
    """``|D' V^-1 w|^2``; after ``transient`` rows the factors are constant."""
    m, p = w.size, band.size - 1
    z, rows, pivots = _forward(w, band, transient)
    last = pivots.size - 1
    l1, l2 = rows[last, 1], rows[last, 2]
    l3 = rows[last, 3] if p == 3 else 0.0
    total = 0.0
    # Backward substitution: u1, u2, u3 are the next three elements of the solution, zero beyond the end.
    u1 = u2 = u3 = 0.0
    s0, s1, s2 = stencil[0], stencil[1], stencil[2]
    s3 = stencil[3] if p == 3 else 0.0
    for i in range(m - 1, -1, -1):
        j1, j2, j3 = min(i + 1, last), min(i + 2, last), min(i + 3, last)
        if i > last:
            value = z[i] / pivots[last] - l1 * u1 - l2 * u2 - l3 * u3
        else:
            value = z[i] / pivots[i] - rows[j1, 1] * u1 - rows[j2, 2] * u2
            if p == 3:
                value -= rows[j3, 3] * u3
        # Element i + p of D' u.
        out = s3 * value + s2 * u1 + s1 * u2 + s0 * u3 if p == 3 else s2 * value + s1 * u1 + s0 * u2
        total += out * out
        u3, u2, u1 = u2, u1, value
    if p == 3:
        ends = (s2 * u1 + s1 * u2 + s0 * u3, s1 * u1 + s0 * u2, s0 * u1)
        return total + ends[0] ** 2 + ends[1] ** 2 + ends[2] ** 2
    return total + (s1 * u1 + s0 * u2) ** 2 + (s0 * u1) ** 2
