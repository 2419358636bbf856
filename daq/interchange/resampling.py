"""Samples on one clock: rows of a table as they are, polled or with jitter; recordings at another rate."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError, RobotConfig
from armident.daq.interchange.clocks import (
    EQUAL,
    MOST_NUMBERS,
    POLLED_SHARE,
    check_resolution,
    clock_of,
    gaps_and_counters,
    in_seconds,
    repeated_share,
)
from armident.daq.interchange.table_files import Source
from armident.daq.interchange.table_rows import TableRows
from armident.daq.interchange.text_files import listed
from armident.daq.recording import Gap, Mark, Recording, Stream
from armident.daq.recording.model import Quantity

_DURATION_TOLERANCE = 0.02
"""Largest relative difference of the duration by the motion from that by the times."""
_LONGEST_POLLED = 20
"""Longest step of polled samples, periods of the controller; interpolation over more is no measurement."""
_WINDOW = 21
"""Increments in the median filter: odd, far shorter than any motion, and longer than a burst of missed samples."""
_SLOW_SHARE = 0.02
"""Share of the largest increment below which the number of samples is not resolved."""
_AMBIGUOUS = 0.25
"""Distance of an advance from a whole number of samples above which it is ambiguous."""
_MOST_AMBIGUOUS = 0.05
"""Share of ambiguous advances above which the rows are not samples of one clock."""
_HOLE = 1.5
"""Steps longer than this number of usual ones, and than usual jitter beyond it, are holes."""
_USUAL = 0.8
"""Share of the steps whose deviations from the median are usual jitter."""
_FEWEST = 4
"""Rows that a cubic spline needs; shorter pieces between holes are left out."""
_MOST_BETWEEN = 1000.0
"""Most even samples between two rows that are no hole: more are no resampling."""
_MOST_UNEVEN = 0.5
"""Share of steps that are holes above which the rows are no samples of one motion."""

PASS_SHARE = 0.8
"""Share of the lower of both Nyquist frequencies up to which signals are kept; from 1 on they are attenuated."""
ATTENUATION_DB = 80.0
"""Attenuation above the Nyquist frequency, dB: a ten-thousandth of the amplitude folds back."""
BETA = 0.1102 * (ATTENUATION_DB - 8.7)
"""Shape of the Kaiser window of this attenuation (Kaiser 1974)."""
SAME = 1e-9
"""Relative difference of two sampling rates that are the same number."""
_ROWS = 4096
"""Number of output rows that are computed at a time."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Sampled:
    """Sampling rate (1/s), number of each sample (M,), quantities (M, n), facts for the metadata, and notes."""

    rate_hz: float
    numbers: Ints
    values: dict[Quantity, Floats]
    resampled: bool = False
    facts: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def sampled(
    source: Source,
    rows: TableRows,
    robot: RobotConfig,
    *,
    rate_hz: float | None = None,
    polled: bool = False,
    resample_hz: float | None = None,
    time_unit: str | None = None,
) -> Sampled:
    """Return the rows of a table as samples of one clock; options as those of `import_recording`."""
    everything = np.concatenate([values for name, values in rows.values.items() if name != "demand"], axis=1)
    repeated = repeated_share(everything) if len(everything) > 1 else 0.0
    note = (
        f"{100 * repeated:.1f} % of the rows repeat the row before, as in polled samples: "
        "--resample RATE, with the rate of the controller, puts them on its clock"
    )
    polled_note = [note] if repeated > POLLED_SHARE else []
    times, notes = _times(source, rows, robot, time_unit)
    if polled or (resample_hz is not None and (times is None or repeated > POLLED_SHARE)):
        return _from_polled(rows, times, resample_hz or rate_hz or 0.0, polled, notes)
    if resample_hz is not None and times is not None:
        return _from_jitter(rows, times, resample_hz, notes)
    if times is None:
        if rate_hz is None:
            raise DataError(
                f"no time column t; give the sampling rate with --rate, or the column with --map time=NAME; "
                f"found {listed(list(source.table))}"
            )
        return Sampled(rate_hz, rows.row - rows.row[0], rows.values, notes=(*notes, *polled_note))
    clock = clock_of(times, rate_hz, repeated, received=bool(source.clock))
    missing = int(clock.numbers[-1]) + 1 - clock.numbers.size
    notes += [*clock.notes, *polled_note]
    if missing:
        notes.append(f"{missing} samples are missing between the rows: recorded as gaps")
    return Sampled(clock.rate_hz, clock.numbers, rows.values, notes=tuple(notes))


