"""Retention of recordings: deletion by age and by free disk space."""

import datetime
import fcntl
import logging
import re
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

_NAME = re.compile(r"-(\d{8}T\d{6})-(\d{3})Z(?:\.\d+)?\.mcap(?:\.damaged)?$")
EVERY_S = 60.0
"""Interval between two deletions of old recordings, s."""

log = logging.getLogger(__name__)


def prune(
    directory: Path,
    robot: str,
    now: datetime.datetime,
    keep_days: float | None,
    min_free_bytes: float | None,
    free: Callable[[Path], int] = lambda path: shutil.disk_usage(path).free,
) -> list[Path]:
    """Delete recordings that are too old, then the oldest ones until there is enough free space.

    Only finished captures of this robot are deleted, recognised by the names that ``capture`` gives them. A file being
    written is never deleted.

    Parameters
    ----------
    directory
        Directory of the recordings; its subdirectories are not searched.
    robot
        Name of the robot, with which the file names begin.
    now
        Current time, with its zone.
    keep_days
        Age, by the times in the names, at which a recording is deleted, days; ``None``: no limit. It counts to the
        newest finished recording that is not in the future: a clock that is ahead deletes nothing younger.
    min_free_bytes
        Free space to keep on the file system, bytes; ``None``: no limit.
    free
        Returns the free space, bytes.

    Returns
    -------
    list of Path
        Deleted files, the oldest first.
    """
    deleted = []
    found = [(path, made, is_being_written(path)) for path, made in recordings_of(directory, robot)]
    # A clock that is ahead must not make all recordings old: they are compared with the newest finished one.
    newest = max((made for _, made, written in found if not written and made <= now), default=now)
    for path, made, written in found:
        old = keep_days is not None and (newest - made).total_seconds() > keep_days * 86_400
        if not (old or (min_free_bytes is not None and free(directory) < min_free_bytes)):
            break
        if written:
            continue
        path.unlink(missing_ok=True)
        deleted.append(path)
    return deleted


def recordings_of(directory: Path, robot: str) -> Iterator[tuple[Path, datetime.datetime]]:
    """Yield the recordings of a robot with the times in their names, the oldest first.

    Parameters
    ----------
    directory
        Directory of the recordings; its subdirectories are not searched.
    robot
        Name of the robot, with which the file names begin.
    """
    found = []
    for path in directory.glob(f"{robot}-*.mcap*"):
        match = _NAME.search(path.name)
        if match is not None and path.name[: match.start()] == robot and path.is_file():
            made = datetime.datetime.strptime(f"{match[1]}.{match[2]}+0000", "%Y%m%dT%H%M%S.%f%z")
            found.append((path, made))
    yield from sorted(found, key=lambda entry: entry[0].name)


def is_being_written(path: Path) -> bool:
    """Return True if a capture has locked a file for writing.

    Parameters
    ----------
    path
        The file.
    """
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


class RetentionThread:
    """Deletes old recordings at regular intervals in a separate thread, so that a capture does not wait for the disk.

    Every deleted file is logged, and every error once.

    Parameters
    ----------
    delete
        Deletes old recordings and returns their paths.
    every_s
        Interval between two calls of it, s.
    """

    def __init__(self, delete: Callable[[], list[Path]], every_s: float = EVERY_S) -> None:
        self.deleted = 0
        self._delete, self._every_s = delete, every_s
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="retention", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        last: str | None = None
        while True:
            try:
                for path in self._delete():
                    self.deleted += 1
                    log.info("deleted %s (retention)", path)
                last = None
            except OSError as error:
                if str(error) != last:
                    log.warning("retention: %s", error)
                last = str(error)
            if self._over.wait(self._every_s):
                return
