"""Values that were not renewed: frozen while the joint moves, or repeated from earlier."""

from collections.abc import Callable

import numpy as np

from armident.arrays import Array, Mask
from armident.daq.recording.faults.jumps import JumpCriteria
from armident.daq.recording.faults.updates import resolution
from armident.daq.recording.faults.zeros import NOTHING, runs

Rows = tuple[int, int]

MOST_CHANCE = 1e-3
"""Largest expected number of equal runs as long in the recording by chance."""

LEAST_RUN = 5
"""Equal values in a row that may be frozen: noise of one count keeps a value for fewer."""

NEAR = 8
"""Rows on either side of a run that tell whether a joint moves: shorter than a change of a motion at usual rates."""

SLOW = 0.2
"""Velocity over the usual one from which a joint moves."""

OF_NOISE, OF_SIGNS = -0.25, -1.0 / 6.0
"""Correlation of successive changes, and of their signs, below which an effort is noise: white has -1/2 and -1/3."""

SPANNED = 0.6
"""Least share of renewed values of an effort in coarse steps whose noise, half a step or more, renews it anywhere."""

RUN_RATIO = 3.0
"""Time for which an effort stays the same at the end of a recording over the longest such time before."""

REPEATED = 20
"""Rows in the same order as earlier that are a copy: noise repeats a value of twelve bits so often once in 10^70."""

MOST_ROWS = 10_000
"""Rows that tell the usual velocity."""

APART = 0.01
"""Distance of the positions, in shares of their range, from which equal torques are no repeated motion."""


def frozen_before(x: Array, row: int, criteria: JumpCriteria) -> Rows | None:
    """Rows of the equal positions (N,) before a step to ``row``, if the joint stops there as no motion does."""
    other = np.flatnonzero(x[:row] != x[row - 1])
    if not other.size or row - 1 - other[-1] < LEAST_RUN:
        return None
    begin = int(other[-1]) + 1
    usual = float(np.quantile(np.abs(np.diff(x, 2)), criteria.most))
    stops = begin > 1 and abs(x[begin - 1] - x[begin - 2]) > criteria.ratio * usual
    return (begin + 1, row) if stops else None


def frozen_efforts(effort: Array, position: Array, criteria: JumpCriteria) -> Mask:
    """Mask (N, n) of efforts (N, n) that stay the same too long for chance while their joints move.

    A smooth effort in coarse steps is flat at its peaks: one that is frozen ends with a jump, or lasts to the end and
    much longer. At its extremes an effort is clipped, and zeros are faults of their own.
    """
    found = np.zeros(effort.shape, dtype=np.bool_)
    moves = _moves(position)
    for j, x in enumerate(effort.T):
        change = np.diff(x)
        step, sign = np.abs(change), np.sign(change)
        renewed = np.flatnonzero(step)
        if not renewed.size:
            continue
        wide = renewed.size > SPANNED * step.size or not resolution(x)
        # Rare large changes, as at the counts of an encoder, have the correlation of noise; their signs have not.
        opposite = float(sign[1:] @ sign[:-1]) < OF_SIGNS * np.count_nonzero(sign[1:] * sign[:-1])
        noisy = wide and opposite and float(change[1:] @ change[:-1]) < OF_NOISE * float(change @ change)
        jump = criteria.ratio * float(np.quantile(step, criteria.most))
        chance = np.log(max(1.0 - renewed.size / step.size, 1.0 / step.size))
        longest = max((np.log(MOST_CHANCE) - np.log(step.size)) / min(chance, -1e-12), LEAST_RUN)
        ends = np.concatenate([[-1], renewed, [step.size]])
        lengths = np.sort(np.diff(ends))
        for k in np.flatnonzero(np.diff(ends) > longest):
            begin, end = int(ends[k]) + 1, int(ends[k + 1])
            outermost = x[begin] in (x.min(), x.max())
            jumps = step[end] > jump if end < step.size else end - begin > RUN_RATIO * lengths[-2]
            if (noisy or jumps) and not outermost and abs(x[begin]) >= NOTHING:
                found[begin + 1 : end + 1, j] = moves(begin, end)[j]
    return found


def repeated_efforts(effort: Array, position: Array) -> Mask:
    """Mask (N,) of efforts (N, n) that repeat an earlier stretch row by row although the arm is elsewhere."""
    found = np.zeros(len(effort), dtype=np.bool_)
    key = effort @ np.sqrt(np.arange(2.0, 2.0 + effort.shape[1]))
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(np.diff(key[order]) == 0)
    lag = np.zeros(len(effort), dtype=np.int64)
    lag[order[same + 1]] = order[same + 1] - order[same]
    far = APART * np.maximum(np.ptp(position, axis=0), 1e-300)
    for begin, end in runs(np.asarray((np.diff(lag) == 0) & (lag[1:] > 0))):
        rows = np.arange(begin, end + 1)
        changes = np.count_nonzero(np.diff(key[rows]))
        elsewhere = np.any(np.abs(position[rows] - position[rows - lag[begin]]) > far, axis=1).all()
        if changes >= REPEATED and elsewhere:
            found[rows] = True
    return found


def _moves(position: Array) -> Callable[[int, int], Mask]:
    """Return a function of two rows: which joints (n,) move between them, against their usual velocity."""
    some = np.arange(0, len(position) - NEAR, max(1, len(position) // MOST_ROWS))
    usual = np.quantile(np.abs(position[some + NEAR] - position[some]), JumpCriteria().quantile, axis=0) / NEAR

    def between(begin: int, end: int) -> Mask:
        first, last = max(begin, 0), min(end, len(position) - 1)
        if last <= first:
            return np.zeros(usual.size, dtype=np.bool_)
        # differences over several rows: noise of the encoders is no motion
        rows = np.append(np.arange(first, last, NEAR), last)
        velocity = np.abs(np.diff(position[rows], axis=0)).sum(axis=0) / (last - first)
        return np.asarray((usual > 0) & (velocity >= SLOW * usual))

    return between
