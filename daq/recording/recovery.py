"""Gives a torn recording the end that it lacks: index, summary, and what is missing in words."""

import contextlib
import fcntl
import mmap
import os
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from armident.configs import ArmidentError, ConfigError, DataError
from armident.daq.recording import mcap_records as mcap
from armident.daq.recording.layout import StreamLayout
from armident.daq.recording.reader import (
    HEALED,
    checked_record,
    damaged_text,
    message_counts,
    short_text,
    torn_text,
    uncompressed,
)
from armident.daq.recording.summary import Summary
from armident.daq.recording.writer import CHECK, COUNTERS

_COPY = 1 << 24
"""Bytes copied at a time."""


@dataclass(frozen=True)
class Recovered:
    """What became of a file.

    Parameters
    ----------
    path
        The file, complete now.
    missing
        What it lacks, in words; ``None``: nothing, it was complete and has not been touched.
    original
        Where the file is kept as it was, if chunks in its middle had to be left out.
    """

    path: Path
    missing: str | None
    original: Path | None = None


def recover_recording(path: Path | str) -> Recovered:
    """Make a torn recording an indexed one that any MCAP reader opens.

    A file that merely ends too early gets its end in place, so that no space for a copy is needed: what follows its
    last whole chunk is cut off, then index and summary are written. If that is interrupted, it is torn as before.
    Where chunks in the middle are damaged, a file without them takes its name, and the damaged one is kept under the
    name with ``.damaged`` added.

    Raises
    ------
    ConfigError
        If there is no such file, it is being written, or it cannot be.
    DataError
        If it is not a recording of armident, or torn before its first chunk, where there is nothing to heal.
    """
    path = Path(path)
    try:
        with path.open("r+b") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise ConfigError(f"{path}: is being written") from error
            if os.fstat(file.fileno()).st_size == 0:
                raise DataError(f"{path}: empty, not a recording")
            data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
            found = _scan(path, data)
            missing = found.missing
            if missing is None:
                return Recovered(path, None)
            if found.holes:
                return Recovered(path, missing, _rewrite(path, data, found, missing))
            file.truncate(found.end)
            file.seek(found.end)
            for part in _ending(found, found.end, missing):
                file.write(part)
            file.flush()
            os.fsync(file.fileno())
            return Recovered(path, missing)
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such recording") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be healed: {error.strerror}") from error


@dataclass(frozen=True)
class _Hole:
    """Bytes from ``begin`` to ``end`` that are left out, and what comes in their place."""

    begin: int
    end: int
    instead: bytes = b""

    @property
    def closed(self) -> int:
        """By how much what follows moves towards the beginning."""
        return self.end - self.begin - len(self.instead)


@dataclass
class _Chunk:
    """A whole chunk whose indexes are being read: where it is, where they end, and their messages by channel."""

    place: mcap.ChunkPlace
    raw: bytes
    messages: dict[int, int]
    end: int
    broken: bool = False
    indexed: dict[int, int] = field(default_factory=dict)

    def take(self, body: memoryview, at: int, end: int) -> None:
        """Take one of its indexes."""
        channel, count = mcap.read_message_index(body)
        offsets = {**self.place.index_offsets, channel: at}
        length = self.place.index_length + end - at
        self.place = replace(self.place, index_offsets=offsets, index_length=length)
        self.indexed[channel], self.end = count, end

    def indexes(self) -> bytes:
        """Its indexes made again; the place knows of them afterwards."""
        records, offsets = b"", {}
        for channel, entries in _indexes(self.raw).items():
            offsets[channel] = self.place.offset + self.place.length + len(records)
            records += mcap.message_index(channel, entries)
        self.place = replace(self.place, index_offsets=offsets, index_length=len(records))
        return records


@dataclass
class _Scan:
    """What was found in a file: its summary as far as it goes, and where its whole records end.

    ``holes`` are spans of bytes of damaged chunks with their indexes and of other damaged records, ``damage`` the words
    for them, ``messages`` counts by channel, ``tail`` the indexes of the last chunk where those in the file may be
    torn.
    """

    size: int
    summary: Summary = field(default_factory=Summary)
    layouts: dict[int, StreamLayout] = field(default_factory=dict)
    last_sync: int | None = None
    holes: list[_Hole] = field(default_factory=list)
    damage: list[str] = field(default_factory=list)
    messages: dict[int, int] = field(default_factory=dict)
    topics: dict[int, str] = field(default_factory=dict)
    head_crc: int = 0
    finished: bool = False
    end: int = 0
    left_out: int = 0
    tail: bytes = b""

    @property
    def missing(self) -> str | None:
        words = list(self.damage)
        if not self.finished:
            words.append(torn_text(self.last_sync, self.left_out))
        return "; ".join(words) or None


