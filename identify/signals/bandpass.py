"""Bandpass filtering of the thesis: zero-phase Butterworth filter and central differences (section 2.3.1)."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from armident.configs import DataError


def butterworth(
    x: NDArray[np.float64], dt: float, cutoff_hz: float, order: int = 4, padlen: int | None = None
) -> NDArray[np.float64]:
    """Zero-phase Butterworth low-pass along the first axis, in second-order sections.

    ``x``: signal, shape (N,) or (N, n). ``cutoff_hz``: cut-off frequency of one pass, Hz; forward and reverse pass
    together have -6 dB there. ``order``: filter order of one pass. ``padlen``: number of samples of odd extension at
    each end; ``None``: ``3 * order``. Raises DataError if the cut-off is not below the Nyquist frequency or the signal
    is not longer than the padding.
    """
    if cutoff_hz * dt >= 0.5:
        raise DataError(f"cut-off {cutoff_hz:g} Hz is not below half the sampling rate ({0.5 / dt:g} Hz)")
    padlen = 3 * order if padlen is None else padlen
    if x.shape[0] <= padlen:
        raise DataError(f"filtering needs more than {padlen} samples, got {x.shape[0]}")
    sections = _sections(order, 2 * cutoff_hz * dt)
    filtered: NDArray[np.float64] = signal.sosfiltfilt(sections, x, axis=0, padlen=padlen)
    return filtered


@lru_cache(maxsize=64)
def _sections(order: int, cutoff: float) -> NDArray[np.float64]:
    """Second-order sections of a low-pass; ``cutoff`` relative to half the sampling rate."""
    sections: NDArray[np.float64] = signal.butter(order, cutoff, output="sos")
    return sections


def central_difference(x: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
    """Derivative ``(x(k+1) - x(k-1)) / (2 dt)`` along the first axis, one-sided at both ends.

    ``x``: signal, shape (N,) or (N, n). Result: shape of ``x``, in its unit per s.
    """
    return np.gradient(x, dt, axis=0)
