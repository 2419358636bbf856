"""Import of measured motion from CSV, MAT, NPZ, Parquet and bags of ROS 2."""

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError, RobotConfig
from armident.configs.yaml_loader import is_file
from armident.daq.interchange.bag_files import bag_files, is_bag
from armident.daq.interchange.rate_conversion import at_rate
from armident.daq.interchange.resample import onto_even_clock
from armident.daq.interchange.sample_clock import HOLE, gaps_and_counters, sample_numbers
from armident.daq.interchange.sandbox import error_line, read_in_subprocess
from armident.daq.recording import Field, Recording, Stream, is_recording, read_recording
from armident.daq.recording.model import Quantity, Side

NAMES: Mapping[str, tuple[str, ...]] = {
    "time": ("t", "time", "times"),
    "position": ("q", "qm", "position", "positions"),
    "torque": ("tau", "torque", "torques"),
    "current": ("current", "currents"),
    "voltage": ("voltage", "vir"),
    "demand": ("qr", "qg", "target_positions"),
}
"""Accepted names of each quantity; ``q`` also stands for columns ``q1..qn``."""

OMITTED = "-"
"""Name with which a quantity of a file is left out."""

EFFORTS: tuple[Quantity, ...] = ("torque", "current", "voltage")
_STEP_TOLERANCE = 0.01
"""Largest deviation of a sampling step from the median step, relative."""
_POSITION_FACTOR, _TORQUE_FACTOR = 3.0, 10.0
"""Positions and torques beyond these multiples of the joint's limits are taken as a wrong unit."""

_MOVED_SHARE = 1e-3
"""Share of its position range that a joint must move for its demand to be checked."""
_UNEXPLAINED_SHARE = 0.5
"""Largest share of the power of a joint's motion that its demand may leave unexplained."""

Table = dict[str, NDArray[np.float64]]


@dataclass(frozen=True)
class Source:
    """Named arrays of a file.

    Parameters
    ----------
    path
        The file.
    table
        Arrays by name, (N,) or (N, n).
    first_line
        Line number of the first row in a text file; ``None`` for other formats.
    remarks
        Sentences on what was assumed, passed over or is missing, for the user.
    t_ns
        Stamps of the samples, ns, (N,); ``None`` if the rows have none, or a column of times.
    """

    path: Path
    table: Table
    first_line: int | None = None
    remarks: tuple[str, ...] = ()
    t_ns: NDArray[np.int64] | None = None

    def place(self, row: int, name: str) -> str:
        """Return the position of a value in the file, for messages.

        Parameters
        ----------
        row
            Row, from 0.
        name
            Name of the column.
        """
        where = f"row {row}" if self.first_line is None else f"line {self.first_line + row}"
        return f"{self.path}: {where}, column {name}"


