"""Efforts that are no measurement: zero in every row, or in rows between others that are not."""

import numpy as np
from numpy.typing import NDArray

from armident.daq.recording.faults.jumps import JumpCriteria

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

NOTHING = 1e-300
"""Magnitude below which an effort is 0 in every unit: memory that was never written holds such numbers."""


def never_measured(effort: Array) -> Mask:
    """Mask (n,) of the efforts (N, n) that are 0 in every row."""
    return np.asarray((np.abs(effort) < NOTHING).all(axis=0), dtype=np.bool_)


def zero_rows(effort: Array, holes: Mask, criteria: JumpCriteria) -> Mask:
    """Mask (N, n) of zeros in few rows between efforts far from 0 on both sides.

    Rows in which all joints are 0 count together: one of them that is far from 0 tells for all.
    """
    zero = np.abs(effort) < NOTHING
    found = np.zeros(effort.shape, dtype=np.bool_)
    used = ~zero.all(axis=0)
    if not zero[:, used].any():
        return found
    far = np.zeros(effort.shape, dtype=np.bool_)
    for j in np.flatnonzero(used):
        far[:, j] = _far(effort[:, j], zero[:, j], holes, criteria)
    together = zero[:, used].all(axis=1) & (used.sum() > 1)
    for begin, end in _runs(together):
        if end - begin <= criteria.longest and far[begin:end].any():
            found[begin:end, used] = True
    if found.any() and found.any(axis=1).sum() >= 0.5 * together.sum():
        for begin, end in _runs(together):
            found[begin:end, used] |= end - begin <= criteria.longest
    return found | far


def _far(x: Array, zero: Mask, holes: Mask, criteria: JumpCriteria) -> Mask:
    """Zeros of an effort (N,) between values on one side of it, farther from 0 than its usual steps."""
    found = np.zeros(x.size, dtype=np.bool_)
    changes = np.abs(np.diff(x[~zero]))
    changes = changes[changes > 0]
    if not changes.size:
        return found
    least = criteria.ratio * float(np.quantile(changes, criteria.quantile))
    for begin, end in _runs(zero):
        if begin == 0 or end == x.size or end - begin > criteria.longest or holes[begin - 1 : end].any():
            continue
        before, after = x[begin - 1], x[end]
        found[begin:end] = before * after > 0 and min(abs(before), abs(after)) > least
    return found


def _runs(mask: Mask) -> list[tuple[int, int]]:
    """First row, and the one after the last, of each run of true rows."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
