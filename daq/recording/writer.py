"""Writes recordings: MCAP, chunk by chunk, so that what is on the disk is always whole up to the last chunk."""

import contextlib
import errno
import fcntl
import json
import os
import secrets
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import zstandard
from numpy.typing import NDArray

from armident.configs import ConfigError, RobotConfig, SessionConfig
from armident.daq.recording import mcap_records as mcap
from armident.daq.recording.layout import StreamLayout
from armident.daq.recording.lost_rows import STANDS_STILL, LostRows, RowRanges
from armident.daq.recording.model import Gap, Mark, Recording
from armident.daq.recording.preview import PREFIX, PreviewChannel
from armident.daq.recording.summary import Summary

SCHEMA = "armident/recording/1"
GAPS_TOPIC, MARKS_TOPIC = "/events/gaps", "/events/marks"
COUNTERS = "armident.counters"
CHECK = "armident.check"
"""Metadata that follow what they check: the checksum of so many bytes before them.

The first checks the head; those of what comes at the end begin with the head's, so that they are of this file alone.
"""
_ZSTD_LEVEL = 1
_ROWS_PER_CHUNK = 5000
_MOST_CHANNELS = 65_000

_EVENTS = {
    GAPS_TOPIC: {"stream": "string", "first": "integer", "last": "integer", "joint": "string", "reason": "string"},
    MARKS_TOPIC: {"kind": "string", "sync": "integer", "t_ns": "integer", "text": "string"},
}


