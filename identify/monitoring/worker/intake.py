"""Recordings that enter the ledger of a worker: files in folders, announced files, and streams without a file."""

import logging
import math
import re
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from armident.configs import ConfigError, DataError
from armident.configs.reasons import reason_of
from armident.daq.recording import Recording
from armident.daq.recording.reader import has_end
from armident.daq.recording.retention import is_being_written
from armident.identify.monitoring.worker.ledger import Ledger, LedgerEntry
from armident.identify.monitoring.worker.recorded import (
    MOST_BYTES,
    Captured,
    captured_as,
    captured_in,
    check_origin,
    fault_of_name,
    result_of,
    shown,
    stamp_of,
)
from armident.identify.monitoring.worker.stream_buffer import MOST_NAMES, Assembly, StreamBuffer, drop_oldest

log = logging.getLogger(__name__)

STILL_S = 60.0
"""Time without a change after which a file without an end counts as torn, not as one that is being copied, s."""

_CAPTURE = re.compile(r"-\d{8}T\d{6}-")
"""Time in the name of a capture: one of another robot belongs to another worker."""


class Intake:
    """Enters ended recordings in the ledger, unless from before ``since``, s since 1970; reads them under a claim."""

    def __init__(
        self,
        cell: str,
        robot: str,
        folder_of: Callable[[LedgerEntry], Path],
        buffer: StreamBuffer,
        lock: threading.Lock,
        refused: Callable[[str, str, int], None],
        since: float = -math.inf,
    ) -> None:
        self._cell, self._robot, self._folder_of, self._since = cell, robot, folder_of, since
        self._buffer, self._lock, self._refused = buffer, lock, refused
        self._known: dict[Path, str] = {}
        self._changed: dict[Path, tuple[str, float]] = {}
        self._said: dict[Path, str] = {}
        self._streamed: dict[str, str] = {}
        self.streams: dict[str, Recording] = {}
        """Streams without a file that wait for their identification, by the hash of the recording."""

    def begin(self, ledger: Ledger) -> None:
        """Take over what a ledger knows."""
        self._known = ledger.files()

    def take_stream(self, ledger: Ledger, assembly: Assembly, folders: Sequence[Path]) -> None:
        """Enter the files of a capture that has ended, below ``folders``; without them the stream itself."""
        try:
            found = captured_as(assembly.files(folders))
        except DataError as error:
            self._buffer.refuse("paths", error)
            found = []
        if any(not captured.finished for captured in found):
            with self._lock:
                self._buffer.keep(assembly)
                self._buffer.refuse("early", f"capture {assembly.capture}: its file is being written, its end is not")
            return
        try:
            streamed = None
            if not found or (assembly.complete and not assembly.too_long and not assembly.triggered):
                streamed = assembly.recording()
                if not found:
                    check_origin(streamed, None, self._robot)
        except DataError as error:
            if not found:
                self._refuse(assembly, error)
                return
            log.warning("%s", error)
        if found:
            found = [part for each in found for part in self._stretches(ledger, each, set(), growing=False)]
            self._enter(ledger, found, None if streamed is None else streamed.sha256, announced=True)
        elif streamed is not None:
            digest = streamed.sha256
            self.streams[digest] = streamed
            drop_oldest(self.streams)
            name = assembly.capture if streamed.path is None else streamed.path.name.removesuffix(".mcap")
            ledger.add(digest, name, ())

    def scan(self, ledger: Ledger, folders: Sequence[Path]) -> None:
        """Enter the finished recordings of folders that the ledger does not know; none is read."""
        for folder in folders:
            missing = not folder.is_dir()
            self._say(folder.absolute(), "no such folder; it is searched as soon as it is there" if missing else None)
            for path in folder.glob("*.mcap") if folder.is_dir() else ():
                if not path.name.startswith(f"{self._robot}-") and not (
                    _CAPTURE.search(path.name) or path in self._known
                ):
                    self._say(path, f"its name does not begin with {self._robot}-; passed over")
        fresh = [each for each in captured_in(folders, self._robot) if self._is_new(each)]
        if not fresh:
            return
        unfinished = {path for each in fresh for path in each.paths if not self._is_finished(path)}
        # A capture begins a part before it ends the one before: parts that are new by now belong to it.
        now = set(captured_in(folders, self._robot))
        found = [part for each in fresh for part in self._stretches(ledger, each, unfinished, growing=each not in now)]
        self._enter(ledger, found, None)

    def read(self, ledger: Ledger, entry: LedgerEntry) -> tuple[LedgerEntry, Recording] | None:
        """Return a claimed recording with its hash; ``None`` if it is passed over, known, or read again later."""
        if not entry.paths:
            return entry, self.streams[entry.sha256]
        captured = Captured(entry.name, entry.paths)
        before = captured.stamps
        try:
            recording = captured.read()
            check_origin(recording, None if entry.any_cell else self._cell, self._robot)
            if captured.stamps != before:
                raise ConfigError("it changed while it was read")
            if recording.missing is not None and abs(time.time() - captured.found().made) < STILL_S:
                # A copy over an older file, or into reserved space, may have an end from its begin.
                raise ConfigError(f"it is damaged, and changed in the last {STILL_S:g} s, as in a copy under way")
        except (ConfigError, OSError) as error:
            # It may be deleted, or on a disk that is mounted again later.
            reason = reason_of(error) if isinstance(error, OSError) else str(error)
            self._pass_over(ledger, entry, f"{entry.name}: {reason}", again=True)
        except DataError as error:
            self._pass_over(ledger, entry, str(error))
        else:
            return self._settled(ledger, entry, recording)
        return None

    def _settled(
        self, ledger: Ledger, entry: LedgerEntry, recording: Recording
    ) -> tuple[LedgerEntry, Recording] | None:
        digest = recording.sha256
        _compare(entry.paths[0], self._streamed.pop(entry.sha256, digest), digest)
        if not ledger.settle(entry, digest):
            if (known := ledger.entry(digest)) is not None:
                log.info("%s: its samples are those of %s, and so is its result", entry.name, known.name)
            return None
        settled = ledger.entry(digest)
        assert settled is not None
        found = result_of(digest, self._folder_of(settled)) if entry.digest is None else None
        if found is not None:
            # It was announced before this ledger existed.
            ledger.finish(digest, "done", found[0], found[1].verdict or "")
            ledger.enter_announced(digest)
            return None
        return settled, recording

    def _pass_over(self, ledger: Ledger, entry: LedgerEntry, reason: str, *, again: bool = False) -> None:
        """Enter why a recording is none; ``again``: the next search takes its files for new ones."""
        ledger.finish(entry.sha256, "passed", None, reason)
        if not again:
            log.warning("%s; passed over", reason)
            return
        ledger.forget(entry.paths)
        for path in entry.paths:
            self._known.pop(path, None)
        with self._lock:
            self._buffer.refuse("files", f"{reason}; trying again")

    def _stretches(self, ledger: Ledger, captured: Captured, unfinished: set[Path], *, growing: bool) -> list[Captured]:
        """Return what is identified as one recording: a finished capture, or each finished file of a long one.

        A capture whose files were entered one by one stays so: when old ones are deleted, the rest is not joined.
        """
        finished = Captured(captured.name, tuple(path for path in captured.paths if path not in unfinished))
        with suppress(FileNotFoundError):
            if len(captured.paths) > 1 and (ledger.alone(captured.paths) or finished.nbytes > MOST_BYTES):
                return [part for part in finished.parts() if self._is_new(part)]
        return [] if growing or unfinished.intersection(captured.paths) else [captured]

    def _is_new(self, captured: Captured) -> bool:
        """Return True if a file is not known with its present stamp."""
        return any(self._known.get(path) != stamp_of(path) for path in captured.paths)

    def _is_finished(self, path: Path) -> bool:
        """Return True if nobody writes a file any more; otherwise the reason is reported once."""
        try:
            reason = self._not_finished(path)
        except OSError as error:
            reason = reason_of(error, named=False)
        if reason is None:
            self._changed.pop(path, None)
        self._say(path, None if reason is None else f"{reason}; it waits")
        return reason is None

    def _say(self, path: Path, reason: str | None) -> None:
        """Report a reason once while it lasts."""
        if reason is None:
            self._said.pop(path, None)
        elif self._said.get(path) != reason:
            log.info("%s: %s", shown(path), reason)
            self._said[path] = reason

    def _not_finished(self, path: Path) -> str | None:
        if (fault := fault_of_name(path)) is not None:
            return fault
        if not path.is_file():
            return "no file, but a link that leads nowhere, a folder or a pipe"
        if is_being_written(path):
            return "a capture writes it"
        if has_end(path):
            return None
        stamp, now = stamp_of(path), time.monotonic()
        if self._changed.setdefault(path, (stamp, now))[0] != stamp:
            self._changed[path] = stamp, now
        still = now - self._changed[path][1] >= STILL_S
        return None if still else f"it has no end, and did not stay the same for {STILL_S:g} s"

    def _enter(
        self, ledger: Ledger, captures: Sequence[Captured], streamed: str | None, *, announced: bool = False
    ) -> None:
        """Enter finished captures; ``streamed``: hash of their stream."""
        found = []
        for captured in captures:
            with suppress(OSError):
                found.append(captured.found(any_cell=announced))
        entered = [each for each in found if announced or each.made >= self._since]
        if older := [each for each in found if each not in entered]:
            log.info("%d recordings from before --since are passed over", len(older))
        ledger.enter(entered)
        ledger.enter(older, "it is older than --since")
        for each in found:
            self._known.update(zip(each.paths, each.stamps, strict=True))
        if streamed is not None and len(entered) == 1:
            key = ledger.key_of(entered[0].paths[0])
            if key == entered[0].key:
                self._streamed = dict([*self._streamed.items(), (key, streamed)][-MOST_NAMES:])
            else:
                _compare(entered[0].paths[0], streamed, key)

    def _refuse(self, assembly: Assembly, error: DataError) -> None:
        paths = [str(path) for path in (assembly.end or {}).get("paths", ())]
        where = f"its file {paths[0]} is not here" if paths else "it was not written to a file"
        message = f"{error}, and {where}"
        log.error("%s", message)
        self._refused(assembly.capture, message, error.exit_code)


def _compare(path: Path, streamed: str, digest: str) -> None:
    if streamed != digest:
        log.warning("%s: the stream has other samples than the file, which counts", path)
