"""What the disk did not take: rows that become gaps, and events that are written later."""

from collections.abc import Mapping
from typing import Any

from daq.recording.model import Gap

NOT_WRITTEN = "not written"
"""Samples that were received, but the disk did not take them."""

Event = tuple[str, int, dict[str, Any]]
"""Topic, SYNC number and entries."""


class Unwritten:
    """Rows and events of chunks that failed, and those of the chunk that is being gathered.

    Parameters
    ----------
    every
        Of each stream, on every how many SYNCs it has a row.
    """

    def __init__(self, every: Mapping[str, int]) -> None:
        self._every = dict(every)
        self._gathered: list[tuple[str, int, int]] = []
        self._lost: dict[str, list[tuple[int, int]]] = {name: [] for name in every}
        self.events: list[Event] = []

    def gather(self, stream: str, first: int, last: int) -> None:
        """Rows from SYNC ``first`` to ``last`` are in the chunk."""
        self._gathered.append((stream, first, last))

    def failed(self) -> None:
        """The chunk was not written: its rows are lost, its events are not."""
        for stream, first, last in self._gathered:
            spans = self._lost[stream]
            if spans and first == spans[-1][1] + self._every[stream]:
                first = spans.pop()[0]
            spans.append((first, last))
        self._gathered = []

    def written(self) -> None:
        """The chunk was written, and with it what was not before."""
        self._gathered, self.events = [], []
        self._lost = {name: [] for name in self._lost}

    def gaps(self) -> list[Gap]:
        """The rows that were lost."""
        return [Gap(name, *span, None, NOT_WRITTEN) for name, spans in self._lost.items() for span in spans]

    def take_over(self, other: "Unwritten") -> None:
        """Take what another file could not be told."""
        self.events += other.events
        for stream, spans in other._lost.items():
            self._lost[stream] = spans + self._lost[stream]
