"""The reference between two set points: the straight line that a CiA 402 drive interpolates (60C2h)."""

import numpy as np
from numpy.typing import NDArray


def between_set_points(
    at: NDArray[np.int64], every: int, sync: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Places of samples with the SYNC numbers ``sync`` (N,) among set points at ``at`` (k,), reported ``every`` SYNCs.

    Mask (N,) without those near a lost set point, set points before and after, and share (N, 1) of the way.
    """
    before = np.searchsorted(at, sync, side="right") - 1
    low = np.maximum(before, 0)
    high = np.minimum(low + 1, at.size - 1)
    width = at[high] - at[low]
    known = (before >= 0) & ((at[low] == sync) | (width == every))
    return known, low, high, np.clip((sync - at[low]) / np.maximum(width, 1), 0.0, 1.0)[:, None]
