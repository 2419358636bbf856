"""Repetitions of a motion: the repeatable part of the residual is model error, the rest is noise."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate, signal

from armident.identify.diagnosis.study import Study

Array = NDArray[np.float64]

SAME = 1e-3
"""Mean square distance of two equal motions over that of both from their mean, with positions scaled by the spread of
each joint: 4.5 % of the spread."""

MOVING = 0.1
"""Speed of any joint, over its root mean square, above which the arm moves."""

SHORTEST = 10.0
"""Shortest repetition, in periods of the bandwidth of the motion."""


@dataclass(frozen=True)
class Repeat:
    """The same motion twice.

    Parameters
    ----------
    first, second
        Numbers of the two stretches, those of the training data before the held-out ones.
    rows, again
        Rows of the motion and of its repetition, at the rate of the comparison.
    shift
        Delay of the repetition beyond its rows, in rows; at most one half.
    """

    first: int
    second: int
    rows: slice
    again: slice
    shift: float

    def halves(self, values: Sequence[Array]) -> tuple[Array, Array]:
        """Sum and difference of the values of both stretches over ``sqrt 2``, (L, n) each.

        Noise that is independent of the motion has the same spectrum in both; the repeatable part is in the sum only.
        """
        there = np.arange(values[self.second].shape[0], dtype=np.float64)
        spline = interpolate.CubicSpline(there, values[self.second], axis=0)
        a = values[self.first][self.rows]
        b = spline(there[self.again] + self.shift)
        return (a + b) / np.sqrt(2.0), (a - b) / np.sqrt(2.0)


def repeats(study: Study, period: float) -> tuple[Repeat, ...]:
    """All repetitions, the longest first; no sample is in two of them.

    Parameters
    ----------
    study
        The stretches.
    period
        Period of the bandwidth of the motion, s.
    """
    stretches = [*study.train, *study.held]
    kept = [study.decimation.instants(s.measured.q.shape[0]) for s in stretches]
    moves = [s.measured.qd[rows] for s, rows in zip(stretches, kept, strict=True)]
    places = [s.measured.q[rows] for s, rows in zip(stretches, kept, strict=True)]
    every = np.concatenate(places)
    centre, spread = every.mean(axis=0), np.maximum(every.std(axis=0), 1e-12)
    places = [(p - centre) / spread for p in places]
    speed = np.sqrt(np.mean(np.concatenate(moves) ** 2, axis=0))
    moving = [np.any(np.abs(m) > MOVING * speed, axis=1) for m in moves]
    least = max(8, int(np.ceil(SHORTEST * period / (study.dt * study.decimation.factor))))
    found = []
    for a, b in combinations_with_replacement(range(len(stretches)), 2):
        best = _longest(places[a], places[b], moving[a], least, itself=a == b)
        if best is not None:
            found.append(Repeat(a, b, *best))
    found.sort(key=lambda r: r.rows.start - r.rows.stop)
    used = [np.zeros_like(m) for m in moving]
    chosen = []
    for r in found:
        if not used[r.first][r.rows].any() and not used[r.second][r.again].any():
            used[r.first][r.rows] = used[r.second][r.again] = True
            chosen.append(r)
    return tuple(chosen)


def _longest(
    a: Array, b: Array, moving: NDArray[np.bool_], least: int, *, itself: bool
) -> tuple[slice, slice, float] | None:
    """Longest piece of one motion (M, n) that another one (M', n) repeats, or the same one at another time."""
    m, k = a.shape[0], b.shape[0]
    lags = np.arange(-(m - 1), k)
    # The motion a(t) against b(t + lag).
    common = sum(signal.correlate(b[:, j], a[:, j], mode="full", method="fft") for j in range(a.shape[1]))
    begin, end = np.maximum(0, -lags), np.minimum(m, k - lags)
    power_a, power_b, moved = (
        np.concatenate([[0.0], np.cumsum(x)]) for x in (np.sum(a**2, axis=1), np.sum(b**2, axis=1), moving)
    )
    both = power_a[end] - power_a[begin] + power_b[end + lags] - power_b[begin + lags]
    misses = (both - 2 * common) / np.maximum(both, 1e-300)
    length = np.minimum(end - begin, lags) if itself else end - begin
    # Standstill at the same place is no repeated motion.
    fits = (length >= least) & (moved[end] - moved[begin] > 0.5 * (end - begin)) & (misses < SAME)
    if not fits.any():
        return None
    # Neighbouring lags fit, too: take the best of those nearly as long as the longest.
    nearly = fits & (length >= 0.9 * np.max(length[fits]))
    at = int(np.argmin(np.where(nearly, misses, np.inf)))
    lag, size, first = int(lags[at]), int(length[at]), int(begin[at])
    shift = _vertex(misses[at - 1 : at + 2]) if 0 < at < lags.size - 1 else 0.0
    # A row less at either end, for the shift.
    rows = slice(first + 1, first + size - 1)
    return rows, slice(rows.start + lag, rows.stop + lag), shift


def _vertex(values: Array) -> float:
    """Abscissa of the minimum of the parabola through values at -1, 0, 1."""
    bend = values[0] - 2 * values[1] + values[2]
    return float(np.clip(0.5 * (values[0] - values[2]) / bend, -0.5, 0.5)) if bend > 0 else 0.0
