"""Identification worker: identifies every recording of a cell once, and announces the results on Zenoh."""

import datetime
import errno
import importlib.metadata
import logging
import math
import os
import queue
import shlex
import signal
import threading
import time
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, TypeVar

from armident.configs import ArmidentError, ConfigError, DataError, RobotConfig, SessionConfig, load_robot, load_session
from armident.configs.reasons import reason_of
from armident.daq.recording import Recording
from armident.daq.streaming import Keys
from armident.identify.identification.identify_recording import IdentificationOutcome, identify_recording
from armident.identify.identification.options import options_of
from armident.identify.monitoring.worker.announcements import Announcements
from armident.identify.monitoring.worker.intake import Intake
from armident.identify.monitoring.worker.ledger import (
    FILE,
    MOST_ATTEMPTS,
    Ledger,
    LedgerEntry,
    LedgerError,
    LedgerLost,
    LedgerUnusable,
    State,
    open_ledger,
    unique_owner,
)
from armident.identify.monitoring.worker.recorded import Captured, result_of
from armident.identify.monitoring.worker.results import results_since
from armident.identify.monitoring.worker.stream_buffer import LARGEST_BLOCK, LARGEST_EVENT, StreamBuffer
from armident.identify.monitoring.worker.worker_link import LinkDown, WorkerLink
from armident.identify.monitoring.worker.worker_metrics import WorkerMetrics
from armident.identify.report.robot_file import write_identification
from armident.systemd import Notifier

log = logging.getLogger(__name__)

POLL_S = 1.0
"""Interval at which the ledger is looked at, and at which leases are renewed, s."""
SCAN_S = 5.0
"""Interval at which folders are searched for recordings whose capture announced no end, s."""
RETRY_S, LONGEST_RETRY_S = 1.0, 30.0
"""First and longest wait before a write is tried again, s."""
LONGEST_STAGE_S = 7200.0
"""Time after which an identification that reports no further stage counts as hung, s."""

_OF_FOLDER = frozenset({errno.EACCES, errno.EPERM, errno.EEXIST, errno.EISDIR, errno.ENOTDIR})
"""Errors of the folder of a result, such as one of another user; others are of the disk, and waited for."""

VERSION = importlib.metadata.version("armident")

T = TypeVar("T")


class _Closing(Exception):
    """The worker is being closed while it waits."""


