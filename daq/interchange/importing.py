"""Import of measured motion from files of other tools."""

import logging
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armident.configs import ConfigError, DataError, RobotConfig, SessionConfig
from armident.daq.interchange.bag_files import bag_files
from armident.daq.interchange.clocks import UNITS, descending, gaps_and_counters
from armident.daq.interchange.column_units import SINCE
from armident.daq.interchange.csv_files import seconds_of_date
from armident.daq.interchange.exporting import CLOCK_SET_NS
from armident.daq.interchange.import_options import ImportOptions
from armident.daq.interchange.lerobot import FULL, UNSURE, data_files, position_hint
from armident.daq.interchange.readers import check_options, reader_of
from armident.daq.interchange.resampling import Sampled, at_rate, sampled
from armident.daq.interchange.si_checks import OMITTED, check_units, limit_notes, si_unit_of
from armident.daq.interchange.stated_units import in_si
from armident.daq.interchange.table_columns import NAMES
from armident.daq.interchange.table_files import Source
from armident.daq.interchange.table_rows import EFFORTS, TableRows, complete_rows
from armident.daq.interchange.text_files import NOTES, listed, sha256_of
from armident.daq.recording import Field, Recording, Stream, read_recording
from armident.daq.recording.faults.repair import REPAIRS, repair
from armident.daq.recording.faults.sign_bit import sign_bit
from armident.daq.recording.model import Side

__all__ = ["NAMES", "OMITTED", "import_recording"]


# Numbers of other tools may overflow; the checks refuse what comes of them.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def import_recording(
    path: Path, config: RobotConfig | SessionConfig | None, **options: Unpack[ImportOptions]
) -> Recording:
    """Return measured motion and effort as a recording, after checks of content, units and clock.

    ``config`` is the robot that was measured, the session of a bus log, or ``None`` for a recording, which has its
    robot.
    """
    reader = reader_of(path)
    check_options(path, reader, options)
    if not isinstance(config, SessionConfig if reader.session else RobotConfig) and not (config is None and reader.own):
        raise ConfigError(f"{path}: needs the configuration of the {'session' if reader.session else 'robot'}")
    _check_rates(options.get("rate_hz"), options.get("polled", False), options.get("resample_hz"))
    found = reader.read(path, config, options)
    if isinstance(found, Recording):
        return found
    assert isinstance(config, RobotConfig)
    files = data_files(path) or (bag_files(path)[0] if path.is_dir() else [path])
    facts = {"source": path.name, "source_sha256": sha256_of(*files)}
    effort = options.get("effort")
    if effort is not None:
        facts |= {"effort": effort.name, "effort_sha256": sha256_of(effort)}
    return _from_table(config, found, options, facts)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def recording_of_arrays(
    t: ArrayLike,
    position: ArrayLike,
    torque: ArrayLike,
    robot: RobotConfig,
    reference: ArrayLike | None = None,
    resample_hz: float | None = None,
) -> Recording:
    """Return arrays as a recording, after the checks of an import; see `Recording.from_arrays`."""
    table: dict[str, NDArray[np.float64]] = {"t": np.asarray(t, np.float64).reshape(-1)}
    for name, label, given in (("q", "position", position), ("tau", "torque", torque), ("qr", "reference", reference)):
        if given is not None:
            values = np.asarray(given, np.float64)
            table[name] = values[:, None] if values.ndim == 1 else values
            if table[name].shape != (table["t"].size, robot.n):
                raise DataError(
                    f"{label}: an array of shape {values.shape}; expected ({table['t'].size}, {robot.n}): one row for "
                    f"each time and one column for each joint of {robot.name}"
                )
    _check_rates(None, False, resample_hz)
    if descending(table["t"]):
        raise DataError("t: time does not increase: give all arrays from the oldest row to the newest")
    try:
        return _from_table(robot, Source(Path("arrays"), table), {"resample_hz": resample_hz}, {"source": "arrays"})
    except DataError as error:
        raise type(error)(_as_arguments(str(error))) from error


def _as_arguments(message: str) -> str:
    """Return a message with the options of ``armident import`` as arguments of `Recording.from_arrays`."""
    for option, argument in (
        (r"--resample (\S+)", r"resample_hz=\1"),
        (r"--rate (\S+)( if the samples are even)?", r"t = numpy.arange(len(t)) / \1\2"),
        (r"--time-unit (m|u|n)s reads it so", r"t has to be in s"),
        (r"give the sampling rate with --rate, and omit the times: --map time=-", "t has to be in s, at equal steps"),
        (r" unless --motor-side", ""),
        (r"--units \w+=\w+ if they are", "convert them if they are"),
        (rf"--map demand={OMITTED} omits (it|the demand)", r"reference=None omits \1"),
        (rf", or omit the demand with --map demand={OMITTED}", ", or leave the reference out"),
    ):
        message = re.sub(option, argument, message)
    return message


