"""Samples of a controller that was read without waiting for it, put back on the controller's clock.

A program that asks an arm for its state as fast as it can gets some samples twice and misses others, and when it asked
says little about when the controller sampled. The motion does: from one sample to the next the joints advance by a
whole number of the increments that are usual around it.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import median_filter

from armident.configs import DataError

WINDOW = 21
"""Increments whose median is the usual one: odd, far shorter than any motion, and more than a burst of misses."""

SLOW = 0.02
"""Share of the fastest increment below which digits are too few to tell how many samples went by."""

DOUBTFUL = 0.25
"""An advance this far from a whole number of samples is doubtful."""

MOST_DOUBTFUL = 0.05
"""Share of doubtful advances beyond which the rows are not samples of one clock."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class EvenClockSamples:
    """Even samples, and how many rows were repeats and how many samples were interpolated."""

    values: dict[str, Floats]
    repeated: int
    interpolated: int


def onto_even_clock(raw: Mapping[str, Floats]) -> EvenClockSamples:
    """Rows as they were read, as the samples of an even clock.

    Repeated rows are dropped and skipped samples interpolated: positions by a cubic spline, efforts linearly. Where
    the arm stands still every row counts as one sample.

    Parameters
    ----------
    raw
        Quantities (N, n) as read; ``position`` is one of them.

    Raises
    ------
    DataError
        If the rows do not fit an even clock, or there are too few.
    """
    rows = np.concatenate(list(raw.values()), axis=1)
    fresh = np.append(True, np.any(rows[1:] != rows[:-1], axis=1))
    index = np.flatnonzero(fresh)
    if index.size <= WINDOW:
        raise DataError(
            f"only {index.size} of {rows.shape[0]} rows differ from the row before: too few to find a clock"
        )
    advances = _advances(raw["position"][index], np.diff(index))
    # A position that is read again with another effort is still the same sample.
    kept = np.append(True, advances > 0)
    index, ticks = index[kept], np.append(0, np.cumsum(advances))[kept]
    clock = np.arange(ticks[-1] + 1)
    values = {}
    for name, value in raw.items():
        if name in ("position", "demand"):
            values[name] = np.ascontiguousarray(CubicSpline(ticks, value[index])(clock))
        else:
            values[name] = np.stack([np.interp(clock, ticks, column) for column in value[index].T], axis=1)
    return EvenClockSamples(values, rows.shape[0] - index.size, clock.size - index.size)


def _advances(q: Floats, rows: Ints) -> Ints:
    """Samples from each row (N, n) to the next (N - 1,); where nothing moves, the number of ``rows`` that were read."""
    steps = np.diff(q, axis=0)
    usual = median_filter(steps, size=(WINDOW, 1), mode="nearest")
    power = np.sum(usual**2, axis=1)
    moving = power > SLOW**2 * power.max()
    if not moving.any():
        raise DataError("nothing moves: the clock of the controller cannot be found")
    advance = np.sum(steps[moving] * usual[moving], axis=1) / power[moving]
    doubtful = float(np.mean(np.abs(advance - np.round(advance)) > DOUBTFUL))
    if doubtful > MOST_DOUBTFUL:
        raise DataError(
            f"{100 * doubtful:.0f} % of the rows are not a whole number of samples after the row before: "
            "not read from a controller with an even clock"
        )
    ticks = rows.astype(np.int64)
    ticks[moving] = np.maximum(0, np.round(advance)).astype(np.int64)
    return ticks
