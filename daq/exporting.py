"""Recordings for other tools: CSV, NPZ and Parquet, in SI units at the joints."""

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from configs import ConfigError, DataError
from daq.recording import Recording, Stream


def columns(recording: Recording) -> dict[str, NDArray[np.float64]]:
    """Time (s), joint positions, torques and, where recorded, reference positions; every value of shape (N,).

    The reference between set points is linear, as the drives interpolate it (CiA 402, 60C0h = 0); rows it does not
    cover are NaN.

    Raises
    ------
    DataError
        If the recording has no samples.
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
    """Write the columns to ``path`` (.csv, .npz or .parquet); the file appears when it is complete.

    Raises
    ------
    ConfigError
        If the kind of file is unknown, needs a package that is not installed, or cannot be written.
    DataError
        If the recording has no samples.
    """
    writers = {".csv": _write_csv, ".npz": _write_npz, ".parquet": _write_parquet}
    write = writers.get(path.suffix.lower())
    if write is None:
        raise ConfigError(f"{path}: cannot export {path.suffix or 'without suffix'}; expected {', '.join(writers)}")
    table = columns(recording)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(table, temporary)
        temporary.replace(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
    finally:
        temporary.unlink(missing_ok=True)


def _positions(recording: Recording, stream: Stream, name: str) -> NDArray[np.float64]:
    """A position field at the joints, (N, n)."""
    values = stream.si(name)
    if stream.fields[name].side == "motor":
        values = values @ np.linalg.inv(recording.robot.transmission_matrix).T
    return values


def _numbered(base: str, values: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    return {f"{base}{j + 1}": np.ascontiguousarray(values[:, j]) for j in range(values.shape[1])}


def _write_csv(table: dict[str, NDArray[np.float64]], path: Path) -> None:
    values = np.stack(list(table.values()), axis=1)
    np.savetxt(path, values, fmt="%.17g", delimiter=",", header=",".join(table), comments="")


def _write_npz(table: dict[str, NDArray[np.float64]], path: Path) -> None:
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **table)


def _write_parquet(table: dict[str, NDArray[np.float64]], path: Path) -> None:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ConfigError(f"{path}: Parquet needs the package pyarrow (pip install pyarrow)") from error
    pyarrow.parquet.write_table(pyarrow.table(table), path)  # type: ignore[no-untyped-call]
