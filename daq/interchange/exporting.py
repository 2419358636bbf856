"""Export of recordings in SI units at the joints, and as bus logs."""

import csv
import io
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError, RobotConfig
from armident.daq.interchange.column_units import SINCE
from armident.daq.interchange.readers import writer_of
from armident.daq.interchange.table_columns import find_columns
from armident.daq.recording import Recording, Stream
from armident.extras import install_line

CLOCK_SET_NS = 10**18
"""Time, ns UTC (September 2001), from which on the stamps of a recording are those of a clock; others count from 0."""


def exported_columns(recording: Recording) -> dict[str, NDArray[np.float64]]:
    """Return time ``t`` (s), joint positions ``q1..``, torques ``tau1..`` and references ``qr1..``, (N,) each.

    References are linear between recorded set points, as drives interpolate (CiA 402, 60C0h = 0), and NaN outside them.
    """
    robot, samples = recording.robot, recording.samples
    if samples.sync.size == 0:
        raise DataError(f"{recording.path}: no samples")
    table = {"t": samples.sync / recording.sample_rate_hz}
    position = samples.named("position")
    if position is not None:
        table |= _numbered("q", _positions(recording, samples, position))
    effort = next((e for e in (samples.named("torque"), samples.named("current"), samples.named("voltage")) if e), None)
    if effort is not None:
        field = samples.fields[effort]
        torque = samples.si(effort)
        if field.quantity != "torque":
            torque = torque * np.array([joint.drive.gain for joint in robot.joints])
        if field.side == "motor":
            torque = torque @ robot.transmission_matrix
        table |= _numbered("tau", torque)
    for stream in recording.streams.values():
        demand = stream.named("demand")
        if demand is not None and stream.sync.size > 1:
            values = _positions(recording, stream, demand)
            reference = np.stack(
                [np.interp(samples.sync, stream.sync, v, left=np.nan, right=np.nan) for v in values.T], axis=1
            )
            table |= _numbered("qr", reference)
    return table


def export_recording(recording: Recording, path: Path) -> None:
    """Write a recording in the format of the suffix (`armident.daq.interchange.readers`), all of the file or none."""
    write = writer_of(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(recording, temporary)
        temporary.replace(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
    finally:
        temporary.unlink(missing_ok=True)


def _positions(recording: Recording, stream: Stream, name: str) -> NDArray[np.float64]:
    """Return a position field at the joints, (N, n)."""
    values = stream.si(name)
    if stream.fields[name].side == "motor":
        values = values @ np.linalg.inv(recording.robot.transmission_matrix).T
    return values


def _numbered(base: str, values: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    return {f"{base}{j + 1}": np.ascontiguousarray(values[:, j]) for j in range(values.shape[1])}


def titled_columns(recording: Recording) -> dict[tuple[str, str], NDArray[np.float64]]:
    """Return the `exported_columns` by name and unit, such as ``elbow/position`` and ``rad``.

    The unit of ``t`` has the date of ``t`` = 0 if it is known. Columns keep their numbers (``q1``) where an import
    would not find the joints of the robot in their names.
    """
    table, samples, robot = exported_columns(recording), recording.samples, recording.robot
    names, units = {"t": "t"}, {"t": "s"}
    for k, joint in enumerate(robot.joints, start=1):
        revolute = joint.type == "revolute"
        for base, word in (("q", "position"), ("tau", "torque"), ("qr", "demand")):
            names[f"{base}{k}"] = f"{joint.source_name or joint.name}/{word}"
            units[f"{base}{k}"] = ("N m" if revolute else "N") if word == "torque" else "rad" if revolute else "m"
    start_ns = int(samples.t_ns[0]) - round(int(samples.sync[0]) * 1e9 / recording.sample_rate_hz)
    if start_ns > CLOCK_SET_NS:
        units["t"] = f"s{SINCE}{np.datetime64(start_ns, 'ns')}Z"
    found = _titles_found(robot, [names[key] for key in table])
    return {(names[key] if found else key, units[key]): values for key, values in table.items()}


def _titles_found(robot: RobotConfig, titles: Sequence[str]) -> bool:
    """Return True if an import finds the joints of a robot, in their order, in the titles of their columns."""
    probe = {title: np.zeros(1) for title in titles}
    try:
        for word in ("position", "torque", "demand"):
            wanted = tuple(title for title in titles if title.endswith(f"/{word}"))
            found = find_columns(probe, word, robot)
            if wanted != (() if found is None else found.labels):
                return False
    except DataError:
        return False
    return True


def export_csv(recording: Recording, path: Path) -> None:
    """Write the `titled_columns` of a recording as text."""
    table = titled_columns(recording)
    header = io.StringIO()
    csv.writer(header, lineterminator="").writerow(f"{name} [{unit}]" for name, unit in table)
    values = np.stack(list(table.values()), axis=1)
    np.savetxt(path, values, fmt="%.17g", delimiter=",", header=header.getvalue(), comments="", encoding="utf-8")


def export_npz(recording: Recording, path: Path) -> None:
    """Write the `exported_columns` of a recording as an archive of numpy."""
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **exported_columns(recording))


def export_parquet(recording: Recording, path: Path) -> None:
    """Write the `titled_columns` of a recording as a table of Apache Parquet, with units in the metadata of its fields.

    Metadata of the schema: ``robot``, ``sample_rate_hz`` and ``utc``, the date of ``t`` = 0.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ConfigError(install_line(f"{path}: Parquet", ["parquet"])) from error
    table = titled_columns(recording)
    start = next(iter(table))[1].partition(SINCE)[2]
    about = {"robot": recording.robot.name, "sample_rate_hz": f"{recording.sample_rate_hz:.17g}"}
    about |= {"utc": start} if start else {}
    fields = [pyarrow.field(name, pyarrow.float64(), metadata={"unit": unit}) for name, unit in table]
    made = pyarrow.table(list(table.values()), schema=pyarrow.schema(fields, metadata=about))
    pyarrow.parquet.write_table(made, path)


def export_mat(recording: Recording, path: Path) -> None:
    """Write the `exported_columns` of a recording as a MAT file."""
    from scipy.io import savemat

    savemat(path, exported_columns(recording), do_compression=True, oned_as="column")


def export_rosbag(recording: Recording, path: Path) -> None:
    """Write the `exported_columns` as joint states, stamped by the sampling clock: times of reception jitter."""
    from armident.daq.interchange.rosbag import write_joint_states

    table, samples = exported_columns(recording), recording.samples
    t_ns = samples.t_ns[0] + np.round((samples.sync - samples.sync[0]) * (1e9 / recording.sample_rate_hz)).astype(
        np.int64
    )
    write_joint_states(path, [j.source_name or j.name for j in recording.robot.joints], t_ns, table)
