"""How fast the recorded motion is, where nobody said it."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from configs import DataError

POWER_SHARE = 0.99
"""Share of the power of the velocity that lies below the bandwidth of the motion."""

MARGIN = 2.0
"""From the bandwidth of the motion to the closed-loop bandwidth that the filters are chosen for."""


def motion_bandwidth(q: Sequence[NDArray[np.float64]], dt: float) -> float:
    """Bandwidth (Hz) to choose filters by: a margin above where nearly all power of every joint's velocity lies.

    Parameters
    ----------
    q
        Measured positions (N, n) of every experiment.
    dt
        Sampling period, s.

    Raises
    ------
    DataError
        If nothing moves.
    """
    highest = 0.0
    for positions in q:
        velocity = np.diff(positions, axis=0) / dt
        frequency, power = signal.periodogram(velocity, 1 / dt, window="hann", axis=0)
        below = frequency <= 0.1 / dt
        cumulative = np.cumsum(power[below], axis=0)
        for j in np.flatnonzero(cumulative[-1] > 0):
            reached = np.searchsorted(cumulative[:, j], POWER_SHARE * cumulative[-1, j])
            highest = max(highest, float(frequency[reached]))
    if highest == 0:
        raise DataError("nothing moves in this recording")
    return MARGIN * highest
