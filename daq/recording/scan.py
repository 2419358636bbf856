"""One pass over the records of a recording, in file order and checked, for reading and for recovery."""

import zlib
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import lz4.frame
import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Statistics

from armident.configs import DataError
from armident.daq.recording import mcap_records as mcap
from armident.daq.recording.layout import StreamLayout
from armident.daq.recording.names import (
    CHECK,
    COUNTERS,
    LAYOUT_KEY,
    LIBRARY,
    RECORDING,
    RECOVERED,
    ROBOT,
    ROWS_OF,
    SESSION,
)

LARGEST_CHUNK = 1 << 28
"""Largest uncompressed chunk that is read, bytes."""
_PIECE = 1 << 20
"""Bytes that are decompressed at a time where the size is not known beforehand."""
_lz4_decompressor: Any = lz4.frame.LZ4FrameDecompressor
_WORKERS, _CHUNKS_AHEAD = 2, 16
"""Threads that decompress, and chunks they may be ahead of the scan."""
_IN_DATA = frozenset(
    map(
        int,
        (
            Opcode.HEADER,
            Opcode.SCHEMA,
            Opcode.CHANNEL,
            Opcode.MESSAGE,
            Opcode.CHUNK,
            Opcode.MESSAGE_INDEX,
            Opcode.ATTACHMENT,
            Opcode.METADATA,
            Opcode.DATA_END,
        ),
    )
)
"""Opcodes that may precede the summary."""
WRITTEN_ONCE = (RECORDING, ROBOT, SESSION)
"""Metadata of which a file has one record: another content belongs to another recording."""


class MessageRun(NamedTuple):
    """Consecutive messages of one channel in a chunk. ``start``, ``end``: position in the uncompressed chunk, bytes."""

    channel_id: int
    start: int
    end: int
    number: int


class MessageIndexContent(NamedTuple):
    """Content of a message index record. ``number``: number of entries."""

    channel_id: int
    number: int


@dataclass(frozen=True)
class RecordItem:
    """Valid record other than a chunk, with its position in bytes; ``content`` is ``None`` if it was not decoded."""

    opcode: int
    start: int
    end: int
    content: Channel | Metadata | MessageIndexContent | None


@dataclass(frozen=True)
class ChunkItem:
    """A valid chunk, in bytes ``start`` to ``end``; ``raw`` has its records, ``runs`` its messages in order."""

    start: int
    end: int
    body: memoryview
    raw: bytes
    runs: list[MessageRun]

    def message_counts(self) -> dict[int, int]:
        """Return the number of messages by channel."""
        counts: dict[int, int] = {}
        for run in self.runs:
            counts[run.channel_id] = counts.get(run.channel_id, 0) + run.number
        return counts


@dataclass(frozen=True)
class LooseMessage(ChunkItem):
    """A valid message outside a chunk, as other tools write it; ``raw`` is its record, and ``body`` its content."""


@dataclass(frozen=True)
class DamageItem:
    """Damaged record. ``opcode``: MCAP opcode; ``start``, ``end``: position in the file, bytes."""

    opcode: int
    start: int
    end: int


Item = RecordItem | ChunkItem | DamageItem
_Pending = tuple[int, int, memoryview, "Future[bytes | None] | None"]


