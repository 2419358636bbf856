"""Output of captured rows: the recording, and Zenoh."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig, SessionConfig
from armident.daq.capture.batches import FileBoundaries, SamplesFirst, pieces
from armident.daq.capture.publisher import Publisher
from armident.daq.matching.assembler import Batch, Rows
from armident.daq.matching.streams import CapturedStream
from armident.daq.recording import Gap, Mark, QueuedSeries
from armident.daq.recording.model import MarkKind
from armident.daq.streaming import Block, encode_event
from armident.daq.streaming.codec import end_content, start_content


class Sink:
    """Writes batches to the recording, publishes them on Zenoh, and places marks at their SYNC."""

    def __init__(
        self,
        writer: QueuedSeries,
        publisher: Publisher,
        streams: Sequence[CapturedStream],
        capture: str,
    ) -> None:
        self.gaps: list[Gap] = []
        self.marks: list[Mark] = []
        self.first_sync: int | None = None
        self.last_sync = -1
        self.last_raw: dict[str, NDArray[Any]] = {}
        """Newest values of the samples by object, each (n,), in units of the drive."""
        self.last_ns = 0
        self._writer, self._publisher = writer, publisher
        self._streams, self._capture = tuple(streams), capture
        self._samples_first, self._file_boundaries = SamplesFirst(), FileBoundaries()
        self._blocks = 0
        self._planned: list[tuple[MarkKind, int, str]] = []

    @property
    def path(self) -> Path | None:
        """Path of the current file; ``None`` if none is open."""
        return self._writer.path

    @property
    def lost_rows(self) -> int:
        """Number of rows that could not be written."""
        return self._writer.lost_rows

    @property
    def waiting_rows(self) -> int:
        """Number of rows that wait for the disk."""
        return self._writer.waiting_rows

    @property
    def waiting_share(self) -> float:
        """Used share of the memory for rows that wait for the disk."""
        return self._writer.waiting_share

    @property
    def problem(self) -> str | None:
        """Message of the last error in writing."""
        return self._writer.problem

    def announce(
        self, robot: RobotConfig, session: SessionConfig, sample_rate_hz: float, metadata: dict[str, str]
    ) -> None:
        """Publish the start of the capture. ``metadata``: metadata of the recording."""
        layouts = [stream.layout for stream in self._streams]
        content = start_content(self._capture, robot, session, sample_rate_hz, layouts, metadata)
        self._publisher.event(encode_event("experiment_start", content))

    def mark(self, kind: MarkKind, sync: int, text: str = "") -> None:
        """Place a mark, at once or when its SYNC has been received."""
        self._planned.append((kind, sync, text))
        self._place_marks(False)

    def trigger(self) -> None:
        """Write the seconds before and after the newest sample, in a capture with triggers."""
        self._writer.trigger(self.last_ns)

    def move_mark(self, kind: MarkKind, sync: int, text: str) -> None:
        """Place a mark at another SYNC than planned."""
        self._planned = [planned for planned in self._planned if planned[0] != kind]
        self.mark(kind, sync, text)

    def take(self, batch: Batch) -> None:
        """Write and publish matched rows. ``batch``: rows and gaps from the assembler."""
        for piece in pieces(self._samples_first.take(batch)):
            self._take(piece)

    def _take(self, batch: Batch) -> None:
        samples = batch.rows["samples"]
        if samples.sync.size:
            if self._file_boundaries.allow(samples, batch.certain):
                self._writer.rotate(int(samples.t_ns[0]))
            self.last_ns = self.last_ns or int(samples.t_ns[0])
        if batch.gaps:
            # Before the rows that follow them: a truncated file then lists all gaps of its rows.
            self.gaps += batch.gaps
            self._writer.add_gaps(batch.gaps, self.last_ns)
        decoded = [
            (stream, rows, stream.decode(rows))
            for stream in self._streams
            if (rows := batch.rows[stream.bus.name]).sync.size
        ]
        self._writer.append({stream.bus.name: (rows.sync, rows.t_ns, raw) for stream, rows, raw in decoded})
        for stream, rows, raw in decoded:
            self._publisher.offer(Block(stream.layout, self._blocks, rows.sync, rows.t_ns, raw, self._capture))
            self._blocks += 1
            if stream.bus.name == "samples":
                if self.first_sync is None:
                    self.first_sync = int(rows.sync[0])
                self.last_sync, self.last_ns = int(rows.sync[-1]), int(rows.t_ns[-1])
                self.last_raw = {name: column[-1] for name, column in raw.items()}
                self._place_marks(False, rows)
        if batch.gaps:
            found = [asdict(gap) for gap in batch.gaps]
            self._publisher.event(encode_event("gaps", {"capture": self._capture, "gaps": found}))

    def finish(self, counters: dict[str, int]) -> None:
        """Place the last marks, close the recording, and publish the end with the counters of all parts."""
        if (rest := self._samples_first.rest()) is not None:
            self._take(rest)
        self._place_marks(True)
        self._writer.flush()
        counters["writer.rows_lost"] = self._writer.lost_rows
        counters["writer.files"] = len(self._writer.paths)
        counters["zenoh.blocks"] = self._blocks
        counters["zenoh.blocks_dropped"] = self._publisher.dropped
        counters["gaps"] = len(self.gaps)
        self._writer.close(counters)
        paths = [path.resolve() for path in self._writer.paths]
        content = end_content(self._capture, self._blocks, counters, self.gaps, self.marks, paths)
        self._publisher.event(encode_event("experiment_end", content))

    def _place_marks(self, final: bool, rows: Rows | None = None) -> None:
        due = [planned for planned in self._planned if final or planned[1] <= self.last_sync]
        self._planned = [planned for planned in self._planned if planned not in due]
        for kind, sync, text in due:
            t_ns = self.last_ns
            if rows is not None and sync >= rows.sync[0]:
                t_ns = int(rows.t_ns[np.searchsorted(rows.sync, sync)])
            mark = Mark(kind, sync, t_ns, text)
            self.marks.append(mark)
            self._writer.add_marks([mark])
            self._publisher.event(encode_event("mark", {"capture": self._capture, **asdict(mark, dict_factory=_mark)}))


def _mark(entries: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a mark as a dictionary; its kind is named ``mark``, since ``kind`` is that of the event."""
    return {("mark" if key == "kind" else key): value for key, value in entries}
