"""Decimation by the correlation time of the noise instead of the bandwidth (thesis 6.2.3)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError
from armident.identify.regression.ar_noise import fit_ar

MAX_ORDER = 250
"""Highest order tried: twice the decimation that the thesis chose by hand."""


@dataclass(frozen=True)
class NoiseDecimation:
    """Decimation by the orders (n,) of the AR models of each joint's noise; the greatest is ``factor``.

    ``bounded``: an order is the highest tried, so that the noise may be correlated over longer times.
    """

    factor: int
    orders: NDArray[np.int64]
    bounded: bool


def decimation_from_noise(series: Sequence[NDArray[np.float64]], max_order: int = MAX_ORDER) -> NoiseDecimation:
    """Decimation after which the noise is hardly correlated any more: the order of its AR model (section 6.2.3).

    ``series``: residuals (N, n) at the sampling rate per experiment, N m or N; a tenth of the samples limits the order.
    """
    if not series or any(s.ndim != 2 or s.shape[1] != series[0].shape[1] for s in series):
        raise DataError(f"decimation from noise: expected residuals (N, n), got {[s.shape for s in series]}")
    if not all(np.isfinite(s).all() for s in series):
        raise DataError("decimation from noise: a residual is not a finite number")
    total = sum(s.shape[0] for s in series)
    highest = max(0, min(max_order, total // 10, min(s.shape[0] for s in series) - 1))
    orders = np.array([fit_ar([s[:, j] for s in series], highest).order for j in range(series[0].shape[1])])
    longest = int(orders.max())
    return NoiseDecimation(max(1, longest), orders.astype(np.int64), longest == highest > 0)
