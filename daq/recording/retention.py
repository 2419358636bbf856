"""Retention of recordings: deletion by age and by free disk space, of those that are not needed any more."""

import datetime
import errno
import fcntl
import json
import logging
import re
import shutil
import sqlite3
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, suppress
from functools import cache
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import make_reader

from armident.daq.recording.names import MARKS_TOPIC, in_order

_NAME = re.compile(r"-(\d{8}T\d{6})-(\d{3})Z(?:\.\d+)?\.mcap(?:\.damaged)?$")
LONGEST_PAUSE = datetime.timedelta(days=365)
"""Longest time between two recordings of a robot that is a pause: an arm is identified again at least once a year."""
KEEP = ".keep"
"""Suffix of a file beside a recording, after its whole name, that marks it as one to keep."""
LEDGER = "worker.sqlite"
"""Name of the ledger of the cell's workers in the folder of the recordings."""
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
    needed: Callable[[Path], bool] = lambda _: False,
) -> list[Path]:
    """Delete recordings that are too old, then the oldest ones until there is enough space; return them, oldest first.

    Only finished captures of this robot are deleted, recognised by their names; subdirectories are not searched.
    ``keep_days`` counts to the newest finished recording not in the future, without pauses of more than a year: a clock
    that is ahead deletes nothing younger. ``min_free_bytes``, ``free``: wanted and present space, bytes. ``needed``:
    True for recordings that must stay.
    """
    deleted = []
    found = [(path, made, is_being_written(path)) for path, made in recordings_in(directory, robot)]
    keep = datetime.timedelta.max if keep_days is None else datetime.timedelta(days=keep_days)
    newest = max((made for _, made, written in found if not written and made <= now), default=now)
    ages = _ages([made for _, made, _ in found if made <= newest], keep)
    for path, made, written in found:
        old = ages.get(made, datetime.timedelta(0)) > keep
        if not (old or (min_free_bytes is not None and free(directory) < min_free_bytes)):
            break
        if written or needed(path):
            continue
        path.unlink(missing_ok=True)
        deleted.append(path)
    return deleted


def _ages(times: list[datetime.datetime], keep: datetime.timedelta) -> dict[datetime.datetime, datetime.timedelta]:
    """Ages of recordings against the newest one, by the time of each, without steps of the clock.

    A pause longer than `LONGEST_PAUSE` is taken for a clock that is ahead: only time between recordings on one side of
    it counts. After a real pause old recordings stay for ``keep`` longer.
    """
    ages: dict[datetime.datetime, datetime.timedelta] = {}
    age, later = datetime.timedelta(0), max(times, default=None)
    for made in sorted(times, reverse=True):
        pause = later - made if later is not None else datetime.timedelta(0)
        age += pause if pause <= max(LONGEST_PAUSE, keep) else datetime.timedelta(0)
        ages[made], later = age, made
    return ages


def recordings_in(directory: Path, robot: str) -> Iterator[tuple[Path, datetime.datetime]]:
    """Yield the recordings of a robot in a directory with the times in their names, the oldest first."""
    found = []
    for path in directory.glob(f"{robot}-*.mcap*"):
        match = _NAME.search(path.name)
        if match is not None and path.name[: match.start()] == robot and path.is_file():
            # A name that only looks like a time is none of a capture.
            with suppress(ValueError):
                made = datetime.datetime.strptime(f"{match[1]}.{match[2]}+0000", "%Y%m%dT%H%M%S.%f%z")
                found.append((path, made))
    yield from sorted(found, key=lambda entry: in_order(entry[0]))


def reason_to_stay(path: Path, identified: Collection[str] | None, copied_to: Path | None) -> str | None:
    """Return why retention spares a recording: marked, not identified, or not copied; ``None`` if it does not.

    ``identified``: names of the captures that need no worker any more (`identified_in`), ``None``: there is none.
    ``copied_to``: folder in which a file of the same name and size is a copy, ``None``: none is wanted.
    """
    # A damaged file is kept beside its repaired one, which is identified.
    if identified is not None and path.suffix == ".mcap" and capture_of(path) not in identified:
        return "not identified"
    if copied_to is not None:
        copy = copied_to / path.name
        if not copy.is_file() or copy.stat().st_size != path.stat().st_size:
            return "not copied"
    if path.with_name(path.name + KEEP).exists() or _has_note(path, path.stat().st_mtime_ns):
        return "marked"
    return None


def identified_in(directory: Path, robot: str) -> set[str] | None:
    """Return the captures that need no worker any more; ``None`` if the folder has no ledger of workers."""
    ledger = directory / LEDGER
    if not ledger.is_file():
        return None
    try:
        with closing(sqlite3.connect(f"{ledger.resolve().as_uri()}?mode=ro", uri=True)) as db:
            ended = db.execute("SELECT paths FROM experiments WHERE state != 'waiting'").fetchall()
    except sqlite3.Error as error:
        raise OSError(errno.EIO, str(error), str(ledger)) from error
    names = [name for (paths,) in ended for name in json.loads(paths)]
    names += [path for path, _ in recordings_in(directory, robot) if is_being_written(path)]
    return {capture_of(Path(name)) for name in names}


def capture_of(path: Path) -> str:
    """Return the name of the capture that a file is of: without suffix and number of the part."""
    return re.sub(r"(\.\d{4,})?\.mcap(\.damaged)?$", "", path.name)


@cache
def _has_note(path: Path, _changed_ns: int) -> bool:
    """Return True if an operator has set a mark in a recording (``armident command mark``)."""
    try:
        with path.open("rb") as file:
            marks = make_reader(file).iter_messages(topics=[MARKS_TOPIC])
            return any(json.loads(message.data)["kind"] == "note" for _, _, message in marks)
    except (OSError, McapError, ValueError, KeyError):
        return False


def is_being_written(path: Path) -> bool:
    """Return True if a capture has locked a file for writing."""
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


class RetentionThread:
    """Calls ``delete`` every ``every_s`` in a thread, so that a capture does not wait for the disk; logs results."""

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
                    log.warning(
                        "retention: %s: %s; old recordings stay, tried again every %g s",
                        error.filename or "the folder",
                        error.strerror,
                        self._every_s,
                    )
                last = str(error)
            if self._over.wait(self._every_s):
                return
