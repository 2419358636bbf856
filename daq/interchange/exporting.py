"""Export of recordings in SI units at the joints, and as bus logs."""

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError
from armident.daq.interchange.readers import writer_of
from armident.daq.recording import Recording, Stream
from armident.extras import install_line


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


def export_csv(recording: Recording, path: Path) -> None:
    """Write the `exported_columns` of a recording as text."""
    table = exported_columns(recording)
    values = np.stack(list(table.values()), axis=1)
    np.savetxt(path, values, fmt="%.17g", delimiter=",", header=",".join(table), comments="")


def export_npz(recording: Recording, path: Path) -> None:
    """Write the `exported_columns` of a recording as an archive of numpy."""
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **exported_columns(recording))


def export_parquet(recording: Recording, path: Path) -> None:
    """Write the `exported_columns` of a recording as a table of Apache Parquet."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ConfigError(install_line(f"{path}: Parquet", ["parquet"])) from error
    pyarrow.parquet.write_table(pyarrow.table(exported_columns(recording)), path)


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
