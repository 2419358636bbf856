"""Clocks of imported samples: unit of their times, sample numbers with gaps, agreement with a stated rate."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError, RobotConfig, SessionConfig
from armident.daq.recording import Gap, Stream
from armident.drivers.can.frames import Frames
from armident.drivers.canopen.objects import COB_SYNC

UNITS: Mapping[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Units of times, s."""
_LONGER: Mapping[str, float] = {"min": 60.0, "h": 3600.0, "days": 86400.0}
"""Units of times that are recognised and not read, s: spreadsheets count days."""
_SHORT_STEP_S = 1e-4
"""Step below which times with impossible velocities may be in one of these units, s."""
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
POLLED_SHARE = 0.01
"""Share of rows that repeat the row before above which samples were polled."""
EQUAL = 0.01
"""Share of equal times above which times have too few digits to tell the instants of the samples."""
_WINDOWS = 200
"""Velocities are differences over this part of the recording."""
AMBIGUOUS = 0.25
"""Distance, periods, of a jittering step from a whole number above which missing samples cannot be counted."""

PERIOD_TOLERANCE = 0.02
"""Largest relative difference of log's and session's SYNC periods: clocks agree to 0.1 %, periods differ by more."""
_FEWEST = 10
"""SYNCs below which a log tells no period."""
_CLOCK_STEP_NS = 20_000_000
"""Difference of times and SYNC numbers above which a clock was set: masters are late by less on an idle machine, ns."""
_HOLE_PERIODS = 10
"""Steps longer than this number of usual ones are not counted: SYNCs may be lacking there."""
_VERIFIED = 0.4
"""Uncertainty of a SYNC period over that of the session up to which half and double of it are told from it."""
_WRAPS_NS = (60_000_000_000, 65_536_000_000, 2**32 * 1000)
"""Times at which clocks of adapters begin again, ns: one minute and 16 bits of ms (SLCAN), 32 bits of us."""
_WRAPS = tuple(2.0**bits * 10.0**-exponent for bits in (16, 32) for exponent in (0, 3, 6))
"""Times at which counters of 16 and 32 bits begin again, in their own unit, or in one that is larger by 1e3 or 1e6."""
_LOST_AT_STEP = 3
"""Largest advance of the SYNC counter over a step of the times: frames may be lost there."""
_LONGEST_PAUSE_NS = 1_000_000_000
"""Longest pause between two frames at a wrap, ns."""
_DESCENDING = 20
"""Number of steps back for each step forward of a file from the newest row to the oldest."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class JitterError(DataError):
    """Times that are no sampling instants of one clock."""


@dataclass(frozen=True)
class Clock:
    """Sampling rate (1/s), number of each sample from 0 (N,), and sentences on what was assumed."""

    rate_hz: float
    numbers: Ints
    notes: tuple[str, ...] = ()


def in_seconds(
    times: Floats, q: Floats, robot: RobotConfig, *, named: str = "", stated: str | None = None
) -> tuple[Floats, tuple[str, ...]]:
    """Return times (N,) in seconds, and notes, from the unit that is ``stated``, or ``named`` in the file, or seconds.

    A unit is refused if only another one gives a rate and velocities, of positions ``q`` (N, n), that an arm can have.
    """
    if stated is not None and stated not in UNITS:
        raise ConfigError(f"--time-unit: expected one of {', '.join(UNITS)}, found {stated}")
    if named and named not in UNITS and stated is None:
        raise DataError(f"the time column states the unit {named!r}, expected s, ms, us or ns: convert the times")
    named = named if named in UNITS else ""
    if stated is not None and named and stated != named:
        raise DataError(f"--time-unit {stated} contradicts the name of the time column, which states {named}")
    unit = stated or named or "s"
    steps = np.diff(times)
    step = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
    if step <= 0.0:
        return times * UNITS[unit], ()
    share = _velocity_share(times, q, robot)
    fast = step * UNITS[unit] < _SHORT_STEP_S and share > FASTEST_SHARE * UNITS[unit]
    units = {**UNITS, **(_LONGER if fast else {})}
    others = [u for u in units if u != unit and _plausible(step * units[u], share / units[u])]
    implausible = not _plausible(step * UNITS[unit], share / UNITS[unit])
    # A unit that is stated is believed, unless the rate is beyond every recording.
    if implausible and others and (not (stated or named) or step * UNITS[unit] < 1.0 / FASTEST_HZ):
        moved = f" and joints at {100 * share / UNITS[unit]:.2g} % of their velocity limits" if share else ""
        rates = " and ".join(f"in {each} it would be {1.0 / (step * units[each]):.6g} Hz" for each in others)
        # An option is advised only if no other unit is plausible.
        advice = f"--time-unit {others[0]} reads it so" if len(others) == 1 else "state the unit with --time-unit"
        if any(each in _LONGER for each in others):
            advice = "convert the times to s"
        elif step == 1.0 and np.all(steps == np.rint(steps)):
            advice += "; if the column counts samples, omit it with --map time=- and give their --rate"
        raise DataError(
            f"a step of {step:.6g} {unit} is a rate of {1.0 / (step * UNITS[unit]):.6g} Hz{moved}; {rates}: {advice}"
        )
    note = (f"times are in {unit}, the unit in the column name",) if named and named != "s" and not stated else ()
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


def check_resolution(times: Floats) -> None:
    """Refuse times (N,), s, of a single row, and those whose usual step is shorter than a recording can hold."""
    steps = np.diff(times)
    if steps.size == 0:
        raise DataError("a single row is not a recording")
    usual = float(np.median(steps)) or float(steps.max())
    if 0.0 < usual < SHORTEST_STEP_S:
        raise DataError(
            f"steps of {usual:.3g} s are shorter than 1 ns, the resolution of a recording; state the unit of the times "
            "with --time-unit, or another column with --map time=NAME"
        )


def repeated_share(values: Floats) -> float:
    """Return the share of rows (N, columns) that repeat the row before; longer runs are standstill."""
    same = np.all(values[1:] == values[:-1], axis=1)
    change = np.flatnonzero(np.concatenate([[True], ~same, [True]]))
    runs = np.diff(change) - 1
    return float(runs[runs <= 2].sum()) / max(1, len(same))


def clock_of(times: Floats, rate_hz: float | None, repeated: float = 0.0, *, received: bool = False) -> Clock:
    """Return the clock of samples by their times (N,), s; missing samples are missing numbers.

    ``received``: times are those of a receiver, whose jitter is not that of the samples.
    """
    steps = np.diff(times)
    median = float(np.median(steps))
    if times[-1] <= times[0]:
        raise DataError("all times are equal; give the sampling rate with --rate, and omit the times: --map time=-")
    if median <= 0 or np.any(steps <= 0):
        return _jittering(times, rate_hz, repeated, received, f"{int(np.sum(steps <= 0))} of {steps.size} steps are 0")
    ratio = steps / median
    advance = np.maximum(np.rint(ratio), 1.0)
    allowed = np.where(advance == 1, EVEN, np.where(advance < _LONG_HOLE, _WHOLE, 0.5))
    uneven = np.flatnonzero(np.abs(ratio - advance) > allowed)
    if uneven.size:
        return _jittering(times, rate_hz, repeated, received, f"{uneven.size} of {steps.size} steps")
    single = steps[advance == 1]
    measured = float(single.size / single.sum())
    if advance.sum() > MOST_NUMBERS:
        raise DataError(
            f"time column inconsistent: {times.size} samples at {median:.6g} s do not span "
            f"{float(times[-1] - times[0]):.6g} s; give the time column with --map time=NAME"
        )
    missing = int(advance.sum()) - steps.size
    if missing > _MOST_MISSING * advance.sum() and np.any(advance > 1) and (advance > 1).mean() > EVEN:
        raise DataError(f"{missing} of {int(advance.sum()) + 1} samples are missing at {measured:.6g} Hz")
    if rate_hz is not None and abs(rate_hz / measured - 1.0) > RATE_TOLERANCE:
        raise DataError(
            f"--rate {rate_hz:g} contradicts the times: steps of {median:.6g} s, {measured:.6g} Hz; "
            f"omit --rate, or give the rate of a conversion with --resample {rate_hz:g}"
        )
    return Clock(rate_hz or measured, np.append(0, np.cumsum(advance)).astype(np.int64))


def _jittering(times: Floats, rate_hz: float | None, repeated: float, received: bool, how: str) -> Clock:
    """Return the clock of even samples at a stated rate whose times jitter; refuse anything else."""
    steps = np.diff(times)
    coarse = float(np.mean(steps == 0)) > EQUAL
    # Of times with few digits, those at which they change tell the rate.
    ends = np.flatnonzero(steps > 0)[[0, -1]] + 1 if coarse and np.sum(steps > 0) > 1 else np.array([0, steps.size])
    mean = float(np.diff(ends)[0] / np.diff(times[ends])[0])
    low, high = np.quantile(steps, [0.01, 0.99])
    spread = f"steps of {low:.4g} to {high:.4g} s, {mean:.6g} Hz on average ({how})"
    if repeated > POLLED_SHARE:
        raise JitterError(
            f"the times jitter: {spread}, and {100 * repeated:.1f} % of the rows repeat the row before: the samples "
            "were polled; --resample RATE, with the rate of the controller, puts them on its clock"
        )
    if rate_hz is None and coarse:
        raise JitterError(
            f"the times have too few digits: {spread}; --rate {two_digits(mean):g} if the samples are even, "
            "or write the times with more digits"
        )
    # Missing samples lower the mean; the median of times with few digits is one of two values.
    median = float(np.median(steps))
    typical = two_digits(1.0 / median if 0 < _JITTER * median < steps.max() else mean)
    if rate_hz is None and received:
        raise JitterError(
            f"the times jitter: {spread}; --rate RATE, that of the publisher, if it sends evenly; else set the stamps "
            "where they are published"
        )
    if rate_hz is None:
        raise JitterError(f"the times jitter: {spread}; --resample {typical:g} puts the samples on an even clock")
    on_clock = f"--resample {rate_hz:g} puts the samples on an even clock, with"
    periods = steps * rate_hz
    advance = np.rint(periods)
    clear = (advance >= 1) & (np.abs(periods - advance) <= AMBIGUOUS)
    counted = bool(clear.all()) and np.median(advance) == 1
    if counted:
        mean *= float(advance.mean())
    if abs(rate_hz / mean - 1.0) > RATE_TOLERANCE:
        raise JitterError(f"--rate {rate_hz:g} contradicts the times: {spread}; {on_clock} gaps where some are missing")
    longest = float(steps.max())
    if not counted and longest > _JITTER * max(1.0 / mean, float(np.quantile(steps[steps > 0], 0.99))):
        raise JitterError(f"no sample for {longest:.6g} s, and the times jitter: {spread}; {on_clock} a gap there")
    numbers = np.append(0, np.cumsum(advance if counted else np.ones(steps.size))).astype(np.int64)
    late = times - times[0] - numbers / mean
    note = f"times jitter by {1e3 * float(np.ptp(late)):.4g} ms; rows are taken as even samples at {rate_hz:g} Hz"
    return Clock(rate_hz, numbers, (note,))


def two_digits(rate: float) -> float:
    """Return a rate with two digits, for advice."""
    return float(f"{rate:.2g}")


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


def descending(times: NDArray[Any]) -> bool:
    """Return True if times (N,) come in the order from the last to the first."""
    steps = np.diff(times)
    back = int(np.sum(steps < 0))
    return back >= _FEWEST and back > _DESCENDING * int(np.sum(steps > 0))


def without_wraps(times: Floats) -> tuple[Floats, tuple[str, ...]]:
    """Return times (N,) of a table, in any unit, without wraps of a counter of 16 or 32 bits, and a note on them."""
    steps = np.diff(times)
    back = np.flatnonzero(steps < 0)
    if not back.size or not np.any(steps > 0):
        return times, ()
    longest = _HOLE_PERIODS * float(np.median(steps[steps > 0]))
    made, wraps = times.copy(), []
    for k in back:
        ends = (end for end in _WRAPS if times[k] <= end and 0 < times[k + 1] + end - times[k] <= longest)
        if end := next(ends, 0.0):
            made[k + 1 :] += end
            wraps.append(end)
    return made, (f"times begin again after {wraps[0]:.10g} ({len(wraps)} times): unwrapped",) if wraps else ()


def newest_first(frames: Frames) -> bool:
    """Return True if frames (N,) come from the newest to the oldest, by their times or by the SYNC counter."""
    if descending(frames["t_ns"]):
        return True
    syncs = frames[(frames["can_id"] == COB_SYNC) & (frames["length"] > 0)]
    counts = np.diff(syncs["data"][:, 0].astype(np.int64))
    if counts.size < _FEWEST or np.mean(counts == -1) < 0.5:
        return False
    # Times that increase contradict the counter; equal ones and differences tell nothing.
    steps = np.diff(frames["t_ns"])
    return bool(np.sum(steps > 0) <= 2 * np.sum(steps < 0))


def continuous(path: Path, frames: Frames, lines: Ints, session: SessionConfig) -> list[str]:
    """Undo wraps of the times of one bus (N,), in place, and return a note on them; refuse a log of several runs."""
    raw = frames["t_ns"].copy()
    syncs = np.flatnonzero(frames["can_id"] == COB_SYNC)
    counts = frames["data"][syncs, 0].astype(np.int64)
    turn = session.sync.counter if np.all(frames["length"][syncs] > 0) else 0
    wraps: list[int] = []
    for k in np.flatnonzero(np.diff(raw) < -_CLOCK_STEP_NS):
        after = int(np.searchsorted(syncs, k, side="right"))
        if turn and 0 < after < syncs.size:
            last, first = counts[after - 1], counts[after]
            if not 0 < (first - last) % turn <= _LOST_AT_STEP:
                raise DataError(
                    f"{path}: line {lines[k + 1]}: times go back by {(raw[k] - raw[k + 1]) * 1e-9:.4g} s here, and the "
                    f"SYNC counter jumps from {last} to {first}: several runs in one log; write one file for each"
                )
        wrap = next((w for w in _WRAPS_NS if raw[k] <= w and 0 <= raw[k + 1] + w - raw[k] <= _LONGEST_PAUSE_NS), 0)
        if wrap:
            frames["t_ns"][k + 1 :] += wrap
            wraps.append(wrap)
    if not wraps:
        return []
    return [f"times begin again after {wraps[0] * 1e-9:.10g} s ({len(wraps)} times): unwrapped"]


def clock_steps(numbers: Ints, t_ns: Ints, session: SessionConfig, *, counted: bool) -> list[str]:
    """Return a sentence if the times of SYNCs, ns, (N,), step where their numbers, (N,), do not.

    ``counted``: the numbers are those of a SYNC counter.
    """
    period = session.sync.period_us * 1000
    late = np.diff(t_ns) - np.diff(numbers) * period
    limit = max(_CLOCK_STEP_NS, (session.sync.counter or 0) * period * 0.9)
    steps = np.flatnonzero(np.abs(late) > limit)
    if not steps.size:
        return []
    k = int(steps[0])
    more = f" (and at {steps.size - 1} more)" if steps.size > 1 else ""
    turns = ", or whole turns of the counter are missing there" if counted and late[k] > 0 else ""
    goes_on = counted and numbers[k + 1] - numbers[k] == 1
    runs = "" if goes_on else ", or another run begins there: write one file for each"
    return [
        f"times step by {late[k] * 1e-9:+.4g} s at SYNC {numbers[k + 1]}{more}, where the SYNCs go on: "
        f"the clock was set{turns}{runs}"
    ]


def check_sync_period(path: Path, frames: Frames, session: SessionConfig, stated_hz: float | None) -> list[str]:
    """Refuse a log whose SYNCs, among the frames of one bus (N,), come at another period than that of the session.

    Times that do not tell the period are refused, unless the rate is ``stated_hz``, which a note then says.
    """
    syncs = frames[frames["can_id"] == COB_SYNC]
    counted = session.sync.counter and np.all(syncs["length"] > 0)
    steps = np.diff(syncs["data"][:, 0].astype(np.int64)) % session.sync.counter if counted else None
    found = sync_period_ns(syncs["t_ns"], steps)
    expected = session.sync.period_us * 1000
    configured = f"every {expected * 1e-6:.4g} ms in the session (sync.period_us: {session.sync.period_us})"
    if stated_hz is not None and abs(stated_hz * expected * 1e-9 - 1.0) > RATE_TOLERANCE:
        raise ConfigError(f"{path}: --rate {stated_hz:g} contradicts the session: SYNC comes {configured}")
    if syncs.size < _FEWEST:
        return []
    unit = next((u for u in ("ms", "us") if found and abs(found[0] * UNITS[u] / expected - 1.0) < PERIOD_TOLERANCE), "")
    if unit:
        raise DataError(
            f"{path}: times in {unit} fit SYNC {configured}, times in s do not: name their column 'time [{unit}]', or "
            "use the session that the log was recorded with"
        )
    if found is None or found[1] > _VERIFIED * expected:
        why = "all its times are equal" if not np.ptp(syncs["t_ns"]) else "its times have too few digits, or jump"
        if stated_hz is None:
            raise DataError(
                f"{path}: {why}, so that they do not tell the SYNC period, which is {configured}: record times of the "
                "adapter or the kernel; or look up the rate of SYNC in the master and state it with --rate"
            )
        return [f"{why}: the SYNC rate of {stated_hz:g} Hz is that of --rate, and is not verified"]
    period, uncertainty = found
    if abs(period - expected) > PERIOD_TOLERANCE * expected + uncertainty:
        raise DataError(
            f"{path}: SYNC comes every {period * 1e-6:.4g} ms ({1e9 / period:.4g} Hz) in this log, "
            f"but {configured}: use the session that the log was recorded with"
        )
    return []


def sync_period_ns(t_ns: Ints, steps: Ints | None) -> tuple[float, float] | None:
    """Return the mean SYNC period and its uncertainty, ns, from receive times (N,); ``None`` if there are too few.

    ``steps`` are the periods between them by their counter (N - 1,), or one each.
    """
    if t_ns.size < _FEWEST:
        return None
    elapsed = np.diff(t_ns).astype(np.float64)
    periods = np.ones(elapsed.size) if steps is None else steps.astype(np.float64)
    forward = elapsed[elapsed > 0]
    if not forward.size:
        return None
    # Coarse times make a median of 0: most of the others are one unit of theirs.
    usual = float(np.median(elapsed)) if np.median(elapsed) > 0 else float(np.median(forward))
    counted = (elapsed >= 0) & (elapsed <= _HOLE_PERIODS * usual) & (periods > 0) & (periods <= _HOLE_PERIODS)
    total = float(periods[counted].sum())
    if counted.sum() < _FEWEST - 1 or not total:
        return None
    period = float(elapsed[counted].sum()) / total
    if period <= 0:
        return None
    late = np.cumsum(np.where(counted, elapsed - period * periods, 0.0))
    spread = float(np.quantile(late, 0.95) - np.quantile(late, 0.05))
    return period, spread / total
