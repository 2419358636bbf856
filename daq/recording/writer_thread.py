"""Writes a series from a thread of its own, so that whoever drains the buses never waits for the disk."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from armident.daq.recording.lost_rows import DISK_STALLED, RowRanges
from armident.daq.recording.model import Gap, Mark
from armident.daq.recording.ring_buffer import TriggeredSeries
from armident.daq.recording.rotation import RecordingSeries

MOST_WAITING_BYTES = 128 << 20
"""Rows that may wait for the disk: some six minutes of six axes at 5 kHz."""

CATCH_UP = 2.0
"""Times as fast as they came that rows are written which have waited: the buses want the processor, too."""

_Do = Callable[[], object]
_Rows = tuple[NDArray[np.int64], NDArray[np.int64], Mapping[str, NDArray[Any]]]


@dataclass(frozen=True)
class _State:
    """What the series said when it had done the last thing."""

    path: Path | None
    lost_rows: int
    problem: str | None
    left_out: int
    """Rows left out that it has been told of."""


@dataclass(frozen=True)
class _Work:
    """Something to do, and the rows that go with it: their bytes, how many they are, and how long they took to come."""

    do: _Do
    bytes: int = 0
    rows: int = 0
    took_ns: int = 0


@dataclass
class _Chunk:
    """What is handed over at once: rows of each stream as they came, gaps and when they were found, marks."""

    rows: dict[str, list[_Rows]] = field(default_factory=dict)
    gaps: list[tuple[Sequence[Gap], int]] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)
    since: int | None = None
    span_ns: int = 0
    began_ns: int = 0
    bytes: int = 0
    count: int = 0

    def add(self, stream: str, rows: _Rows, size: int) -> None:
        if not self.rows:
            self.began_ns = time.monotonic_ns()
        self.rows.setdefault(stream, []).append(rows)
        if self.since is not None:
            self.span_ns = max(self.span_ns, int(rows[1][-1]) - self.since)
        self.bytes += size
        self.count += len(rows[0])

    def write(self, series: RecordingSeries | TriggeredSeries) -> None:
        if self.since is not None:
            series.turn(self.since)
        # Before the rows behind them: a file that ends in the middle says what is missing in what it has.
        for gaps, found_ns in self.gaps:
            series.add_gaps(gaps, found_ns)
        for stream, parts in self.rows.items():
            sync, t_ns = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
            raw = {name: np.concatenate([part[2][name] for part in parts]) for name in parts[0][2]}
            series.append(stream, sync, t_ns, raw)
        series.add_marks(self.marks)
        series.flush()


class QueuedSeries:
    """Stands in the place of the series that it writes to: gathers rows, and has a thread write them chunk by chunk.

    A disk that stands still for seconds (a worn memory card, a busy server) costs memory and no samples. When
    ``most_bytes`` wait, rows are left out until there is room again: they count in :attr:`lost_rows` and become gaps,
    as rows do that a full disk refuses. What is reported is how it was when the last thing was done.

    Parameters
    ----------
    series
        What is written; nobody else may use it.
    every
        Of each stream, on every how many SYNCs it has a row.
    chunk_ns
        Time that rows are gathered for, ns; they are on the disk soon after.
    most_bytes
        Of rows that wait.
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
        self._hurry = threading.Event()
        self._failure: BaseException | None = None
        # Of rows, what was handed over and what was done with: each is counted by one thread.
        self._put_bytes = self._put_rows = self._done_bytes = self._done_rows = 0
        self._left_out, self._left_out_rows, self._told_rows = RowRanges(every), 0, 0
        self._thread: threading.Thread | None = threading.Thread(target=self._run, name="disk", daemon=True)
        self._thread.start()

    @property
    def path(self) -> Path | None:
        """The file being written, if one is."""
        return self._state.path

    @property
    def paths(self) -> list[Path]:
        """All files so far."""
        return list(self._series.paths)

    @property
    def lost_rows(self) -> int:
        """Rows that the disk did not take, of all files."""
        state = self._state
        return state.lost_rows + self._left_out_rows - state.left_out

    @property
    def problem(self) -> str | None:
        """What went wrong with writing last, in words."""
        return f"{self.path}: {DISK_STALLED}" if self._left_out else self._state.problem

    @property
    def waiting_rows(self) -> int:
        """Rows that wait for the disk."""
        return self._put_rows - self._done_rows

    def limit(self, max_bytes: int | None, max_ns: int | None) -> None:
        """Change when a file is full."""
        self._do(lambda: self._series.limit(max_bytes, max_ns))

    def gather(self, chunk_ns: int) -> None:
        """Change how long rows are gathered for, ns."""
        self._chunk_ns = chunk_ns

    def keep(self, before_ns: int, after_ns: int) -> None:
        """Change how much is kept before and after a trigger from now on, ns."""
        self._do(lambda: self._series.keep(before_ns, after_ns))

    def trigger(self, t_ns: int) -> None:
        """Have what was just recorded, and what follows, written where only events are."""
        self._do(lambda: self._series.trigger(t_ns))

    def turn(self, t_ns: int) -> None:
        """Rows that begin at ``t_ns`` are to come: a new file may be begun with them."""
        if self._chunk.since is None:
            self._chunk.since = t_ns

    def append(
        self, stream: str, sync: NDArray[np.int64], t_ns: NDArray[np.int64], raw: Mapping[str, NDArray[Any]]
    ) -> None:
        """Add rows to a stream: ``sync`` and ``t_ns`` of shape (N,), each of ``raw`` (N, n); none may change after."""
        if len(sync) == 0:
            return
        self._check()
        size = sync.nbytes + t_ns.nbytes + sum(values.nbytes for values in raw.values())
        # Not one in, one out: a disk that is too slow gets few long gaps.
        room = self._most_bytes // 2 if self._left_out else self._most_bytes
        if self._chunk.bytes + self._put_bytes - self._done_bytes + size > room:
            self._left_out.add(stream, sync)
            self._left_out_rows += len(sync)
            return
        self._own_up()
        self.turn(int(t_ns[0]))
        self._chunk.add(stream, (sync, t_ns, raw), size)
        if self._chunk.span_ns >= self._chunk_ns:
            self._hand_over()

    def add_gaps(self, gaps: Sequence[Gap], t_ns: int) -> None:
        """Record gaps found at ``t_ns``."""
        self._chunk.gaps.append((gaps, t_ns))

    def add_marks(self, marks: Sequence[Mark]) -> None:
        """Record marks."""
        self._chunk.marks += marks

    def flush(self) -> None:
        """Bring all of it to the disk; returns when it is there."""
        self._own_up()
        self._hand_over()
        self._wait()

    def close(self, counters: Mapping[str, int]) -> None:
        """Finish the last file, with the counters of the whole capture.

        Raises
        ------
        ConfigError
            If the disk does not take its end; what is there remains readable as a torn file.
        """
        self.flush()
        self._end()
        self._series.close(counters)

    def abort(self) -> None:
        """Leave nothing behind of a capture that did not begin."""
        self._end()
        self._series.abort()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._end()
        self._series.__exit__(kind, error, at)

    def _own_up(self) -> None:
        """Have the series say what was left out, before what comes next."""
        if not self._left_out:
            return
        left_out, rows = self._left_out.take(), self._left_out_rows

        def tell() -> None:
            self._series.leave_out(left_out)
            self._told_rows = rows

        self._do(tell)

    def _do(self, do: _Do) -> None:
        """Have something done behind what has been gathered so far."""
        self._hand_over()
        self._put(_Work(do))

    def _hand_over(self) -> None:
        chunk, self._chunk = self._chunk, _Chunk()
        took_ns = time.monotonic_ns() - chunk.began_ns if chunk.rows else 0
        self._put(_Work(lambda: chunk.write(self._series), chunk.bytes, chunk.count, took_ns))

    def _check(self) -> None:
        """Raise what went wrong in the thread, if something did."""
        if self._failure is not None:
            raise self._failure

    def _put(self, work: _Work) -> None:
        self._check()
        self._put_bytes += work.bytes
        self._put_rows += work.rows
        self._work.put(work)

    def _wait(self) -> None:
        """Until all that was handed over is done."""
        done = threading.Event()
        self._hurry.set()
        self._work.put(done)
        done.wait()
        self._hurry.clear()
        self._check()

    def _end(self) -> None:
        if self._thread is not None:
            self._hurry.set()
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
                    work.do()
            except BaseException as error:
                # Raised where something is handed over next.
                self._failure = error
            series = self._series
            self._state = _State(series.path, series.lost_rows, series.problem, self._told_rows)
            self._done_bytes += work.bytes
            self._done_rows += work.rows
            if not self._work.empty():
                # Where SYNC rests a chunk takes long to come.
                wanted_ns = min(work.took_ns, self._chunk_ns) / CATCH_UP
                self._hurry.wait(1e-9 * max(0.0, wanted_ns - (time.monotonic_ns() - began)))
