"""Jumps of recorded positions: full turns, single rows that no motion reaches, and steps that last."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array, Mask


@dataclass(frozen=True)
class JumpCriteria:
    """Limits between a motion and a jump; a step is the difference of two rows that follow each other.

    ``ratio``: step over the usual steps near it. Of Gaussian noise the usual step (80 % quantile) is 1.8 standard
    deviations, so that noise exceeds 5 of them once in 1e9 rows. ``near``: changes of value on either side that tell
    the usual step, without ``aside`` at the step itself; ``most``: quantile of all steps that a usual one does not
    exceed where a jump comes back. ``accelerations``: acceleration that the jump needs over the
    usual ones (95 % quantile of the joint), and over its limit. ``start_s``: a joint without a limit of acceleration
    takes at least this time to its velocity limit. ``counts``: least jump in steps of the encoder. ``longest``: rows
    that a value may be wrong before it counts as a lasting step. ``smallest``: least jump over the range of the motion.
    ``turn_share``: largest usual step in turns where steps of a turn are no motion.
    """

    ratio: float = 5.0
    near: int = 20
    aside: int = 3
    quantile: float = 0.8
    most: float = 0.95
    accelerations: float = 10.0
    start_s: float = 0.05
    counts: float = 8.0
    longest: int = 10
    smallest: float = 1e-3
    turn_share: float = 0.1


@dataclass(frozen=True)
class Jumps:
    """Jumps of one position: rows to leave out (N,) and ``steps``, lasting ones, as first row and size, rad or m."""

    wrong: Mask
    steps: tuple[tuple[int, float], ...]


def unwrapped(x: Array, holes: Mask, turn: float, criteria: JumpCriteria) -> tuple[Array, NDArray[np.int64]]:
    """Return a position (N,) without steps of one turn, and the rows of these steps.

    ``holes`` (N - 1,): steps over missing rows, which are no evidence. One row between may have any value.
    """
    nothing = np.zeros(0, dtype=np.int64)
    step = np.diff(x)
    big = np.abs(step) > 0.4 * turn
    if not big.any() or np.quantile(np.abs(step), criteria.quantile) > criteria.turn_share * turn:
        return x, nothing
    tolerance = criteria.turn_share * turn
    turns = np.rint(step / turn)
    whole = (turns != 0) & (np.abs(step - turns * turn) <= tolerance)
    # A row between both ends of a turn, as of a mean over the wrap.
    two = x[2:] - x[:-2]
    split = (np.abs(np.abs(two) - turn) <= tolerance) & ~whole[:-1] & ~whole[1:] & (np.abs(step[:-1]) > tolerance)
    split &= ~holes[:-1] & ~holes[1:]
    moved = np.where(whole, turns, 0.0)
    moved[1:][split] += np.sign(two[split])
    rows = np.flatnonzero((moved != 0) & ~holes) + 1
    if not rows.size:
        return x, nothing
    return x - turn * np.concatenate([[0.0], np.cumsum(moved)]), rows


def jumps(x: Array, dt: float, holes: Mask, fastest: float, hardest: float, criteria: JumpCriteria) -> Jumps:
    """Return the jumps of a position (N,) without wraps. ``fastest``, ``hardest``: limits of velocity, acceleration."""
    wrong = np.zeros(x.size, dtype=np.bool_)
    rows = np.concatenate([[0], np.flatnonzero((np.diff(x) != 0) | holes) + 1])
    y, over_hole = x[rows], holes[rows[1:] - 1]
    if rows.size < 2 * criteria.near:
        return Jumps(wrong, ())
    size = np.where(over_hole, 0.0, np.abs(np.diff(y)))
    changes = size[size > 0]
    if not changes.size:
        return Jumps(wrong, ())
    bends = np.abs(np.diff(y, 2))
    limit = min(hardest, fastest / criteria.start_s)
    least = max(
        criteria.counts * float(changes.min()),
        criteria.smallest * float(np.quantile(y, 0.99) - np.quantile(y, 0.01)),
        criteria.accelerations * max(float(np.quantile(bends, 0.95)), limit * dt**2 if np.isfinite(limit) else 0.0),
    )
    # Single jumps raise the mean of their neighbourhood by little: a quick choice of steps to look at.
    mean = _mean(size, criteria.near + criteria.aside)
    most = float(np.quantile(changes, criteria.most))
    candidates = np.flatnonzero((size > least) & (size > criteria.ratio * np.minimum(mean / 2.0, most)))
    if not candidates.size:
        return Jumps(wrong, ())
    usual = _usual(size, candidates, criteria)
    lasts = size[candidates] > criteria.ratio * usual
    # Several wrong rows during a rest are each other's neighbours; rows that come back need no quiet neighbours.
    usual = np.minimum(usual, most)
    chosen = size[candidates] > criteria.ratio * usual
    steps: list[tuple[int, float]] = []
    done = -1
    for k, allow, last in zip(candidates[chosen], criteria.ratio * usual[chosen], lasts[chosen], strict=True):
        if k < done:
            continue
        # y[k] -> y[k + 1] is a jump: it returns at a later row, or the rows before it are wrong, or it lasts.
        back = _return(y, int(k), max(allow, least), criteria.longest)
        if back:
            wrong[rows[k + 1] : rows[k + 1 + back]] = True
            done = k + 1 + back
        elif not last:
            continue
        elif rows[k + 1] <= criteria.longest:
            wrong[: rows[k + 1]] = True
        elif x.size - rows[k + 1] <= criteria.longest:
            wrong[rows[k + 1] :] = True
            break
        else:
            steps.append((int(rows[k + 1]), float(y[k + 1] - y[k])))
    return Jumps(wrong, tuple(steps))


def _return(y: Array, k: int, allow: float, longest: int) -> int:
    """Number of rows after y[k] until a position is where the motion before would have led; 0 if that is none."""
    slope = y[k] - y[k - 1] if k else 0.0
    jump = y[k + 1] - y[k]
    for m in range(1, min(longest, y.size - k - 2) + 1):
        returned = (y[k + 1] - y[k + 1 + m]) / jump
        apart = y[k + 1 + m] - y[k]
        if returned > 0.5 and min(abs(apart), abs(apart - (m + 1) * slope)) <= allow * (1.0 + m / 4.0):
            return m
    return 0


def _mean(size: Array, reach: int) -> Array:
    """Mean (M,) of each value and of ``reach`` ones on either side; the ends are mirrored."""
    sums = np.cumsum(np.pad(size, (reach + 1, reach), mode="symmetric"))
    return np.asarray((sums[2 * reach + 1 :] - sums[: -2 * reach - 1]) / (2 * reach + 1))


def _usual(size: Array, at: NDArray[np.int64], criteria: JumpCriteria) -> Array:
    """Usual step near each of some steps: a quantile of its neighbours, so that other jumps there do not count."""
    aside, near = criteria.aside, criteria.near
    offsets = np.concatenate([np.arange(-near - aside, -aside + 1), np.arange(aside, near + aside + 1)])
    around = at[:, None] + offsets
    around = np.abs(np.where(around < size.size, around, 2 * (size.size - 1) - around))
    values = size[around]
    place = round(criteria.quantile * (offsets.size - 1))
    return np.asarray(np.partition(values, place, axis=1)[:, place])
