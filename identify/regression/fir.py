"""Finite impulse responses on many columns at once, as products with a banded Toeplitz matrix.

A whitening filter of sixty coefficients on sixty columns is the most expensive thing that a prefiltered method does at
the recorded rate. In blocks of rows it is matrix multiplication, which the machine does best, on strided columns as
they lie and without the interpreter lock.
"""

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

_ROWS = 8
"""Rows per product at least; half as many as taps are fastest: fewer waste calls, more waste the zeros off the band."""


def filter_columns(taps: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """``sum_i taps[i] x(t - i)`` for every t whose samples are all there.

    Parameters
    ----------
    taps
        Impulse response, shape (l + 1,).
    x
        Columns, shape (M, b), at least l + 1 rows.

    Returns
    -------
    ndarray
        Shape (M - l, b).

    Raises
    ------
    ValueError
        If there are fewer rows than taps.
    """
    span, count = taps.size - 1, x.shape[0] - taps.size + 1
    if count < 1:
        raise ValueError(f"{x.shape[0]} rows are fewer than the {taps.size} of the impulse response")
    out = np.empty((count, x.shape[1]))
    if span == 0:
        np.multiply(x, taps[0], out=out)
        return out
    rows = min(max(_ROWS, span // 2), count)
    band = np.zeros((rows, rows + span))
    for i in range(rows):
        band[i, i : i + span + 1] = taps[::-1]
    whole = count // rows
    windows = as_strided(
        x, (whole, rows + span, x.shape[1]), (rows * x.strides[0], x.strides[0], x.strides[1]), writeable=False
    )
    np.matmul(band, windows, out=out[: whole * rows].reshape(whole, rows, x.shape[1]))
    left = count - whole * rows
    if left:
        np.matmul(band[:left, : left + span], x[whole * rows :], out=out[whole * rows :])
    return out
