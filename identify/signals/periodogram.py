"""Power spectra of short records: Hann window and periodogram."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def hann_window(samples: int) -> Array:
    """Symmetric Hann window of unit norm, so that windowed white noise keeps its power; shape (N,).

    ``samples``: length N of the window.
    """
    window = np.hanning(samples)
    return np.asarray(window / np.sqrt(window @ window))


def periodogram(windowed: Array, padding: int = 1) -> Array:
    """``|DFT|^2`` of a windowed record at the frequencies ``k / (padding N dt)`` from zero to the Nyquist frequency.

    White noise of variance v has the expected level v at every frequency. Multiplied by ``2 dt`` the result is the
    one-sided power density.
    scipy.signal.periodogram is not used: its one-sided density has half of this at the Nyquist frequency.

    ``windowed``: record multiplied by :func:`hann_window`, shape (N,); ``padding``: zero-padding factor: the length of
    the DFT is ``padding N``. Result: shape (padding N // 2 + 1,), in the squared unit of the record.
    """
    return np.asarray(np.abs(np.fft.rfft(windowed, padding * windowed.size)) ** 2)