class RecordingScan:
    """Iterates over the records up to the end of the data, and collects the content of those other than chunks.

    A damaged record behind the head is skipped and described in ``damage``; other threads decompress chunks ahead. A
    file of another MCAP tool (``rewritten``) is judged by its chunks' checksums, numbers of messages and metadata.

    By channel id: ``channels``, ``layouts``, ``messages`` so far, ``expected`` (``None``: the summary is invalid, or
    ``part`` of the chunks have been left out).
    ``finished``: data end and closing magic are there. ``end``: end of the last complete record, bytes.
    """

    def __init__(self, data: memoryview, *, part: bool = False) -> None:
        if bytes(data[: len(mcap.MAGIC)]) != mcap.MAGIC:
            raise DataError("not a recording (not an MCAP file)")
        self.channels: dict[int, Channel] = {}
        self.layouts: dict[int, StreamLayout] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.messages: dict[int, int] = {}
        self.expected = None if part else expected_messages(data)
        self.damage: list[str] = []
        self.head_crc: int | None = None
        self.finished = self.rewritten = False
        self.end = 0
        self._data, self._part, self._foreign = data, part, False

    def __iter__(self) -> Iterator[Item]:
        """Yield the records in file order, the data end last; MalformedRecord at a damaged head."""
        with ThreadPoolExecutor(_WORKERS, "zstd") as pool:
            for opcode, start, body, chunk in self._read_ahead(pool):
                end = start + mcap.RECORD_HEAD.size + len(body)
                item: Item | None = None
                try:
                    if opcode == Opcode.MESSAGE:
                        record = bytes(self._data[start:end])
                        item = LooseMessage(start, end, body, record, self._runs(record))
                    elif chunk is None:
                        item = RecordItem(opcode, start, end, self._decoded(opcode, start, body))
                    elif (raw := chunk.result()) is not None:
                        item = ChunkItem(start, end, body, raw, self._runs(raw))
                    else:
                        self.damage.append(f"the chunk at byte {start} is damaged and left out")
                except mcap.MalformedRecord as error:
                    if chunk is None and self.head_crc is None:
                        raise
                    self.damage.append(f"the record at byte {start} is damaged and left out ({error})")
                self.end = end
                if isinstance(item, ChunkItem):
                    for channel, count in item.message_counts().items():
                        self.messages[channel] = self.messages.get(channel, 0) + count
                elif item is None and chunk is None:
                    # Either the counters or their checksum may be damaged.
                    self.metadata.pop(COUNTERS, None)
                yield item or DamageItem(opcode, start, end)
                if opcode == Opcode.DATA_END:
                    break
        self.finished = self.finished and bytes(self._data[-len(mcap.MAGIC) :]) == mcap.MAGIC

    def missing(self, last_sync: int | None) -> list[str]:
        """Return descriptions of missing parts after the iteration, by the SYNC of the last sample (``None``: none)."""
        words = list(self.damage)
        if self.rewritten and self.finished and COUNTERS not in self.metadata and RECOVERED not in self.metadata:
            words.append(
                "the recording was not finished when another tool rewrote it: its last rows and counters are missing"
            )
        if not self._part and (self.rewritten or (self.finished and not self.damage)):
            left = self._by_topic(self.messages)
            words += [
                f"{left.get(topic, 0)} of {count} messages of topic {topic} are left"
                for topic, count in self._written()
                if count != left.get(topic, 0)
            ]
        if self.finished and self.expected is None and not (self._part or self._foreign):
            words.append("the summary at the end of the file is damaged: it does not tell if messages are missing")
        if not self.finished:
            since = "from the start" if last_sync is None else f"after SYNC {last_sync}"
            words.append(
                f"the file was not finished: rows {since} and the counters are missing"
                f" ({len(self._data) - self.end} bytes left out)"
            )
        return words

    def _written(self) -> list[tuple[str, int]]:
        """Return topics and numbers of messages by the summary, and by the checksum record of a file not recovered."""
        stated = {} if RECOVERED in self.metadata else self.metadata.get(CHECK, {})
        rows = {
            (key.removeprefix(ROWS_OF), int(value))
            for key, value in stated.items()
            if key.startswith(ROWS_OF) and value.isdecimal()
        }
        return sorted(rows | set(self._by_topic(self.expected or {}).items()))

    def _by_topic(self, numbers: dict[int, int]) -> dict[str, int]:
        """Return sums, by topic, of the numbers of messages by channel id; unknown channels are left out."""
        sums: dict[str, int] = {}
        for k, number in numbers.items():
            if k in self.channels:
                sums[self.channels[k].topic] = sums.get(self.channels[k].topic, 0) + number
        return sums

    def _read_ahead(self, pool: ThreadPoolExecutor) -> Iterator[_Pending]:
        """Yield the records in file order, with the futures of the chunks."""
        waiting: deque[_Pending] = deque()
        chunks = 0
        for opcode, at, body in mcap.records(self._data, len(mcap.MAGIC)):
            future = None
            if opcode == Opcode.CHUNK:
                # All records before the first chunk are decoded by now, so it is known if chunks must have checksums.
                future = pool.submit(_uncompressed, body, self.head_crc is not None)
                chunks += 1
            waiting.append((opcode, at, body, future))
            while waiting and (chunks > _CHUNKS_AHEAD or chunks == 0):
                chunks -= waiting[0][3] is not None
                yield waiting.popleft()
        yield from waiting

    def _decoded(self, opcode: int, at: int, body: memoryview) -> Channel | Metadata | MessageIndexContent | None:
        """Check a record at byte ``at``, register its content and return it; MalformedRecord if it is wrong."""
        if opcode not in _IN_DATA:
            raise mcap.MalformedRecord(f"a record of kind {opcode:02X}h before the end of the data")
        if opcode == Opcode.MESSAGE_INDEX:
            return MessageIndexContent(*mcap.read_message_index(body))
        if opcode == Opcode.CHANNEL:
            channel = mcap.decode(Channel, body)
            self._add_channel(channel)
            return channel
        if opcode == Opcode.METADATA:
            metadata = mcap.decode(Metadata, body)
            if metadata.name == CHECK:
                moved = self._foreign and self.head_crc is None and self._is_moved(metadata.metadata, at)
                self.rewritten = self.rewritten or moved
                if not self.rewritten:
                    crc = self._verified(metadata.metadata, at)
                    self.head_crc = crc if self.head_crc is None else self.head_crc
                self.metadata[CHECK] = self.metadata.get(CHECK, {}) | metadata.metadata
            elif metadata.name not in WRITTEN_ONCE:
                self.metadata[metadata.name] = metadata.metadata
            elif self.metadata.setdefault(metadata.name, metadata.metadata) != metadata.metadata:
                raise mcap.MalformedRecord(f"another {metadata.name} than at the start of the file")
            return metadata
        if opcode == Opcode.HEADER:
            self._foreign = not mcap.decode(Header, body).library.startswith(LIBRARY)
        self.finished = opcode == Opcode.DATA_END
        return None

    def _is_moved(self, entries: dict[str, str], at: int) -> bool:
        """Return True if the first checksum record, at byte ``at``, was made at another place of another file.

        It covers all bytes before it. If one of its two numbers is damaged, the other one still fits them.
        """
        size, crc = entries.get("bytes", ""), entries.get("crc32", "")
        return size.isdecimal() and crc.isdecimal() and int(size) != at and int(crc) != zlib.crc32(self._data[:at])

    def _verified(self, entries: dict[str, str], at: int) -> int:
        """Return the CRC-32 that a checksum record at byte ``at`` states, if it is right."""
        try:
            size, crc = int(entries["bytes"]), int(entries["crc32"])
        except (KeyError, ValueError) as error:
            raise mcap.MalformedRecord("a checksum record without a checksum") from error
        if not 0 < size <= at or zlib.crc32(self._data[at - size : at], self.head_crc or 0) != crc:
            raise mcap.MalformedRecord(f"wrong checksum of the {size} bytes before byte {at}")
        return crc

    def _add_channel(self, channel: Channel) -> None:
        if self.channels.setdefault(channel.id, channel) != channel:
            raise mcap.MalformedRecord(f"another channel {channel.id}")
        if LAYOUT_KEY in channel.metadata:
            self.layouts[channel.id] = StreamLayout.from_json(channel.metadata[LAYOUT_KEY])

    def _runs(self, raw: bytes) -> list[MessageRun]:
        """Return the messages in a chunk's records; channels in it are registered."""
        runs = []
        at = 0
        while at + mcap.RECORD_HEAD.size <= len(raw):
            opcode, length = mcap.RECORD_HEAD.unpack_from(raw, at)
            body = at + mcap.RECORD_HEAD.size
            end = body + length
            if end > len(raw):
                raise mcap.MalformedRecord("a record reaches beyond its chunk")
            if opcode == Opcode.CHANNEL:
                self._add_channel(mcap.decode(Channel, memoryview(raw)[body:end]))
            elif opcode == Opcode.MESSAGE and length >= mcap.MESSAGE_HEAD.size:
                channel_id = mcap.MESSAGE_HEAD.unpack_from(raw, body)[0]
                run = self._run(raw, channel_id, at, end)
                runs.append(run)
                end = run.end
            at = end
        return runs

    def _run(self, raw: bytes, channel_id: int, at: int, end: int) -> MessageRun:
        """Return the run that begins with the message in bytes ``at`` to ``end``."""
        layout = self.layouts.get(channel_id)
        if layout is not None:
            count = layout.run_length(raw, at, channel_id)
            if count == 0:
                raise DataError(f"a message of topic {layout.topic} has another length than its channel states")
            return MessageRun(channel_id, at, at + count * layout.record[0].itemsize, count)
        if channel_id not in self.channels:
            raise mcap.MalformedRecord(f"messages of a channel {channel_id} that the file does not define")
        return MessageRun(channel_id, at, end, 1)


