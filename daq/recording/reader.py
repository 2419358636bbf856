"""Reads recordings, whole or torn, in file order and chunk by chunk, straight into arrays."""

import json
import mmap
import zlib
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray
from pydantic import ValidationError

from armident.configs import ConfigError, DataError, RobotConfig, SessionConfig
from armident.daq.recording import mcap_records as mcap
from armident.daq.recording.layout import StreamLayout
from armident.daq.recording.model import Gap, Mark, Recording, Stream, gap_from, mark_from
from armident.daq.recording.rows import Rows
from armident.daq.recording.writer import CHECK, COUNTERS, GAPS_TOPIC, MARKS_TOPIC, SCHEMA

_LARGEST_CHUNK = 1 << 28
_LEAST_ROW, _MOST_RESERVED = 2, 1 << 25
"""Least share of a compressed file that a row takes, bytes, and rows that room is made for before they come."""
_WORKERS, _CHUNKS_AHEAD = 2, 16
_LET_GO = 1 << 26
HEALED = "armident.healed"
"""Metadata of a file that was torn and has been given its end: what it lacks."""


@dataclass
class _Content:
    """What was found in a file so far."""

    channels: dict[int, mcap.ChannelRecord] = field(default_factory=dict)
    layouts: dict[int, StreamLayout] = field(default_factory=dict)
    rows: dict[int, Rows] = field(default_factory=dict)
    messages: dict[int, int] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    gaps: list[Gap] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)
    headed: bool = False
    head_crc: int = 0
    finished: bool = False
    end: int = 0
    counts: dict[int, int] | None = None
    most_rows: int = 0

    def rows_of(self, channel: int) -> Rows:
        """The rows of a channel with a layout."""
        if channel not in self.rows:
            expected = min((self.counts or {}).get(channel, 0), self.most_rows)
            self.rows[channel] = Rows(self.layouts[channel], expected)
        return self.rows[channel]


@dataclass
class _Part:
    """What was found in a chunk."""

    rows: list[tuple[int, NDArray[Any]]] = field(default_factory=list)
    messages: dict[int, int] = field(default_factory=dict)
    gaps: list[Gap] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)

    def count(self, channel: int, messages: int) -> None:
        """Count messages of a channel."""
        self.messages[channel] = self.messages.get(channel, 0) + messages


