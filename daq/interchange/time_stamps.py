"""Clock of a table: unit of its times, sample numbers with gaps, and agreement with a stated rate."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError, RobotConfig

UNITS: Mapping[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Units of times, s."""
SLOWEST_HZ, FASTEST_HZ = 10.0, 100e3
"""Sampling rates of recordings of arms; a rate beyond them may be that of times in another unit, 1/s."""
SLOWEST_SHARE, FASTEST_SHARE = 2e-3, 3.0
"""Shares of the joints' velocity limits that a motion reaches; beyond them times may be in another unit."""
SHORTEST_STEP_S = 1e-9
"""Resolution of the times of a recording, s: shorter steps are none."""
EVEN = 0.01
"""Largest deviation of a step from the period, relative, of samples that are taken as even."""
_WHOLE = 0.1
"""Largest distance of a step over a hole from a whole number of periods, periods; long holes need none."""
_LONG_HOLE = 5
"""Steps from this number of periods on are holes whatever their length."""
RATE_TOLERANCE = 0.01
"""Largest relative difference of a stated rate from that of the times."""
_MOST_MISSING = 0.5
"""Share of missing samples above which the usual step is not the period."""
MOST_NUMBERS = 2.0**53
"""Largest sample number that a floating-point number holds exactly."""
_JITTER = 3.0
"""Longest step of even samples whose times jitter, periods; longer ones are holes of an unknown length."""
_REPEATED = 0.01
"""Share of rows that repeat the row before above which samples were polled."""
EQUAL = 0.01
"""Share of equal times above which times have too few digits to tell the instants of the samples."""
_WINDOWS = 200
"""Velocities are differences over this part of the recording."""

Floats = NDArray[np.float64]


class JitterError(DataError):
    """Times that are no sampling instants of one clock."""


@dataclass(frozen=True)
class Clock:
    """Clock of the samples.

    Parameters
    ----------
    rate_hz
        Sampling rate, 1/s.
    numbers
        Number of each sample, from 0, strictly increasing, (N,).
    notes
        Sentences on what was assumed.
    """

    rate_hz: float
    numbers: NDArray[np.int64]
    notes: tuple[str, ...] = ()


def in_seconds(
    times: Floats, q: Floats, robot: RobotConfig, *, named: str = "", stated: str | None = None
) -> tuple[Floats, tuple[str, ...]]:
    """Return the times in seconds, and notes.

    The unit is that of the option, of the name of the column, or seconds. Seconds are refused if only another unit
    gives a rate and velocities that an arm can have.

    Parameters
    ----------
    times
        Times (N,).
    q
        Positions (N, n), for the velocities.
    robot
        The robot, for its velocity limits.
    named
        Unit in the name of the column; empty if there is none.
    stated
        Unit of the option ``--time-unit``.

    Raises
    ------
    ConfigError
        If the stated unit is none.
    DataError
        If units contradict each other, or the unit contradicts rate and motion.
    """
    if stated is not None and stated not in UNITS:
        raise ConfigError(f"--time-unit: expected one of {', '.join(UNITS)}, found {stated}")
    if named and named not in UNITS and stated is None:
        raise DataError(f"the column of times states the unit {named!r}, expected s, ms, us or ns: convert the times")
    named = named if named in UNITS else ""
    if stated is not None and named and stated != named:
        raise DataError(f"--time-unit {stated} contradicts the name of the column, which says {named}")
    unit = stated or named or "s"
    steps = np.diff(times)
    step = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
    if step <= 0.0:
        return times * UNITS[unit], ()
    share = _velocity_share(times, q, robot)
    others = [u for u in UNITS if u != unit and _plausible(step * UNITS[u], share / UNITS[u])]
    implausible = not _plausible(step * UNITS[unit], share / UNITS[unit])
    # A unit that is stated is believed, unless the rate is beyond every recording.
    if implausible and others and (not (stated or named) or step * UNITS[unit] < 1.0 / FASTEST_HZ):
        seconds = step * UNITS[unit]
        other = step * UNITS[others[0]]
        moved = f" and joints at {100 * share / UNITS[unit]:.2g} % of their velocity limits" if share else ""
        raise DataError(
            f"a step of {step:.6g} {unit} is a rate of {1.0 / seconds:.6g} Hz{moved}; in {others[0]} it would be "
            f"{1.0 / other:.6g} Hz: --time-unit {others[0]} reads it so"
        )
    note = (f"times are in {unit}, as the name of their column says",) if named and named != "s" and not stated else ()
    return (times - times[0]) * UNITS[unit], note


def _plausible(step_s: float, share: float) -> bool:
    return 1.0 / FASTEST_HZ <= step_s <= 1.0 / SLOWEST_HZ and (share == 0.0 or SLOWEST_SHARE <= share <= FASTEST_SHARE)


