"""Power spectra of short records."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def hann_window(samples: int) -> Array:
    """Symmetric Hann window divided by its norm, so that windowed white noise keeps its power; shape (N,).

    Parameters
    ----------
    samples
        Length N.
    """
    window = np.hanning(samples)
    return np.asarray(window / np.sqrt(window @ window))


def periodogram(windowed: Array, padding: int = 1) -> Array:
    """``|DFT|^2`` of a windowed record at the frequencies ``k / (padding N dt)`` from zero to the Nyquist frequency.

    White noise of variance v has the level v at every frequency; times ``2 dt`` it is the one-sided power density.
    scipy.signal.periodogram is not used: its one-sided density has half of this at the Nyquist frequency.

    Parameters
    ----------
    windowed
        Record times :func:`hann_window`, shape (N,).
    padding
        Frequencies over independent ones.

    Returns
    -------
    ndarray
        Shape (padding N // 2 + 1,).
    """
    return np.asarray(np.abs(np.fft.rfft(windowed, padding * windowed.size)) ** 2)
