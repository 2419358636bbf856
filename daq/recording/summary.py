"""What the end of a recording says of the rest: where chunks and metadata stand, and how many messages there are."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from armident.daq.recording import mcap_records as mcap


@dataclass
class Summary:
    """The summary of a file that grows chunk by chunk.

    Parameters
    ----------
    schemas, channels
        Their records, as in the file.
    chunks, metadata
        Where they stand.
    messages
        How many of every channel there are.
    span_ns
        First and last time of all messages, ns; ``None`` while there is none.
    """

    schemas: list[bytes] = field(default_factory=list)
    channels: list[bytes] = field(default_factory=list)
    chunks: list[mcap.ChunkPlace] = field(default_factory=list)
    metadata: list[mcap.MetadataPlace] = field(default_factory=list)
    messages: dict[int, int] = field(default_factory=dict)
    span_ns: tuple[int, int] | None = None

    def add_chunk(self, place: mcap.ChunkPlace, messages: Mapping[int, int]) -> None:
        """Count a chunk that is in the file, and how many messages of every channel it holds."""
        self.chunks.append(place)
        for channel, count in messages.items():
            self.messages[channel] = self.messages.get(channel, 0) + count
        low, high = self.span_ns or (place.start_ns, place.end_ns)
        self.span_ns = min(low, place.start_ns), max(high, place.end_ns)

    def ending(self, position: int) -> bytes:
        """Everything that comes after the last record, to be written at ``position``."""
        statistics = mcap.statistics(
            len(self.schemas),
            len(self.channels),
            len(self.metadata),
            len(self.chunks),
            self.span_ns or (0, 0),
            self.messages,
        )
        groups = [
            (mcap.SCHEMA, b"".join(self.schemas)),
            (mcap.CHANNEL, b"".join(self.channels)),
            (mcap.STATISTICS, statistics),
            (mcap.CHUNK_INDEX, b"".join(place.record() for place in self.chunks)),
            (mcap.METADATA_INDEX, b"".join(place.record() for place in self.metadata)),
        ]
        return mcap.ending(position, groups)