def read_recording(path: Path | str) -> Recording:
    """Read a recording; of a torn one all whole chunks, with what is missing said in words.

    Parameters
    ----------
    path
        The MCAP file.

    Returns
    -------
    Recording
        Raw values in the dtypes they were captured in; ``missing`` is ``None`` if the file is complete.

    Raises
    ------
    ConfigError
        If there is no such file, or it cannot be read.
    DataError
        If it is not a recording of armident, and why.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            if path.stat().st_size == 0:
                raise DataError(f"{path}: empty, not a recording")
            return _read(path, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such recording") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error


def _read(path: Path, mapped: mmap.mmap) -> Recording:
    data = memoryview(mapped)
    if bytes(data[: len(mcap.MAGIC)]) != mcap.MAGIC:
        raise DataError(f"{path}: not a recording (not an MCAP file)")
    # No row takes less of a file than this, so that a file cannot have us reserve what it has no room for.
    content = _Content(counts=message_counts(data), most_rows=min(len(data) // _LEAST_ROW, _MOST_RESERVED))
    let_go = 0
    try:
        with ThreadPoolExecutor(_WORKERS, "zstd") as pool:
            for opcode, at, body, chunk in _ahead(data, pool, content):
                _take(content, data, opcode, at, body, chunk)
                content.end = at + mcap.RECORD_HEAD.size + len(body)
                if content.finished:
                    break
                if content.end - let_go > _LET_GO:
                    # What was read need not stay in memory; the kernel has it, should anybody ask again.
                    let_go = content.end // mmap.PAGESIZE * mmap.PAGESIZE
                    mapped.madvise(mmap.MADV_DONTNEED, 0, let_go)
        content.finished = content.finished and bytes(data[-len(mcap.MAGIC) :]) == mcap.MAGIC
        return _recording(path, content, len(data))
    except mcap.MalformedRecord as error:
        raise DataError(f"{path}: damaged: {error}") from error
    except DataError as error:
        raise error if str(path) in str(error) else DataError(f"{path}: {error}") from error


_Pending = tuple[int, int, memoryview, "Future[bytes | None] | None"]


def _ahead(data: memoryview, pool: ThreadPoolExecutor, content: _Content) -> Iterator[_Pending]:
    """The records of a file in their order; chunks are decompressed ahead by other threads."""
    waiting: deque[_Pending] = deque()
    chunks = 0
    for opcode, at, body in mcap.records(data, len(mcap.MAGIC)):
        future = None
        if opcode == mcap.CHUNK:
            # Whatever stood before the first chunk was taken by then: it says whether chunks have checksums.
            future = pool.submit(uncompressed, body, content.headed)
            chunks += 1
        waiting.append((opcode, at, body, future))
        while waiting and (chunks > _CHUNKS_AHEAD or chunks == 0):
            chunks -= waiting[0][3] is not None
            yield waiting.popleft()
    yield from waiting


def _take(
    content: _Content, data: memoryview, opcode: int, at: int, body: memoryview, chunk: "Future[bytes | None] | None"
) -> None:
    if chunk is not None:
        _take_chunk(content, at, chunk.result())
        return
    if opcode == mcap.DATA_END:
        content.finished = True
        return
    try:
        name = checked_record(data, opcode, at, body, content.head_crc)
        if opcode == mcap.CHANNEL:
            _take_channel(content, mcap.read_channel(body))
    except mcap.MalformedRecord as error:
        if not content.headed:
            raise
        content.metadata.pop(COUNTERS, None)
        content.damaged.append(damaged_text(at, error))
        return
    if opcode == mcap.METADATA:
        content.metadata[name] = entries = mcap.read_metadata(body)[1]
        if name == CHECK and not content.headed:
            content.headed, content.head_crc = True, int(entries["crc32"])


def checked_record(data: memoryview, opcode: int, at: int, body: memoryview, head_crc: int) -> str:
    """Name of a metadata record, empty of another one; ``head_crc`` is the checksum of the head, 0 in the head.

    Raises
    ------
    MalformedRecord
        If it is none that may stand there, or what it is to check is not what was written.
    """
    if opcode not in mcap.IN_DATA:
        raise mcap.MalformedRecord(f"a record of kind {opcode:02X}h before the end of the data")
    if opcode == mcap.MESSAGE_INDEX:
        mcap.read_message_index(body)
    if opcode != mcap.METADATA:
        return ""
    name, entries = mcap.read_metadata(body)
    if name == CHECK:
        try:
            size, crc = int(entries["bytes"]), int(entries["crc32"])
        except (KeyError, ValueError) as error:
            raise mcap.MalformedRecord("a checksum that is none") from error
        if not 0 < size <= at or zlib.crc32(data[at - size : at], head_crc) != crc:
            raise mcap.MalformedRecord(f"the {size} bytes before byte {at} are not what was written")
    return name


def _take_channel(content: _Content, channel: mcap.ChannelRecord) -> None:
    if content.channels.setdefault(channel.channel_id, channel) != channel:
        raise mcap.MalformedRecord(f"another channel {channel.channel_id}")
    if "armident.stream" in channel.metadata:
        content.layouts[channel.channel_id] = StreamLayout.from_json(channel.metadata["armident.stream"])


def uncompressed(body: memoryview, checked: bool) -> bytes | None:
    """The records in a chunk record's content, or ``None`` if it is damaged; ``checked`` ones have a checksum."""
    try:
        chunk = mcap.read_chunk(body)
    except mcap.MalformedRecord:
        return None
    if chunk.size > _LARGEST_CHUNK:
        return None
    if chunk.compression == "zstd":
        try:
            # The size in the chunk's head is no reason to reserve memory.
            if zstandard.frame_content_size(chunk.data) not in (-1, chunk.size):
                return None
            raw = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=chunk.size)
        except zstandard.ZstdError:
            return None
    elif chunk.compression == "":
        raw = bytes(chunk.data)
    elif chunk.compression == "lz4":
        raise DataError("compressed with lz4; recordings are compressed with zstd")
    else:
        return None
    if len(raw) != chunk.size or ((checked or chunk.crc) and zlib.crc32(raw) != chunk.crc):
        return None
    return raw


