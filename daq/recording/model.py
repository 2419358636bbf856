"""What a recording is once it is read: raw numbers in arrays, and what they mean."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError, RobotConfig, SessionConfig

Quantity = Literal["position", "velocity", "current", "voltage", "torque", "demand", "status"]
Side = Literal["motor", "joint"]
MarkKind = Literal["experiment_start", "experiment_end", "note", "emcy", "heartbeat_lost"]


@dataclass(frozen=True)
class Field:
    """One quantity of every joint: ``SI = scale * raw``, on the motor's or the joint's side.

    ``demand`` is the reference position; ``unit`` is the unit after scaling (rad, m, A, V, N m, N or "").
    """

    name: str
    quantity: Quantity
    unit: str
    side: Side
    scale: tuple[float, ...]


@dataclass(frozen=True)
class Stream:
    """Samples matched by SYNC: row k of every array belongs to SYNC number ``sync[k]``.

    ``sync`` (N,) int64 counts SYNC from the start of the capture and is strictly increasing; a number that is
    absent is a gap. ``t_ns`` (N,) int64 is the kernel's receive time of that SYNC (ns, UTC).
    ``raw[name]`` has shape (N, n), one column per joint, as it came off the bus.
    """

    name: str
    every: int
    sync: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    fields: dict[str, Field]
    raw: dict[str, NDArray[Any]]

    def si(self, name: str) -> NDArray[np.float64]:
        """The field in SI units, shape (N, n), on the side the field says."""
        scaled: NDArray[np.float64] = self.raw[name].astype(np.float64) * np.asarray(self.fields[name].scale)
        return scaled

    def named(self, quantity: Quantity) -> str | None:
        """The name of the field with this quantity, if there is one."""
        return next((f.name for f in self.fields.values() if f.quantity == quantity), None)


@dataclass(frozen=True)
class Gap:
    """SYNC numbers ``first`` to ``last`` (inclusive) lack the sample of ``joint`` (``None``: of all)."""

    stream: str
    first: int
    last: int
    joint: str | None = None
    reason: str = "lost"


@dataclass(frozen=True)
class Mark:
    """An experiment begins or ends, or something worth keeping happened, at a SYNC number."""

    kind: MarkKind
    sync: int
    t_ns: int
    text: str = ""


def gap_from(entries: object) -> Gap:
    """A gap from what a file or a stream says of it.

    Raises
    ------
    DataError
        If that is none.
    """
    if not isinstance(entries, dict) or not {"stream", "first", "last"} <= entries.keys() <= _GAP_ENTRIES:
        raise DataError(f"no gap: {entries!r:.100}")
    gap = Gap(**entries)
    numbers = type(gap.first) is int and type(gap.last) is int and 0 <= gap.first <= gap.last < _NO_SYNC
    words = isinstance(gap.stream, str) and isinstance(gap.reason, str) and isinstance(gap.joint, str | None)
    if not (numbers and words):
        raise DataError(f"no gap: {entries!r:.100}")
    return gap


def mark_from(entries: object) -> Mark:
    """A mark from what a file or a stream says of it.

    Raises
    ------
    DataError
        If that is none.
    """
    if not isinstance(entries, dict) or not {"kind", "sync", "t_ns"} <= entries.keys() <= _MARK_ENTRIES:
        raise DataError(f"no mark: {entries!r:.100}")
    mark = Mark(**entries)
    numbers = type(mark.sync) is int and type(mark.t_ns) is int and -1 <= mark.sync < _NO_SYNC
    if not (numbers and mark.kind in get_args(MarkKind) and isinstance(mark.text, str)):
        raise DataError(f"no mark: {entries!r:.100}")
    return mark


_NO_SYNC = 2**63
"""No SYNC has so large a number."""
_GAP_ENTRIES = {entry.name for entry in fields(Gap)}
_MARK_ENTRIES = {entry.name for entry in fields(Mark)}


def join_parts(parts: "Sequence[Recording]") -> "Recording":
    """The recording whose files, in order, are the parts of one capture.

    Raises
    ------
    DataError
        If they are not: SYNC numbers that do not go on, or other streams.
    """
    last = parts[-1]
    if len(parts) == 1:
        return last
    streams = {}
    for name, stream in last.streams.items():
        pieces = [part.streams[name] for part in parts if name in part.streams]
        sync = np.concatenate([piece.sync for piece in pieces])
        if len(pieces) != len(parts) or np.any(np.diff(sync) <= 0):
            raise DataError(f"{last.path}: stream {name} does not go on from file to file; are they of one capture?")
        raw = {field: np.concatenate([piece.raw[field] for piece in pieces]) for field in stream.fields}
        streams[name] = replace(stream, sync=sync, t_ns=np.concatenate([piece.t_ns for piece in pieces]), raw=raw)
    missing = "; ".join(part.missing for part in parts if part.missing is not None) or None
    gaps = tuple(gap for part in parts for gap in part.gaps)
    marks = tuple(mark for part in parts for mark in part.marks)
    return replace(last, streams=streams, gaps=gaps, marks=marks, missing=missing)


@dataclass(frozen=True)
class Recording:
    """A recording, from a file or assembled from the stream: the same numbers either way."""

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
    """What a torn file lacks, in words; ``None`` for a complete one."""

    @property
    def samples(self) -> Stream:
        """The stream that every recording has: one row per SYNC."""
        return self.streams["samples"]

    @property
    def sha256(self) -> str:
        """Digest of all raw samples in order, the same for the file and for the stream it was published as."""
        digest = hashlib.sha256()
        for name in sorted(self.streams):
            stream = self.streams[name]
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(stream.sync).tobytes())
            for key in sorted(stream.raw):
                digest.update(key.encode())
                digest.update(np.ascontiguousarray(stream.raw[key]).tobytes())
        return digest.hexdigest()

    def experiments(self) -> list[tuple[int, int]]:
        """SYNC numbers (first, last) of every marked experiment; the whole recording if none is marked."""
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
