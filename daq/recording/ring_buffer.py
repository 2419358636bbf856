"""Ring buffer of the last seconds of a capture, which are written, with the following ones, on a trigger."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError
from armident.daq.recording.lost_rows import RowRanges
from armident.daq.recording.model import Gap, Mark
from armident.daq.recording.rotation import RETRY_NS, RecordingSeries


@dataclass(frozen=True)
class _Rows:
    stream: str
    sync: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    raw: Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class _Events:
    """Gaps and marks found at one time."""

    t_ns: int
    gaps: tuple[Gap, ...] = ()
    marks: tuple[Mark, ...] = ()


class TriggeredSeries(AbstractContextManager["TriggeredSeries", None]):
    """Replacement for :class:`RecordingSeries` that creates files only on a trigger.

    ``begin``: creates the files of an event by its number, from 1. Rows from ``before_ns`` before to ``after_ns`` after
    a trigger are written; a trigger during an event prolongs it.
    """

    def __init__(self, begin: Callable[[int], RecordingSeries], before_ns: int, after_ns: int) -> None:
        self._begin, self._before_ns, self._after_ns = begin, before_ns, after_ns
        self._kept: deque[_Rows | _Events] = deque()
        self._series: RecordingSeries | None = None
        self._done: list[Path] = []
        self._events = 0
        self._until: int | None = None
        self._not_before: int | None = None
        self._lost_before = 0
        self._problem: str | None = None
        self._limits: tuple[int | None, int | None] | None = None

    def limit(self, max_bytes: int | None, max_ns: int | None) -> None:
        """Set the size in bytes and the time span in ns at which a new file of an event begins; ``None``: no limit."""
        self._limits = max_bytes, max_ns
        if self._series is not None:
            self._series.limit(max_bytes, max_ns)

    def keep(self, before_ns: int, after_ns: int) -> None:
        """Set the time before and after later triggers that is written, ns."""
        self._before_ns, self._after_ns = before_ns, after_ns

    @property
    def path(self) -> Path | None:
        """File being written, ``None`` between events."""
        return None if self._series is None else self._series.path

    @property
    def paths(self) -> list[Path]:
        """All files so far."""
        return self._done + ([] if self._series is None else self._series.paths)

    @property
    def lost_rows(self) -> int:
        """Number of rows of all files that could not be written."""
        return self._lost_before + (0 if self._series is None else self._series.lost_rows)

    @property
    def problem(self) -> str | None:
        """Description of the last write error, or ``None``."""
        return self._problem if self._series is None else self._series.problem or self._problem

    def trigger(self, t_ns: int) -> None:
        """Write the rows from ``before_ns`` before ``t_ns`` (ns UTC) to ``after_ns`` after it."""
        self._until = max(self._until or 0, t_ns + self._after_ns)
        self._open(t_ns)

    def rotate(self, t_ns: int) -> Path | None:
        """End an event that is over at ``t_ns`` (ns UTC), or begin a new file; return the finished one."""
        if self._until is not None and self._series is None:
            self._open(t_ns)
        if self._series is None or self._until is None:
            return None
        if t_ns <= self._until:
            return self._series.rotate(t_ns)
        last = self._series.path
        self._end()
        return last

    def append(
        self, stream: str, sync: NDArray[np.int64], t_ns: NDArray[np.int64], raw: Mapping[str, NDArray[Any]]
    ) -> None:
        """Add rows to a stream, in the current event's file or in memory, as :meth:`RecordingWriter.append`."""
        if len(sync) == 0:
            return
        if self._series is not None:
            self._series.append(stream, sync, t_ns, raw)
            return
        self._keep(_Rows(stream, sync, t_ns, raw), int(t_ns[-1]))

    def add_gaps(self, gaps: Sequence[Gap], t_ns: int) -> None:
        """Record gaps that were found at ``t_ns``, ns UTC."""
        if self._series is not None:
            self._series.add_gaps(gaps, t_ns)
        else:
            self._keep(_Events(t_ns, gaps=tuple(gaps)), t_ns)

    def add_marks(self, marks: Sequence[Mark]) -> None:
        """Record marks."""
        if self._series is not None:
            self._series.add_marks(marks)
        elif marks:
            self._keep(_Events(marks[-1].t_ns, marks=tuple(marks)), marks[-1].t_ns)

    def leave_out(self, rows: RowRanges) -> None:
        """Count rows as lost that were never handed over (:meth:`RecordingWriter.leave_out`)."""
        if self._series is not None:
            self._series.leave_out(rows)
            return
        self._lost_before += rows.rows
        t_ns = _newest(self._kept[-1]) if self._kept else 0
        self._keep(_Events(t_ns, gaps=tuple(rows.gaps())), t_ns)

    def flush(self) -> None:
        """Write gathered rows and events of the current event to the disk."""
        if self._series is not None:
            self._series.flush()

    def close(self, counters: Mapping[str, int]) -> None:
        """Finish the current event's file, as :meth:`RecordingWriter.close`, with the counters of the whole capture."""
        if self._series is not None:
            self._series.close(counters)

    def abort(self) -> None:
        """Close and delete the current file, of a capture that did not begin."""
        if self._series is not None:
            self._series.abort()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._series is not None:
            self._series.__exit__(kind, error, at)

    def _keep(self, entry: _Rows | _Events, t_ns: int) -> None:
        self._kept.append(entry)
        while self._kept and _newest(self._kept[0]) < t_ns - self._before_ns:
            self._kept.popleft()

    def _open(self, t_ns: int) -> None:
        """Create the files of an event and write the rows in memory; after an error, try again after ``RETRY_NS``."""
        if self._series is not None or (self._not_before is not None and t_ns < self._not_before):
            return
        try:
            series = self._begin(self._events + 1)
        except ConfigError as error:
            self._problem, self._not_before = str(error), t_ns + RETRY_NS
            return
        if self._limits is not None:
            series.limit(*self._limits)
        self._events += 1
        self._series, self._not_before = series, None
        for entry in self._kept:
            if isinstance(entry, _Rows):
                series.append(entry.stream, entry.sync, entry.t_ns, entry.raw)
            else:
                series.add_gaps(entry.gaps, entry.t_ns)
                series.add_marks(entry.marks)
        self._kept.clear()
        series.flush()

    def _end(self) -> None:
        series, self._series, self._until = self._series, None, None
        assert series is not None
        series.finish()
        self._done += series.paths
        self._lost_before += series.lost_rows
        self._problem = series.problem or self._problem


def _newest(entry: _Rows | _Events) -> int:
    return int(entry.t_ns[-1]) if isinstance(entry, _Rows) else entry.t_ns