def expected_messages(data: memoryview) -> dict[int, int] | None:
    """Return the number of messages by channel id of a file's summary; ``None`` without a valid one."""
    try:
        for opcode, body in summary_records(data) or ():
            if opcode == Opcode.STATISTICS:
                return dict(mcap.decode(Statistics, body).channel_message_counts)
    except mcap.MalformedRecord:
        return None
    return None


def summary_records(data: memoryview, begin: int = 0) -> Iterator[tuple[int, memoryview]] | None:
    """Return opcode and content of the records of a valid summary, from byte ``begin`` on; ``None`` without one."""
    footer_start = len(data) - len(mcap.MAGIC) - mcap.FOOTER_SIZE
    footer_end = footer_start + mcap.FOOTER_SIZE
    if begin + footer_start < len(mcap.MAGIC) or footer_start < 0 or bytes(data[footer_end:]) != mcap.MAGIC:
        return None
    footer = mcap.read_footer(data[footer_start:footer_end])
    start, crc = footer.summary_start - begin, footer.summary_crc
    whole = footer.summary_start > 0 and 0 <= start <= footer_start
    if not whole or (crc and zlib.crc32(data[start : footer_end - 4]) != crc):
        return None
    return ((opcode, body) for opcode, _, body in mcap.records(data[:footer_start], start))


