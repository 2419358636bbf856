"""Recovers truncated or damaged recordings: adds index and summary, and a description of the missing parts."""

import contextlib
import fcntl
import mmap
import os
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Metadata, MetadataIndex

from armident.configs import ArmidentError, ConfigError, DataError
from armident.daq.recording import mcap_records as mcap
from armident.daq.recording.mcap_summary import Summary
from armident.daq.recording.names import COUNTERS, RECORDING, RECOVERED
from armident.daq.recording.reader import recovered_words
from armident.daq.recording.scan import (
    ChunkItem,
    DamageItem,
    LooseMessage,
    MessageIndexContent,
    RecordingScan,
    RecordItem,
)
from armident.daq.recording.writer import checksum_record

_COPY = 1 << 24
"""Number of bytes copied at a time."""


@dataclass(frozen=True)
class Recovered:
    """Result of recovering a file.

    Parameters
    ----------
    path
        The file, complete now.
    missing
        Description of the missing parts; ``None`` if the file was complete and has not been touched.
    original
        Path of the unchanged damaged file, if damaged records in its middle were left out.
    """

    path: Path
    missing: str | None
    original: Path | None = None


def recover_recording(path: Path | str) -> Recovered:
    """Turn a truncated or damaged recording into a complete, indexed one that any MCAP reader opens.

    A truncated file is completed in place, which needs no space for a copy: the bytes after the last complete chunk are
    cut off, then index and summary are written. If that is interrupted, the file is truncated as before. If records
    before the end are damaged, a file without them replaces the damaged one, which is kept under its name with
    ``.damaged`` added.

    Raises ConfigError if there is no such file, it is being written, or it cannot be written. Raises DataError if it is
    not a recording of armident, or ends before its first chunk.
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
            if found.missing is None:
                return Recovered(path, None)
            if found.scan.rewritten:
                raise DataError(
                    f"{path}: {found.missing}. Another tool has written this file; try: mcap recover {path}"
                )
            if found.cuts:
                return Recovered(path, found.missing, _rewrite(path, data, found))
            file.truncate(found.end)
            file.seek(found.end)
            for part in _ending(found, found.summary, found.end):
                file.write(part)
            file.flush()
            os.fsync(file.fileno())
            return Recovered(path, found.missing)
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such recording") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be recovered: {error.strerror}") from error


@dataclass(frozen=True)
class _Cut:
    """Bytes ``start`` to ``end`` that are left out, and the bytes that replace them."""

    start: int
    end: int
    replacement: bytes = b""

    @property
    def shift(self) -> int:
        """Bytes by which the following records move towards the beginning."""
        return self.end - self.start - len(self.replacement)


@dataclass
class _Chunk:
    """A valid chunk with its index record, records ``raw``, messages and index entries by channel, and end in bytes."""

    index: ChunkIndex
    raw: bytes
    messages: dict[int, int]
    end: int
    damaged: bool = False
    indexed: dict[int, int] = field(default_factory=dict)

    @property
    def indexes_start(self) -> int:
        """Position of its message indexes, bytes."""
        return self.index.chunk_start_offset + self.index.chunk_length

    def add_index(self, content: MessageIndexContent, start: int, end: int) -> None:
        """Add a message index of the chunk; ``start``, ``end``: position of the record in the file, bytes."""
        self.index.message_index_offsets[content.channel_id] = start
        self.index.message_index_length += end - start
        self.indexed[content.channel_id], self.end = content.number, end

    def rebuild_indexes(self) -> bytes:
        """Return message indexes made from its messages; the index record then refers to them."""
        records, offsets = b"", {}
        for channel, entries in _index_entries(self.raw).items():
            offsets[channel] = self.indexes_start + len(records)
            records += mcap.message_index(channel, entries)
        self.index.message_index_offsets, self.index.message_index_length = offsets, len(records)
        return records


class _Contents:
    """Summary, damaged byte ranges (``cuts``) and end of a file's valid records; MalformedRecord at a damaged head.

    ``end`` precedes the data end, bytes; ``tail``: message indexes of the last chunk, if those in the file may lack
    some; ``missing``: ``None`` for a complete file.
    """

    def __init__(self, data: memoryview) -> None:
        self.scan = RecordingScan(data)
        self.summary = Summary()
        self.cuts: list[_Cut] = []
        self.end = 0
        self.tail = b""
        self._last: _Chunk | None = None
        self._last_sync: int | None = None
        self._after_damaged_chunk = False
        for item in self.scan:
            if isinstance(item, DamageItem):
                self._add_damage(item)
            elif isinstance(item, LooseMessage):
                self._note_last_sync(item)
            elif isinstance(item, ChunkItem):
                self._add_chunk(item)
            elif isinstance(item.content, MessageIndexContent):
                self._add_message_index(item, item.content)
            else:
                self._add_record(item, data)
            if not (isinstance(item, RecordItem) and item.opcode == Opcode.DATA_END):
                self.end = item.end
        if RECORDING not in self.scan.metadata:
            raise DataError("an MCAP file, but not a recording of armident, or truncated before its first chunk")
        self._add_tail()
        missing = self.scan.missing(self._last_sync)
        self.missing = "; ".join(recovered_words(self.scan.metadata) + missing) if missing else None

    def _add_tail(self) -> None:
        """Rebuild the indexes of the last chunk, which may be incomplete although the chunk is complete."""
        if self._last is not None:
            self.end = self._last.indexes_start
            self.tail = self._last.rebuild_indexes()
            self.summary.add_chunk(self._last.index, self._last.messages)

    def _add_damage(self, item: DamageItem) -> None:
        if item.opcode == Opcode.CHUNK:
            self._end_chunk()
            self.cuts.append(_Cut(item.start, item.end))
            self._after_damaged_chunk = True
        elif self._last is not None:
            self._last.damaged, self._last.end = True, item.end
        else:
            if item.opcode == Opcode.METADATA:
                self._leave_out_counters()
            self.cuts = sorted([*self.cuts, _Cut(item.start, item.end)], key=lambda cut: cut.start)

    def _leave_out_counters(self) -> None:
        """Cut the counters, whose checksum is damaged or may be."""
        counters = [index for index in self.summary.metadata if index.name == COUNTERS]
        self.summary.metadata = [index for index in self.summary.metadata if index.name != COUNTERS]
        self.cuts += [_Cut(index.offset, index.offset + index.length) for index in counters]

    def _add_message_index(self, item: RecordItem, content: MessageIndexContent) -> None:
        if self._after_damaged_chunk:
            self.cuts[-1] = _Cut(self.cuts[-1].start, item.end)
        elif self._last is not None:
            self._last.add_index(content, item.start, item.end)

    def _add_chunk(self, item: ChunkItem) -> None:
        self._end_chunk()
        self._after_damaged_chunk = False
        self._note_last_sync(item)
        content = mcap.read_chunk(item.body)
        index = ChunkIndex(
            chunk_length=item.end - item.start,
            chunk_start_offset=item.start,
            compression=content.compression,
            compressed_size=len(content.data),
            message_end_time=content.end_ns,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=content.start_ns,
            uncompressed_size=content.size,
        )
        self._last = _Chunk(index, item.raw, item.message_counts(), item.end)

    def _note_last_sync(self, item: ChunkItem) -> None:
        for run in item.runs:
            layout = self.scan.layouts.get(run.channel_id)
            if layout is not None and layout.name == "samples":
                self._last_sync = layout.last_sync(item.raw, run.start, run.number)

    def _add_record(self, item: RecordItem, data: memoryview) -> None:
        self._end_chunk()
        self._after_damaged_chunk = False
        if item.opcode == Opcode.SCHEMA:
            self.summary.schemas.append(bytes(data[item.start : item.end]))
        elif item.opcode == Opcode.CHANNEL:
            self.summary.channels.append(bytes(data[item.start : item.end]))
        elif isinstance(item.content, Metadata):
            self.summary.metadata.append(MetadataIndex(item.start, item.end - item.start, item.content.name))

    def _end_chunk(self) -> None:
        """Add the last chunk to the summary; its message indexes are replaced if they do not fit its messages."""
        chunk, self._last = self._last, None
        if chunk is None:
            return
        if chunk.damaged or chunk.indexed != chunk.messages:
            self.cuts.append(_Cut(chunk.indexes_start, chunk.end, chunk.rebuild_indexes()))
        self.summary.add_chunk(chunk.index, chunk.messages)


def _scan(path: Path, data: memoryview) -> _Contents:
    try:
        return _Contents(data)
    except (mcap.MalformedRecord, DataError) as error:
        raise DataError(f"{path}: {error}") from error


def _index_entries(raw: bytes) -> dict[int, bytes]:
    """Return the message index entries of a chunk's records, by channel."""
    entries: dict[int, list[bytes]] = {}
    for opcode, at, body in mcap.records(memoryview(raw), 0):
        if opcode == Opcode.MESSAGE:
            channel, _, log, _ = mcap.MESSAGE_HEAD.unpack_from(body)
            entries.setdefault(channel, []).append(mcap.index_entry(log, at))
    return {channel: b"".join(parts) for channel, parts in entries.items()}