def _take_chunk(content: _Content, at: int, raw: bytes | None) -> None:
    """Take all that a chunk holds, or nothing."""
    if raw is None:
        content.damaged.append(damaged_text(at))
        return
    part = _Part()
    try:
        _scan_chunk(content, part, raw)
    except mcap.MalformedRecord as error:
        content.damaged.append(damaged_text(at, error))
        return
    for channel, rows in part.rows:
        content.rows_of(channel).append(rows)
    for channel, count in part.messages.items():
        content.messages[channel] = content.messages.get(channel, 0) + count
    content.gaps += part.gaps
    content.marks += part.marks


def _scan_chunk(content: _Content, part: _Part, raw: bytes) -> None:
    at = 0
    while at + mcap.RECORD_HEAD.size <= len(raw):
        opcode, length = mcap.RECORD_HEAD.unpack_from(raw, at)
        body = at + mcap.RECORD_HEAD.size
        if body + length > len(raw):
            raise mcap.MalformedRecord("a record reaches beyond its chunk")
        if opcode == mcap.CHANNEL:
            _take_channel(content, mcap.read_channel(memoryview(raw)[body : body + length]))
        elif opcode == mcap.MESSAGE and length >= mcap.MESSAGE_HEAD.size:
            channel_id = mcap.MESSAGE_HEAD.unpack_from(raw, body)[0]
            layout = content.layouts.get(channel_id)
            if layout is not None:
                count = layout.run_length(raw, at, channel_id)
                if count == 0:
                    raise DataError(f"a message of topic {layout.topic} is not as long as its channel says")
                dtype = layout.record[0]
                part.rows.append((channel_id, np.frombuffer(raw, dtype, count=count, offset=at)))
                part.count(channel_id, count)
                at += count * dtype.itemsize
                continue
            channel = content.channels.get(channel_id)
            if channel is None:
                raise mcap.MalformedRecord(f"messages of a channel {channel_id} that this file has not")
            part.count(channel_id, 1)
            if channel.topic in (GAPS_TOPIC, MARKS_TOPIC):
                _take_event(part, channel.topic, raw[body + mcap.MESSAGE_HEAD.size : body + length])
        at = body + length


def _take_event(part: _Part, topic: str, data: bytes) -> None:
    try:
        entries = json.loads(data)
        if topic == GAPS_TOPIC:
            part.gaps.append(gap_from(entries))
        else:
            part.marks.append(mark_from(entries))
    except (ValueError, RecursionError) as error:
        raise DataError(f"topic {topic}: an event that cannot be understood: {_one_line(error)}") from error


