"""Rows that could not be written, which become gaps, and events that are written later."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.daq.recording.model import Gap

NOT_WRITTEN = "not written"
"""Reason of gaps whose samples were received but not written."""

DISK_STALLED = "the disk has stalled"
"""Problem that is reported while rows are left out."""

Event = tuple[str, int, dict[str, Any]]
"""Topic, SYNC number and JSON entries of an event."""


class RowRanges:
    """Ranges of rows, by stream of one row per ``every`` SYNCs: first and last SYNC; adjacent ranges are merged."""

    def __init__(self, every: Mapping[str, int]) -> None:
        self._every = dict(every)
        self._spans: dict[str, list[tuple[int, int]]] = {name: [] for name in every}

    def __bool__(self) -> bool:
        return any(self._spans.values())

    def add(self, stream: str, sync: NDArray[np.int64]) -> None:
        """Add rows. ``sync``: SYNC numbers of the rows, (N,), increasing; they may have gaps."""
        breaks = [0, *(np.flatnonzero(np.diff(sync) != self._every[stream]) + 1).tolist(), len(sync)]
        for begin, end in pairwise(breaks):
            self.add_span(stream, int(sync[begin]), int(sync[end - 1]))

    def add_span(self, stream: str, first: int, last: int) -> None:
        """Add a range of rows. ``first``, ``last``: first and last SYNC number, both inclusive."""
        spans = self._spans[stream]
        if spans and first == spans[-1][1] + self._every[stream]:
            first = spans.pop()[0]
        spans.append((first, last))

    def take(self) -> "RowRanges":
        """Return all ranges and clear this object."""
        taken = RowRanges(self._every)
        taken._spans, self._spans = self._spans, taken._spans
        return taken

    def before(self, other: "RowRanges") -> "RowRanges":
        """Return these ranges followed by later ones of ``other``."""
        both = RowRanges(self._every)
        for spans in (self._spans, other._spans):
            for stream, found in spans.items():
                for first, last in found:
                    both.add_span(stream, first, last)
        return both

    @property
    def rows(self) -> int:
        """Number of rows."""
        return sum(
            (last - first) // self._every[name] + 1 for name, spans in self._spans.items() for first, last in spans
        )

    def gaps(self) -> list[Gap]:
        """Return the ranges as gaps."""
        return [Gap(name, *span, None, NOT_WRITTEN) for name, spans in self._spans.items() for span in spans]


class LostRows:
    """Rows and events of chunks that could not be written, and rows of the chunk that is being gathered."""

    def __init__(self, every: Mapping[str, int]) -> None:
        self._gathered, self._lost = RowRanges(every), RowRanges(every)
        self.events: list[Event] = []

    def gather(self, stream: str, sync: NDArray[np.int64]) -> None:
        """Count rows as part of the current chunk. ``sync``: SYNC numbers of the rows, (N,)."""
        self._gathered.add(stream, sync)

    def add_lost(self, rows: RowRanges) -> None:
        """Count rows that never came into a chunk as lost."""
        self._lost = self._lost.before(rows)

    def failed(self) -> None:
        """Count the rows of the current chunk as lost; its events are kept."""
        self.add_lost(self._gathered.take())

    def written(self) -> None:
        """Clear all: the chunk was written, with the gaps and events that were pending."""
        self.events = []
        self._gathered.take()
        self._lost.take()

    def gaps(self) -> list[Gap]:
        """Return the lost rows as gaps."""
        return self._lost.gaps()

    def take_over(self, other: "LostRows") -> None:
        """Add the lost rows and events of another file that could not be finished."""
        self.events += other.events
        self._lost = other._lost.before(self._lost)
