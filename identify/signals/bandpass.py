"""Bandpass filtering of the thesis: zero-phase Butterworth filter and central differences (section 2.3.1)."""

import numpy as np

from armident.arrays import Array
from armident.configs import DataError
from armident.identify.signals.recursive import butterworth_sections, zero_phase


def butterworth(x: Array, dt: float, cutoff_hz: float, order: int = 4, padlen: int | None = None) -> Array:
    """Zero-phase Butterworth low-pass along the first axis, in second-order sections; -6 dB at the cut-off.

    ``padlen``: samples of odd extension at each end, by default ``3 * order`` (of one pass).
    """
    if cutoff_hz * dt >= 0.5:
        raise DataError(f"cut-off {cutoff_hz:g} Hz is not below half the sampling rate ({0.5 / dt:g} Hz)")
    padlen = 3 * order if padlen is None else padlen
    if x.shape[0] <= padlen:
        raise DataError(f"filtering needs more than {padlen} samples, got {x.shape[0]}")
    sections = butterworth_sections(order, 2 * cutoff_hz * dt)
    return zero_phase(sections, x, padlen)


def central_difference(x: Array, dt: float) -> Array:
    """Derivative ``(x(k+1) - x(k-1)) / (2 dt)`` along the first axis, one-sided at both ends."""
    return np.gradient(x, dt, axis=0)
