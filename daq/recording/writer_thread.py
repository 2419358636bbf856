"""Writes a series of files in a separate thread, so that reading the buses never waits for the disk."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.daq.recording.lost_rows import DISK_STALLED, RowRanges
from armident.daq.recording.model import Gap, Mark
from armident.daq.recording.ring_buffer import TriggeredSeries
from armident.daq.recording.rotation import RecordingSeries

MOST_WAITING_BYTES = 128 << 20
"""Memory for rows that wait for the disk, bytes: about six minutes of six axes at 5 kHz."""

CATCH_UP = 2.0
"""Largest write rate of a backlog, over the rate at which its rows came: reading the buses has priority."""

_Task = Callable[[], object]
Columns = tuple[NDArray[np.int64], NDArray[np.int64], Mapping[str, NDArray[Any]]]
"""SYNC numbers, times (ns UTC) and raw values by field."""


@dataclass(frozen=True)
class _State:
    """State of the series after the last piece of work."""

    path: Path | None
    lost_rows: int
    problem: str | None
    left_out: int
    """Rows left out that are already included in ``lost_rows``."""


@dataclass(frozen=True)
class _Work:
    """Work for the thread, with size (bytes), number and duration (ns) of its rows."""

    run: _Task
    bytes: int = 0
    rows: int = 0
    took_ns: int = 0


@dataclass
class _Chunk:
    """Rows of each stream, gaps with the time they were found, and marks that are handed over together."""

    rows: dict[str, list[Columns]] = field(default_factory=dict)
    gaps: list[tuple[Sequence[Gap], int]] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)
    since: int | None = None
    may_begin_file: bool = False
    span_ns: int = 0
    began_ns: int = 0
    bytes: int = 0
    count: int = 0

    def add(self, stream: str, rows: Columns, size: int) -> None:
        """Add rows of a stream. ``rows``: SYNC numbers, times (ns UTC) and raw values of the rows."""
        if not self.rows:
            self.began_ns = time.monotonic_ns()
        if self.since is None:
            self.since = int(rows[1][0])
        self.rows.setdefault(stream, []).append(rows)
        self.span_ns = max(self.span_ns, int(rows[1][-1]) - self.since)
        self.bytes += size
        self.count += len(rows[0])

    def write(self, series: RecordingSeries | TriggeredSeries) -> None:
        """Write the content to a series."""
        if self.since is not None and self.may_begin_file:
            series.rotate(self.since)
        # Gaps first: a truncated file then lists the gaps of all rows it has.
        for gaps, found_ns in self.gaps:
            series.add_gaps(gaps, found_ns)
        for stream, parts in self.rows.items():
            sync, t_ns = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
            raw = {name: np.concatenate([part[2][name] for part in parts]) for name in parts[0][2]}
            series.append(stream, sync, t_ns, raw)
        series.add_marks(self.marks)
        series.flush()


class QueuedSeries(AbstractContextManager["QueuedSeries", None]):
    """Replacement for the series that it writes to: gathers rows, and a thread writes them chunk by chunk.

    A disk that stalls for seconds (worn memory card, busy server) costs memory, no samples. When ``most_bytes`` wait,
    rows are left out until memory is free: they count in :attr:`lost_rows` and become gaps, like rows that a full disk
    refuses. Properties report the state after the last piece of work. ``every``: SYNCs per row, by stream.
    ``chunk_ns``: time for which rows are gathered.
    """

    def __init__(
        self,
        series: RecordingSeries | TriggeredSeries,
        every: Mapping[str, int],
        chunk_ns: int,
        most_bytes: int = MOST_WAITING_BYTES,
    ) -> None:
        self._series, self._chunk_ns, self._most_bytes = series, chunk_ns, most_bytes
        self._chunk = _Chunk()
        self._state = _State(series.path, series.lost_rows, series.problem, 0)
        self._work: SimpleQueue[_Work | threading.Event | None] = SimpleQueue()
        self._unpaced = threading.Event()
        self._failure: BaseException | None = None
        # Bytes and rows handed over and written: each counter is changed by one thread only.
        self._put_bytes = self._put_rows = self._done_bytes = self._done_rows = 0
        self._left_out, self._left_out_rows, self._reported_rows = RowRanges(every), 0, 0
        self._thread: threading.Thread | None = threading.Thread(target=self._run, name="disk", daemon=True)
        self._thread.start()

    @property
    def path(self) -> Path | None:
        """File being written, or ``None``."""
        return self._state.path

    @property
    def paths(self) -> list[Path]:
        """All files so far."""
        return list(self._series.paths)

    @property
    def lost_rows(self) -> int:
        """Number of rows of all files that could not be written."""
        state = self._state
        return state.lost_rows + self._left_out_rows - state.left_out

    @property
    def problem(self) -> str | None:
        """Description of the last write error, or ``None``."""
        return f"{self.path}: {DISK_STALLED}" if self._left_out else self._state.problem

    @property
    def waiting_rows(self) -> int:
        """Number of rows that wait for the disk."""
        return self._put_rows - self._done_rows

    @property
    def waiting_share(self) -> float:
        """Used share of the memory for rows that wait for the disk, from 0 to 1."""
        return self._waiting_bytes / self._most_bytes

    @property
    def _waiting_bytes(self) -> int:
        return self._chunk.bytes + self._put_bytes - self._done_bytes

    def limit(self, max_bytes: int | None, max_ns: int | None) -> None:
        """Set the size in bytes and the time span in ns at which a new file begins; ``None``: no limit."""
        self._enqueue(lambda: self._series.limit(max_bytes, max_ns))

    def gather(self, chunk_ns: int) -> None:
        """Set the time for which rows are gathered, ns."""
        self._chunk_ns = chunk_ns

    def keep(self, before_ns: int, after_ns: int) -> None:
        """Set the time before and after later triggers that is written, ns."""
        self._enqueue(lambda: self._series.keep(before_ns, after_ns))

    def trigger(self, t_ns: int) -> None:
        """Trigger an event at ``t_ns`` (ns UTC) in a series that writes only events."""
        self._enqueue(lambda: self._series.trigger(t_ns))

    def rotate(self, t_ns: int) -> None:
        """Allow a new file to begin before the next rows, whose first time is ``t_ns`` (ns UTC)."""
        if self._chunk.since is None:
            self._chunk.since, self._chunk.may_begin_file = t_ns, True

    def append(self, rows: Mapping[str, Columns]) -> None:
        """Add rows of the same time to several streams, which no file divides; the arrays must not change later."""
        sizes = {
            stream: sync.nbytes + t_ns.nbytes + sum(values.nbytes for values in raw.values())
            for stream, (sync, t_ns, raw) in rows.items()
            if len(sync)
        }
        if not sizes:
            return
        self._check()
        # Resume at half the limit: a slow disk causes a few long gaps instead of many short ones.
        allowed_bytes = self._most_bytes // 2 if self._left_out else self._most_bytes
        if self._waiting_bytes + sum(sizes.values()) > allowed_bytes:
            for stream in sizes:
                self._left_out.add(stream, rows[stream][0])
                self._left_out_rows += len(rows[stream][0])
            return
        self._report_left_out()
        for stream, size in sizes.items():
            self._chunk.add(stream, rows[stream], size)
        if self._chunk.span_ns >= self._chunk_ns:
            self._hand_over()

    def add_gaps(self, gaps: Sequence[Gap], t_ns: int) -> None:
        """Record gaps that were found at ``t_ns``, ns UTC."""
        self._chunk.gaps.append((gaps, t_ns))

    def add_marks(self, marks: Sequence[Mark]) -> None:
        """Record marks."""
        self._chunk.marks += marks

    def flush(self) -> None:
        """Write all rows and events to the disk; return when this is done."""
        self._report_left_out()
        self._hand_over()
        self._wait()

    def close(self, counters: Mapping[str, int]) -> None:
        """Finish the last file, as :meth:`RecordingWriter.close`, with the counters of the whole capture."""
        self.flush()
        self._end()
        self._series.close(counters)

    def abort(self) -> None:
        """Close and delete the current file, of a capture that did not begin."""
        self._end()
        self._series.abort()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._end()
        self._series.__exit__(kind, error, at)

    def _report_left_out(self) -> None:
        """Report rows left out to the series, before the next rows."""
        if not self._left_out:
            return
        left_out, rows = self._left_out.take(), self._left_out_rows

        def report() -> None:
            self._series.leave_out(left_out)
            self._reported_rows = rows

        self._enqueue(report)

    def _enqueue(self, run: _Task) -> None:
        """Run a function in the thread, after all rows gathered so far."""
        self._hand_over()
        self._put(_Work(run))

    def _hand_over(self) -> None:
        chunk, self._chunk = self._chunk, _Chunk()
        took_ns = time.monotonic_ns() - chunk.began_ns if chunk.rows else 0
        self._put(_Work(lambda: chunk.write(self._series), chunk.bytes, chunk.count, took_ns))

    def _check(self) -> None:
        """Raise the exception of the thread, if there is one."""
        if self._failure is not None:
            raise self._failure

    def _put(self, work: _Work) -> None:
        self._check()
        self._put_bytes += work.bytes
        self._put_rows += work.rows
        self._work.put(work)

    def _wait(self) -> None:
        """Wait until all work is done."""
        done = threading.Event()
        self._unpaced.set()
        self._work.put(done)
        done.wait()
        self._unpaced.clear()
        self._check()

    def _end(self) -> None:
        if self._thread is not None:
            self._unpaced.set()
            self._work.put(None)
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        while (work := self._work.get()) is not None:
            if isinstance(work, threading.Event):
                work.set()
                continue
            began = time.monotonic_ns()
            try:
                if self._failure is None:
                    work.run()
            except BaseException as error:
                # Raised when the next work is handed over.
                self._failure = error
            series = self._series
            self._state = _State(series.path, series.lost_rows, series.problem, self._reported_rows)
            self._done_bytes += work.bytes
            self._done_rows += work.rows
            if not self._work.empty():
                # While SYNC pauses, a chunk may take long to fill.
                wanted_ns = min(work.took_ns, self._chunk_ns) / CATCH_UP
                self._unpaced.wait(1e-9 * max(0.0, wanted_ns - (time.monotonic_ns() - began)))