def _uncompressed(body: memoryview, checked: bool) -> bytes | None:
    """Return the records in a chunk, or ``None`` if it is damaged; a ``checked`` one must have a checksum."""
    try:
        chunk = mcap.read_chunk(body)
    except mcap.MalformedRecord:
        return None
    if chunk.size > LARGEST_CHUNK:
        return None
    raw = _decompressed(chunk)
    if raw is None:
        return None
    if len(raw) != chunk.size or ((checked or chunk.crc) and zlib.crc32(raw) != chunk.crc):
        return None
    return raw


def _decompressed(chunk: mcap.ChunkContent) -> bytes | None:
    """Return the records in a chunk of any compression that MCAP has, or ``None`` if they cannot be decompressed."""
    if chunk.compression == "":
        return bytes(chunk.data)
    if chunk.compression == "lz4":
        return _from_lz4(chunk)
    if chunk.compression != mcap.COMPRESSION:
        return None
    try:
        # Memory is reserved by the size in the zstd frame, never by that in the chunk's head alone.
        size = zstandard.frame_content_size(chunk.data)
        if size == chunk.size:
            return zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=chunk.size)
        # Other tools write several frames, or frames without their size. Memory grows with what is in them.
        with zstandard.ZstdDecompressor().stream_reader(chunk.data, read_across_frames=True) as reader:
            return _limited(iter(lambda: reader.read(_PIECE), b""), chunk.size)
    except zstandard.ZstdError:
        return None


def _from_lz4(chunk: mcap.ChunkContent) -> bytes | None:
    """Return the records in a chunk that another tool has compressed with lz4."""
    decompressor: Any = _lz4_decompressor()

    def pieces() -> Iterator[bytes]:
        data = bytes(chunk.data)
        while not decompressor.eof:
            piece = decompressor.decompress(data, max_length=_PIECE)
            if not piece and not data:
                return
            data = b""
            yield piece

    try:
        return _limited(pieces(), chunk.size)
    except (RuntimeError, EOFError, ValueError):
        return None


def _limited(pieces: Iterator[bytes], most: int) -> bytes:
    """Return pieces in one, up to the first that goes beyond ``most`` bytes."""
    whole = bytearray()
    for piece in pieces:
        whole += piece
        if len(whole) > most:
            break
    return bytes(whole)
