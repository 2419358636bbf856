"""The records of an MCAP file that recordings use (MCAP specification, version 0), written and read as bytes."""

import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

MAGIC = b"\x89MCAP0\r\n"

HEADER = 0x01
FOOTER = 0x02
SCHEMA = 0x03
CHANNEL = 0x04
MESSAGE = 0x05
CHUNK = 0x06
MESSAGE_INDEX = 0x07
CHUNK_INDEX = 0x08
ATTACHMENT = 0x09
STATISTICS = 0x0B
METADATA = 0x0C
METADATA_INDEX = 0x0D
SUMMARY_OFFSET = 0x0E
DATA_END = 0x0F

RECORD_HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_STATISTICS_HEAD = struct.Struct("<QHIIIIQQI")

FOOTER_SIZE = RECORD_HEAD.size + 20

IN_DATA = frozenset((HEADER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, ATTACHMENT, METADATA, DATA_END))
"""Records that may stand before the summary."""


class MalformedRecord(ValueError):
    """Bytes that are not what the specification says."""


def record(opcode: int, content: bytes) -> bytes:
    """A record: opcode, length, content."""
    return RECORD_HEAD.pack(opcode, len(content)) + content


def _string(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _mapping(entries: Mapping[str, str]) -> bytes:
    body = b"".join(_string(key) + _string(value) for key, value in entries.items())
    return struct.pack("<I", len(body)) + body


def header(library: str) -> bytes:
    """The first record of a file."""
    return record(HEADER, _string("") + _string(library))


def schema(schema_id: int, name: str, encoding: str, data: bytes) -> bytes:
    """A message schema."""
    content = struct.pack("<H", schema_id) + _string(name) + _string(encoding) + struct.pack("<I", len(data)) + data
    return record(SCHEMA, content)


def channel(channel_id: int, schema_id: int, topic: str, encoding: str, metadata: Mapping[str, str]) -> bytes:
    """A channel: one topic with its schema and metadata."""
    head = struct.pack("<HH", channel_id, schema_id)
    return record(CHANNEL, head + _string(topic) + _string(encoding) + _mapping(metadata))


def message(channel_id: int, sequence: int, t_ns: int, data: bytes) -> bytes:
    """One message; log and publish time are the same."""
    return record(MESSAGE, MESSAGE_HEAD.pack(channel_id, sequence & 0xFFFFFFFF, t_ns, t_ns) + data)


def metadata(name: str, entries: Mapping[str, str]) -> bytes:
    """A named set of strings."""
    return record(METADATA, _string(name) + _mapping(entries))


def check(name: str, data: bytes, start: int = 0) -> bytes:
    """Metadata with the checksum of the bytes before it, which begins with ``start``."""
    return metadata(name, {"bytes": str(len(data)), "crc32": str(zlib.crc32(data, start))})


def index_entry(t_ns: int, offset: int) -> bytes:
    """A message's entry in a message index."""
    return struct.pack("<QQ", t_ns, offset)


def message_index(channel_id: int, entries: bytes) -> bytes:
    """Where the messages of a channel stand in the chunk before; ``entries`` are pairs of u64 (time, offset)."""
    return record(MESSAGE_INDEX, struct.pack("<HI", channel_id, len(entries)) + entries)


def chunk(start_ns: int, end_ns: int, raw: bytes, compressed: bytes) -> bytes:
    """A zstd chunk with the CRC of its uncompressed content."""
    head = _CHUNK_HEAD.pack(start_ns, end_ns, len(raw), zlib.crc32(raw))
    return record(CHUNK, head + _string("zstd") + struct.pack("<Q", len(compressed)) + compressed)


@dataclass(frozen=True)
class ChunkPlace:
    """Where a chunk and its message indexes stand; what the summary says of it."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    index_offsets: Mapping[int, int]
    index_length: int
    compressed: int
    uncompressed: int

    def record(self) -> bytes:
        """The chunk index record."""
        offsets = b"".join(struct.pack("<HQ", key, value) for key, value in self.index_offsets.items())
        return record(
            CHUNK_INDEX,
            struct.pack("<QQQQI", self.start_ns, self.end_ns, self.offset, self.length, len(offsets))
            + offsets
            + struct.pack("<Q", self.index_length)
            + _string("zstd")
            + struct.pack("<QQ", self.compressed, self.uncompressed),
        )


@dataclass(frozen=True)
class MetadataPlace:
    """Where a metadata record stands."""

    name: str
    offset: int
    length: int

    def record(self) -> bytes:
        """The metadata index record."""
        return record(METADATA_INDEX, struct.pack("<QQ", self.offset, self.length) + _string(self.name))


def statistics(
    schemas: int, channels: int, metadata_count: int, chunks: int, span_ns: tuple[int, int], messages: Mapping[int, int]
) -> bytes:
    """The statistics record; ``messages`` counts by channel."""
    counts = b"".join(struct.pack("<HQ", key, value) for key, value in messages.items())
    head = struct.pack("<QHIIII", sum(messages.values()), schemas, channels, 0, metadata_count, chunks)
    return record(STATISTICS, head + struct.pack("<QQI", *span_ns, len(counts)) + counts)


def ending(position: int, groups: list[tuple[int, bytes]]) -> bytes:
    """Data end, summary, footer and closing magic, to be written at ``position``.

    ``groups`` are (opcode, records of that opcode) in the order of the summary.
    """
    data_end = record(DATA_END, struct.pack("<I", 0))
    summary_start = position + len(data_end)
    summary, offsets = b"", b""
    for opcode, records in groups:
        if records:
            place = struct.pack("<BQQ", opcode, summary_start + len(summary), len(records))
            offsets += record(SUMMARY_OFFSET, place)
            summary += records
    body = summary + offsets
    starts = struct.pack("<QQ", summary_start, summary_start + len(summary))
    crc = zlib.crc32(body + RECORD_HEAD.pack(FOOTER, 20) + starts)
    return data_end + body + record(FOOTER, starts + struct.pack("<I", crc)) + MAGIC


class Cursor:
    """Reads the parts of a record, never beyond its end."""

    def __init__(self, data: bytes | memoryview) -> None:
        self._data = data
        self._at = 0

    def bytes(self, count: int) -> bytes:
        """The next ``count`` bytes.

        Raises
        ------
        MalformedRecord
            If there are not as many.
        """
        end = self._at + count
        if end > len(self._data):
            raise MalformedRecord(f"{count} bytes expected, {len(self._data) - self._at} there")
        part = bytes(self._data[self._at : end])
        self._at = end
        return part

    def number(self, size: int) -> int:
        """An unsigned number of ``size`` bytes."""
        return int.from_bytes(self.bytes(size), "little")

    @property
    def over(self) -> bool:
        """Whether there is no more."""
        return self._at >= len(self._data)

    def prefixed(self) -> memoryview:
        """Bytes with their length before them."""
        return memoryview(self.bytes(self.number(4)))

    def string(self) -> str:
        """A prefixed string."""
        try:
            return str(self.prefixed(), "utf-8")
        except UnicodeDecodeError as error:
            raise MalformedRecord("a string is not UTF-8") from error

    def mapping(self) -> dict[str, str]:
        """A prefixed map of strings."""
        inner = Cursor(self.prefixed())
        entries: dict[str, str] = {}
        while not inner.over:
            key = inner.string()
            entries[key] = inner.string()
        return entries


@dataclass(frozen=True)
class ChannelRecord:
    """A channel as read."""

    channel_id: int
    topic: str
    encoding: str
    metadata: dict[str, str]


def read_channel(content: memoryview) -> ChannelRecord:
    """A channel record's content."""
    cursor = Cursor(content)
    channel_id, _ = cursor.number(2), cursor.number(2)
    return ChannelRecord(channel_id, cursor.string(), cursor.string(), cursor.mapping())


def read_metadata(content: memoryview) -> tuple[str, dict[str, str]]:
    """Name and entries of a metadata record's content."""
    cursor = Cursor(content)
    return cursor.string(), cursor.mapping()


@dataclass(frozen=True)
class ChunkRecord:
    """A chunk as read, its content still compressed."""

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data: memoryview


def read_chunk(content: memoryview) -> ChunkRecord:
    """A chunk record's content, without copying its data."""
    if len(content) < _CHUNK_HEAD.size:
        raise MalformedRecord("a chunk without a head")
    start_ns, end_ns, size, crc = _CHUNK_HEAD.unpack_from(content)
    cursor = Cursor(content[_CHUNK_HEAD.size :])
    compression = cursor.string()
    length = cursor.number(8)
    start = _CHUNK_HEAD.size + 4 + len(compression.encode()) + 8
    if start + length > len(content):
        raise MalformedRecord("a chunk shorter than it says")
    return ChunkRecord(start_ns, end_ns, size, crc, compression, content[start : start + length])


def read_message_index(content: memoryview) -> tuple[int, int]:
    """Channel of a message index record's content, and how many messages it lists."""
    cursor = Cursor(content)
    channel_id, size = cursor.number(2), cursor.number(4)
    if size % 16 or len(content) != 6 + size:
        raise MalformedRecord("a message index that is not as long as it says")
    return channel_id, size // 16


def read_message_counts(content: memoryview) -> dict[int, int]:
    """How many messages of every channel there are, from a statistics record's content."""
    if len(content) < _STATISTICS_HEAD.size:
        raise MalformedRecord("statistics without a head")
    counts = Cursor(Cursor(content[_STATISTICS_HEAD.size - 4 :]).prefixed())
    found = {}
    while not counts.over:
        channel_id = counts.number(2)
        found[channel_id] = counts.number(8)
    return found


def read_footer(data: memoryview) -> tuple[int, int]:
    """Where the summary starts, and the checksum of it and of the footer up to the checksum; from a footer record."""
    if len(data) != FOOTER_SIZE or RECORD_HEAD.unpack_from(data) != (FOOTER, 20):
        raise MalformedRecord("no footer")
    start, _, crc = struct.unpack_from("<QQI", data, RECORD_HEAD.size)
    return start, crc


def records(data: memoryview, start: int) -> Iterator[tuple[int, int, memoryview]]:
    """Opcode, position and content of every whole record from ``start`` on; stops before a torn one."""
    at = start
    while at + RECORD_HEAD.size <= len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        end = at + RECORD_HEAD.size + length
        if opcode == 0 or end > len(data):
            return
        yield opcode, at, data[at + RECORD_HEAD.size : end]
        at = end
