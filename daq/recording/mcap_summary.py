"""The summary section of a recording: chunk and metadata indexes, and statistics."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, DataEnd, Footer, MetadataIndex, Statistics, SummaryOffset

from armident.daq.recording import mcap_records as mcap


@dataclass
class Summary:
    """The summary of a file that grows chunk by chunk; ``span_ns``: earliest and latest log time, ns."""

    schemas: list[bytes] = field(default_factory=list)
    channels: list[bytes] = field(default_factory=list)
    chunks: list[ChunkIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    messages: dict[int, int] = field(default_factory=dict)
    span_ns: tuple[int, int] | None = None

    def add_chunk(self, index: ChunkIndex, messages: Mapping[int, int]) -> None:
        """Add a chunk. ``index``: index record of the chunk; ``messages``: number of its messages by channel."""
        self.chunks.append(index)
        for channel, count in messages.items():
            self.messages[channel] = self.messages.get(channel, 0) + count
        low, high = self.span_ns or (index.message_start_time, index.message_end_time)
        self.span_ns = min(low, index.message_start_time), max(high, index.message_end_time)

    def encode(self, position: int) -> bytes:
        """Return data end, summary, footer and magic, to be written at byte ``position``."""
        data_end = mcap.encode(DataEnd(data_section_crc=0))
        start = position + len(data_end)
        groups = {
            Opcode.SCHEMA: self.schemas,
            Opcode.CHANNEL: self.channels,
            Opcode.STATISTICS: [mcap.encode(self._statistics())],
            Opcode.CHUNK_INDEX: [mcap.encode(index) for index in self.chunks],
            Opcode.METADATA_INDEX: [mcap.encode(index) for index in self.metadata],
        }
        summary, offsets = b"", b""
        for opcode, records in groups.items():
            if records:
                group = b"".join(records)
                offsets += mcap.encode(SummaryOffset(opcode, start + len(summary), len(group)))
                summary += group
        footer = Footer(summary_start=start, summary_offset_start=start + len(summary), summary_crc=0)
        # The CRC covers the footer up to the CRC itself.
        footer.summary_crc = zlib.crc32(summary + offsets + mcap.encode(footer)[:-4])
        return data_end + summary + offsets + mcap.encode(footer) + mcap.MAGIC

    def _statistics(self) -> Statistics:
        first, last = self.span_ns or (0, 0)
        return Statistics(
            attachment_count=0,
            channel_count=len(self.channels),
            channel_message_counts=self.messages,
            chunk_count=len(self.chunks),
            message_count=sum(self.messages.values()),
            message_end_time=last,
            message_start_time=first,
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )
