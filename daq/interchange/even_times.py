"""Resampling of samples with uneven times onto an even clock."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError
from armident.daq.interchange.time_stamps import MOST_NUMBERS

HOLE = 1.5
"""Steps longer than this number of usual ones, and than usual jitter beyond it, are holes."""
_USUAL = 0.8
"""Share of the steps whose deviations from the median are usual jitter."""
_FEWEST = 4
"""Rows that a cubic spline needs; shorter pieces between holes are left out."""
_MOST_BETWEEN = 1000.0
"""Most even samples between two rows that are no hole: more are no resampling."""
_MOST_UNEVEN = 0.5
"""Share of steps that are holes above which the rows are no samples of one motion."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class EvenSamples:
    """Samples on an even clock, with gaps.

    ``numbers``: number of each sample, from 0, strictly increasing, (M,); ``values``: quantities, (M, n) each;
    ``left_out``: rows of pieces too short to resample; ``steps_s``: quantiles 0.01, 0.5 and 0.99 of the steps of the
    times, s.
    """

    numbers: NDArray[np.int64]
    values: dict[str, Floats]
    holes: int
    left_out: int
    steps_s: tuple[float, float, float]


def usual_rate(times: Floats) -> float:
    """Return the rate of the usual step, 1/s. ``times`` (N,), s, strictly increasing."""
    return 1.0 / float(np.median(np.diff(times)))


def onto_even_times(times: Floats, raw: Mapping[str, Floats], rate_hz: float) -> EvenSamples:
    """Return samples at even times: positions by cubic splines, efforts linearly; nothing across holes.

    ``times`` (N,), s, strictly increasing. ``raw``: quantities (N, n); ``position`` and ``demand`` are smooth, others
    are not. ``rate_hz``: rate of the even clock, 1/s, not much below that of the rows. Raises DataError if there are
    too few rows, or too many holes.
    """
    from scipy.interpolate import CubicSpline

    steps = np.diff(times)
    if steps.size + 1 < _FEWEST:
        raise DataError(f"only {steps.size + 1} rows: too few to resample")
    median = float(np.median(steps))
    jitter = float(np.quantile(np.abs(steps / median - 1.0), _USUAL))
    holes = np.flatnonzero(steps > (HOLE + jitter) * median)
    if holes.size > _MOST_UNEVEN * steps.size:
        raise DataError(f"{holes.size} of {steps.size} steps are holes: the rows are no samples of one clock")
    numbers: list[NDArray[np.int64]] = []
    values: dict[str, list[Floats]] = {name: [] for name in raw}
    left_out = 0
    relative = times - times[0]
    between = (HOLE + jitter) * median * rate_hz
    if between > _MOST_BETWEEN or not relative[-1] * rate_hz < MOST_NUMBERS:
        raise DataError(
            f"steps of {steps.min():.4g} to {steps.max():.4g} s are no samples of a clock of {rate_hz:g} Hz"
        )
    for piece in np.split(np.arange(times.size), holes + 1):
        own = relative[piece]
        clock = np.arange(np.ceil(own[0] * rate_hz - 1e-6), np.floor(own[-1] * rate_hz + 1e-6) + 1, dtype=np.int64)
        if piece.size < _FEWEST or not clock.size:
            left_out += piece.size
            continue
        at = np.clip(clock / rate_hz, own[0], own[-1])
        numbers.append(clock)
        for name, array in raw.items():
            if name in ("position", "demand"):
                values[name].append(np.ascontiguousarray(CubicSpline(own, array[piece])(at)))
            else:
                values[name].append(np.stack([np.interp(at, own, column) for column in array[piece].T], axis=1))
    if not numbers:
        raise DataError("no piece without a hole is long enough to resample")
    low, middle, high = (float(x) for x in np.quantile(steps, [0.01, 0.5, 0.99]))
    joined = {name: np.concatenate(parts) for name, parts in values.items()}
    return EvenSamples(np.concatenate(numbers), joined, holes.size, left_out, (low, middle, high))
