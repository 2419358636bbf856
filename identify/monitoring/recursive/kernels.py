"""Compiled loops of the recursive estimator; no result depends on the number of threads or of rows in a call."""

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.compiled import compiled


@compiled("f8[:, ::1], f8[:, ::1], f8[:, ::1]")
def to_joint_side(raw: Array, factor: Array, out: Array) -> None:
    """Multiply every row by a matrix: ``out[k] = factor @ raw[k]``, shapes (N, n) and (n, n)."""
    for k in range(raw.shape[0]):
        for i in range(raw.shape[1]):
            total = 0.0
            for j in range(raw.shape[1]):
                total += factor[i, j] * raw[k, j]
            out[k, i] = total


@compiled("f8[:, ::1], f8[::1], f8[::1]")
def first_order_lag(x: Array, share: Array, state: Array) -> None:
    """Filter columns (N, n) by a first-order lag, in place; ``share`` (n,) is made up per sample."""
    for k in range(x.shape[0]):
        for j in range(x.shape[1]):
            state[j] += share[j] * (x[k, j] - state[j])
            x[k, j] = state[j]


@compiled("f8[:, ::1], f8[::1], i8, i8, i8, f8[:, ::1]")
def low_pass(data: Array, taps: Array, factor: int, seen: int, done: int, rows: Array) -> None:
    """Add the contribution of further samples to the decimated rows that are not complete, in place.

    Samples (N, c) follow ``seen`` others; row ``done`` is the first of ``rows`` (r, c).
    """
    for k in range(data.shape[0]):
        at = seen + k
        last = at // factor
        first = max(done, -((taps.size - 1 - at) // factor))
        for m in range(first, last + 1):
            weight = taps[at - m * factor]
            row = rows[m - done]
            for c in range(data.shape[1]):
                row[c] += weight * data[k, c]


@compiled("f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], b1[::1]")
def update(
    state: Array, covariance: Array, x: Array, z: Array, y: Array, variance: Array, use: NDArray[np.bool_]
) -> None:
    """Measurement update of the random walk with instruments, equation by equation; a Kalman filter if ``z = x``.

    Young's symmetric form: gain and ``covariance`` (b, b) have the instruments, the innovation the regressor (n, b).
    """
    b = state.size
    gain = np.empty(b)
    for j in range(y.size):
        if not use[j]:
            continue
        innovation, total = y[j], variance[j]
        for i in range(b):
            innovation -= x[j, i] * state[i]
        present = np.flatnonzero(z[j])
        for i in range(b):
            value = 0.0
            for p in present:
                value += covariance[i, p] * z[j, p]
            gain[i] = value
        for p in present:
            total += z[j, p] * gain[p]
        for i in range(b):
            state[i] += gain[i] / total * innovation
        # P - g g' / s, the same number above and below the diagonal.
        for i in range(b):
            for k in range(i, b):
                value = covariance[i, k] - gain[i] * gain[k] / total
                covariance[i, k] = value
                covariance[k, i] = value


@compiled("f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], b1[::1]")
def add_products(
    sums: Array, squares: Array, right: Array, x: Array, z: Array, y: Array, variance: Array, use: NDArray[np.bool_]
) -> None:
    """Add the weighted products ``z' x``, ``z' z`` and ``z' y`` of an instant to the three sums; see `update`."""
    for j in range(y.size):
        if not use[j]:
            continue
        weight = 1.0 / variance[j]
        for i in range(right.size):
            if z[j, i] == 0.0:
                continue
            scaled = weight * z[j, i]
            right[i] += scaled * y[j]
            for k in range(right.size):
                sums[i, k] += scaled * x[j, k]
                squares[i, k] += scaled * z[j, k]


@compiled("f8[:, ::1], f8[:, ::1]")
def solve(matrix: Array, right: Array) -> bool:
    """Solve ``matrix x = right``, (b, b) and (b, r), by pivoted elimination in place; return ``False`` if singular."""
    b = matrix.shape[0]
    for i in range(b):
        pivot = i
        for k in range(i + 1, b):
            if abs(matrix[k, i]) > abs(matrix[pivot, i]):
                pivot = k
        if not abs(matrix[pivot, i]) > 0.0:
            return False
        if pivot != i:
            for c in range(b):
                matrix[i, c], matrix[pivot, c] = matrix[pivot, c], matrix[i, c]
            for c in range(right.shape[1]):
                right[i, c], right[pivot, c] = right[pivot, c], right[i, c]
        for k in range(i + 1, b):
            share = matrix[k, i] / matrix[i, i]
            if share != 0.0:
                for c in range(i, b):
                    matrix[k, c] -= share * matrix[i, c]
                for c in range(right.shape[1]):
                    right[k, c] -= share * right[i, c]
    for i in range(b - 1, -1, -1):
        for c in range(right.shape[1]):
            value = right[i, c]
            for k in range(i + 1, b):
                value -= matrix[i, k] * right[k, c]
            right[i, c] = value / matrix[i, i]
    return True


@compiled("f8[::1], b1[::1], f8, f8[:, ::1], b1[:, ::1], f8[:, ::1], f8[:, ::1]")
def add_residuals(
    residual: Array,
    use: NDArray[np.bool_],
    keep: float,
    past: Array,
    known: NDArray[np.bool_],
    sums: Array,
    counts: Array,
) -> None:
    """Add an instant's residuals (n,), N m or N, to the running autocovariances, in place; ``keep``: share that stays.

    ``past``, ``known`` (L, n): last residuals and masks, latest first; ``sums``, ``counts`` (L + 1, n): by lag.
    """
    lags, n = past.shape
    for j in range(n):
        if use[j]:
            for lag in range(lags + 1):
                if lag > 0 and not known[lag - 1, j]:
                    continue
                other = residual[j] if lag == 0 else past[lag - 1, j]
                sums[lag, j] = keep * sums[lag, j] + residual[j] * other
                counts[lag, j] = keep * counts[lag, j] + 1.0
        for lag in range(lags - 1, 0, -1):
            past[lag, j] = past[lag - 1, j]
            known[lag, j] = known[lag - 1, j]
        past[0, j] = residual[j]
        known[0, j] = use[j]
