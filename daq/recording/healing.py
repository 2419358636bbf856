"""Gives a torn recording the end that it lacks: index, summary, and what is missing in words."""

import contextlib
import fcntl
import mmap
import os
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from configs import ArmidentError, ConfigError, DataError
from daq.recording import mcap_format as mcap
from daq.recording.layout import StreamLayout
from daq.recording.reader import HEALED, damaged_text, torn_text, uncompressed
from daq.recording.summary import Summary

_COPY = 1 << 24
"""Bytes copied at a time."""


@dataclass(frozen=True)
class Healed:
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


def heal_recording(path: Path | str) -> Healed:
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
                return Healed(path, None)
            if found.holes:
                return Healed(path, missing, _rewrite(path, data, found, missing))
            file.truncate(found.end)
            file.seek(found.end)
            for part in _ending(found, found.end, missing):
                file.write(part)
            file.flush()
            os.fsync(file.fileno())
            return Healed(path, missing)
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such recording") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be healed: {error.strerror}") from error


@dataclass
class _Scan:
    """What was found in a file: its summary as far as it goes, and where its whole records end.

    ``holes`` are spans of bytes (begin, end) of damaged chunks with their indexes, ``tail`` the indexes of the last
    chunk where those in the file may be torn.
    """

    size: int
    summary: Summary = field(default_factory=Summary)
    layouts: dict[int, StreamLayout] = field(default_factory=dict)
    last_sync: int | None = None
    holes: list[tuple[int, int]] = field(default_factory=list)
    finished: bool = False
    end: int = 0
    left_out: int = 0
    tail: bytes = b""

    @property
    def missing(self) -> str | None:
        words = [damaged_text(begin) for begin, _ in self.holes]
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
    known = False
    last: tuple[mcap.ChunkPlace, dict[int, int], bytes] | None = None
    after_hole = False
    end = 0
    for opcode, at, body in mcap.records(data, len(mcap.MAGIC)):
        end = at + mcap.RECORD_HEAD.size + len(body)
        if opcode == mcap.MESSAGE_INDEX:
            if after_hole:
                found.holes[-1] = found.holes[-1][0], end
            elif last is not None:
                place, counts, raw = last
                channel, count = mcap.read_message_index(body)
                offsets = {**place.index_offsets, channel: at}
                place = replace(place, index_offsets=offsets, index_length=place.index_length + end - at)
                last = place, {**counts, channel: count}, raw
            found.end = end
            continue
        if last is not None:
            found.summary.add_chunk(*last[:2])
            last = None
        after_hole = False
        if opcode == mcap.SCHEMA:
            found.summary.schemas.append(bytes(data[at:end]))
        elif opcode == mcap.CHANNEL:
            found.summary.channels.append(bytes(data[at:end]))
            channel_record = mcap.read_channel(body)
            if "armident.stream" in channel_record.metadata:
                layout = StreamLayout.from_json(channel_record.metadata["armident.stream"])
                found.layouts[channel_record.channel_id] = layout
        elif opcode == mcap.METADATA:
            name, _ = mcap.read_metadata(body)
            known = known or name == "armident.recording"
            found.summary.metadata.append(mcap.MetadataPlace(name, at, end - at))
        elif opcode == mcap.CHUNK:
            chunk = mcap.read_chunk(body)
            raw_or_none = uncompressed(chunk)
            if raw_or_none is None:
                found.holes.append((at, end))
                after_hole = True
            else:
                span = chunk.start_ns, chunk.end_ns
                last = mcap.ChunkPlace(*span, at, end - at, {}, 0, len(chunk.data), chunk.size), {}, raw_or_none
                found.last_sync = _last_sync(found, raw_or_none)
        elif opcode == mcap.DATA_END:
            found.finished = bytes(data[-len(mcap.MAGIC) :]) == mcap.MAGIC
            break
        found.end = end
    if not known:
        raise DataError("an MCAP file, but not a recording of armident, or torn before its first chunk")
    found.left_out = found.size - end
    if last is not None:
        # The chunk is whole, its indexes need not be: they are made again.
        place, _, raw = last
        found.end = place.offset + place.length
        offsets, counts, found.tail = {}, {}, b""
        for channel, entries in _indexes(raw).items():
            offsets[channel] = found.end + len(found.tail)
            counts[channel] = len(entries) // 16
            found.tail += mcap.message_index(channel, entries)
        found.summary.add_chunk(replace(place, index_offsets=offsets, index_length=len(found.tail)), counts)
    return found


def _indexes(raw: bytes) -> dict[int, bytes]:
    """Times and places of the messages in a chunk, by channel, as message indexes hold them."""
    entries: dict[int, list[bytes]] = {}
    for opcode, at, body in mcap.records(memoryview(raw), 0):
        if opcode == mcap.MESSAGE:
            channel, _, log, _ = mcap.MESSAGE_HEAD.unpack_from(body)
            entries.setdefault(channel, []).append(mcap.index_entry(log, at))
    return {channel: b"".join(parts) for channel, parts in entries.items()}


def _last_sync(found: _Scan, raw: bytes) -> int | None:
    """Number of the last SYNC so far, with the rows of a chunk."""
    last = found.last_sync
    at = 0
    while at + mcap.RECORD_HEAD.size <= len(raw):
        opcode, length = mcap.RECORD_HEAD.unpack_from(raw, at)
        step = mcap.RECORD_HEAD.size + length
        if opcode == mcap.MESSAGE and at + step <= len(raw):
            channel = mcap.MESSAGE_HEAD.unpack_from(raw, at + mcap.RECORD_HEAD.size)[0]
            layout = found.layouts.get(channel)
            if layout is not None:
                count = layout.run_length(raw, at, channel)
                if count == 0:
                    raise DataError(f"a message of topic {layout.topic} is not as long as its channel says")
                if layout.name == "samples":
                    last = layout.last_sync(raw, at, count)
                step = count * layout.record[0].itemsize
        at += step
    return last


def _ending(found: _Scan, position: int, missing: str) -> Iterator[bytes]:
    """What a file whose records end at ``position`` lacks."""
    yield found.tail
    position += len(found.tail)
    record = mcap.metadata(HEALED, {"missing": missing})
    found.summary.metadata.append(mcap.MetadataPlace(HEALED, position, len(record)))
    yield record
    yield found.summary.ending(position + len(record))


def _rewrite(path: Path, data: memoryview, found: _Scan, missing: str) -> Path:
    """Put a file without the damaged chunks in the place of one with them; where that one is kept."""
    original = path.with_name(f"{path.name}.damaged")
    if original.exists():
        raise ConfigError(f"{original}: is in the way; the damaged file would be kept under this name")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")

    def moved(at: int) -> int:
        return at - sum(end - begin for begin, end in found.holes if begin < at)

    def moved_chunk(place: mcap.ChunkPlace) -> mcap.ChunkPlace:
        offsets = {channel: moved(at) for channel, at in place.index_offsets.items()}
        return replace(place, offset=moved(place.offset), index_offsets=offsets)

    summary = found.summary
    chunks = [moved_chunk(place) for place in summary.chunks]
    places = [replace(place, offset=moved(place.offset)) for place in summary.metadata]
    healed = replace(found, summary=replace(summary, chunks=chunks, metadata=places))
    try:
        with temporary.open("xb") as file:
            begin = 0
            for stop, resume in [*found.holes, (found.end, found.end)]:
                for at in range(begin, stop, _COPY):
                    file.write(data[at : min(at + _COPY, stop)])
                begin = resume
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
