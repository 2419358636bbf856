"""Finite impulse responses applied to many columns at once, as products with a banded Toeplitz matrix.

At the recorded rate a whitening filter of sixty coefficients on sixty columns is the most expensive part of a
prefiltered method. In blocks of rows it is a matrix product, which needs no copy of strided columns and no interpreter
lock. Measured with 2 048 and 30 000 rows, 53 columns, 21 and 61 taps: scipy.signal.oaconvolve takes 2.6 to 4.4 times as
long, a product with sliding_window_view 6.5 times.
"""

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

_ROWS = 8
"""Fewest rows per product. Half as many rows as taps are fastest: fewer cost calls, more cost zeros off the band."""


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