def _ending(found: _Contents, summary: Summary, position: int) -> Iterator[bytes]:
    """Yield the bytes that complete a file whose valid records end at ``position``."""
    yield found.tail
    position += len(found.tail)
    recovered = mcap.encode(Metadata(RECOVERED, {"missing": found.missing or ""}))
    check = checksum_record(recovered, found.scan.head_crc or 0)
    for record in (recovered, mcap.encode(check)):
        name = RECOVERED if record is recovered else check.name
        summary.metadata.append(MetadataIndex(position, len(record), name))
        yield record
        position += len(record)
    yield summary.encode(position)


def _rewrite(path: Path, data: memoryview, found: _Contents) -> Path:
    """Replace a file by one without its damaged records; return the path under which the damaged file is kept."""
    original = path.with_name(f"{path.name}.damaged")
    if original.exists():
        raise ConfigError(f"{original}: exists; the damaged file would be kept under this name. Move it away first")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")

    def moved(at: int) -> int:
        return at - sum(cut.shift for cut in found.cuts if cut.end <= at)

    def moved_chunk(index: ChunkIndex) -> ChunkIndex:
        start = moved(index.chunk_start_offset)
        # Message indexes follow their chunk without a cut between them.
        offsets = {
            channel: at - index.chunk_start_offset + start for channel, at in index.message_index_offsets.items()
        }
        return replace(index, chunk_start_offset=start, message_index_offsets=offsets)

    summary = replace(
        found.summary,
        chunks=[moved_chunk(index) for index in found.summary.chunks],
        metadata=[replace(index, offset=moved(index.offset)) for index in found.summary.metadata],
    )
    try:
        with temporary.open("xb") as file:
            start = 0
            for cut in [*found.cuts, _Cut(found.end, found.end)]:
                for at in range(start, cut.start, _COPY):
                    file.write(data[at : min(at + _COPY, cut.start)])
                file.write(cut.replacement)
                start = cut.end
            for part in _ending(found, summary, moved(found.end)):
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
