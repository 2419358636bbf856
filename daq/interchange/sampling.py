"""Sampling of the rows of a table: their clock, and resampling onto an even one."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError, RobotConfig
from armident.daq.interchange.even_times import onto_even_times, usual_rate
from armident.daq.interchange.resample import onto_even_clock
from armident.daq.interchange.sample_clock import sample_numbers
from armident.daq.interchange.table_files import Source
from armident.daq.interchange.table_rows import Rows
from armident.daq.interchange.text_files import listed
from armident.daq.interchange.time_stamps import EQUAL, clock_of, in_seconds, repeated_share
from armident.daq.recording.model import Quantity

_POLLED_SHARE = 0.01
"""Share of rows that repeat the row before above which samples were polled."""
_DURATION_TOLERANCE = 0.02
"""Largest relative difference of the duration by the motion from that by the times."""
_LONGEST_POLLED = 20
"""Longest step of polled samples, periods of the controller; interpolation over more is no measurement."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Sampled:
    """Samples with their numbers.

    ``numbers``: number of each sample, strictly increasing, (M,); ``values``: quantities, (M, n) each; ``resampled``:
    the values were interpolated; ``facts``: facts on the resampling, for the metadata of the recording; ``notes``:
    sentences on what was assumed or done.
    """

    rate_hz: float
    numbers: NDArray[np.int64]
    values: dict[Quantity, Floats]
    resampled: bool = False
    facts: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def sampled(
    source: Source,
    rows: Rows,
    robot: RobotConfig,
    *,
    rate_hz: float | None = None,
    polled: bool = False,
    resample_hz: float | None = None,
    time_unit: str | None = None,
) -> Sampled:
    """Return the rows of a table as samples of one clock.

    ``source``: the table, for messages; ``rows``: its complete rows; ``robot``: for its velocity limits; ``rate_hz``:
    rate that the user states, 1/s; ``polled``: the rows were polled from a controller of this rate; ``resample_hz``:
    resample to this rate, 1/s; ``time_unit``: unit of the times that the user states. Raises DataError if times, rate
    and motion contradict each other, or there is neither a time nor a rate.
    """
    everything = np.concatenate([values for name, values in rows.values.items() if name != "demand"], axis=1)
    repeated = repeated_share(everything) if len(everything) > 1 else 0.0
    if source.t_ns is not None and not polled and resample_hz is None:
        numbers, rate = sample_numbers(source.t_ns[rows.row], rate_hz)
        return Sampled(rate, numbers, rows.values, notes=_polled_note(repeated))
    times, notes = _times(source, rows, robot, time_unit)
    if polled or (resample_hz is not None and (times is None or repeated > _POLLED_SHARE)):
        return _from_polled(rows, times, resample_hz or rate_hz or 0.0, polled, notes)
    if resample_hz is not None and times is not None:
        return _from_jitter(rows, times, resample_hz, notes)
    if times is None:
        if rate_hz is None:
            raise DataError(
                f"no time column t; give the sampling rate with --rate, or the column with --map time=NAME; "
                f"found {listed(list(source.table))}"
            )
        numbers = rows.row - rows.row[0]
        return Sampled(rate_hz, numbers, rows.values, notes=(*notes, *_polled_note(repeated)))
    clock = clock_of(times, rate_hz, repeated)
    missing = int(clock.numbers[-1]) + 1 - clock.numbers.size
    notes += [*clock.notes, *_polled_note(repeated)]
    if missing:
        notes.append(f"{missing} samples are missing between the rows: recorded as gaps")
    return Sampled(clock.rate_hz, clock.numbers, rows.values, notes=tuple(notes))


def _times(source: Source, rows: Rows, robot: RobotConfig, unit: str | None) -> tuple[Floats | None, list[str]]:
    """Return the times of the rows in s, and notes."""
    if rows.times is None:
        return None, []
    backward = np.flatnonzero(np.diff(rows.times) < 0)
    if backward.size:
        where = source.place(int(rows.row[backward[0] + 1]), rows.time_name)
        raise DataError(f"{where}: time does not increase")
    times, notes = in_seconds(rows.times, rows.values["position"], robot, named=rows.time_unit, stated=unit)
    return times, list(notes)


def _polled_note(repeated: float) -> tuple[str, ...]:
    """Return a sentence on rows that repeat the row before, if their share is that of polled samples."""
    if repeated <= _POLLED_SHARE:
        return ()
    return (
        f"{100 * repeated:.1f} % of the rows repeat the row before, as samples that were polled do: "
        "--resample RATE, with the rate of the controller, puts them on its clock",
    )


def _from_polled(rows: Rows, times: Floats | None, rate_hz: float, polled: bool, notes: list[str]) -> Sampled:
    longest = float(np.diff(times).max(initial=0.0)) if times is not None else 0.0
    if longest * rate_hz > _LONGEST_POLLED:
        raise DataError(f"no sample for {longest:.6g} s: --polled does not fill holes")
    raw = {str(name): values for name, values in rows.values.items()}
    even = onto_even_clock(raw)
    count = len(even.values["position"])
    if times is not None:
        lasts, motion = float(times[-1] - times[0]), (count - 1) / rate_hz
        if abs(motion - lasts) > _DURATION_TOLERANCE * lasts:
            raise DataError(
                f"the motion takes {motion:.6g} s at the {rate_hz:g} Hz of {'--polled' if polled else '--resample'}, "
                f"but {lasts:.6g} s by the column of times: give the rate of the controller"
            )
    facts = {"polled.repeated": str(even.repeated), "polled.interpolated": str(even.interpolated)}
    notes.append(
        f"polled samples put on a clock of {rate_hz:g} Hz by their motion: {even.repeated} repeated rows left out, "
        f"{even.interpolated} missed samples interpolated"
    )
    values = {name: even.values[name] for name in rows.values}
    return Sampled(rate_hz, np.arange(count, dtype=np.int64), values, True, facts, tuple(notes))


def _from_jitter(rows: Rows, times: Floats, rate_hz: float, notes: list[str]) -> Sampled:
    first = np.append(True, np.diff(times) > 0)
    if float(np.mean(~first)) > EQUAL:
        raise DataError(
            f"{int((~first).sum())} of {times.size} rows have the time of the row before: they have too few digits "
            f"to resample by them; --rate {times.size / max(float(np.ptp(times)), 1e-9):.2g} if the samples are even"
        )
    if not first.all():
        notes.append(f"{int((~first).sum())} rows have the time of the row before: left out")
        rows, times = rows.taken(first), times[first]
    if times.size < 2:
        raise DataError("a single row is not a recording")
    usual = usual_rate(times)
    # Fewer samples need a filter first, at the rate of the rows.
    grid = rate_hz if rate_hz > 0.99 * usual else usual
    raw = {str(name): values for name, values in rows.values.items()}
    even = onto_even_times(times, raw, grid)
    low, middle, high = even.steps_s
    how = (
        f"resampled from steps of {1e3 * low:.4g} to {1e3 * high:.4g} ms (median {1e3 * middle:.4g} ms) to "
        f"{rate_hz:g} Hz: positions by cubic splines, efforts linearly"
    )
    notes.append(how + (f"; {even.holes} holes are gaps" if even.holes else ""))
    if even.left_out:
        notes.append(f"{even.left_out} rows between holes too close to each other left out")
    facts = {"resampled": how, "resampled.from_hz": f"{usual:.6g}", "resampled.holes": str(even.holes)}
    values = {name: even.values[name] for name in rows.values}
    return Sampled(grid, even.numbers, values, True, facts, tuple(notes))