def _scan(path: Path, data: memoryview) -> _Scan:
    try:
        return _scanned(data)
    except (mcap.MalformedRecord, DataError) as error:
        raise DataError(f"{path}: {error}") from error


def _scanned(data: memoryview) -> _Scan:
    found = _Scan(len(data))
    if bytes(data[: len(mcap.MAGIC)]) != mcap.MAGIC:
        raise DataError("not a recording (not an MCAP file)")
    known = headed = False
    last: _Chunk | None = None
    after_hole = False
    end = 0
    for opcode, at, body in mcap.records(data, len(mcap.MAGIC)):
        end = at + mcap.RECORD_HEAD.size + len(body)
        try:
            name = checked_record(data, opcode, at, body, found.head_crc)
            channel = mcap.read_channel(body) if opcode == mcap.CHANNEL else None
        except mcap.MalformedRecord as error:
            if not headed:
                raise
            found.damage.append(damaged_text(at, error))
            if last is not None:
                last.broken, last.end = True, end
            else:
                found.holes.append(_Hole(_begin_of_damage(found, opcode, at), end))
            found.end = end
            continue
        if opcode == mcap.MESSAGE_INDEX:
            if after_hole:
                found.holes[-1] = _Hole(found.holes[-1].begin, end)
            elif last is not None:
                last.take(body, at, end)
            found.end = end
            continue
        if last is not None:
            _add_chunk(found, last)
            last = None
        after_hole = False
        if opcode == mcap.SCHEMA:
            found.summary.schemas.append(bytes(data[at:end]))
        elif channel is not None:
            found.summary.channels.append(bytes(data[at:end]))
            found.topics[channel.channel_id] = channel.topic
            if "armident.stream" in channel.metadata:
                found.layouts[channel.channel_id] = StreamLayout.from_json(channel.metadata["armident.stream"])
        elif opcode == mcap.METADATA:
            known = known or name == "armident.recording"
            if name == CHECK and not headed:
                headed, found.head_crc = True, int(mcap.read_metadata(body)[1]["crc32"])
            found.summary.metadata.append(mcap.MetadataPlace(name, at, end - at))
        elif opcode == mcap.CHUNK:
            raw, counts, why = uncompressed(body, headed), dict[int, int](), None
            try:
                counts = {} if raw is None else _count(found, raw)
            except mcap.MalformedRecord as error:
                raw, why = None, error
            if raw is None:
                found.holes.append(_Hole(at, end))
                found.damage.append(damaged_text(at, why))
                after_hole = True
            else:
                chunk = mcap.read_chunk(body)
                span = chunk.start_ns, chunk.end_ns
                place = mcap.ChunkPlace(*span, at, end - at, {}, 0, len(chunk.data), chunk.size)
                last = _Chunk(place, raw, counts, end)
        elif opcode == mcap.DATA_END:
            found.finished = bytes(data[-len(mcap.MAGIC) :]) == mcap.MAGIC
            if found.finished and not found.damage:
                found.damage += _short(found, message_counts(data))
            break
        found.end = end
    if not known:
        raise DataError("an MCAP file, but not a recording of armident, or torn before its first chunk")
    found.left_out = found.size - end
    if last is not None:
        # The chunk is whole, its indexes need not be: they are made again.
        found.end = last.place.offset + last.place.length
        found.tail = last.indexes()
        found.summary.add_chunk(last.place, last.messages)
    return found


def _begin_of_damage(found: _Scan, opcode: int, at: int) -> int:
    """Where what is left out with the damaged record at byte ``at`` begins.

    Of counters and their checksum nobody knows which is damaged: both go.
    """
    counters = [place.offset for place in found.summary.metadata if place.name == COUNTERS]
    if opcode != mcap.METADATA or not counters:
        return at
    found.summary.metadata = [place for place in found.summary.metadata if place.offset < counters[0]]
    return counters[0]


def _add_chunk(found: _Scan, chunk: _Chunk) -> None:
    """Count a chunk; where its indexes are not those of its messages others come in their place."""
    if chunk.broken or chunk.indexed != chunk.messages:
        begin = chunk.place.offset + chunk.place.length
        found.holes.append(_Hole(begin, chunk.end, chunk.indexes()))
    found.summary.add_chunk(chunk.place, chunk.messages)


