"""Preprocessing used for the published EMPS data and many other data sets: IIR filters as applied by MATLAB."""

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import DataError


def chebyshev_decimate(x: Array, factor: int, order: int, ripple_db: float, padlen: int) -> Array:
    """Decimate with a zero-phase Chebyshev low-pass (type I) at 0.8 of the new Nyquist frequency.

    Second-order sections: one transfer function fails numerically for a ``factor`` above about 30. The samples kept are
    those of MATLAB's ``decimate``. ``padlen``: samples of odd extension at each end.
    """
    from scipy import signal

    if x.shape[0] <= padlen:
        raise DataError(f"decimating needs more than {padlen} samples, got {x.shape[0]}")
    sections = signal.cheby1(order, ripple_db, 0.8 / factor, output="sos")
    filtered: Array = signal.sosfiltfilt(sections, x, axis=0, padlen=padlen)
    return filtered[kept_samples(x.shape[0], factor)]


def kept_samples(samples: int, factor: int) -> NDArray[np.int64]:
    """Indices (M,) of the samples that MATLAB's ``decimate`` keeps."""
    first = factor - (factor * (-(-samples // factor)) - samples) - 1
    return np.arange(first, samples, factor, dtype=np.int64)