def _recording(path: Path, content: _Content, size: int) -> Recording:
    head = content.metadata.get("armident.recording")
    if head is None:
        what = "no metadata 'armident.recording'" if content.finished else "torn before its first chunk"
        raise DataError(f"{path}: an MCAP file, but not a recording of armident ({what})")
    if head.get("check") == CHECK and not content.headed:
        raise DataError(f"{path}: torn before its first chunk, or its head is damaged")
    if head.get("schema") != SCHEMA:
        raise DataError(f"{path}: a recording of schema {head.get('schema')!r}, this version reads {SCHEMA}")
    streams = {layout.name: _stream(content.rows_of(k), layout) for k, layout in content.layouts.items()}
    if "samples" not in streams:
        raise DataError(f"{path}: no topic /samples")
    try:
        robot = RobotConfig.model_validate_json(content.metadata["armident.robot"]["json"])
        stored = content.metadata.get("armident.session")
        session = SessionConfig.model_validate_json(stored["json"]) if stored else None
        rate = float(head["sample_rate_hz"])
        counters = {key: int(value) for key, value in content.metadata.get("armident.counters", {}).items()}
    except (KeyError, ValidationError, ValueError) as error:
        raise DataError(f"{path}: its configuration cannot be understood: {_one_line(error)}") from error
    joints = tuple(joint.name for joint in robot.joints)
    for layout in content.layouts.values():
        if layout.joints != joints:
            raise DataError(f"{path}: topic {layout.topic} has other joints than its robot {robot.name}")
    return Recording(
        path=path,
        robot=robot,
        session=session,
        sample_rate_hz=rate,
        streams=streams,
        gaps=tuple(content.gaps),
        marks=tuple(content.marks),
        counters=counters,
        metadata=content.metadata.get("armident.facts", {}),
        missing=_missing(content, streams["samples"], size),
    )


def _stream(rows: Rows, layout: StreamLayout) -> Stream:
    sync, t_ns, raw = rows.arrays()
    if np.any(sync[1:] <= sync[:-1]):
        raise DataError(f"topic {layout.topic}: SYNC numbers do not increase")
    return Stream(layout.name, layout.every, sync, t_ns, {f.name: f for f in layout.fields}, raw)


def message_counts(data: memoryview) -> dict[int, int] | None:
    """How many messages of every channel a finished file says it has; ``None`` if its summary was not written so."""
    footer = len(data) - len(mcap.MAGIC) - mcap.FOOTER_SIZE
    if footer < len(mcap.MAGIC) or bytes(data[-len(mcap.MAGIC) :]) != mcap.MAGIC:
        return None
    try:
        start, crc = mcap.read_footer(data[footer : footer + mcap.FOOTER_SIZE])
        if not 0 < start <= footer or (crc and zlib.crc32(data[start : footer + mcap.FOOTER_SIZE - 4]) != crc):
            return None
        for opcode, _, body in mcap.records(data[:footer], start):
            if opcode == mcap.STATISTICS:
                return mcap.read_message_counts(body)
    except mcap.MalformedRecord:
        return None
    return None


def short_text(topic: str, found: int, written: int) -> str:
    """What is said of a topic that has not as many messages as the file's summary says."""
    return f"{found} messages of topic {topic} where {written} were written"


def _missing(content: _Content, samples: Stream, size: int) -> str | None:
    healed = content.metadata.get(HEALED)
    words = [healed["missing"]] if healed and "missing" in healed else []
    words += content.damaged
    if content.counts is not None and content.finished and not content.damaged:
        words += [
            short_text(content.channels[k].topic, content.messages.get(k, 0), written)
            for k, written in content.counts.items()
            if k in content.channels and written != content.messages.get(k, 0)
        ]
    if not content.finished:
        words.append(torn_text(int(samples.sync[-1]) if samples.sync.size else None, size - content.end))
    return "; ".join(words) or None


def damaged_text(at: int, why: Exception | None = None) -> str:
    """What is said of a chunk (or another record, with the reason) at byte ``at`` that cannot be read."""
    if why is None:
        return f"the chunk at byte {at} is damaged and left out"
    return f"the record at byte {at} is damaged and left out ({why})"


def torn_text(last_sync: int | None, left_out: int) -> str:
    """What is said of a file that ends after a SYNC (``None``: before the first), with bytes that say nothing."""
    last = "from the start" if last_sync is None else f"after SYNC {last_sync}"
    return (
        f"the file was not finished: whatever came {last} and the counters are missing"
        f" ({left_out} bytes of a torn record left out)"
    )


def _one_line(error: Exception) -> str:
    return str(error).replace("\n", " ")[:200]