class RecordingWriter:
    """A recording being written.

    Rows are gathered and written as one zstd chunk with its index per ``chunk_ns``, then synced to the disk: a killed
    process or a pulled plug loses at most that. A chunk that does not go to the disk whole (disk full) is taken back,
    its rows are counted in :attr:`lost_rows`, and writing goes on.

    Parameters
    ----------
    path
        The file; must not exist yet.
    robot, session
        Stored in the file.
    sample_rate_hz
        Rate of SYNC, 1/s.
    layouts
        One per stream.
    metadata
        Facts worth keeping, stored in the file.
    chunk_ns
        Longest time a chunk spans, ns.
    look_hz
        Samples per second for looking, in SI units (`looking`); 0: none.

    Raises
    ------
    ConfigError
        If the file cannot be created.
    """

    def __init__(
        self,
        path: Path,
        robot: RobotConfig,
        session: SessionConfig | None,
        sample_rate_hz: float,
        layouts: Sequence[StreamLayout],
        metadata: Mapping[str, str],
        chunk_ns: int = 100_000_000,
        look_hz: float = 0.0,
    ) -> None:
        self.path = path
        self.lost_rows = 0
        self.problem: str | None = None
        self._chunk_ns = chunk_ns
        facts = {"schema": SCHEMA, "sample_rate_hz": repr(sample_rate_hz), "check": CHECK}
        texts = {
            "armident.recording": facts,
            "armident.robot": {"json": robot.model_dump_json(by_alias=True)},
            "armident.session": {} if session is None else {"json": session.model_dump_json(by_alias=True)},
            "armident.facts": dict(metadata),
        }
        # Channels have numbers of their own in every file: a chunk that strayed in from another one is noticed.
        first = 1 + zlib.crc32(repr(texts).encode()) % _MOST_CHANNELS
        self._layouts = {layout.name: (k, layout) for k, layout in enumerate(layouts, start=first)}
        self._topics = {topic: first + len(layouts) + k for k, topic in enumerate(_EVENTS)}
        looks = [PreviewChannel.at(layout, robot, sample_rate_hz, look_hz) for layout in layouts if look_hz > 0]
        numbers = range(first + len(layouts) + len(_EVENTS), 2**16)
        self._looks = {
            look.layout.name[len(PREFIX) :]: (k, look)
            for k, look in zip(numbers, (look for look in looks if look is not None), strict=False)
        }
        self._compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL)
        self._parts: list[bytes] = []
        self._unwritten = LostRows({layout.name: layout.every for layout in layouts})
        self._last_ns = 0
        self._indexes: dict[int, list[NDArray[np.uint64]]] = {}
        self._size = 0
        self._rows = 0
        self._span: tuple[int, int] | None = None
        schemas = [mcap.schema(k, la.message_name, "protobuf", la.descriptor) for k, la in self._layouts.values()]
        channels = [
            mcap.channel(k, k, la.topic, "protobuf", {"armident.stream": la.to_json()})
            for k, la in self._layouts.values()
        ]
        for topic, k in self._topics.items():
            properties = {name: {"type": kind} for name, kind in _EVENTS[topic].items()}
            document = json.dumps({"type": "object", "properties": properties}).encode()
            schemas.append(mcap.schema(k, f"armident{topic.replace('/', '.')}", "jsonschema", document))
            channels.append(mcap.channel(k, k, topic, "json", {}))
        for k, look in self._looks.values():
            schemas.append(mcap.schema(k, look.layout.message_name, "protobuf", look.layout.descriptor))
            channels.append(mcap.channel(k, k, look.layout.topic, "protobuf", look.metadata))
        self._summary = Summary(schemas, channels)
        # A file of this name has its head whole, whenever we are killed.
        self._name = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self._name, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
            # Whoever heals torn recordings sees that this one is being written.
            with contextlib.suppress(OSError):
                fcntl.flock(self._file, fcntl.LOCK_EX)
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
        self._position = self._head_crc = 0
        try:
            head = mcap.MAGIC + mcap.header(f"armident {_version()}") + b"".join(schemas + channels)
            self._append(head)
            for name, text in texts.items():
                if text or name == "armident.facts":
                    head += self._add_metadata(name, text)
            self._add_check(head)
            self._head_crc = zlib.crc32(head)
            self._name = _published(self._name, path)
        except OSError as error:
            self.abort()
            raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error

    @property
    def size(self) -> int:
        """Bytes in the file so far."""
        return self._position

    @property
    def rows(self) -> dict[str, int]:
        """Rows of every stream that are in the file."""
        return {name: self._summary.messages.get(channel, 0) for name, (channel, _) in self._layouts.items()}

    def append(
        self, stream: str, sync: NDArray[np.int64], t_ns: NDArray[np.int64], raw: Mapping[str, NDArray[Any]]
    ) -> None:
        """Add rows to a stream: ``sync`` and ``t_ns`` of shape (N,), each of ``raw`` (N, n)."""
        if len(sync) == 0:
            return
        channel, layout = self._layouts[stream]
        rows = layout.pack(channel, sync, t_ns, raw)
        offsets = self._size + np.arange(len(rows), dtype=np.uint64) * np.uint64(rows.itemsize)
        self._rows += len(rows)
        self._unwritten.gather(stream, sync)
        self._gather(channel, t_ns, offsets, rows.tobytes())
        if stream in self._looks:
            channel, look = self._looks[stream]
            sync, t_ns, shown = look.of(sync, t_ns, raw)
            if sync.size:
                rows = look.layout.pack(channel, sync, t_ns, shown)
                offsets = self._size + np.arange(len(rows), dtype=np.uint64) * np.uint64(rows.itemsize)
                self._gather(channel, t_ns, offsets, rows.tobytes())
        self._flush_if_full()

    def add_gaps(self, gaps: Sequence[Gap], t_ns: int) -> None:
        """Record gaps found at ``t_ns``."""
        for gap in gaps:
            self._event(GAPS_TOPIC, gap.first, t_ns, asdict(gap))
            self._unwritten.events.append((GAPS_TOPIC, gap.first, asdict(gap)))
        self._flush_if_full()

    def add_marks(self, marks: Sequence[Mark]) -> None:
        """Record marks."""
        for mark in marks:
            self._event(MARKS_TOPIC, mark.sync, mark.t_ns, asdict(mark))
            self._unwritten.events.append((MARKS_TOPIC, mark.sync, asdict(mark)))
        self._flush_if_full()

    def leave_out(self, rows: RowRanges) -> None:
        """Rows that nobody could hand to the disk: they are lost as if it had refused them."""
        self.lost_rows += rows.rows
        self.problem = f"{self.path}: {STANDS_STILL}"
        self._unwritten.lose(rows)

    def take_over(self, other: "RecordingWriter") -> None:
        """Tell what the file of another writer could not be told: rows and events that its disk did not take."""
        self._unwritten.take_over(other._unwritten)
        for topic, sync, entries in other._unwritten.events:
            self._event(topic, sync, other._last_ns, entries)

    def flush(self) -> None:
        """Write what is gathered as a chunk and bring it to the disk."""
        for gap in self._unwritten.gaps():
            self._event(GAPS_TOPIC, gap.first, self._last_ns, asdict(gap))
        if not self._parts or self._span is None:
            return
        raw = b"".join(self._parts)
        compressed = self._compressor.compress(raw)
        chunk = mcap.chunk(*self._span, raw, compressed)
        indexes, offsets = b"", {}
        counts = {}
        for channel, entries in self._indexes.items():
            pairs = np.concatenate(entries)
            counts[channel] = len(pairs)
            offsets[channel] = self._position + len(chunk) + len(indexes)
            indexes += mcap.message_index(channel, pairs.tobytes())
        place = mcap.ChunkPlace(
            *self._span, self._position, len(chunk), offsets, len(indexes), len(compressed), len(raw)
        )
        try:
            self._append(chunk + indexes)
            os.fdatasync(self._file)
        except OSError as error:
            self.lost_rows += self._rows
            self.problem = f"{self.path}: {error.strerror}"
            self._unwritten.failed()
        else:
            self._summary.add_chunk(place, counts)
            self._unwritten.written()
        self._parts, self._indexes, self._size, self._rows, self._span = [], {}, 0, 0, None
        for topic, sync, event in self._unwritten.events:
            self._event(topic, sync, self._last_ns, event)

    def close(self, counters: Mapping[str, int]) -> None:
        """Write the rest, the counters and the summary; the file is complete afterwards.

        Raises
        ------
        ConfigError
            If the disk does not take the end of the file; what is there remains readable as a torn file.
        """
        try:
            self.flush()
            # A disk that did not take the last rows may take the word that they are missing.
            self.flush()
            self._add_check(self._add_metadata(COUNTERS, {key: str(value) for key, value in counters.items()}))
            self._append(self._summary.ending(self._position))
            os.fsync(self._file)
        except OSError as error:
            raise ConfigError(f"{self.path}: could not be finished: {error.strerror}") from error
        finally:
            self._release()

    def abort(self) -> None:
        """Leave nothing behind."""
        self._release()
        self._name.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._release()

    def _release(self) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _event(self, topic: str, sync: int, t_ns: int, entries: dict[str, Any]) -> None:
        channel = self._topics[topic]
        data = mcap.message(channel, sync, t_ns, json.dumps(entries).encode())
        self._gather(channel, np.array([t_ns]), np.array([self._size], dtype=np.uint64), data)

    def _gather(self, channel: int, t_ns: NDArray[np.int64], offsets: NDArray[np.uint64], data: bytes) -> None:
        pairs = np.stack([t_ns.astype(np.uint64), offsets], axis=1)
        self._indexes.setdefault(channel, []).append(pairs)
        self._parts.append(data)
        self._size += len(data)
        low, high = int(t_ns.min()), int(t_ns.max())
        if self._span is not None:
            low, high = min(low, self._span[0]), max(high, self._span[1])
        self._span, self._last_ns = (low, high), high

    def _flush_if_full(self) -> None:
        if self._span is not None and self._span[1] - self._span[0] >= self._chunk_ns:
            self.flush()

    def _add_metadata(self, name: str, entries: Mapping[str, str]) -> bytes:
        """Write a metadata record; the bytes of it."""
        data = mcap.metadata(name, entries)
        place = mcap.MetadataPlace(name, self._position, len(data))
        self._append(data)
        self._summary.metadata.append(place)
        return data

    def _add_check(self, data: bytes) -> None:
        """Write the checksum of what was just written: chunks have their own, the other records have none."""
        record = mcap.check(CHECK, data, self._head_crc)
        place = mcap.MetadataPlace(CHECK, self._position, len(record))
        self._append(record)
        self._summary.metadata.append(place)

    def _append(self, data: bytes) -> None:
        """Write all of ``data``, or nothing."""
        view = memoryview(data)
        try:
            while view:
                view = view[os.write(self._file, view) :]
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, self._position)
                os.lseek(self._file, self._position, os.SEEK_SET)
            raise
        self._position += len(data)


