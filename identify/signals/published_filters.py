"""The preprocessing that EMPS and many other data sets were published with: IIR filters as MATLAB applies them."""

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from armident.configs import DataError


def chebyshev_decimate(
    x: NDArray[np.float64], factor: int, order: int, ripple_db: float, padlen: int
) -> NDArray[np.float64]:
    """Zero-phase Chebyshev low-pass at 0.8 of the new Nyquist frequency, then one sample of ``factor``.

    In second-order sections: as one transfer function the filter is numerically broken beyond ``factor`` of
    about 30. The samples kept are those of MATLAB's ``decimate``: the last one is among them.

    Parameters
    ----------
    x
        Shape (N, ...).
    padlen
        Samples of odd extension at each end.

    Raises
    ------
    DataError
        If there are not more than ``padlen`` samples.
    """
    if x.shape[0] <= padlen:
        raise DataError(f"decimating needs more than {padlen} samples, got {x.shape[0]}")
    sections = signal.cheby1(order, ripple_db, 0.8 / factor, output="sos")
    filtered: NDArray[np.float64] = signal.sosfiltfilt(sections, x, axis=0, padlen=padlen)
    return filtered[kept_samples(x.shape[0], factor)]


def kept_samples(samples: int, factor: int) -> NDArray[np.int64]:
    """Indices that MATLAB's ``decimate`` keeps of ``samples``."""
    first = factor - (factor * (-(-samples // factor)) - samples) - 1
    return np.arange(first, samples, factor, dtype=np.int64)
