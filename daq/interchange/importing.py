"""Import of measured motion from CSV, MAT, NPZ, Parquet, LeRobot data sets and bags of ROS 2."""

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError, RobotConfig
from armident.daq.interchange.bag_files import bag_files, is_bag
from armident.daq.interchange.lerobot import data_files
from armident.daq.interchange.rate_conversion import at_rate
from armident.daq.interchange.sample_clock import gaps_and_counters
from armident.daq.interchange.sampling import Sampled, sampled
from armident.daq.interchange.si_checks import OMITTED, check_units, fast_note, unit_of
from armident.daq.interchange.stated_units import in_si
from armident.daq.interchange.table_columns import NAMES
from armident.daq.interchange.table_files import Source, read_pair, read_table
from armident.daq.interchange.table_rows import Rows, complete_rows
from armident.daq.recording import Field, Recording, Stream, is_recording, read_recording
from armident.daq.recording.model import Side

__all__ = ["NAMES", "OMITTED", "import_recording"]

NOTES = "source_remarks"
"""Key of the metadata with everything that an import left out or assumed."""


# Numbers of other tools may overflow; the checks refuse what comes of them.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def import_recording(
    path: Path,
    robot: RobotConfig | None,
    *,
    effort: Path | None = None,
    motor_side: bool = False,
    rate_hz: float | None = None,
    names: Mapping[str, str] | None = None,
    polled: bool = False,
    resample_hz: float | None = None,
    time_unit: str | None = None,
    topic: str | None = None,
    joints: Sequence[str] | None = None,
    by_position: bool = False,
    units: Mapping[str, str] | None = None,
) -> Recording:
    """Return measured motion and effort as a recording, after checks of content, units and clock.

    Raises ConfigError if a file or option is wrong; DataError if the content is wrong: missing columns, wrong number of
    axes, too many damaged rows, times that jitter or contradict the rate, values far outside the limits, or a demand
    that no joint followed.

    Parameters
    ----------
    path
        CSV with a header line, MAT (up to version 7), NPZ, Parquet, a LeRobot data set (file or folder), or joint
        states in a bag of ROS 2 (MCAP, SQLite, or a folder); SI units.
        A recording of armident is resampled to ``rate_hz`` (`armident.daq.interchange.rate_conversion`).
    robot
        The robot that was measured; ``None`` for a recording: the one inside it.
    effort
        A second CSV with one effort column per joint; ``path`` then has one position column per joint, and
        headers of both are free or absent. A file of a single column has the joints one after the other, sample by
        sample.
    motor_side
        Positions and torques are those of the motors; currents and voltages always are.
    rate_hz
        Sampling rate, 1/s, if the file has no time column, or if its times are less precise than the clock. Refused if
        the times contradict it.
    names
        Names of this file by quantity (``time, position, torque, current, voltage, demand``); ``-`` leaves one out.
    polled
        The rows were polled from a controller of ``rate_hz``, so that some samples are repeated and some missed: they
        are resampled onto its clock (`armident.daq.interchange.resample`).
    resample_hz
        Resample rows whose times jitter, or that were polled from a controller of this rate, 1/s; holes are gaps.
        Metadata of the recording tell the method.
    time_unit
        Unit of the times: ``s``, ``ms``, ``us`` or ``ns``.
    topic
        Topic of joint states of a bag.
    joints
        Names of the joints in the file, in the robot's order.
    by_position
        Take joints of other names in the order of the file.
    units
        Units of quantities that are not in SI units (`armident.daq.interchange.stated_units.CHOICES`).
    """
    if is_recording(path):
        if effort is not None or motor_side or names or polled or time_unit or topic or joints or by_position or units:
            raise ConfigError(f"{path}: a recording of armident takes no option but --rate, --config and --out")
        return _resampled(path, robot, rate_hz if rate_hz is not None else resample_hz)
    if robot is None:
        raise ConfigError(f"{path}: needs the configuration of the robot")
    _check_rates(rate_hz, polled, resample_hz)
    if time_unit is not None and is_bag(path) and not data_files(path):
        raise ConfigError(f"{path}: --time-unit is an option of tables; the stamps of a bag are in s and ns")
    source, rows = read_rows(
        path, robot, effort=effort, names=names, topic=topic, joints=joints, by_position=by_position
    )
    rows = in_si(rows, robot, units or {})
    _refuse_immense(source, rows)
    side: Side = "motor" if motor_side else "joint"
    fields: dict[str, Field] = {
        name: Field(
            name, name, unit_of(name, robot), "motor" if name in ("current", "voltage") else side, (1.0,) * robot.n
        )
        for name in rows.values
    }
    known = _rows_with_demand(source, rows)
    check_units(path, robot, fields, {str(name): values for name, values in rows.values.items()}, known)
    if (polled or resample_hz is not None) and known != slice(0, rows.row.size):
        option = "--polled" if polled else "--resample"
        raise DataError(
            f"{source.place(int(rows.row[0]), 'demand')}: {option} needs a demand in every row, "
            f"or --map demand={OMITTED}"
        )
    try:
        made = sampled(
            source, rows, robot, rate_hz=rate_hz, polled=polled, resample_hz=resample_hz, time_unit=time_unit
        )
    except DataError as error:
        shown = str(error)
        raise type(error)(shown if shown.startswith(str(path)) else f"{path}: {shown}") from error
    notes = (*source.notes, *rows.notes, *made.notes)
    if not motor_side:
        notes += fast_note(robot, made.values["position"], made.rate_hz)
    for note in notes:
        logging.getLogger(__name__).warning("%s: %s", path, note)
    facts = {"source": path.name, "source_sha256": _digest(path), **made.facts}
    if effort is not None:
        facts |= {"effort": effort.name, "effort_sha256": _digest(effort)}
    if notes:
        facts[NOTES] = "; ".join(notes)
    recording = _recording(robot, fields, made, known, facts)
    if resample_hz is None or abs(made.rate_hz / resample_hz - 1.0) < 1e-9:
        return recording
    return at_rate(recording, resample_hz)