def _from_table(robot: RobotConfig, source: Source, options: ImportOptions, facts: Mapping[str, str]) -> Recording:
    """Return a table as a recording, after checks of content, units and clock."""
    path = source.path
    rate_hz, resample_hz = options.get("rate_hz"), options.get("resample_hz")
    polled, motor_side = options.get("polled", False), options.get("motor_side", False)
    rows = table_rows(source, robot, options)
    _refuse_sign_bits(source, rows)
    hint = position_hint(rows.values["position"]) if source.lerobot else ""
    units = options.get("units") or {}
    if source.lerobot and np.abs(rows.values["position"]).max() <= FULL:
        rows = replace(rows, notes=(*rows.notes, *filter(None, [UNSURE.get(units.get("position", ""))])))
    rows = in_si(rows, robot, units)
    _refuse_immense(source, rows)
    side: Side = "motor" if motor_side else "joint"
    rows, repairs = _repaired(rows, robot, side, options)
    facts = {**facts, REPAIRS: "\n".join(repairs)} if repairs else facts
    fields: dict[str, Field] = {
        name: Field(
            name, name, si_unit_of(name, robot), "motor" if name in ("current", "voltage") else side, (1.0,) * robot.n
        )
        for name in rows.values
    }
    known = _rows_with_demand(source, rows)
    check_units(path, robot, fields, {str(name): values for name, values in rows.values.items()}, known, hint)
    if (polled or resample_hz is not None) and known != slice(0, rows.row.size):
        option = "--polled" if polled else "--resample"
        raise DataError(
            f"{source.place(int(rows.row[0]), 'demand')}: {option} needs a demand in every row, "
            f"or --map demand={OMITTED}"
        )
    try:
        made = sampled(
            source,
            rows,
            robot,
            rate_hz=rate_hz,
            polled=polled,
            resample_hz=resample_hz,
            time_unit=options.get("time_unit"),
        )
    except DataError as error:
        shown = "; ".join(part for part in (source.clock, str(error)) if part)
        raise type(error)(shown if shown.startswith(str(path)) else f"{path}: {shown}") from error
    notes = (*source.notes, *rows.notes, *made.notes)
    if not motor_side:
        notes += limit_notes(robot, made.values["position"], made.values.get("torque"), made.rate_hz)
    for note in notes:
        logging.getLogger(__name__).warning("%s: %s", path, note)
    remarks = {NOTES: "; ".join(notes)} if notes else {}
    begin_ns = _begin_ns(source, rows, options.get("time_unit"))
    recording = _recording(robot, fields, made, known, {**facts, **made.facts, **remarks}, begin_ns)
    if resample_hz is None or abs(made.rate_hz / resample_hz - 1.0) < 1e-9:
        return recording
    return at_rate(recording, resample_hz)


def _repaired(
    rows: TableRows, robot: RobotConfig, side: Side, options: ImportOptions
) -> tuple[TableRows, tuple[str, ...]]:
    """Return the rows without wraps of their positions and without impossible rows, and a note on each kind."""
    rate_hz = options.get("rate_hz")
    if rows.times is None:
        times = rows.row / (rate_hz or 1.0)
    elif rate_hz is None:
        unit = options.get("time_unit") or rows.time_unit
        times = rows.times * UNITS.get(unit, 1.0)
    else:
        usual = float(np.median(np.diff(rows.times))) if rows.times.size > 1 else 0.0
        times = rows.times / (usual * rate_hz) if usual > 0.0 else rows.row / rate_hz
    effort = next(rows.values[name] for name in EFFORTS if name in rows.values)
    q, demand, polled = rows.values["position"], rows.values.get("demand"), options.get("polled", False)
    found = repair(q, effort, demand, times, robot, side, polled=polled, torque="torque" in rows.values)
    if not found.notes:
        return rows, ()
    values = {**rows.values, "position": found.position}
    if found.demand is not None:
        values["demand"] = found.demand
    made = replace(rows, values=values, notes=(*rows.notes, *found.notes))
    return made.taken(~found.wrong), found.notes


def read_rows(path: Path, robot: RobotConfig, **options: Unpack[ImportOptions]) -> tuple[Source, TableRows]:
    """Return a table, and its complete rows in the units of the file."""
    reader = reader_of(path)
    check_options(path, reader, options)
    source = reader.read(path, robot, options)
    if not isinstance(source, Source):
        raise ConfigError(f"{path}: a {reader.name} is no table")
    return source, table_rows(source, robot, options)


def table_rows(source: Source, robot: RobotConfig, options: ImportOptions) -> TableRows:
    """Return the complete rows of a table in the units of the file."""
    chosen = dict(options.get("names") or {})
    unknown = sorted(chosen.keys() - NAMES.keys())
    if unknown:
        raise ConfigError(f"--map: no quantity named {unknown[0]!r}; expected one of {', '.join(NAMES)}")
    if source.t_ns is not None:
        # The joints of a bag were chosen when it was read.
        return complete_rows(source, robot, chosen)
    return complete_rows(
        source, robot, chosen, by_position=options.get("by_position", False), joints=options.get("joints")
    )


