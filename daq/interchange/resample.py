"""Resampling of polled samples onto the even clock of the controller.

A program that polls the state of an arm as fast as it can gets some samples twice and misses others. Its own times
are no measure of the controller's sampling times. The motion is one: from one sample to the next, the joints advance
by a whole multiple of their usual increments at that time.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError

WINDOW = 21
"""Increments in the median filter: odd, far shorter than any motion, and longer than a burst of missed samples."""

SLOW_SHARE = 0.02
"""Share of the largest increment below which the number of samples is not resolved."""

AMBIGUOUS = 0.25
"""Distance of an advance from a whole number of samples above which it is ambiguous."""

MOST_AMBIGUOUS = 0.05
"""Share of ambiguous advances above which the rows are not samples of one clock."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class EvenClockSamples:
    """Samples on an even clock.

    ``values``: quantities, (M, n) each; ``repeated``: number of repeated rows that were dropped; ``interpolated``:
    number of missed samples that were interpolated.
    """

    values: dict[str, Floats]
    repeated: int
    interpolated: int


def onto_even_clock(raw: Mapping[str, Floats]) -> EvenClockSamples:
    """Return polled rows as samples on an even clock.

    Repeated rows are dropped and missed samples interpolated: positions by a cubic spline, efforts linearly. During
    standstill every row counts as one sample.

    ``raw``: quantities (N, n) as read; ``position`` is one of them. Raises DataError if the rows do not fit an even
    clock, or there are too few.
    """
    rows = np.concatenate(list(raw.values()), axis=1)
    changed = np.append(True, np.any(rows[1:] != rows[:-1], axis=1))
    index = np.flatnonzero(changed)
    from scipy.interpolate import CubicSpline

    if index.size <= WINDOW:
        raise DataError(f"only {index.size} of {rows.shape[0]} rows differ from the row before: too few to resample")
    advances = _advances(raw["position"][index], np.diff(index))
    # The same position with another effort is still the same sample.
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
    """Return the samples from each row (N, n) to the next, (N - 1,); during standstill, the number of ``rows`` read."""
    from scipy.ndimage import median_filter

    steps = np.diff(q, axis=0)
    median_steps = median_filter(steps, size=(WINDOW, 1), mode="nearest")
    power = np.sum(median_steps**2, axis=1)
    moving = power > SLOW_SHARE**2 * power.max()
    if not moving.any():
        raise DataError("no joint moves: the sampling clock cannot be determined; omit --polled")
    advance = np.sum(steps[moving] * median_steps[moving], axis=1) / power[moving]
    ambiguous = float(np.mean(np.abs(advance - np.round(advance)) > AMBIGUOUS))
    if ambiguous > MOST_AMBIGUOUS:
        raise DataError(
            f"{100 * ambiguous:.0f} % of the rows do not fit an even clock; "
            "omit --polled if they were not polled from a controller"
        )
    ticks = rows.astype(np.int64)
    ticks[moving] = np.maximum(0, np.round(advance)).astype(np.int64)
    return ticks