def _times(source: Source, rows: TableRows, robot: RobotConfig, unit: str | None) -> tuple[Floats | None, list[str]]:
    """Return the times of the rows in s, and notes."""
    if rows.times is None:
        return None, []
    times, notes = in_seconds(rows.times, rows.values["position"], robot, named=rows.time_unit, stated=unit)
    check_resolution(times)
    return times, list(notes)


def _interpolated(name: str, at: Floats | Ints, known: Floats | Ints, values: Floats) -> Floats:
    """Return values (N, n), known at (N,), at (M,): positions by cubic splines, efforts linearly."""
    from scipy.interpolate import CubicSpline

    if name in ("position", "demand"):
        return np.ascontiguousarray(CubicSpline(known, values)(at), dtype=np.float64)
    return np.stack([np.interp(at, known, column) for column in values.T], axis=1)


def _from_polled(rows: TableRows, times: Floats | None, rate_hz: float, polled: bool, notes: list[str]) -> Sampled:
    """Put polled rows on the clock of the controller: repeated ones are dropped, missed ones interpolated.

    The times of a polling program tell nothing. The motion does: between samples, joints advance by a whole multiple of
    their usual increments at that time. During standstill every row counts as one sample.
    """
    longest = float(np.diff(times).max(initial=0.0)) if times is not None else 0.0
    if longest * rate_hz > _LONGEST_POLLED:
        raise DataError(f"no sample for {longest:.6g} s: --polled does not fill holes")
    everything = np.concatenate(list(rows.values.values()), axis=1)
    index = np.flatnonzero(np.append(True, np.any(everything[1:] != everything[:-1], axis=1)))
    if index.size <= _WINDOW:
        raise DataError(f"only {index.size} of {len(everything)} rows differ from the row before: too few to resample")
    advice = "omit --polled" if polled else "leave out the rows that repeat the row before: then their times are used"
    advances = _advances(rows.values["position"][index], np.diff(index), advice)
    # The same position with another effort is still the same sample.
    kept = np.append(True, advances > 0)
    index, ticks = index[kept], np.append(0, np.cumsum(advances))[kept]
    numbers = np.arange(ticks[-1] + 1, dtype=np.int64)
    if times is not None:
        lasts, motion = float(times[-1] - times[0]), (numbers.size - 1) / rate_hz
        if abs(motion - lasts) > _DURATION_TOLERANCE * lasts:
            raise DataError(
                f"the motion takes {motion:.6g} s at the {rate_hz:g} Hz of {'--polled' if polled else '--resample'}, "
                f"but {lasts:.6g} s by the time column: give the rate of the controller"
            )
    repeated, missed = len(everything) - index.size, numbers.size - index.size
    notes.append(
        f"polled samples put on a clock of {rate_hz:g} Hz by their motion: {repeated} repeated rows left out, "
        f"{missed} missed samples interpolated"
    )
    values = {name: _interpolated(name, numbers, ticks, array[index]) for name, array in rows.values.items()}
    facts = {"polled.repeated": str(repeated), "polled.interpolated": str(missed)}
    return Sampled(rate_hz, numbers, values, True, facts, tuple(notes))


def _advances(q: Floats, rows: Ints, advice: str) -> Ints:
    """Return the samples from each row (N, n) to the next, (N - 1,); during standstill, the number of ``rows`` read."""
    from scipy.ndimage import median_filter

    steps = np.diff(q, axis=0)
    median_steps = median_filter(steps, size=(_WINDOW, 1), mode="nearest")
    power = np.sum(median_steps**2, axis=1)
    moving = power > _SLOW_SHARE**2 * power.max()
    if not moving.any():
        raise DataError(f"no joint moves: the sampling clock cannot be determined; {advice}")
    advance = np.sum(steps[moving] * median_steps[moving], axis=1) / power[moving]
    ambiguous = float(np.mean(np.abs(advance - np.round(advance)) > _AMBIGUOUS))
    if ambiguous > _MOST_AMBIGUOUS:
        raise DataError(f"{100 * ambiguous:.0f} % of the rows do not fit an even clock of a controller; {advice}")
    ticks = rows.astype(np.int64)
    ticks[moving] = np.maximum(0, np.round(advance)).astype(np.int64)
    return ticks


def usual_rate(times: Floats) -> float:
    """Return the rate of the usual step, 1/s, of strictly increasing times (N,), s."""
    return 1.0 / float(np.median(np.diff(times)))


