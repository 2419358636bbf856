"""Writes recordings: MCAP, chunk by chunk, so that a file on the disk is complete up to its last chunk."""

import contextlib
import errno
import fcntl
import json
import os
import secrets
import zlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.records import Channel, ChunkIndex, Header, Metadata, MetadataIndex, Schema
from numpy.typing import NDArray

from armident.configs import ConfigError, RobotConfig, SessionConfig
from armident.daq.recording import mcap_records as mcap
from armident.daq.recording.layout import StreamLayout
from armident.daq.recording.lost_rows import DISK_STALLED, LostRows, RowRanges
from armident.daq.recording.mcap_summary import Summary
from armident.daq.recording.model import Gap, Mark, Recording
from armident.daq.recording.names import (
    CHECK,
    COUNTERS,
    CRC_OF,
    FACTS,
    GAPS_TOPIC,
    LAYOUT_KEY,
    LIBRARY,
    MARKS_TOPIC,
    RECORDING,
    ROBOT,
    ROWS_OF,
    SAMPLE_RATE,
    SCHEMA,
    SESSION,
    head_texts,
)
from armident.daq.recording.preview import PREFIX, PreviewChannel

_ZSTD_LEVEL = 1
_ROWS_PER_CHUNK = 5000
_MOST_CHANNELS = 65_000

_EVENTS = {
    GAPS_TOPIC: {"stream": "string", "first": "integer", "last": "integer", "joint": "string", "reason": "string"},
    MARKS_TOPIC: {"kind": "string", "sync": "integer", "t_ns": "integer", "text": "string"},
}
"""Topics of events, with the JSON types of their entries."""