def import_recording(
    path: Path,
    robot: RobotConfig | None,
    *,
    effort: Path | None = None,
    motor_side: bool = False,
    rate_hz: float | None = None,
    names: Mapping[str, str] | None = None,
    polled: bool = False,
    topic: str | None = None,
    joints: Sequence[str] | None = None,
    by_position: bool = False,
) -> Recording:
    """Return measured motion and effort as a recording, after checks of content and units.

    Parameters
    ----------
    path
        CSV with a header line, MAT (up to version 7), NPZ, Parquet, or joint states in a bag of ROS 2 (MCAP, SQLite,
        or a folder); SI units.
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
        Sampling rate, 1/s, if the file has no time column, or if its times are less precise than the clock.
    names
        Names of this file by quantity (``time, position, torque, current, voltage, demand``); ``-`` leaves one out.
    polled
        The rows were polled from a controller of ``rate_hz``, so that some samples are repeated and some missed: they
        are resampled onto its clock (`armident.daq.interchange.resample`).
    topic, joints, by_position
        Of a bag: the topic of joint states, the names of the robot's joints in it, and True to take joints of other
        names in their order (`armident.daq.interchange.rosbag`).

    Raises
    ------
    ConfigError
        If a file or option is wrong.
    DataError
        If the content is wrong: missing columns, wrong number of axes, NaN, uneven time, values far outside the limits,
        or a demand that no joint followed.
    """
    if is_recording(path):
        if effort is not None or motor_side or names or polled or topic or joints or by_position:
            raise ConfigError(f"{path}: a recording of armident takes no option but --rate, --config and --out")
        return _resampled(path, robot, rate_hz)
    if robot is None:
        raise ConfigError(f"{path}: needs the configuration of the robot")
    names = dict(names or {})
    unknown = sorted(names.keys() - NAMES.keys())
    if unknown:
        raise ConfigError(f"--map: no quantity named {unknown[0]!r}; expected one of {', '.join(NAMES)}")
    if polled and rate_hz is None:
        raise ConfigError("--polled: needs --rate, the sampling rate of the controller")
    if is_bag(path) and effort is None:
        source = _bag(path, robot, topic, joints, by_position)
    elif topic is not None or joints is not None or by_position:
        raise ConfigError(f"{path}: --topic, --joints and --by-position are options of ROS 2 bags")
    else:
        source = _pair(path, effort, robot) if effort is not None else _load(path)
    for remark in source.remarks:
        logging.getLogger(__name__).warning("%s: %s", path, remark)
    numbers, rate = _clock(source, names, rate_hz, polled)
    side: Side = "motor" if motor_side else "joint"
    fields: dict[str, Field] = {}
    raw: dict[str, NDArray[Any]] = {}
    quantities: tuple[Quantity, ...] = ("position", *EFFORTS, "demand")
    for quantity in quantities:
        values = _pick(source, quantity, robot.n, names)
        if values is None or (quantity in EFFORTS and any(e in raw for e in EFFORTS)):
            continue
        own_side: Side = "motor" if quantity in ("current", "voltage") else side
        fields[quantity] = Field(quantity, quantity, _unit(quantity, robot), own_side, (1.0,) * robot.n)
        raw[quantity] = values
    if "position" not in raw or not any(e in raw for e in EFFORTS):
        have = ", ".join(source.table)
        raise DataError(
            f"{path}: expected columns q1..q{robot.n} and tau1..tau{robot.n} (or current, voltage); found {have}"
        )
    known = _rows_with_demand(raw["demand"]) if "demand" in raw else slice(0, len(raw["position"]))
    _check_units(path, robot, fields, raw, known)
    if polled and known != slice(0, len(raw["position"])):
        raise DataError(f"{source.place(0, 'demand')}: --polled needs a demand in every row, or --map demand={OMITTED}")
    facts = {"source": path.name, "source_sha256": _digest(path)}
    if effort is not None:
        facts |= {"effort": effort.name, "effort_sha256": _digest(effort)}
    if source.remarks:
        facts |= {"source_remarks": "; ".join(source.remarks)}
    if polled:
        try:
            even = onto_even_clock(raw)
        except DataError as error:
            raise DataError(f"{path}: {error}") from error
        raw = dict(even.values)
        facts |= {"polled.repeated": str(even.repeated), "polled.interpolated": str(even.interpolated)}
    count = len(raw["position"])
    sync = np.arange(count, dtype=np.int64) if numbers is None else numbers
    t_ns = np.round(sync * (1e9 / rate)).astype(np.int64)
    streams: dict[str, Stream] = {}
    if known != slice(0, count) and not polled:
        demand, field = raw.pop("demand")[known], fields.pop("demand")
        streams["demand"] = Stream("demand", 1, sync[known], t_ns[known], {"demand": field}, {"demand": demand})
    streams["samples"] = Stream("samples", 1, sync, t_ns, fields, raw)
    gaps, counters = gaps_and_counters(streams)
    return Recording(None, robot, None, rate, streams, gaps=gaps, counters=counters, metadata=facts)


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


def _rows_with_demand(demand: NDArray[np.float64]) -> slice:
    """Return the rows from the first to the last with a demand; a capture has none before the first set point."""
    rows = np.flatnonzero(~np.isnan(demand).all(axis=1))
    return slice(int(rows[0]), int(rows[-1]) + 1) if rows.size else slice(0, len(demand))


