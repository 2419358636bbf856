"""Efforts that are no measurement: zero in every row, or 0 or beyond the limit in rows between others that are not."""

import numpy as np

from armident.arrays import Array, Mask
from armident.daq.recording.faults.jumps import JumpCriteria

NOTHING = 1e-300
"""Magnitude below which an effort is 0 in every unit: memory that was never written holds such numbers."""

FAR_BEYOND = 3.0
"""Effort over the usual ones (95 % quantile) from which one beyond the limit is no peak of a motion."""

LEAST_OFF_S = 0.1
"""Shortest time, s, for which drives are off."""


def never_measured(effort: Array) -> Mask:
    """Mask (n,) of the efforts (N, n) that are 0 in every row."""
    return np.asarray((np.abs(effort) < NOTHING).all(axis=0), dtype=np.bool_)


def zero_rows(effort: Array, holes: Mask, criteria: JumpCriteria) -> Mask:
    """Mask (N, n) of zeros in few rows between efforts far from 0 on both sides."""
    zero = np.abs(effort) < NOTHING
    found = np.zeros(effort.shape, dtype=np.bool_)
    used = ~zero.all(axis=0)
    if not zero[:, used].any():
        return found
    far = np.zeros(effort.shape, dtype=np.bool_)
    for j in np.flatnonzero(used):
        far[:, j] = _far(effort[:, j], zero[:, j], holes, criteria)
    together = zero[:, used].all(axis=1) & (used.sum() > 1)
    for begin, end in runs(together):
        if end - begin <= criteria.longest and far[begin:end].any():
            found[begin:end, used] = True
    if found.any() and found.any(axis=1).sum() >= 0.5 * together.sum():
        for begin, end in runs(together):
            found[begin:end, used] |= end - begin <= criteria.longest
    return found | far


def rows_beyond(effort: Array, strongest: Array, criteria: JumpCriteria) -> tuple[Mask, Array]:
    """Mask (N, n) of efforts beyond their limits (n,) and all others in few rows, and efforts with the rows before."""
    size = np.abs(effort)
    beyond = size > np.maximum(strongest, FAR_BEYOND * np.quantile(size, criteria.most, axis=0))
    for j in np.flatnonzero(beyond.any(axis=0)):
        for begin, end in runs(beyond[:, j]):
            beyond[begin:end, j] = end - begin <= criteria.longest
    before = np.maximum.accumulate(np.where(beyond, 0, np.arange(len(effort))[:, None]), axis=0)
    return beyond, np.take_along_axis(effort, before, axis=0)


def switched_off(effort: Array, dt: float, criteria: JumpCriteria) -> list[tuple[int, int]]:
    """First row, and the one after the last, of stretches of time in which all efforts (N, n) are 0, unlike elsewhere.

    At both ends an effort is far from 0: an arm at rest without load has small efforts before and after, too.
    """
    used = ~never_measured(effort)
    if not used.any():
        return []
    x = effort[:, used]
    zero: Mask = np.asarray((np.abs(x) < NOTHING).all(axis=1), dtype=np.bool_)
    usual = np.array([float(np.quantile(np.abs(np.diff(v[~zero])), criteria.quantile)) for v in x.T])
    far: Mask = np.asarray((np.abs(x) > criteria.ratio * usual).any(axis=1), dtype=np.bool_)
    return [
        (begin, end)
        for begin, end in runs(zero)
        if (end - begin) * dt >= LEAST_OFF_S
        and end - begin > criteria.longest
        and (begin > 0 or end < len(x))
        and (begin == 0 or far[begin - 1])
        and (end == len(x) or far[end])
    ]


def _far(x: Array, zero: Mask, holes: Mask, criteria: JumpCriteria) -> Mask:
    """Zeros of an effort (N,) between values on one side of it, farther from 0 than its usual steps."""
    found = np.zeros(x.size, dtype=np.bool_)
    changes = np.abs(np.diff(x[~zero]))
    changes = changes[changes > 0]
    if not changes.size:
        return found
    least = criteria.ratio * float(np.quantile(changes, criteria.quantile))
    for begin, end in runs(zero):
        if begin == 0 or end == x.size or end - begin > criteria.longest or holes[begin - 1 : end].any():
            continue
        before, after = x[begin - 1], x[end]
        found[begin:end] = before * after > 0 and min(abs(before), abs(after)) > least
    return found


def runs(mask: Mask) -> list[tuple[int, int]]:
    """First row, and the one after the last, of each run of true rows."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