def _velocity_share(times: Floats, q: Floats, robot: RobotConfig) -> float:
    """Return the largest velocity over the limit of its joint, with times as they are; 0 if nothing moves."""
    apart = max(1, len(q) // _WINDOWS)
    elapsed = times[apart:] - times[:-apart]
    valid = elapsed > 0
    if not valid.any():
        return 0.0
    limits = np.array([joint.limits.velocity or np.inf for joint in robot.joints])
    speeds = np.abs(q[apart:] - q[:-apart])[valid] / elapsed[valid][:, None] / limits
    return float(np.quantile(speeds.max(axis=1), 0.99))


def repeated_share(values: Floats) -> float:
    """Return the share of rows that repeat the row before, among those of a motion.

    Parameters
    ----------
    values
        All quantities, (N, columns).
    """
    same = np.all(values[1:] == values[:-1], axis=1)
    # Standstill repeats rows too, in long runs; polling repeats one or two.
    change = np.flatnonzero(np.concatenate([[True], ~same, [True]]))
    runs = np.diff(change) - 1
    return float(runs[runs <= 2].sum()) / max(1, len(same))


def clock_of(times: Floats, rate_hz: float | None, repeated: float = 0.0) -> Clock:
    """Return the clock of samples by their times; missing samples are missing numbers.

    Parameters
    ----------
    times
        Times (N,), s, not decreasing.
    rate_hz
        Rate that the user states; ``None``: that of the times.
    repeated
        Share of rows that repeat the row before.

    Raises
    ------
    DataError
        If there is a single sample, or the times contradict the rate.
    JitterError
        If the steps are too uneven to tell how many samples are missing.
    """
    steps = np.diff(times)
    if steps.size == 0:
        raise DataError("a single row is not a recording")
    median = float(np.median(steps))
    usual = median if median > 0 else float(steps.max())
    if 0.0 < usual < SHORTEST_STEP_S:
        raise DataError(
            f"steps of {usual:.3g} s are shorter than 1 ns, the resolution of a recording; state the unit of the times "
            "with --time-unit, or another column with --map time=NAME"
        )
    if median <= 0 or np.any(steps <= 0):
        return _coarse(times, rate_hz, repeated)
    ratio = steps / median
    advance = np.maximum(np.rint(ratio), 1.0)
    allowed = np.where(advance == 1, EVEN, np.where(advance < _LONG_HOLE, _WHOLE, 0.5))
    uneven = np.flatnonzero(np.abs(ratio - advance) > allowed)
    if uneven.size:
        return _jittering(times, rate_hz, repeated, f"{uneven.size} of {steps.size} steps")
    single = steps[advance == 1]
    measured = float(single.size / single.sum())
    if advance.sum() > MOST_NUMBERS:
        raise DataError(
            f"{float(times[-1] - times[0]):.6g} s in steps of {median:.6g} s are no recording of {times.size} samples; "
            "give the column of times with --map time=NAME"
        )
    missing = int(advance.sum()) - steps.size
    if missing > _MOST_MISSING * advance.sum() and np.any(advance > 1) and (advance > 1).mean() > EVEN:
        raise DataError(f"{missing} of {int(advance.sum()) + 1} samples are missing at {measured:.6g} Hz")
    _check_rate(rate_hz, measured, f"steps of {median:.6g} s")
    numbers = np.append(0, np.cumsum(advance)).astype(np.int64)
    return Clock(rate_hz or measured, numbers)


def _check_rate(rate_hz: float | None, measured: float, what: str) -> None:
    if rate_hz is not None and abs(rate_hz / measured - 1.0) > RATE_TOLERANCE:
        raise DataError(
            f"--rate {rate_hz:g} contradicts the column of times: {what}, {measured:.6g} Hz; "
            f"omit --rate, or give the rate of a conversion with --resample {rate_hz:g}"
        )


def _coarse(times: Floats, rate_hz: float | None, repeated: float) -> Clock:
    """Return the clock of times some of which are equal, as when they have too few digits."""
    if times[-1] <= times[0]:
        raise DataError("all times are equal; give the sampling rate with --rate, and omit the times: --map time=-")
    return _jittering(times, rate_hz, repeated, f"{int(np.sum(np.diff(times) <= 0))} of {times.size - 1} steps are 0")


def _jittering(times: Floats, rate_hz: float | None, repeated: float, how: str) -> Clock:
    """Return the clock of even samples at a stated rate whose times jitter; refuse anything else."""
    steps = np.diff(times)
    mean = steps.size / float(times[-1] - times[0])
    low, high = np.quantile(steps, [0.01, 0.99])
    spread = f"steps of {low:.4g} to {high:.4g} s, {mean:.6g} Hz on average ({how})"
    if repeated > _REPEATED:
        raise JitterError(
            f"the times jitter: {spread}, and {100 * repeated:.1f} % of the rows repeat the row before: the samples "
            "were polled; --resample RATE, with the rate of the controller, puts them on its clock"
        )
    if rate_hz is None and float(np.mean(steps == 0)) > EQUAL:
        raise JitterError(
            f"the times have too few digits: {spread}; --rate {_nice(mean):g} if the samples are even, "
            "or write the times with more digits"
        )
    # Missing samples lower the mean; the median of times with few digits is one of two values.
    median = float(np.median(steps))
    typical = _nice(1.0 / median if 0 < _JITTER * median < steps.max() else mean)
    if rate_hz is None:
        raise JitterError(f"the times jitter: {spread}; --resample {typical:g} puts the samples on an even clock")
    if abs(rate_hz / mean - 1.0) > RATE_TOLERANCE:
        raise JitterError(
            f"--rate {rate_hz:g} contradicts the column of times: {spread}; "
            f"--resample {rate_hz:g} puts the samples on an even clock, with gaps where some are missing"
        )
    longest = float(steps.max())
    usual = max(1.0 / mean, float(np.quantile(steps[steps > 0], 0.99)))
    if longest > _JITTER * usual:
        raise JitterError(
            f"no sample for {longest:.6g} s, and the times jitter: {spread}; "
            f"--resample {rate_hz:g} puts the samples on an even clock, with a gap there"
        )
    late = times - times[0] - np.arange(times.size) / mean
    note = f"times jitter by {1e3 * float(np.ptp(late)):.4g} ms; rows are taken as even samples at {rate_hz:g} Hz"
    return Clock(rate_hz, np.arange(times.size, dtype=np.int64), (note,))


def _nice(rate: float) -> float:
    """Return a rate with two digits."""
    return float(f"{rate:.2g}")