def write_recording(recording: Recording, path: Path) -> None:
    """Write a recording that is in memory; the file appears under its name when it is complete.

    Raises
    ------
    ConfigError
        If the file cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    joints = [joint.name for joint in recording.robot.joints]
    layouts = [StreamLayout.of(stream, joints) for stream in recording.streams.values()]
    writer = RecordingWriter(
        temporary, recording.robot, recording.session, recording.sample_rate_hz, layouts, recording.metadata, 2**62
    )
    try:
        first_ns = 0
        for stream in recording.streams.values():
            first_ns = int(stream.t_ns[0]) if stream.t_ns.size else first_ns
            for begin in range(0, len(stream.sync), _ROWS_PER_CHUNK):
                part = slice(begin, begin + _ROWS_PER_CHUNK)
                raw = {name: values[part] for name, values in stream.raw.items()}
                writer.append(stream.name, stream.sync[part], stream.t_ns[part], raw)
                writer.flush()
        writer.add_gaps(recording.gaps, first_ns)
        writer.add_marks(recording.marks)
        writer.flush()
        if writer.problem is not None:
            raise ConfigError(f"{path}: cannot be written: {writer.problem.rpartition(': ')[2]}")
        writer.close(recording.counters)
        temporary.replace(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
    finally:
        writer.abort()


def _published(temporary: Path, path: Path) -> Path:
    """Give a file its name, which nothing may have yet; the name."""
    try:
        os.link(temporary, path)
    except FileExistsError:
        raise
    except OSError:
        # A file system without links.
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)) from None
        temporary.rename(path)
    else:
        temporary.unlink()
    return path


def _version() -> str:
    try:
        return version("armident")
    except PackageNotFoundError:
        return "unpackaged"
