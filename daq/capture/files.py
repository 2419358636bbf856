"""Where a capture's files go, when a new one is begun, and which old ones make room."""

import datetime
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

from armident.configs import RobotConfig, SessionConfig
from armident.configs.schema.session import RecordingOptions, Trigger
from armident.daq.matching.streams import CapturedStream
from armident.daq.recording import QueuedSeries, RecordingSeries, RecordingWriter, TriggeredSeries
from armident.daq.recording.retention import RetentionThread, prune


def open_series(
    session: SessionConfig,
    robot: RobotConfig,
    streams: Sequence[CapturedStream],
    directory: Path,
    name: str,
    metadata: dict[str, str],
) -> QueuedSeries:
    """Begin the files of a capture, or what keeps its last seconds until there is something to write.

    A thread of its own writes them.

    Raises
    ------
    ConfigError
        If the first file cannot be created.
    """
    options = session.recording
    layouts = [stream.layout for stream in streams]
    every = {layout.name: layout.every for layout in layouts}
    chunk_ns = chunk_duration_ns(options)

    def begin(path: Path, part: int) -> RecordingWriter:
        facts = metadata | {"part": str(part)}
        rate = 1.0 / session.sync_period
        # By itself a writer ends chunks only where much comes at once.
        return RecordingWriter(path, robot, session, rate, layouts, facts, 2 * chunk_ns, options.look_hz)

    max_bytes, max_ns = limits(options)
    if options.trigger is None:
        return QueuedSeries(RecordingSeries(begin, directory, name, max_bytes, max_ns), every, chunk_ns)

    def event(_: int) -> RecordingSeries:
        now = capture_stamp(datetime.datetime.now(datetime.UTC))
        return RecordingSeries(begin, directory, f"{robot.name}-{now}", max_bytes, max_ns)

    return QueuedSeries(TriggeredSeries(event, *kept_around(options.trigger)), every, chunk_ns)


def chunk_duration_ns(options: RecordingOptions) -> int:
    """Time that the rows of a chunk are gathered for, ns: what is still in the kernel is lost with them."""
    return round(max(options.chunk_ms - 2.5 * options.drain_ms, options.chunk_ms / 4) * 1e6)


def kept_around(trigger: Trigger) -> tuple[int, int]:
    """Time to keep before and after a trigger, ns."""
    return round(trigger.before_s * 1e9), round(trigger.after_s * 1e9)


def limits(options: RecordingOptions) -> tuple[int | None, int | None]:
    """Bytes and ns at which a file is full."""
    max_bytes = None if options.rotate_mb is None else round(options.rotate_mb * 1e6)
    max_ns = None if options.rotate_minutes is None else round(options.rotate_minutes * 60e9)
    return max_bytes, max_ns


def free_space(directory: Path) -> int | None:
    """Bytes that are free where a directory is or will be; ``None`` if it cannot be told."""
    try:
        there = next(path for path in (directory.absolute(), *directory.absolute().parents) if os.path.exists(path))
        return shutil.disk_usage(there).free
    except (OSError, StopIteration):
        return None


def capture_stamp(now: datetime.datetime) -> str:
    """The time in the names of recordings, to the millisecond, in UTC."""
    return f"{now:%Y%m%dT%H%M%S}-{now.microsecond // 1000:03d}Z"


class RecordingRetention:
    """Deletes old recordings of a robot meanwhile, if the options say so; use it in a ``with`` block.

    Parameters
    ----------
    options
        How long recordings are kept, and how much space is left; may be exchanged at any time.
    directory, robot
        Whose recordings.
    say
        Takes lines.
    """

    def __init__(self, options: RecordingOptions, directory: Path, robot: str, say: Callable[[str], None]) -> None:
        self.options = options
        self._directory, self._robot = directory, robot
        self._janitor = RetentionThread(self._look, say)

    def _look(self) -> list[Path]:
        options = self.options
        if options.keep_days is None and options.min_free_gb is None:
            return []
        least = None if options.min_free_gb is None else options.min_free_gb * 1e9
        return prune(self._directory, self._robot, datetime.datetime.now(datetime.UTC), options.keep_days, least)

    def __enter__(self) -> Self:
        """Begin to look."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop looking."""
        self._janitor.close()
