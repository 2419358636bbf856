"""Power spectra of short records: Hann window and periodogram."""

import numpy as np

from armident.arrays import Array


def hann_window(samples: int) -> Array:
    """Symmetric Hann window (N,) of unit norm, so that windowed white noise keeps its power."""
    window = np.hanning(samples)
    return np.asarray(window / np.sqrt(window @ window))


def periodogram(windowed: Array, padding: int = 1) -> Array:
    """``|DFT|^2`` of a windowed record at the frequencies ``k / (padding N dt)`` from zero to the Nyquist frequency.

    White noise of variance v has the level v everywhere; times ``2 dt`` it is the one-sided power density.
    scipy.signal.periodogram has half of this at the Nyquist frequency.
    """
    return np.asarray(np.abs(np.fft.rfft(windowed, padding * windowed.size)) ** 2)
