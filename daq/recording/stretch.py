"""A stretch of a recording: the parts of its file that are needed, and the rows in it."""

import mmap
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex

from armident.daq.recording import mcap_records as mcap
from armident.daq.recording.model import Mark, Recording
from armident.daq.recording.names import GAPS_TOPIC, MARKS_TOPIC
from armident.daq.recording.scan import summary_records

_PIECE = 1 << 24
"""Most bytes fetched at a time."""
_EXPERIMENT = ("experiment_start", "experiment_end")


@dataclass(frozen=True)
class ChunkTable:
    """Chunks of a finished file by its summary; ``events``: ids of the channels of gaps and marks."""

    chunks: tuple[ChunkIndex, ...]
    events: frozenset[int]
    size: int

    @property
    def begin_ns(self) -> int:
        """Time of the first message, ns UTC."""
        return min((chunk.message_start_time for chunk in self.chunks), default=0)

    def needed(self, window_ns: tuple[int, int]) -> list[tuple[int, int]]:
        """Return the bytes (first, behind the last) of all but the chunks outside a window without gaps and marks."""
        parts, at = [], 0
        for chunk in self.chunks:
            outside = chunk.message_end_time < window_ns[0] or chunk.message_start_time > window_ns[1]
            channels = chunk.message_index_offsets.keys()
            start = chunk.chunk_start_offset
            if outside and channels and not self.events & channels and start >= at:
                parts.append((at, start))
                at = start + chunk.chunk_length + chunk.message_index_length
        return [(first, end) for first, end in (*parts, (at, self.size)) if first < end]


def window(begin_ns: int, between_s: tuple[float, float]) -> tuple[int, int]:
    """Return two times in seconds after the begin of a recording as ns UTC."""
    return begin_ns + round(between_s[0] * 1e9), begin_ns + round(between_s[1] * 1e9)


def chunk_table(file: BinaryIO) -> ChunkTable | None:
    """Return the chunks of a file by its summary, of which alone bytes are read; ``None`` without a valid one."""
    size = file.seek(0, os.SEEK_END)
    footer_start = size - len(mcap.MAGIC) - mcap.FOOTER_SIZE
    if footer_start < len(mcap.MAGIC):
        return None
    try:
        footer = mcap.read_footer(memoryview(_bytes(file, footer_start, size))[: mcap.FOOTER_SIZE])
        records = summary_records(memoryview(_bytes(file, footer.summary_start, size)), footer.summary_start)
        if records is None:
            return None
        found = list(records)
        channels = [mcap.decode(Channel, body) for opcode, body in found if opcode == Opcode.CHANNEL]
        chunks = [mcap.decode(ChunkIndex, body) for opcode, body in found if opcode == Opcode.CHUNK_INDEX]
    except mcap.MalformedRecord:
        return None
    events = frozenset(channel.id for channel in channels if channel.topic in (GAPS_TOPIC, MARKS_TOPIC))
    return ChunkTable(tuple(sorted(chunks, key=lambda chunk: chunk.chunk_start_offset)), events, size)


def copied(file: BinaryIO, parts: Sequence[tuple[int, int]]) -> mmap.mmap:
    """Return parts of a file, one behind the other, in a file without a name, so that they take no memory."""
    with tempfile.TemporaryFile() as copy:
        for first, end in parts:
            for at in range(first, end, _PIECE):
                copy.write(_bytes(file, at, min(at + _PIECE, end)))
        copy.flush()
        return mmap.mmap(copy.fileno(), 0, access=mmap.ACCESS_READ)


def _bytes(file: BinaryIO, first: int, end: int) -> bytes:
    file.seek(first)
    return file.read(end - first)


def stretch_of(recording: Recording, window_ns: tuple[int, int]) -> Recording:
    """Return the rows of a recording in a window, ns UTC, with their gaps and the parts of experiments; no counters."""
    streams = {}
    for name, stream in recording.streams.items():
        inside = (stream.t_ns >= window_ns[0]) & (stream.t_ns <= window_ns[1])
        raw = {field: values[inside] for field, values in stream.raw.items()}
        streams[name] = replace(stream, sync=stream.sync[inside], t_ns=stream.t_ns[inside], raw=raw)
    sync = streams["samples"].sync
    first, last = (int(sync[0]), int(sync[-1])) if sync.size else (0, -1)
    marks = [mark for mark in recording.marks if first <= mark.sync <= last and mark.kind not in _EXPERIMENT]
    if any(mark.kind in _EXPERIMENT for mark in recording.marks):
        for begin, end in recording.experiments():
            if begin <= last and end >= first:
                marks.append(Mark("experiment_start", max(begin, first), window_ns[0]))
                marks.append(Mark("experiment_end", min(end, last), window_ns[1]))
    gaps = tuple(gap for gap in recording.gaps if gap.first <= last and gap.last >= first)
    return replace(recording, streams=streams, marks=tuple(marks), gaps=gaps, counters={})
