"""Recordings in memory: streams of raw samples by SYNC number, gaps, marks and configuration."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armident.arrays import Array
from armident.configs import DataError, RobotConfig, SessionConfig

Quantity = Literal["position", "velocity", "current", "voltage", "torque", "demand", "status"]
Side = Literal["motor", "joint"]
MarkKind = Literal["experiment_start", "experiment_end", "note", "emcy", "heartbeat_lost"]


@dataclass(frozen=True)
class Field:
    """Quantity of every joint: ``SI = scale * raw``, on the motor's or the joint's side.

    Parameters
    ----------
    name
        Name of the field in its stream.
    quantity
        Physical quantity; ``demand`` is the reference position.
    unit
        Unit after scaling: rad, m, rad/s, m/s, A, V, N m, N or "".
    side
        Side of the transmission that the value belongs to.
    scale
        Factors from raw to SI, one per joint.
    """

    name: str
    quantity: Quantity
    unit: str
    side: Side
    scale: tuple[float, ...]


@dataclass(frozen=True)
class Stream:
    """Samples matched by SYNC: row k of every array belongs to SYNC number ``sync[k]``.

    Parameters
    ----------
    name
        Name of the stream.
    every
        Number of SYNCs from one sample to the next.
    sync
        SYNC numbers (N,), counted from the start of the capture, strictly increasing; an absent number is a gap.
    t_ns
        Receive times of these SYNCs by the kernel (N,), ns UTC.
    fields
        Quantity, unit and scale of each field, by name.
    raw
        Raw values of each field as received from the bus, (N, n), one column per joint.
    """

    name: str
    every: int
    sync: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    fields: dict[str, Field]
    raw: dict[str, NDArray[Any]]

    def si(self, name: str) -> Array:
        """Return a field in SI units, shape (N, n), on the side that the field states."""
        scaled: Array = self.raw[name].astype(np.float64) * np.asarray(self.fields[name].scale)
        return scaled

    def named(self, quantity: Quantity) -> str | None:
        """Return the name of the field with this quantity, or ``None``."""
        return next((f.name for f in self.fields.values() if f.quantity == quantity), None)


@dataclass(frozen=True)
class Gap:
    """Missing samples of a stream from SYNC number ``first`` to ``last``.

    Parameters
    ----------
    stream
        Name of the stream.
    first, last
        First and last SYNC number, both inclusive.
    joint
        Joint whose samples are missing; ``None``: all joints.
    reason
        Description of the cause.
    """

    stream: str
    first: int
    last: int
    joint: str | None = None
    reason: str = "lost"


@dataclass(frozen=True)
class Mark:
    """Event at a SYNC number: start or end of an experiment, note, EMCY or heartbeat loss.

    Parameters
    ----------
    kind
        Kind of the event.
    sync
        SYNC number; -1 before the first SYNC.
    t_ns
        Time, ns UTC.
    text
        Description.
    """

    kind: MarkKind
    sync: int
    t_ns: int
    text: str = ""


def gap_from(entries: object) -> Gap:
    """Return the gap from its JSON entries in a file or an event; DataError if they are not those of a gap."""
    if not isinstance(entries, dict) or not {"stream", "first", "last"} <= entries.keys() <= _GAP_ENTRIES:
        raise DataError(f"no gap: {entries!r:.100}")
    gap = Gap(**entries)
    numbers = type(gap.first) is int and type(gap.last) is int and 0 <= gap.first <= gap.last < _NO_SYNC
    words = isinstance(gap.stream, str) and isinstance(gap.reason, str) and isinstance(gap.joint, str | None)
    if not (numbers and words):
        raise DataError(f"no gap: {entries!r:.100}")
    return gap


def mark_from(entries: object) -> Mark:
    """Return the mark from its JSON entries in a file or an event; DataError if they are not those of a mark."""
    if not isinstance(entries, dict) or not {"kind", "sync", "t_ns"} <= entries.keys() <= _MARK_ENTRIES:
        raise DataError(f"no mark: {entries!r:.100}")
    mark = Mark(**entries)
    numbers = type(mark.sync) is int and type(mark.t_ns) is int and -1 <= mark.sync < _NO_SYNC
    if not (numbers and mark.kind in get_args(MarkKind) and isinstance(mark.text, str)):
        raise DataError(f"no mark: {entries!r:.100}")
    return mark


def _bytes(values: NDArray[Any]) -> memoryview:
    """Return the bytes of an array, without a copy where it is contiguous."""
    return np.ascontiguousarray(values).reshape(-1).view(np.uint8).data


_NO_SYNC = 2**63
"""Upper bound of SYNC numbers: they are int64."""
_GAP_ENTRIES = {entry.name for entry in fields(Gap)}
_MARK_ENTRIES = {entry.name for entry in fields(Mark)}


def join_parts(parts: "Sequence[Recording]") -> "Recording":
    """Join the files of one capture, in order, to one recording.

    Raises
    ------
    DataError
        If SYNC numbers do not increase from file to file, or the streams differ.
    """
    last = parts[-1]
    if len(parts) == 1:
        return last
    streams = {}
    for name, stream in last.streams.items():
        pieces = [part.streams[name] for part in parts if name in part.streams]
        sync = np.concatenate([piece.sync for piece in pieces])
        if len(pieces) != len(parts) or np.any(np.diff(sync) <= 0):
            raise DataError(
                f"{last.path}: stream {name} does not continue the file before; join the files of one capture in order"
            )
        raw = {field: np.concatenate([piece.raw[field] for piece in pieces]) for field in stream.fields}
        streams[name] = replace(stream, sync=sync, t_ns=np.concatenate([piece.t_ns for piece in pieces]), raw=raw)
    missing = "; ".join(part.missing for part in parts if part.missing is not None) or None
    gaps = tuple(gap for part in parts for gap in part.gaps)
    marks = tuple(mark for part in parts for mark in part.marks)
    return replace(last, streams=streams, gaps=gaps, marks=marks, missing=missing)


@dataclass(frozen=True, repr=False)
class Recording:
    """Recording of a robot's motion, read from a file or assembled from published blocks.

    Parameters
    ----------
    path
        The file; ``None`` if there is none.
    robot
        Configuration of the robot that was recorded.
    session
        Configuration of the capture; ``None`` for recordings that do not come from a bus.
    sample_rate_hz
        Rate of SYNC, 1/s.
    streams
        Streams by name; ``samples`` is always one of them.
    gaps
        Missing samples.
    marks
        Starts and ends of experiments, notes, EMCY messages and heartbeat losses.
    counters
        Counters of the capture, such as ``samples.rows``.
    metadata
        Facts about the capture, such as software versions or the source file.
    missing
        Description of the missing parts of a truncated or damaged file; ``None`` if the recording is complete.

    Examples
    --------
    >>> import armident, numpy as np
    >>> t = np.arange(2000) / 1000.0
    >>> armident.Recording.from_arrays(t, 0.1 * np.sin(9.0 * t), 50.0 * np.cos(9.0 * t), robot="emps")
    <Recording of emps: 2000 samples at 1000 Hz, position, torque>
    """

    path: Path | None
    robot: RobotConfig
    session: SessionConfig | None
    sample_rate_hz: float
    streams: dict[str, Stream]
    gaps: tuple[Gap, ...] = ()
    marks: tuple[Mark, ...] = ()
    counters: dict[str, int] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    missing: str | None = None

    def __repr__(self) -> str:
        """Return robot, length, rate, quantities and losses on one line."""
        quantities = sorted({entry.quantity for stream in self.streams.values() for entry in stream.fields.values()})
        losses = f", {len(self.gaps)} gaps" if self.gaps else ""
        return (
            f"<Recording of {self.robot.name}: {self.samples.sync.size} samples at {self.sample_rate_hz:g} Hz, "
            f"{', '.join(quantities)}{losses}{', torn' if self.missing else ''}>"
        )

    @classmethod
    def from_arrays(
        cls,
        t: ArrayLike,
        position: ArrayLike,
        torque: ArrayLike,
        robot: RobotConfig | str | Path,
        reference: ArrayLike | None = None,
        *,
        resample_hz: float | None = None,
    ) -> "Recording":
        """Make a recording of arrays in memory: SI units, joint side; checked as a file that is imported.

        Parameters
        ----------
        t
            Times (N,), s, at equal steps.
        position
            Joint positions (N, n), rad or m; (N,) for a single joint.
        torque
            Joint torques or forces (N, n), N m or N; (N,) for a single joint.
        robot
            The robot that was measured: a configuration, or the path or shipped name of one.
        reference
            Reference positions (N, n) of the controller, rad or m; by default unknown.
        resample_hz
            Rate of an even clock, Hz, onto which samples with uneven times are put; holes stay gaps.

        Returns
        -------
        Recording
            The same as that of `armident.import_recording` of these arrays in an NPZ file.

        Raises
        ------
        ConfigError
            If there is no such robot.
        DataError
            If shapes do not fit, times are uneven, or values are no numbers or far beyond the limits of the robot.
        """
        from armident.configs import load_robot
        from armident.daq.interchange.importing import recording_of_arrays

        config = robot if isinstance(robot, RobotConfig) else load_robot(robot, "import")
        return recording_of_arrays(t, position, torque, config, reference, resample_hz)

    def save(self, path: str | Path) -> Path:
        """Write the recording to an MCAP file, which `armident.read_recording` reads; an existing file is replaced.

        Parameters
        ----------
        path
            The file.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        ConfigError
            If it cannot be written.
        """
        from armident.daq.recording.writer import write_recording

        write_recording(self, Path(path))
        return Path(path)

    @property
    def samples(self) -> Stream:
        """Stream with one row per SYNC, present in every recording."""
        return self.streams["samples"]

    @property
    def sha256(self) -> str:
        """SHA-256 of all raw samples in order, the same for the file and for the published stream."""
        digest = hashlib.sha256()
        for name in sorted(self.streams):
            stream = self.streams[name]
            digest.update(name.encode())
            digest.update(_bytes(stream.sync))
            for key in sorted(stream.raw):
                digest.update(key.encode())
                digest.update(_bytes(stream.raw[key]))
        return digest.hexdigest()

    def experiments(self) -> list[tuple[int, int]]:
        """Return first and last SYNC number of every marked experiment; of the whole recording if none is marked."""
        spans: list[tuple[int, int]] = []
        start: int | None = None
        for mark in sorted(self.marks, key=lambda m: m.sync):
            if mark.kind == "experiment_start":
                start = mark.sync
            elif mark.kind == "experiment_end" and start is not None:
                spans.append((start, mark.sync))
                start = None
        sync = self.samples.sync
        if not spans and sync.size:
            spans.append((int(sync[0]), int(sync[-1])))
        return spans
