"""Sample numbers of stamped samples: whole periods from one to the next, so that missing samples are gaps."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError
from armident.daq.interchange.time_stamps import RATE_TOLERANCE
from armident.daq.recording import Gap, Stream

AMBIGUOUS = 0.25
"""Distance, periods, of a step from a whole number of periods above which missing samples cannot be counted."""

JITTER = 0.01
"""Largest deviation of a step from the period, relative, without a stated rate."""


def sample_numbers(t_ns: NDArray[np.int64], rate_hz: float | None = None) -> tuple[NDArray[np.int64], float]:
    """Return the number of each sample, from 0, and the sampling rate, 1/s.

    ``t_ns``: times of the samples, ns, increasing, (N,). ``rate_hz``: sampling rate, 1/s, for times that jitter;
    ``None``: that of the times. Raises DataError if there is one sample only, if the times contradict the rate, or if
    they are too uneven to count the samples that are missing between them.
    """
    steps_ns = np.diff(t_ns)
    steps = steps_ns / 1e9
    if steps.size == 0:
        raise DataError("a single sample is not a recording")
    if steps.min() <= 0:
        raise DataError(f"the time of sample {int(np.argmin(steps)) + 2} is not after that of the one before")
    median = float(np.median(steps))
    single = steps_ns[np.abs(steps - median) <= AMBIGUOUS * median]
    measured = single.size * 1e9 / float(single.sum())
    period = 1.0 / measured
    if rate_hz is not None and abs(rate_hz / measured - 1.0) > RATE_TOLERANCE:
        raise DataError(
            f"--rate {rate_hz:g} contradicts the times of the samples, whose usual step of {period:.6g} s "
            f"is a rate of {measured:.6g} Hz"
        )
    advance = np.round(steps / period)
    error = np.abs(steps / period - advance)
    tolerance = JITTER if rate_hz is None else AMBIGUOUS
    uneven = np.flatnonzero((error > np.where(advance == 1, tolerance, AMBIGUOUS)) | (advance < 1))
    if uneven.size:
        k = int(uneven[0])
        raise DataError(
            f"the step of {steps[k]:.6g} s before sample {k + 2} is not a whole number of periods of {period:.6g} s "
            f"({uneven.size} of {steps.size} steps): the times jitter; "
            f"--resample {float(f'{measured:.2g}'):g} puts the samples on an even clock"
        )
    numbers = np.append(0, np.cumsum(advance)).astype(np.int64)
    return numbers, measured if rate_hz is None else rate_hz


def gaps_and_counters(streams: Mapping[str, Stream]) -> tuple[tuple[Gap, ...], dict[str, int]]:
    """Return the gaps between the sample numbers of streams, and the counters of a recording."""
    gaps: list[Gap] = []
    counters: dict[str, int] = {}
    for name, stream in streams.items():
        sync = stream.sync
        holes = np.flatnonzero(np.diff(sync) > 1)
        gaps += [Gap(name, int(sync[k]) + 1, int(sync[k + 1]) - 1, reason="not in the source") for k in holes]
        lost = int((np.diff(sync)[holes] - 1).sum())
        counters |= {f"{name}.expected": sync.size + lost, f"{name}.rows": sync.size, f"{name}.in_gaps": lost}
    return tuple(gaps), counters