def _short(found: _Scan, counts: dict[int, int] | None) -> list[str]:
    """What is said of topics that have not as many messages as the summary says."""
    return [
        short_text(found.topics[k], found.messages.get(k, 0), written)
        for k, written in (counts or {}).items()
        if k in found.topics and written != found.messages.get(k, 0)
    ]


def _indexes(raw: bytes) -> dict[int, bytes]:
    """Times and places of the messages in a chunk, by channel, as message indexes hold them."""
    entries: dict[int, list[bytes]] = {}
    for opcode, at, body in mcap.records(memoryview(raw), 0):
        if opcode == mcap.MESSAGE:
            channel, _, log, _ = mcap.MESSAGE_HEAD.unpack_from(body)
            entries.setdefault(channel, []).append(mcap.index_entry(log, at))
    return {channel: b"".join(parts) for channel, parts in entries.items()}


def _count(found: _Scan, raw: bytes) -> dict[int, int]:
    """Messages of every channel in a chunk; the last SYNC is kept."""
    counts: dict[int, int] = {}
    last_sync = found.last_sync
    at = 0
    while at + mcap.RECORD_HEAD.size <= len(raw):
        opcode, length = mcap.RECORD_HEAD.unpack_from(raw, at)
        step = mcap.RECORD_HEAD.size + length
        if at + step > len(raw):
            raise mcap.MalformedRecord("a record reaches beyond its chunk")
        if opcode == mcap.MESSAGE and length >= mcap.MESSAGE_HEAD.size:
            channel = mcap.MESSAGE_HEAD.unpack_from(raw, at + mcap.RECORD_HEAD.size)[0]
            layout = found.layouts.get(channel)
            count = 1
            if layout is not None:
                count = layout.run_length(raw, at, channel)
                if count == 0:
                    raise DataError(f"a message of topic {layout.topic} is not as long as its channel says")
                if layout.name == "samples":
                    last_sync = layout.last_sync(raw, at, count)
                step = count * layout.record[0].itemsize
            elif channel not in found.topics:
                raise mcap.MalformedRecord(f"messages of a channel {channel} that this file has not")
            counts[channel] = counts.get(channel, 0) + count
        at += step
    found.last_sync = last_sync
    for channel, count in counts.items():
        found.messages[channel] = found.messages.get(channel, 0) + count
    return counts


def _ending(found: _Scan, position: int, missing: str) -> Iterator[bytes]:
    """What a file whose records end at ``position`` lacks."""
    yield found.tail
    position += len(found.tail)
    healed = mcap.metadata(HEALED, {"missing": missing})
    for name, record in ((HEALED, healed), (CHECK, mcap.check(CHECK, healed, found.head_crc))):
        found.summary.metadata.append(mcap.MetadataPlace(name, position, len(record)))
        yield record
        position += len(record)
    yield found.summary.ending(position)


def _rewrite(path: Path, data: memoryview, found: _Scan, missing: str) -> Path:
    """Put a file without the damaged chunks in the place of one with them; where that one is kept."""
    original = path.with_name(f"{path.name}.damaged")
    if original.exists():
        raise ConfigError(f"{original}: is in the way; the damaged file would be kept under this name")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")

    def moved(at: int) -> int:
        return at - sum(hole.closed for hole in found.holes if hole.begin < at)

    def moved_chunk(place: mcap.ChunkPlace) -> mcap.ChunkPlace:
        offset = moved(place.offset)
        # Indexes follow their chunk without a hole between them.
        offsets = {channel: at - place.offset + offset for channel, at in place.index_offsets.items()}
        return replace(place, offset=offset, index_offsets=offsets)

    summary = found.summary
    chunks = [moved_chunk(place) for place in summary.chunks]
    places = [replace(place, offset=moved(place.offset)) for place in summary.metadata]
    healed = replace(found, summary=replace(summary, chunks=chunks, metadata=places))
    try:
        with temporary.open("xb") as file:
            begin = 0
            for hole in [*found.holes, _Hole(found.end, found.end)]:
                for at in range(begin, hole.begin, _COPY):
                    file.write(data[at : min(at + _COPY, hole.begin)])
                file.write(hole.instead)
                begin = hole.end
            for part in _ending(healed, moved(found.end), missing):
                file.write(part)
            file.flush()
            os.fsync(file.fileno())
        os.link(path, original)
        temporary.replace(path)
    except (OSError, ArmidentError):
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    return original