def _load(path: Path) -> Source:
    if not is_file(path):
        raise ConfigError(f"{path}: no such file")
    kind = path.suffix.lower()
    if kind in (".csv", ".txt"):
        header, values, first_line = _csv(path)
        if header is None:
            raise DataError(f"{path}: no header line; expected t,q1..,tau1.. (or a pair of files with --effort)")
        return Source(path, dict(zip(header, values.T, strict=True)), first_line)
    if kind == ".npz":
        try:
            with np.load(path, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
        except Exception as error:  # zipfile, zlib and numpy raise various errors for damaged files
            raise DataError(f"{path}: not a readable NPZ file: {error_line(error)}") from error
        return Source(path, _numeric(arrays))
    if kind == ".mat":
        return Source(path, _numeric(_mat(path)))
    if kind == ".parquet":
        return Source(path, _numeric(_parquet(path)))
    raise ConfigError(
        f"{path}: cannot import {kind or 'a file without suffix'}; expected .csv, .mat, .npz, .parquet, "
        "a bag of ROS 2 (.mcap, .db3, or its folder), or the log of a bus (.log, .asc, .blf, .trc)"
    )


def _bag(path: Path, robot: RobotConfig, topic: str | None, joints: Sequence[str] | None, by_position: bool) -> Source:
    """Return the joint states of a bag of ROS 2."""
    from armident.daq.interchange.rosbag import read_joint_states

    states = read_joint_states(path, robot, topic=topic, joints=joints, by_position=by_position)
    return Source(path, {"q": states.q, "tau": states.tau}, remarks=states.remarks, t_ns=states.t_ns)


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file, or of the files of a bag folder in their order."""
    digest = hashlib.sha256()
    for file in bag_files(path)[0] if path.is_dir() else [path]:
        with file.open("rb") as opened:
            while block := opened.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def _parquet(path: Path) -> dict[str, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ConfigError(f"{path}: Parquet needs the package pyarrow (pip install pyarrow)") from error
    try:
        table = pyarrow.parquet.read_table(path)  # type: ignore[no-untyped-call]
        return {name: table.column(name).to_numpy() for name in table.column_names}
    except Exception as error:  # pyarrow raises various errors for damaged files
        raise DataError(f"{path}: not a readable Parquet file: {error_line(error)}") from error


def _mat(path: Path) -> dict[str, NDArray[Any]]:
    from scipy.io import loadmat

    def read() -> dict[str, Any]:
        try:
            arrays: dict[str, Any] = loadmat(path)
        except NotImplementedError as error:
            raise ValueError("MAT version 7.3 is not supported; save it with -v7") from error
        return arrays

    try:
        # Some damaged files crash scipy's reader.
        return read_in_subprocess(read)
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not a readable MAT file: {error_line(error)}") from error


def _numeric(arrays: Mapping[str, Any]) -> Table:
    """Return the real arrays; vectors as (N,)."""
    table: Table = {}
    for name, value in arrays.items():
        if isinstance(value, np.ndarray) and value.dtype.kind in "iuf" and value.size:
            array = value.astype(np.float64)
            table[name] = array.ravel() if array.ndim == 2 and 1 in array.shape else array
    return table


def _pair(path: Path, effort: Path, robot: RobotConfig) -> Source:
    """Return two tables with free or no headers as one source; effort is torque or the drive's own signal."""
    columns: Table = {}
    first_line = 1
    for file, base in ((path, "q"), (effort, "tau")):
        if not is_file(file):
            raise ConfigError(f"{file}: no such file")
        _, values, first_line = _csv(file)
        _check_finite(
            Source(file, {}, first_line), values, [f"{j + 1}" for j in range(values.shape[1])], slice(0, len(values))
        )
        if values.shape[1] == 1 and values.shape[0] % robot.n == 0:
            values = values.reshape(-1, robot.n)
        if values.shape[1] != robot.n:
            raise DataError(f"{file}: {values.shape[1]} columns, but {robot.name} has {robot.n} joints")
        columns |= {f"{base}{j + 1}": values[:, j] for j in range(robot.n)}
    rows = {len(v) for v in columns.values()}
    if len(rows) != 1:
        raise DataError(f"{path} and {effort}: {' and '.join(str(r) for r in sorted(rows))} rows")
    return Source(path, columns, first_line)


def _csv(path: Path) -> tuple[list[str] | None, NDArray[np.float64], int]:
    """Return header (if there is one), values (N, columns) and the line number of the first values."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            first = file.readline()
            delimiter = next((d for d in (",", ";", "\t") if d in first), None)
            words = [word.strip() for word in first.split(delimiter)]
            header = None if all(_is_number(w) for w in words) else words
            file.seek(0)
            skip = 0 if header is None else 1
            values = np.loadtxt(file, delimiter=delimiter, skiprows=skip, ndmin=2, comments=None)
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not a text file") from error
    except ValueError as error:
        raise DataError(_bad_line(path, delimiter, len(words), skip) or f"{path}: {error}") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    if values.size == 0:
        raise DataError(f"{path}: no values")
    if header is not None and len(header) != values.shape[1]:
        raise DataError(f"{path}: {len(header)} names in the header, {values.shape[1]} columns of values")
    return header, values, skip + 1


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _bad_line(path: Path, delimiter: str | None, columns: int, skip: int) -> str | None:
    """Describe the first line that cannot be read."""
    with path.open(encoding="utf-8-sig") as file:
        for number, line in enumerate(file, start=1):
            words = line.split(delimiter)
            if number <= skip or not line.strip():
                continue
            if len(words) != columns:
                return f"{path}: line {number} has {len(words)} columns, expected {columns}"
            for k, word in enumerate(words, start=1):
                if not _is_number(word):
                    return f"{path}: line {number}, column {k}: expected a number, found {word.strip()!r:.80}"
    return None


def _pick(source: Source, quantity: str, n: int, names: Mapping[str, str]) -> NDArray[np.float64] | None:
    """Return the (N, n) values of a quantity, or ``None`` if the file has none or it is to be left out."""
    if names.get(quantity) == OMITTED:
        return None
    for base in (names[quantity],) if quantity in names else NAMES[quantity]:
        whole = source.table.get(base)
        labels = [f"{base}{j + 1}" for j in range(n)]
        if whole is not None:
            values = whole[:, None] if whole.ndim == 1 else whole
            if values.ndim != 2 or values.shape[1] != n:
                raise DataError(f"{source.path}: {base} has {values.shape[-1]} axes, the robot has {n}")
            labels = [base] * n if whole.ndim == 1 else labels
        elif labels[0] in source.table:
            absent = [name for name in labels if name not in source.table]
            if absent:
                raise DataError(f"{source.path}: no column {absent[0]}, the robot has {n} joints")
            if f"{base}{n + 1}" in source.table:
                raise DataError(f"{source.path}: has a column {base}{n + 1}, but the robot has {n} joints")
            values = np.stack([source.table[name] for name in labels], axis=1)
        else:
            continue
        _check_finite(
            source, values, labels, _rows_with_demand(values) if quantity == "demand" else slice(0, len(values))
        )
        return np.ascontiguousarray(values)
    if quantity in names:
        raise DataError(f"{source.path}: no array named {names[quantity]!r}; found {', '.join(source.table)}")
    return None


def _check_finite(source: Source, values: NDArray[np.float64], labels: Sequence[str], rows: slice) -> None:
    bad = np.argwhere(~np.isfinite(values[rows]))
    if bad.size:
        row, column = rows.start + int(bad[0, 0]), int(bad[0, 1])
        more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
        raise DataError(f"{source.place(row, labels[column])}: {values[row, column]} is not a number{more}")


def _clock(
    source: Source, names: Mapping[str, str], rate_hz: float | None, polled: bool
) -> tuple[NDArray[np.int64] | None, float]:
    """Return the sample numbers, ``None`` if all rows follow each other, and the sampling rate, 1/s."""
    if source.t_ns is None:
        return None, rate_hz if rate_hz is not None else _rate(source, names)
    if polled and rate_hz is not None:
        longest = float(np.diff(source.t_ns).max(initial=0)) / 1e9
        if longest * rate_hz > HOLE:
            raise DataError(f"{source.path}: no sample for {longest:.6g} s: --polled does not fill holes")
        return None, rate_hz
    try:
        return sample_numbers(source.t_ns, rate_hz)
    except DataError as error:
        raise DataError(f"{source.path}: {error}") from error


def _rate(source: Source, names: Mapping[str, str]) -> float:
    """Return the sampling rate from the time column, 1/s."""
    times = _pick(source, "time", 1, names)
    if times is None:
        raise DataError(f"{source.path}: no time column t; give the sampling rate with --rate")
    steps = np.diff(times[:, 0])
    if steps.size == 0:
        raise DataError(f"{source.path}: a single row is not a recording")
    median = float(np.median(steps))
    backward = np.flatnonzero(steps <= 0)
    if backward.size:
        raise DataError(f"{source.place(int(backward[0]) + 1, 't')}: time does not increase")
    uneven = np.flatnonzero(np.abs(steps - median) > _STEP_TOLERANCE * median)
    if uneven.size:
        k = int(uneven[0])
        raise DataError(
            f"{source.place(k + 1, 't')}: a step of {steps[k]:.6g} s where {median:.6g} s is usual; "
            "give the sampling rate with --rate if the samples are even"
        )
    return float(steps.size / (times[-1, 0] - times[0, 0]))


def _unit(quantity: str, robot: RobotConfig) -> str:
    kinds = {joint.type for joint in robot.joints}
    if quantity in ("position", "demand"):
        return "rad" if kinds == {"revolute"} else "m" if kinds == {"prismatic"} else "rad|m"
    if quantity == "torque":
        return "N m" if kinds == {"revolute"} else "N" if kinds == {"prismatic"} else "N m|N"
    return "A" if quantity == "current" else "V"


def _check_units(path: Path, robot: RobotConfig, fields: Mapping[str, Field], raw: Table, known: slice) -> None:
    """Refuse values far outside the limits in SI units on the stated side; ``known`` are the rows with a demand."""
    transmission = robot.transmission_matrix
    for name, values in raw.items():
        values = values[known] if name == "demand" else values
        motor = fields[name].side == "motor"
        if name in ("position", "demand"):
            joint = values @ np.linalg.inv(transmission).T if motor else values
            limits = [max(abs(end) for end in j.limits.position) for j in robot.joints]
            factor, hint = _POSITION_FACTOR, "rad (or m), joint side unless --motor-side"
        elif name == "torque":
            joint = values @ transmission if motor else values
            limits = [j.limits.torque for j in robot.joints]
            factor, hint = _TORQUE_FACTOR, "N m (or N), joint side unless --motor-side"
        else:
            continue
        peaks = np.abs(joint).max(axis=0)
        for axis, peak, limit in zip(robot.joints, peaks, limits, strict=True):
            if peak > factor * limit:
                raise DataError(
                    f"{path}: {name} of {axis.name} reaches {peak:.4g}, its limit is {limit:.4g}: expected {hint}"
                )
    if "demand" in raw:
        _check_demand(path, robot, raw["demand"][known], raw["position"][known])


def _check_demand(path: Path, robot: RobotConfig, demand: NDArray[np.float64], position: NDArray[np.float64]) -> None:
    """Refuse a demand that does not move like the joints: another unit, or another quantity."""
    motion = np.sum((position - position.mean(axis=0)) ** 2, axis=0)
    residual = np.sum((demand - demand.mean(axis=0) - position + position.mean(axis=0)) ** 2, axis=0)
    for k in np.flatnonzero(residual > _UNEXPLAINED_SHARE * motion):
        joint, moved, wanted = robot.joints[k], np.ptp(position[:, k]), np.ptp(demand[:, k])
        if moved > _MOVED_SHARE * np.ptp(joint.limits.position):
            raise DataError(
                f"{path}: {joint.name} moved by {moved:.4g}, but its demand by {wanted:.4g}: "
                f"give both in the same unit, or omit the demand with --map demand={OMITTED}"
            )
