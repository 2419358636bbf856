"""What the disk did not take: rows that become gaps, and events that are written later."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.daq.recording.model import Gap

NOT_WRITTEN = "not written"
"""Samples that were received, but the disk did not take them."""

DISK_STALLED = "the disk has stalled"
"""Problem that is reported while rows are left out."""

Event = tuple[str, int, dict[str, Any]]
"""Topic, SYNC number and entries."""


class RowRanges:
    """Rows of streams, from one SYNC to another; what goes on without a seam is one span.

    Parameters
    ----------
    every
        Of each stream, on every how many SYNCs it has a row.
    """

    def __init__(self, every: Mapping[str, int]) -> None:
        self._every = dict(every)
        self._spans: dict[str, list[tuple[int, int]]] = {name: [] for name in every}

    def __bool__(self) -> bool:
        return any(self._spans.values())

    def add(self, stream: str, sync: NDArray[np.int64]) -> None:
        """Add rows by their SYNCs, shape (N,), which may have gaps."""
        breaks = [0, *(np.flatnonzero(np.diff(sync) != self._every[stream]) + 1).tolist(), len(sync)]
        for begin, end in pairwise(breaks):
            self.add_span(stream, int(sync[begin]), int(sync[end - 1]))

    def add_span(self, stream: str, first: int, last: int) -> None:
        """Add the rows from SYNC ``first`` to ``last``."""
        spans = self._spans[stream]
        if spans and first == spans[-1][1] + self._every[stream]:
            first = spans.pop()[0]
        spans.append((first, last))

    def take(self) -> "RowRanges":
        """All of it, which is then elsewhere."""
        taken = RowRanges(self._every)
        taken._spans, self._spans = self._spans, taken._spans
        return taken

    def before(self, other: "RowRanges") -> "RowRanges":
        """These rows, and those of another that came later."""
        both = RowRanges(self._every)
        for spans in (self._spans, other._spans):
            for stream, found in spans.items():
                for first, last in found:
                    both.add_span(stream, first, last)
        return both

    @property
    def rows(self) -> int:
        """How many."""
        return sum(
            (last - first) // self._every[name] + 1 for name, spans in self._spans.items() for first, last in spans
        )

    def gaps(self) -> list[Gap]:
        """Them as gaps."""
        return [Gap(name, *span, None, NOT_WRITTEN) for name, spans in self._spans.items() for span in spans]


class LostRows:
    """Rows and events of chunks that failed, and those of the chunk that is being gathered.

    Parameters
    ----------
    every
        Of each stream, on every how many SYNCs it has a row.
    """

    def __init__(self, every: Mapping[str, int]) -> None:
        self._gathered, self._lost = RowRanges(every), RowRanges(every)
        self.events: list[Event] = []

    def gather(self, stream: str, sync: NDArray[np.int64]) -> None:
        """Rows of these SYNCs are in the chunk."""
        self._gathered.add(stream, sync)

    def lose(self, rows: RowRanges) -> None:
        """Rows that never came into a chunk are lost."""
        self._lost = self._lost.before(rows)

    def failed(self) -> None:
        """The chunk was not written: its rows are lost, its events are not."""
        self.lose(self._gathered.take())

    def written(self) -> None:
        """The chunk was written, and with it what was not before."""
        self.events = []
        self._gathered.take()
        self._lost.take()

    def gaps(self) -> list[Gap]:
        """The rows that were lost."""
        return self._lost.gaps()

    def take_over(self, other: "LostRows") -> None:
        """Take what another file could not be told."""
        self.events += other.events
        self._lost = other._lost.before(self._lost)