class Worker:
    """Identifies every recording of one robot in one cell, found by Zenoh's events and in the folders of the cell.

    The ledger in the folder of results lets several workers share the work, also after a crash. ``progress`` is called
    every second while the work advances, for a watchdog. ``since``: older files are passed over, s since 1970. Raises
    ConfigError if Zenoh's configuration is wrong.
    """

    def __init__(
        self,
        session: SessionConfig,
        robot: RobotConfig,
        out: Path,
        progress: Callable[[str], None] | None = None,
        since: float = -math.inf,
    ) -> None:
        self._robot, self._cell, self._out = robot, session.cell, out
        self._folders = (session.recording.directory, out)
        self._options = options_of(session)
        self._keys = Keys(session.cell, robot.name)
        self._owner = unique_owner()
        # Not SimpleQueue: a signal that comes as its timeout ends makes it wait forever (CPython 3.11).
        self._results: queue.Queue[int] = queue.Queue()
        self._buffer = StreamBuffer()
        self._lock = threading.Lock()
        self._intake = Intake(session.cell, robot.name, self._folder_of, self._buffer, self._lock, self._refuse, since)
        self._last: bytes | None = None
        self._problem: str | None = None
        self._digits = 1
        self._progress = progress
        self._state, self._advanced = "waiting", time.monotonic()
        self._wake, self._closing = threading.Event(), threading.Event()
        self._ledger: Ledger | None = None
        limits = LARGEST_EVENT, LARGEST_BLOCK
        self._link = WorkerLink(session, self._keys, self._on_event, self._on_block, limits, self._answer)
        self._metrics = WorkerMetrics(session, robot.name)
        self._attempts = self._failures = 0
        self._announcements = Announcements(self._keys, self._link, session.recording.keep_results_days)
        self._threads = [
            threading.Thread(target=self._identify_all, name="identify", daemon=True),
            threading.Thread(target=self._keep_alive, name="lease", daemon=True),
        ]

    def __enter__(self) -> "Worker":
        """Subscribe, answer queries, declare the liveliness token, and begin to work."""
        self._link.check()
        self._link.status("waiting")
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Close the session; a running identification is abandoned, and free for other workers."""
        self._closing.set()
        self._wake.set()
        self._threads[1].join()
        self._threads[0].join(POLL_S)
        self._link.close()
        self._metrics.close()
        if self._ledger is not None:
            try:
                self._ledger.release()
            except ArmidentError as error:
                log.warning("%s", error)

    def result(self, timeout: float | None = None) -> int | None:
        """Wait for the exit code of the next recording; ``None`` after ``timeout``, s."""
        try:
            return self._results.get(timeout=timeout)
        except queue.Empty:
            return None

    def _answer(self, since: str | None) -> bytes:
        """Return the last result, or all since a time or a recording; ArmidentError if there is none."""
        if since is not None:
            return results_since(Ledger(self._out / FILE, self._owner), since)
        if self._last is None:
            raise DataError("no identification yet")
        return self._last

    def _on_event(self, data: bytes | None, size: int) -> None:
        with self._lock:
            event = self._buffer.take_event(data, size)
        if event is None:
            return
        if event["kind"] == "experiment_start":
            self._link.status("recording", capture=event["capture"])
        self._wake.set()

    def _on_block(self, data: bytes | None, size: int) -> None:
        with self._lock:
            self._buffer.take_block(data, size)

    def _keep_alive(self) -> None:
        """Renew the leases, enter what others announced, and keep the Zenoh session open; in a thread of its own."""
        while not self._closing.wait(POLL_S):
            self._metrics.open()
            try:
                # The other thread leaves a ledger that is lost.
                if (ledger := self._ledger) is not None:
                    ledger.renew()
                    self._announcements.enter_heard(ledger)
                    counters = {"attempts": self._attempts, "failures": self._failures}
                    self._metrics.update(ledger, {**counters, "zenoh_open": self._link.can_announce})
            except (ArmidentError, OSError) as error:
                log.debug("lease or metrics not renewed: %s", error)
            self._link.check()
            if self._progress is not None and time.monotonic() - self._advanced < LONGEST_STAGE_S:
                self._progress(self._state)

    def _advance(self, state: str) -> None:
        """Note that the identifying thread has advanced; a thread that hangs does not, and the watchdog ends it."""
        self._state, self._advanced = state, time.monotonic()

    def _identify_all(self) -> None:
        scanned = -SCAN_S
        while not self._closing.is_set():
            self._wake.clear()
            self._advance(self._problem or "waiting")
            try:
                ledger = self._opened()
                with self._lock:
                    ended = self._buffer.take_ended()
                for assembly in ended:
                    self._intake.take_stream(ledger, assembly, self._folders)
                if time.monotonic() - scanned >= SCAN_S:
                    self._intake.scan(ledger, self._folders)
                    scanned = time.monotonic()
                entry = ledger.claim(held=tuple(self._intake.streams), announce=self._link.can_announce)
                self._problem = None
                self._note_backlog(ledger.summary().states["waiting"])
                if entry is not None:
                    self._process(ledger, entry)
                    continue
            except _Closing:
                return
            except LedgerLost as error:
                log.warning("%s; a new one is begun: results in the folder are found and not announced again", error)
                self._ledger, scanned = None, -SCAN_S
            except (ArmidentError, OSError) as error:
                self._say_problem(str(error) if isinstance(error, ArmidentError) else reason_of(error))
            except Exception as error:
                # The worker must survive any failure of one recording.
                self._say_problem(f"internal error ({type(error).__name__})")
                log.debug("internal error", exc_info=True)
            self._wake.wait(POLL_S)

    def _opened(self) -> Ledger:
        if self._ledger is None:
            ledger = open_ledger(self._out / FILE, self._owner)
            ledger.retry_after_upgrade(VERSION)
            self._intake.begin(ledger)
            self._ledger = ledger
            last = ledger.last_result()
            if last is not None and last.is_file():
                self._last = last.read_bytes()
        return self._ledger

    def _note_backlog(self, backlog: int) -> None:
        """Publish the backlog, and warn at 10, 100, 1000 and so on."""
        self._link.backlog = backlog
        if len(str(backlog)) > self._digits:
            log.warning("%d recordings wait; armident queue lists them, and leaves out those that you name", backlog)
        self._digits = max(self._digits, len(str(backlog))) if backlog else 1

    def _say_problem(self, text: str) -> None:
        """Report a problem once while it lasts; the work is tried again."""
        if text != self._problem:
            self._problem = text
            log.warning("%s; trying again", text)
            self._link.status("waiting", message=text)

    def _refuse(self, capture: str, message: str, code: int) -> None:
        self._link.status("failed", capture=capture, message=message)
        self._results.put(code)

    def _folder_of(self, entry: LedgerEntry) -> Path:
        """Return the folder of a result; another one if a recording of the same name has a result there."""
        plain = self._out / f"{entry.name}.identification"
        taken = (plain / "identification.json").is_file() and result_of(entry.sha256, plain) is None
        return self._out / f"{entry.name}.{entry.sha256[:8]}.identification" if taken else plain

    def _process(self, ledger: Ledger, entry: LedgerEntry) -> None:
        """Identify a recording, enter and announce the result; what was done before is not repeated."""
        code = _exit_code(entry.state, entry.message) if entry.version is None else ArmidentError.exit_code
        if entry.state == "waiting":
            self._attempts += 1
            try:
                if entry.attempts > MOST_ATTEMPTS:
                    raise RuntimeError(f"{MOST_ATTEMPTS} workers have ended while they worked on it")
                self._advance(f"reading {entry.name}")
                Captured(entry.name, entry.paths).check_size()
                found = self._intake.read(ledger, entry)
                if found is None:
                    return
                entry, recording = found
                path, verdict = self._identify(entry, recording)
            except (_Closing, LedgerError, LedgerUnusable):
                raise
            except ArmidentError as error:
                self._fail(ledger, entry, str(error))
                code = error.exit_code
            except Exception as error:
                reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
                step = f"another version tries again, or: {_retry(entry)}"
                message = f"{entry.name}: internal error of armident {VERSION} ({reason}); {step}"
                self._fail(ledger, entry, message, VERSION)
                log.debug("internal error", exc_info=True)
                code = ArmidentError.exit_code
            else:
                if not self._enter(ledger, entry, "done", path, verdict):
                    return
                code = _exit_code("done", verdict)
        self._intake.streams.pop(entry.sha256, None)
        # Without Zenoh the other recordings come first; the next claim is for the announcement.
        with suppress(LinkDown):
            self._until_possible("announcement", lambda: self._announce(ledger, entry.sha256))
            self._results.put(code)

    def _fail(self, ledger: Ledger, entry: LedgerEntry, message: str, version: str | None = None) -> None:
        log.error("%s", message)
        self._failures += 1
        self._enter(ledger, entry, "failed", None, message, version)

    def _enter(self, ledger: Ledger, entry: LedgerEntry, state: State, *more: Any) -> bool:
        mine = self._until_possible("ledger", lambda: ledger.finish(entry.sha256, state, *more))
        if not mine:
            log.warning("%s: lease expired: the result of the other worker is used", entry.name)
        return mine

    def _identify(self, entry: LedgerEntry, recording: Recording) -> tuple[Path, str]:
        """Return the file of the result and its verdict; a result that a killed worker has written is used."""
        folder = self._folder_of(entry)
        found = result_of(entry.sha256, folder)
        if found is not None:
            return found[0], found[1].verdict or ""
        source = "file" if entry.paths else "stream"
        self._advance(f"identifying {entry.name}")
        print(f"worker: {recording.samples.sync.size} samples from the {source}, identifying", flush=True)

        def progress(stage: str, share: float) -> None:
            self._advance(f"identifying {entry.name}: {stage}")
            self._link.status("identifying", capture=entry.name, stage=stage, share=share)

        outcome = identify_recording(recording, self._robot, self._options, progress)
        document, report = self._until_possible("result", lambda: self._write(entry, outcome, folder))
        for reason in outcome.result.verdict.reasons:
            log.warning("%s: %s. Next: %s", reason.level, reason.message, reason.next_step)
        for warning in outcome.document.warnings:
            log.warning("%s", warning)
        level = outcome.result.verdict.level
        print(
            f"worker: {level}, relative torque error {outcome.document.relative_error_pct:.2f} %\n"
            f"result: {document}\nreport: {report}",
            flush=True,
        )
        return document, level

    def _write(self, entry: LedgerEntry, outcome: IdentificationOutcome, folder: Path) -> tuple[Path, Path]:
        """Write a result; ConfigError if its folder alone refuses it, so that the others do not wait for it."""
        try:
            return write_identification(outcome, folder, self._link.signer.identity)
        except OSError as error:
            if error.errno not in _OF_FOLDER or not os.access(self._out, os.W_OK):
                raise
            raise ConfigError(f"{reason_of(error)}; move {folder} away, then: {_retry(entry)}") from error

    def _announce(self, ledger: Ledger, sha256: str) -> None:
        document = self._announcements.make(ledger, sha256)
        if document is not None:
            self._last = document

    def _until_possible(self, what: str, action: Callable[[], T]) -> T:
        """Return the result of an action that is tried again while disk, ledger or Zenoh refuse it."""
        wait, said = RETRY_S, ""
        while True:
            try:
                done = action()
            except (OSError, LedgerError) as error:
                reason = reason_of(error) if isinstance(error, OSError) else str(error)
            else:
                if said:
                    log.info("%s: done after all", what)
                return done
            if reason != said:
                log.warning("%s: %s; trying again", what, reason)
                self._link.status("waiting", message=f"{what}: {reason}")
            said = reason
            self._advance(f"waiting, {what}: {reason}")
            if self._closing.wait(wait):
                raise _Closing
            wait = min(2 * wait, LONGEST_RETRY_S)


def _retry(entry: LedgerEntry) -> str:
    return f"armident queue retry {shlex.quote(entry.name)}"


def _exit_code(state: State, message: str | None) -> int:
    return DataError.exit_code if state == "failed" or message == "unusable" else 0


def run_worker(config: Path, *, once: bool, out: Path | None, since: datetime.datetime | None) -> int:
    """Carry out ``armident worker`` until SIGTERM or SIGINT, or ``once``; return the exit code."""
    session = load_session(config, "identify")
    robot = load_robot(session.robot, "identify")
    stopped = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopped.set())
    folder = out or session.recording.directory
    for path in (folder, session.recording.directory):
        if path.exists() and not path.is_dir():
            raise ConfigError(f"{path}: a file, expected a folder")
    begin = -math.inf if since is None else since.timestamp()
    with closing(Notifier()) as notifier, Worker(session, robot, folder, notifier.progress, begin) as worker:
        print("worker: ready", flush=True)
        notifier.ready(f"{session.cell}: waiting")
        while not stopped.is_set():
            code = worker.result(timeout=0.2)
            if once and code is not None:
                return code
        notifier.stopping()
    return 0
