"""Capture in several files: a new file begins when the current one reaches its size or age; each row is in one file."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError
from armident.daq.recording.lost_rows import RowRanges
from armident.daq.recording.model import Gap, Mark
from armident.daq.recording.writer import RecordingWriter

RETRY_NS = 10_000_000_000
"""Time until the next attempt after a new file could not be created, ns."""


class RecordingSeries(AbstractContextManager["RecordingSeries", None]):
    """Writes one capture to consecutive files; ConfigError if the first cannot be created.

    A file is closed, with its index, after the next one has been created. If that fails (disk full, directory removed),
    rows continue in the old file, :attr:`problem` describes the error, and the next attempt follows after ``RETRY_NS``.
    ``begin``: creates part k, from 1, at a path. Files are ``NAME.mcap``, ``NAME.0002.mcap`` and so on.
    """

    def __init__(
        self,
        begin: Callable[[Path, int], RecordingWriter],
        directory: Path,
        name: str,
        max_bytes: int | None = None,
        max_ns: int | None = None,
    ) -> None:
        self._begin, self._directory, self._name = begin, directory, name
        self._max_bytes, self._max_ns = max_bytes, max_ns
        self.paths: list[Path] = []
        self._lost_before = 0
        self._problem: str | None = None
        self._since: int | None = None
        self._not_before: int | None = None
        self._writer = self._next()

    @property
    def path(self) -> Path:
        """File being written."""
        return self._writer.path

    @property
    def lost_rows(self) -> int:
        """Number of rows of all files that could not be written."""
        return self._lost_before + self._writer.lost_rows

    @property
    def problem(self) -> str | None:
        """Description of the last write error, or ``None``."""
        return self._writer.problem or self._problem

    def limit(self, max_bytes: int | None, max_ns: int | None) -> None:
        """Set the size in bytes and the time span in ns at which a new file begins; ``None``: no limit."""
        self._max_bytes, self._max_ns = max_bytes, max_ns

    def rotate(self, t_ns: int) -> Path | None:
        """Begin a new file if the current one is full at ``t_ns``, ns UTC, of the next rows; return the old one."""
        if self._since is None:
            self._since = t_ns
        if not self._full(t_ns) or (self._not_before is not None and t_ns < self._not_before):
            return None
        full = self._writer
        try:
            self._writer = self._next()
        except ConfigError as error:
            self._problem, self._not_before = (
                f"no new file can be created, rows continue in {full.path}: {error}",
                t_ns + RETRY_NS,
            )
            return None
        self._since, self._not_before = t_ns, None
        self._finish(full)
        return full.path

    def append(
        self, stream: str, sync: NDArray[np.int64], t_ns: NDArray[np.int64], raw: Mapping[str, NDArray[Any]]
    ) -> None:
        """Add rows to a stream, as :meth:`RecordingWriter.append`."""
        self._writer.append(stream, sync, t_ns, raw)

    def add_gaps(self, gaps: Sequence[Gap], t_ns: int) -> None:
        """Record gaps that were found at ``t_ns``, ns UTC."""
        self._writer.add_gaps(gaps, t_ns)

    def add_marks(self, marks: Sequence[Mark]) -> None:
        """Record marks."""
        self._writer.add_marks(marks)

    def leave_out(self, rows: RowRanges) -> None:
        """Count rows as lost that were never handed over (:meth:`RecordingWriter.leave_out`)."""
        self._writer.leave_out(rows)

    def flush(self) -> None:
        """Write gathered rows and events to the disk (:meth:`RecordingWriter.flush`)."""
        self._writer.flush()

    def close(self, counters: Mapping[str, int]) -> None:
        """Finish the last file, as :meth:`RecordingWriter.close`, with the counters of the whole capture."""
        self._writer.close(counters)

    def finish(self) -> None:
        """Finish the last file with counters of its own rows; if that fails, it remains as a truncated file."""
        self._finish(self._writer)

    def trigger(self, t_ns: int) -> None:
        """Do nothing: this series writes all rows, without a trigger at ``t_ns``."""

    def keep(self, before_ns: int, after_ns: int) -> None:
        """Do nothing: this series writes all rows, not only those around triggers."""

    def abort(self) -> None:
        """Close and delete the current file, of a capture that did not begin."""
        self._writer.abort()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._writer.__exit__(kind, error, at)

    def _full(self, t_ns: int) -> bool:
        old = self._max_ns is not None and self._since is not None and t_ns - self._since >= self._max_ns
        return old or (self._max_bytes is not None and self._writer.size >= self._max_bytes)

    def _next(self) -> RecordingWriter:
        number = len(self.paths) + 1
        part = "" if number == 1 else f".{number:04d}"
        writer = self._begin(self._directory / f"{self._name}{part}.mcap", number)
        self.paths.append(writer.path)
        return writer

    def _finish(self, writer: RecordingWriter) -> None:
        """Close a full file with counters of its own rows; if that fails, it remains as a truncated file."""
        writer.flush()
        if writer is not self._writer:
            self._lost_before += writer.lost_rows
        self._problem = writer.problem or self._problem
        counters = {f"{name}.rows": count for name, count in writer.rows.items()}
        with suppress(ConfigError):
            writer.close({**counters, "writer.rows_lost": writer.lost_rows})
            return
        self._problem = f"{writer.path}: could not be finished"
        if writer is not self._writer:
            self._writer.take_over(writer)
