"""Files of a capture: creation, rotation, and deletion of old recordings."""

import datetime
import logging
import os
import shutil
from collections import Counter
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from armident.configs import RobotConfig, SessionConfig
from armident.configs.schema.session import RecordingOptions, Trigger
from armident.daq.matching.streams import CapturedStream
from armident.daq.recording import QueuedSeries, RecordingSeries, RecordingWriter, TriggeredSeries
from armident.daq.recording.clock import clock_is_right
from armident.daq.recording.retention import RetentionThread, identified_in, prune, reason_to_stay, recordings_in

log = logging.getLogger(__name__)

_STAMP_STEP = datetime.timedelta(milliseconds=1)
"""Resolution of the times in the names of recordings."""


def open_series(
    session: SessionConfig,
    robot: RobotConfig,
    streams: Sequence[CapturedStream],
    directory: Path,
    name: str,
    metadata: dict[str, str],
) -> QueuedSeries:
    """Return the queued writer of a capture's files; with a trigger it writes the last seconds at each event."""
    options = session.recording
    layouts = [stream.layout for stream in streams]
    every = {layout.name: layout.every for layout in layouts}
    chunk_ns = chunk_duration_ns(options)

    def begin(path: Path, part: int) -> RecordingWriter:
        rate = 1.0 / session.sync_period
        # The series ends the chunks; the writer does so only where many rows come at once.
        own = metadata | {"part": str(part)}
        return RecordingWriter(path, robot, session, rate, layouts, own, 2 * chunk_ns, options.preview_hz)

    max_bytes, max_ns = limits(options)
    if options.trigger is None:
        return QueuedSeries(RecordingSeries(begin, directory, name, max_bytes, max_ns), every, chunk_ns)

    def event(_: int) -> RecordingSeries:
        now = capture_stamp(next_time(directory, robot.name, datetime.datetime.now(datetime.UTC)))
        return RecordingSeries(begin, directory, f"{robot.name}-{now}", max_bytes, max_ns)

    return QueuedSeries(TriggeredSeries(event, *kept_around(options.trigger)), every, chunk_ns)


def chunk_duration_ns(options: RecordingOptions) -> int:
    """Return the time span of a chunk, ns: a crash loses it and the frames in the kernel, together ``chunk_ms``."""
    return round(max(options.chunk_ms - 2.5 * options.drain_ms, options.chunk_ms / 4) * 1e6)


def kept_around(trigger: Trigger) -> tuple[int, int]:
    """Return the times that are recorded before and after a trigger, ns."""
    return round(trigger.before_s * 1e9), round(trigger.after_s * 1e9)


def limits(options: RecordingOptions) -> tuple[int | None, int | None]:
    """Return the size (bytes) and the time span (ns) at which the next file begins."""
    max_bytes = None if options.rotate_mb is None else round(options.rotate_mb * 1e6)
    max_ns = None if options.rotate_minutes is None else round(options.rotate_minutes * 60e9)
    return max_bytes, max_ns


def free_space(directory: Path) -> int | None:
    """Return the free bytes on the disk of a directory that may not exist yet; ``None`` if unknown."""
    try:
        existing = next(path for path in (directory.absolute(), *directory.absolute().parents) if os.path.exists(path))
        return shutil.disk_usage(existing).free
    except (OSError, StopIteration):
        return None


def capture_stamp(now: datetime.datetime) -> str:
    """Return the time (UTC, to the millisecond) as it stands in the names of recordings."""
    return f"{now:%Y%m%dT%H%M%S}-{now.microsecond // 1000:03d}Z"


def next_time(directory: Path, robot: str, now: datetime.datetime) -> datetime.datetime:
    """Return a time (UTC) for a new recording's name, later than all of the robot: the clock may have stepped back."""
    newest = max((made for _, made in recordings_in(directory, robot)), default=None)
    if newest is None or now - newest >= _STAMP_STEP:
        return now
    if newest - now > _STAMP_STEP:
        log.warning(
            "the clock (%s) is behind the newest recording (%s): it has stepped back; the new recording is named after "
            "the newest one",
            f"{now:%Y-%m-%d %H:%M:%S}",
            f"{newest:%Y-%m-%d %H:%M:%S}",
        )
    return newest + _STAMP_STEP


class RecordingRetention(AbstractContextManager["RecordingRetention", None]):
    """Deletes old recordings of a robot in a ``with`` block; ``options`` may be exchanged at any time."""

    def __init__(self, options: RecordingOptions, directory: Path, robot: str) -> None:
        self.options = options
        self._directory, self._robot = directory, robot
        self._said: list[str] = []
        self._thread = RetentionThread(self._prune)

    def _prune(self) -> list[Path]:
        options = self.options
        if options.keep_days is None and options.min_free_gb is None:
            return []
        min_free_bytes = None if options.min_free_gb is None else options.min_free_gb * 1e9
        now, days = datetime.datetime.now(datetime.UTC), options.keep_days if clock_is_right() else None
        identified = identified_in(self._directory, self._robot)
        stay: Counter[str] = Counter()

        def needed(path: Path) -> bool:
            reason = reason_to_stay(path, identified, options.copied_to)
            if reason is not None:
                stay[reason] += 1
            return reason is not None

        deleted = prune(self._directory, self._robot, now, days, min_free_bytes, needed=needed)
        said = [f"{number} recordings stay that are {reason}" for reason, number in sorted(stay.items())]
        if days != options.keep_days:
            said.append("none is deleted by age, because the clock is not synchronised")
        if said and said != self._said:
            log.warning("retention: %s", "; ".join(said))
        self._said = said
        return deleted

    def __exit__(self, *_: object) -> None:
        """End the thread."""
        self._thread.close()