def _check_rates(rate_hz: float | None, polled: bool, resample_hz: float | None) -> None:
    for option, value in (("--rate", rate_hz), ("--resample", resample_hz)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise ConfigError(f"{option}: expected a sampling rate greater than 0 Hz, found {value:g}")
    if polled and rate_hz is None and resample_hz is None:
        raise ConfigError("--polled: needs --rate, the sampling rate of the controller")
    if rate_hz is not None and resample_hz is not None and rate_hz != resample_hz:
        raise ConfigError(f"--rate {rate_hz:g} and --resample {resample_hz:g} contradict each other; give one of them")


def _begin_ns(source: Source, rows: TableRows, stated: str | None) -> int:
    """Return the time of the first row, ns UTC: of a stamp, from the date in the unit, or since 1970; else 0."""
    if source.t_ns is not None:
        return max(int(source.t_ns[rows.row[0]]), 0)
    if rows.times is None:
        return 0
    date = source.units.get(rows.time_name, "").partition(SINCE)[2]
    begin_ns = round(float(rows.times[0]) * UNITS.get(stated or rows.time_unit, 1.0) * 1e9)
    try:
        if date.endswith("Z") and seconds_of_date(date) is not None:
            begin_ns += int(np.datetime64(date[:-1], "ns").astype(np.int64))
        elif date:
            begin_ns += round(1e9 * (seconds_of_date(date) or 0.0))
    except ValueError:
        return 0
    return begin_ns if CLOCK_SET_NS <= begin_ns < 2**62 else 0


def _recording(
    robot: RobotConfig, fields: Mapping[str, Field], made: Sampled, known: slice, facts: dict[str, str], begin_ns: int
) -> Recording:
    raw: dict[str, NDArray[Any]] = {str(name): values for name, values in made.values.items()}
    own = dict(fields)
    sync, rate = made.numbers, made.rate_hz
    t_ns = begin_ns + np.round((sync - sync[0]) * (1e9 / rate)).astype(np.int64)
    streams: dict[str, Stream] = {}
    if known != slice(0, sync.size) and not made.resampled:
        demand, field = raw.pop("demand")[known], own.pop("demand")
        streams["demand"] = Stream("demand", 1, sync[known], t_ns[known], {"demand": field}, {"demand": demand})
    streams["samples"] = Stream("samples", 1, sync, t_ns, own, raw)
    gaps, counters = gaps_and_counters(streams)
    return Recording(None, robot, None, rate, streams, gaps=gaps, counters=counters, metadata=facts)


def resampled_recording(path: Path, robot: RobotConfig | None, options: ImportOptions) -> Recording:
    """Return a recording of armident at another sampling rate, of a configuration with the same joints."""
    rate_hz = options.get("rate_hz") or options.get("resample_hz")
    if rate_hz is None:
        raise ConfigError(f"{path}: a recording already; --rate resamples it")
    recording = read_recording(path)
    own = [joint.name for joint in recording.robot.joints]
    if robot is not None and [joint.name for joint in robot.joints] != own:
        raise DataError(f"{path}: a recording of joints {', '.join(own)}, the configuration has others")
    try:
        made = at_rate(recording, rate_hz)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
    facts = {**made.metadata, "source": path.name, "source_sha256": sha256_of(path)}
    return replace(made, path=None, robot=robot or recording.robot, metadata=facts)


def _refuse_immense(source: Source, rows: TableRows) -> None:
    """Refuse values whose squares are no numbers: no measurement is so large, and least squares needs them."""
    most = np.sqrt(np.finfo(np.float64).max)
    for name, values in rows.values.items():
        bad = np.argwhere(np.abs(values) > most)
        if bad.size:
            row, column = bad[0]
            where = source.place(int(rows.row[row]), rows.labels[name][column])
            raise DataError(f"{where}: {values[row, column]:.3g} is too large for a measurement")


def _refuse_sign_bits(source: Source, rows: TableRows) -> None:
    """Refuse efforts that hold negative values in unsigned numbers: they are wrong wherever they are negative."""
    for name in EFFORTS:
        values = rows.values.get(name, np.zeros((0, 0)))
        found = next((bit for column in values.T if (bit := sign_bit(column)) is not None), None)
        if found is not None:
            labels = zip(rows.labels[name], values.T, strict=True)
            named = [label for label, column in labels if column.max() >= found.least]
            raise DataError(
                f"{source.path}: {listed(named)}: never negative, and values jump by {found.least:g} or more where the "
                f"motion turns: {found.how}; decode it where they are recorded: {found.formula}"
            )


def _rows_with_demand(source: Source, rows: TableRows) -> slice:
    """Return the rows from the first to the last with a demand; a capture has none before the first set point."""
    demand = rows.values.get("demand")
    if demand is None:
        return slice(0, rows.row.size)
    have = np.flatnonzero(~np.isnan(demand).all(axis=1))
    known = slice(int(have[0]), int(have[-1]) + 1) if have.size else slice(0, len(demand))
    bad = np.argwhere(~np.isfinite(demand[known]))
    if bad.size:
        row, column = known.start + int(bad[0, 0]), int(bad[0, 1])
        more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
        where = source.place(int(rows.row[row]), rows.labels["demand"][column])
        raise DataError(
            f"{where}: {demand[row, column]} is not a number{more}; --map demand={OMITTED} omits the demand"
        )
    return known