def read_rows(
    path: Path,
    robot: RobotConfig,
    *,
    effort: Path | None = None,
    names: Mapping[str, str] | None = None,
    topic: str | None = None,
    joints: Sequence[str] | None = None,
    by_position: bool = False,
) -> tuple[Source, Rows]:
    """Return a table, and its complete rows in the units of the file.

    ``path``, ``robot``, ``effort``, ``names``, ``topic``, ``joints``, ``by_position``: as for `import_recording`.
    Raises ConfigError if a file or option is wrong; DataError if columns are missing, or too many rows are damaged.
    """
    chosen = dict(names or {})
    unknown = sorted(chosen.keys() - NAMES.keys())
    if unknown:
        raise ConfigError(f"--map: no quantity named {unknown[0]!r}; expected one of {', '.join(NAMES)}")
    if effort is None and is_bag(path) and not data_files(path):
        source = _bag(path, robot, topic, joints, by_position)
        return source, complete_rows(source, robot, chosen)
    if topic is not None:
        raise ConfigError(f"{path}: --topic is an option of ROS 2 bags")
    source = read_pair(path, effort, robot) if effort is not None else read_table(path)
    return source, complete_rows(source, robot, chosen, by_position=by_position, joints=joints)


def _check_rates(rate_hz: float | None, polled: bool, resample_hz: float | None) -> None:
    for option, value in (("--rate", rate_hz), ("--resample", resample_hz)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise ConfigError(f"{option}: expected a sampling rate greater than 0 Hz, found {value:g}")
    if polled and rate_hz is None and resample_hz is None:
        raise ConfigError("--polled: needs --rate, the sampling rate of the controller")
    if rate_hz is not None and resample_hz is not None and rate_hz != resample_hz:
        raise ConfigError(f"--rate {rate_hz:g} and --resample {resample_hz:g} contradict each other; give one of them")


def _bag(path: Path, robot: RobotConfig, topic: str | None, joints: Sequence[str] | None, by_position: bool) -> Source:
    """Return the joint states of a bag of ROS 2."""
    from armident.daq.interchange.rosbag import read_joint_states

    states = read_joint_states(path, robot, topic=topic, joints=joints, by_position=by_position)
    times = (states.t_ns - states.t_ns[0]) / 1e9
    return Source(path, {"t": times, "q": states.q, "tau": states.tau}, notes=states.remarks, t_ns=states.t_ns)


def _recording(
    robot: RobotConfig, fields: Mapping[str, Field], made: Sampled, known: slice, facts: dict[str, str]
) -> Recording:
    raw: dict[str, NDArray[Any]] = {str(name): values for name, values in made.values.items()}
    own = dict(fields)
    sync, rate = made.numbers, made.rate_hz
    t_ns = np.round(sync * (1e9 / rate)).astype(np.int64)
    streams: dict[str, Stream] = {}
    if known != slice(0, sync.size) and not made.resampled:
        demand, field = raw.pop("demand")[known], own.pop("demand")
        streams["demand"] = Stream("demand", 1, sync[known], t_ns[known], {"demand": field}, {"demand": demand})
    streams["samples"] = Stream("samples", 1, sync, t_ns, own, raw)
    gaps, counters = gaps_and_counters(streams)
    return Recording(None, robot, None, rate, streams, gaps=gaps, counters=counters, metadata=facts)


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file, or of the files of a folder in their order."""
    digest = hashlib.sha256()
    for file in data_files(path) or (bag_files(path)[0] if path.is_dir() else [path]):
        with file.open("rb") as opened:
            while block := opened.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def _resampled(path: Path, robot: RobotConfig | None, rate_hz: float | None) -> Recording:
    """Return a recording of armident at another sampling rate, of a configuration with the same joints."""
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
    facts = {**made.metadata, "source": path.name, "source_sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    return replace(made, path=None, robot=robot or recording.robot, metadata=facts)


def _refuse_immense(source: Source, rows: Rows) -> None:
    """Refuse values whose squares are no numbers: no measurement is so large, and least squares needs them."""
    most = np.sqrt(np.finfo(np.float64).max)
    for name, values in rows.values.items():
        bad = np.argwhere(np.abs(values) > most)
        if bad.size:
            row, column = bad[0]
            where = source.place(int(rows.row[row]), rows.labels[name][column])
            raise DataError(f"{where}: {values[row, column]:.3g} is no measurement")


def _rows_with_demand(source: Source, rows: Rows) -> slice:
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