def _from_jitter(rows: TableRows, times: Floats, rate_hz: float, notes: list[str]) -> Sampled:
    """Put rows on even times, nothing across holes; below the rate of the rows, at that rate (a filter follows)."""
    first = np.append(True, np.diff(times) > 0)
    if float(np.mean(~first)) > EQUAL:
        raise DataError(
            f"{int((~first).sum())} of {times.size} rows have the time of the row before: they have too few digits "
            f"to resample by them; --rate {times.size / max(float(np.ptp(times)), 1e-9):.2g} if the samples are even"
        )
    if not first.all():
        notes.append(f"{int((~first).sum())} rows have the time of the row before: left out")
        rows, times = rows.taken(first), times[first]
    if times.size < _FEWEST:
        raise DataError(f"only {times.size} rows: too few to resample")
    usual = usual_rate(times)
    grid = rate_hz if rate_hz > 0.99 * usual else usual
    steps = np.diff(times)
    median = float(np.median(steps))
    jitter = float(np.quantile(np.abs(steps / median - 1.0), _USUAL))
    holes = np.flatnonzero(steps > (_HOLE + jitter) * median)
    if holes.size > _MOST_UNEVEN * steps.size:
        raise DataError(f"{holes.size} of {steps.size} steps are holes: the rows have no common clock")
    relative = times - times[0]
    if relative[-1] * rate_hz < 1.0:
        raise DataError(
            f"the times span {relative[-1]:.3g} s, less than a period of --resample {rate_hz:g}; "
            "state the unit of the times with --time-unit"
        )
    if (_HOLE + jitter) * median * grid > _MOST_BETWEEN or not relative[-1] * grid < MOST_NUMBERS:
        raise DataError(
            f"time column inconsistent: steps of {steps.min():.4g} to {steps.max():.4g} s on a clock of {grid:g} Hz"
        )
    clocks: list[Ints] = []
    pieces: dict[Quantity, list[Floats]] = {name: [] for name in rows.values}
    left_out = 0
    for piece in np.split(np.arange(times.size), holes + 1):
        own = relative[piece]
        clock = np.arange(np.ceil(own[0] * grid - 1e-6), np.floor(own[-1] * grid + 1e-6) + 1, dtype=np.int64)
        if piece.size < _FEWEST or not clock.size:
            left_out += piece.size
            continue
        clocks.append(clock)
        at = np.clip(clock / grid, own[0], own[-1])
        for name, array in rows.values.items():
            pieces[name].append(_interpolated(name, at, own, array[piece]))
    if not clocks:
        raise DataError("no piece without a hole is long enough to resample")
    low, middle, high = (1e3 * float(x) for x in np.quantile(steps, [0.01, 0.5, 0.99]))
    how = (
        f"resampled from steps of {low:.4g} to {high:.4g} ms (median {middle:.4g} ms) to "
        f"{rate_hz:g} Hz: positions by cubic splines, efforts linearly"
    )
    notes.append(how + (f"; {holes.size} holes are gaps" if holes.size else ""))
    if left_out:
        notes.append(f"{left_out} rows between holes too close to each other left out")
    facts = {"resampled": how, "resampled.from_hz": f"{usual:.6g}", "resampled.holes": str(holes.size)}
    values = {name: np.concatenate(parts) for name, parts in pieces.items()}
    return Sampled(grid, np.concatenate(clocks), values, True, facts, tuple(notes))


def at_rate(recording: Recording, rate_hz: float) -> Recording:
    """Return a recording at another sampling rate, 1/s.

    Positions, velocities and efforts pass a linear-phase low-pass filter (windowed sinc) below the lower Nyquist
    frequency. Demands are linear, as in a CiA 402 drive (60C2h); status words are held. Gaps, marks and pieces keep
    their times, and so does the time from a position to its torque.
    """
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise ConfigError(f"--rate: expected a sampling rate greater than 0 Hz, found {rate_hz:g}")
    if recording.samples.sync.size == 0:
        raise DataError("no samples to resample")
    ratio = rate_hz / recording.sample_rate_hz
    if abs(ratio - 1.0) < SAME:
        return recording
    streams = {name: _stream(stream, ratio) for name, stream in recording.streams.items() if stream.sync.size}
    _, counters = gaps_and_counters(streams)
    counters["sync_skipped_periods"] = round(recording.counters.get("sync_skipped_periods", 0) * ratio)
    return Recording(
        None,
        recording.robot,
        None,
        rate_hz,
        streams,
        gaps=tuple(new for gap in recording.gaps if (new := _gap(gap, ratio)) is not None),
        marks=tuple(_mark(mark, ratio) for mark in recording.marks),
        counters=counters,
        metadata={**recording.metadata, "resampled_from_hz": f"{recording.sample_rate_hz:g}"},
        missing=recording.missing,
    )