class RecordingWriter(AbstractContextManager["RecordingWriter", None]):
    """Writes a recording to a new file; ConfigError if it cannot be created.

    Rows are gathered, written as one zstd chunk with its message indexes per ``chunk_ns``, and synced to the disk: a
    killed process or a power loss costs no more than that. If a chunk cannot be written completely (disk full), it is
    removed again, its rows are counted in :attr:`lost_rows`, and writing continues. ``metadata``: facts about the
    capture. ``preview_hz``: rate of the preview channels in SI units (`preview`), 1/s; 0: none.
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
        preview_hz: float = 0.0,
    ) -> None:
        self.path = path
        self.lost_rows = 0
        self.problem: str | None = None
        self._chunk_ns = chunk_ns
        self._compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL)
        self._parts: list[bytes] = []
        self._unwritten = LostRows({layout.name: layout.every for layout in layouts})
        self._last_ns = 0
        self._indexes: dict[int, list[NDArray[np.uint64]]] = {}
        self._size = 0
        self._rows = 0
        self._span: tuple[int, int] | None = None
        self._position = self._head_crc = 0
        texts = {
            RECORDING: {"schema": SCHEMA, SAMPLE_RATE: repr(sample_rate_hz), "check": CHECK},
            ROBOT: {"json": robot.model_dump_json(by_alias=True)},
            SESSION: {} if session is None else {"json": session.model_dump_json(by_alias=True)},
            FACTS: dict(metadata),
        }
        heads = head_texts(texts, {layout.topic: layout.to_json() for layout in layouts})
        texts[RECORDING] |= {f"{CRC_OF}{name}": str(zlib.crc32(text.encode())) for name, text in heads.items()}
        # Channel ids differ from file to file, so that a chunk of another file is noticed.
        first = 1 + zlib.crc32(repr(texts).encode()) % _MOST_CHANNELS
        self._layouts = {layout.name: (k, layout) for k, layout in enumerate(layouts, start=first)}
        self._topics = {topic: first + len(layouts) + k for k, topic in enumerate(_EVENTS)}
        previews = _previews(layouts, robot, sample_rate_hz, preview_hz)
        ids = range(first + len(layouts) + len(_EVENTS), 2**16)
        self._previews = {
            preview.layout.name[len(PREFIX) :]: (k, preview) for k, preview in zip(ids, previews, strict=False)
        }
        self._summary = Summary(*self._schemas_and_channels())
        self._name = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
        self._file = _created(self._name, path)
        self._write_head(texts)

    def _schemas_and_channels(self) -> tuple[list[bytes], list[bytes]]:
        """Return the schema and channel records; each channel has the id of its schema."""
        schemas, channels = [], []

        def add(k: int, topic: str, schema: tuple[str, str, bytes], encoding: str, metadata: dict[str, str]) -> None:
            name, schema_encoding, data = schema
            schemas.append(mcap.encode(Schema(k, data, schema_encoding, name)))
            channels.append(mcap.encode(Channel(k, topic, encoding, metadata, k)))

        for k, layout in self._layouts.values():
            schema = layout.message_name, "protobuf", layout.descriptor
            add(k, layout.topic, schema, "protobuf", layout.scale_texts | {LAYOUT_KEY: layout.to_json()})
        for topic, k in self._topics.items():
            properties = {name: {"type": kind} for name, kind in _EVENTS[topic].items()}
            document = json.dumps({"type": "object", "properties": properties}).encode()
            add(k, topic, (f"armident{topic.replace('/', '.')}", "jsonschema", document), "json", {})
        for k, preview in self._previews.values():
            schema = preview.layout.message_name, "protobuf", preview.layout.descriptor
            add(k, preview.layout.topic, schema, "protobuf", preview.metadata)
        return schemas, channels

    def _write_head(self, texts: Mapping[str, Mapping[str, str]]) -> None:
        """Write all records before the first chunk, then give the file its name."""
        try:
            head = mcap.MAGIC + mcap.encode(Header("", f"{LIBRARY}{_version()}"))
            head += b"".join(self._summary.schemas + self._summary.channels)
            self._append(head)
            for name, text in texts.items():
                if text or name == FACTS:
                    head += self._add_metadata(Metadata(name, dict(text)))
            self._add_metadata(checksum_record(head))
            self._head_crc = zlib.crc32(head)
            # A file of this name has a complete head, even if the process is killed.
            self._name = _published(self._name, self.path)
        except OSError as error:
            self.abort()
            raise ConfigError(f"{self.path}: cannot be written: {error.strerror}") from error

    @property
    def size(self) -> int:
        """Bytes in the file so far."""
        return self._position

    @property
    def rows(self) -> dict[str, int]:
        """Number of rows in the file, by stream."""
        return {name: self._summary.messages.get(channel, 0) for name, (channel, _) in self._layouts.items()}

    def append(
        self, stream: str, sync: NDArray[np.int64], t_ns: NDArray[np.int64], raw: Mapping[str, NDArray[Any]]
    ) -> None:
        """Add rows to a stream: SYNC numbers (N,), receive times (N,), ns UTC, and raw values (N, n) of every field."""
        if len(sync) == 0:
            return
        channel, layout = self._layouts[stream]
        rows = layout.pack(channel, sync, t_ns, raw)
        offsets = self._size + np.arange(len(rows), dtype=np.uint64) * np.uint64(rows.itemsize)
        self._rows += len(rows)
        self._unwritten.gather(stream, sync)
        self._gather(channel, t_ns, offsets, rows.tobytes())
        if stream in self._previews:
            channel, preview = self._previews[stream]
            sync, t_ns, values = preview.select(sync, t_ns, raw)
            if sync.size:
                rows = preview.layout.pack(channel, sync, t_ns, values)
                offsets = self._size + np.arange(len(rows), dtype=np.uint64) * np.uint64(rows.itemsize)
                self._gather(channel, t_ns, offsets, rows.tobytes())
        self._flush_if_full()

    def add_gaps(self, gaps: Sequence[Gap], t_ns: int) -> None:
        """Record gaps that were found at ``t_ns``, ns UTC."""
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
        """Count rows as lost that were never handed over, because the disk was too slow."""
        self.lost_rows += rows.rows
        self.problem = f"{self.path}: {DISK_STALLED}"
        self._unwritten.add_lost(rows)

    def take_over(self, other: "RecordingWriter") -> None:
        """Record the lost rows and unwritten events of another writer, whose file could not be finished."""
        self._unwritten.take_over(other._unwritten)
        for topic, sync, entries in other._unwritten.events:
            self._event(topic, sync, other._last_ns, entries)

    def flush(self) -> None:
        """Write the gathered rows and events as a chunk, and sync it to the disk."""
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
        index = ChunkIndex(
            chunk_length=len(chunk),
            chunk_start_offset=self._position,
            compression=mcap.COMPRESSION,
            compressed_size=len(compressed),
            message_end_time=self._span[1],
            message_index_length=len(indexes),
            message_index_offsets=offsets,
            message_start_time=self._span[0],
            uncompressed_size=len(raw),
        )
        try:
            self._append(chunk + indexes)
            os.fdatasync(self._file)
        except OSError as error:
            self.lost_rows += self._rows
            self.problem = f"{self.path}: {error.strerror}"
            self._unwritten.failed()
        else:
            self._summary.add_chunk(index, counts)
            self._unwritten.written()
        self._parts, self._indexes, self._size, self._rows, self._span = [], {}, 0, 0, None
        for topic, sync, event in self._unwritten.events:
            self._event(topic, sync, self._last_ns, event)

    def close(self, counters: Mapping[str, int]) -> None:
        """Write the rest, the counters of the capture and the summary; the file is complete afterwards."""
        try:
            self.flush()
            # If the last rows could not be written, their gaps may still fit on the disk.
            self.flush()
            entries = {key: str(value) for key, value in counters.items()}
            check = checksum_record(self._add_metadata(Metadata(COUNTERS, entries)), self._head_crc)
            check.metadata |= {f"{ROWS_OF}/{name}": str(number) for name, number in self.rows.items()}
            self._add_metadata(check)
            self._append(self._summary.encode(self._position))
            os.fsync(self._file)
        except OSError as error:
            raise ConfigError(f"{self.path}: could not be finished: {error.strerror}") from error
        finally:
            self._release()

    def abort(self) -> None:
        """Close and delete the file."""
        self._release()
        self._name.unlink(missing_ok=True)

    def __exit__(self, *_: object) -> None:
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

    def _add_metadata(self, metadata: Metadata) -> bytes:
        data = mcap.encode(metadata)
        index = MetadataIndex(self._position, len(data), metadata.name)
        self._append(data)
        self._summary.metadata.append(index)
        return data

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
    """Write a recording from memory; the file appears under its name when it is complete.

    Parameters
    ----------
    recording
        The recording.
    path
        The file; an existing one is replaced.

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


def checksum_record(data: bytes, start: int = 0) -> Metadata:
    """Return the metadata record with the CRC-32 of ``data``, the bytes right before it, continued from ``start``."""
    return Metadata(CHECK, {"bytes": str(len(data)), "crc32": str(zlib.crc32(data, start))})


def _previews(
    layouts: Iterable[StreamLayout], robot: RobotConfig, sample_rate_hz: float, preview_hz: float
) -> list[PreviewChannel]:
    if preview_hz <= 0:
        return []
    previews = (PreviewChannel.of_stream(layout, robot, sample_rate_hz, preview_hz) for layout in layouts)
    return [preview for preview in previews if preview is not None]


def _created(temporary: Path, path: Path) -> int:
    """Create the file and lock it, so that it is not recovered while it is written; return its descriptor."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        with contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
    return file


def _published(temporary: Path, path: Path) -> Path:
    """Give a file its name, which must be free; return the name."""
    try:
        os.link(temporary, path)
    except FileExistsError:
        raise
    except OSError:
        # The file system has no hard links.
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