def _stream(stream: Stream, ratio: float) -> Stream:
    """Stream with one row for every new sampling instant within its pieces without gaps."""
    cuts = np.flatnonzero(np.diff(stream.sync) != stream.every) + 1
    sync: list[Ints] = []
    t_ns: list[Ints] = []
    raw: dict[str, list[NDArray[Any]]] = {name: [] for name in stream.fields}
    for piece in np.split(np.arange(stream.sync.size), cuts):
        own = stream.sync[piece]
        new = np.arange(np.ceil(own[0] * ratio - SAME), np.floor(own[-1] * ratio + SAME) + 1, dtype=np.int64)
        if not new.size:
            continue
        at = np.clip((new / ratio - own[0]) / stream.every, 0, piece.size - 1)
        elapsed = stream.t_ns[piece] - stream.t_ns[piece[0]]
        t_ns.append(stream.t_ns[piece[0]] + np.rint(np.interp(at, np.arange(piece.size), elapsed)).astype(np.int64))
        sync.append(new)
        for name, its in stream.fields.items():
            raw[name].append(_values(its.quantity, stream.raw[name][piece], at, ratio * stream.every))
    if not sync:
        raise DataError(f"stream {stream.name!r} is too short for the new sampling rate")
    joined = {name: np.concatenate(values) for name, values in raw.items()}
    return Stream(stream.name, 1, np.concatenate(sync), np.concatenate(t_ns), stream.fields, joined)


def _values(quantity: str, raw: NDArray[Any], at: Floats, ratio: float) -> NDArray[Any]:
    """Raw values (M, n) of one quantity at the samples ``at`` (M,) of a piece (N, n)."""
    if quantity == "status":
        return np.ascontiguousarray(raw[np.floor(at + SAME).astype(np.int64)])
    values = raw.astype(np.float64)
    if not np.isfinite(values).all():
        raise DataError(f"{quantity} is not finite: nothing to resample")
    if quantity == "demand":
        rows = np.arange(len(values))
        return np.stack([np.interp(at, rows, column) for column in values.T], axis=1)
    return low_passed(values, at, min(1.0, ratio))


def low_passed(values: Floats, at: Floats, share: float) -> Floats:
    """Return a signal (N, n) after a low-pass filter of linear phase, at any instants (M,), in samples.

    It is attenuated from ``share`` of the Nyquist frequency on, and continues beyond its ends by point reflection.
    """
    stop, begin = 0.5 * share, 0.5 * share * PASS_SHARE
    cutoff = (stop + begin) / 2
    # Length of a Kaiser filter for this attenuation and transition band (Kaiser 1974).
    half = int(np.ceil((ATTENUATION_DB - 7.95) / (14.36 * (stop - begin)) / 2))
    padded = np.pad(values, ((half + 1, half + 1), (0, 0)), mode="reflect", reflect_type="odd")
    at = np.clip(at, -0.5, len(values) - 0.5)
    offsets = np.arange(-half, half + 1)
    parts = []
    for begin_row in range(0, at.size, _ROWS):
        part = at[begin_row : begin_row + _ROWS]
        nearest = np.floor(part + 0.5).astype(np.int64)
        distance = nearest[:, None] + offsets - part[:, None]
        window = np.i0(BETA * np.sqrt(np.maximum(1.0 - (distance / (half + 0.5)) ** 2, 0.0)))
        weights = np.sinc(2 * cutoff * distance) * window
        weights /= weights.sum(axis=1, keepdims=True)
        rows = nearest[:, None] + offsets + half + 1
        parts.append(np.stack([np.einsum("mk,mk->m", weights, column[rows]) for column in padded.T], axis=1))
    return np.concatenate(parts) if parts else np.empty((0, values.shape[1]))


def _gap(gap: Gap, ratio: float) -> Gap | None:
    """The gap at the new rate: all instants between the samples at its ends; ``None`` if there are none."""
    first = int(np.floor((gap.first - 1) * ratio + SAME)) + 1
    last = int(np.ceil((gap.last + 1) * ratio - SAME)) - 1
    first = max(first, 0)
    return replace(gap, first=first, last=last) if first <= last else None


def _mark(mark: Mark, ratio: float) -> Mark:
    if mark.sync < 0:
        return mark
    exact = mark.sync * ratio
    sync = np.ceil(exact - SAME) if mark.kind == "experiment_start" else np.floor(exact + SAME)
    return replace(mark, sync=int(sync))
