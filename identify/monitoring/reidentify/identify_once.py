"""Identification of a recording that a worker of the cell may identify, too: one of them does it and announces it."""

import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from armident.configs import ArmidentError, DataError, RobotConfig
from armident.daq.identity.certificates import Identity
from armident.daq.recording import Recording
from armident.identify.documents.files import load_document
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.identification.identify_recording import identify_recording
from armident.identify.identification.options import Options
from armident.identify.monitoring.reidentify.publish import StatusPublisher
from armident.identify.monitoring.reidentify.record_run import Say
from armident.identify.monitoring.worker.ledger import FILE, Ledger, LedgerError, LedgerUnusable, unique_owner
from armident.identify.monitoring.worker.recorded import captured_in, result_of
from armident.identify.report.robot_file import write_identification

RENEW_S = 1.0
"""Interval at which the lease is renewed, s."""
RETRY_S = 60.0
"""Time for which a ledger that is locked or cannot be written is tried again, s."""
POLL_S = 0.5
"""Interval at which the result of a worker is waited for, s."""


@dataclass(frozen=True)
class OnceIdentified:
    """Identification of a recording, and its file."""

    document: IdentificationDocument
    path: Path


class _NotPublished(Exception):
    """Zenoh took no announcement: its entry in the ledger must not count."""


@dataclass
class _Recorded:
    """Recording that is to be identified and announced once; ``identify`` reads the result's file if there is one."""

    digest: str
    name: str
    identify: Callable[[], OnceIdentified]
    publisher: StatusPublisher
    published: bool = False

    def publish(self, done: OnceIdentified) -> None:
        """Publish the signed document of a result once."""
        if not self.published and not self.publisher.result(done.path.read_text(encoding="utf-8")):
            raise _NotPublished
        self.published = True

    def publish_failure(self, message: str) -> None:
        """Publish the reason of a failure once, as a worker does."""
        if not self.published:
            self.publisher.failure(message, self.name, self.digest)
        self.published = True


def identify_once(
    recording: Recording,
    robot: RobotConfig,
    options: Options,
    out: Path,
    publisher: StatusPublisher,
    say: Say,
) -> OnceIdentified:
    """Identify a recording and announce the result, unless a worker does it; then wait for its result."""
    path = recording.path
    beside = [] if path is None else captured_in((path.parent,), robot.name)
    files = [each for each in beside if path is not None and path.resolve() in each.paths]
    name = files[0].name if files else "recording" if path is None else path.name.removesuffix(".mcap")
    folder = out / f"{name}.identification"

    def identify() -> OnceIdentified:
        return _identified(recording, robot, options, folder, publisher.signer.identity)

    recorded = _Recorded(recording.sha256, name, identify, publisher)
    paths = files[0].paths if files else ()
    problem: ArmidentError | None = None
    until = math.inf
    while problem is None or time.monotonic() < until:
        try:
            return _shared(out / FILE, recorded, paths, say)
        except LedgerUnusable as error:
            problem, until = error, 0.0
        except LedgerError as error:
            if problem is None:
                until = time.monotonic() + RETRY_S
                say(f"warning: {error}; trying again for {RETRY_S:g} s")
            problem = error
            time.sleep(POLL_S)
    say(f"warning: {problem}; workers of this cell may identify and announce the recording, too")
    return _alone(recorded)


def _shared(file: Path, recorded: _Recorded, paths: Sequence[Path], say: Say) -> OnceIdentified:
    """Identify and publish, or wait for a worker that does, by the ledger in a file."""
    ledger = Ledger(file, unique_owner())
    with _renewed(ledger):
        ledger.add(recorded.digest, recorded.name, paths)
        return _claimed(ledger, recorded, say)


def _alone(recorded: _Recorded) -> OnceIdentified:
    """Identify and publish without a ledger."""
    try:
        done = recorded.identify()
    except DataError as error:
        recorded.publisher.wait_for_listeners()
        recorded.publish_failure(str(error))
        raise
    recorded.publisher.wait_for_listeners()
    with suppress(_NotPublished):
        recorded.publish(done)
    return done


def _claimed(ledger: Ledger, recorded: _Recorded, say: Say) -> OnceIdentified:
    """Return the result of the process that has the claim: this one, or a worker."""
    digest, waiting = recorded.digest, False
    while True:
        mine = ledger.claim(digest, held=(digest,))
        entry = mine or ledger.entry(digest)
        assert entry is not None
        done = None
        if mine is not None and mine.state == "waiting":
            done = _entered(ledger, recorded)
            if done is None:
                continue
        elif entry.state == "done" and entry.result is not None:
            done = OnceIdentified(load_document(entry.result, IdentificationDocument), entry.result)
        elif entry.state == "failed":
            message = entry.message or "the recording cannot be identified"
            _announce_failure(ledger, recorded, message)
            raise DataError(message)
        if done is not None:
            recorded.publisher.wait_for_listeners()
            # A worker announces what Zenoh has not taken here.
            with suppress(_NotPublished), ledger.announcement(digest) as announced_here:
                if announced_here:
                    recorded.publish(done)
            return done
        if not waiting:
            say("a worker of this cell identifies the recording; waiting for its result")
            waiting = True
        time.sleep(POLL_S)


def _entered(ledger: Ledger, recorded: _Recorded) -> OnceIdentified | None:
    """Identify, and enter the result; ``None`` if the claim was lost meanwhile."""
    try:
        done = recorded.identify()
    except DataError as error:
        if not ledger.finish(recorded.digest, "failed", None, str(error)):
            return None
        _announce_failure(ledger, recorded, str(error))
        raise
    return done if ledger.finish(recorded.digest, "done", done.path, done.document.verdict or "") else None


def _announce_failure(ledger: Ledger, recorded: _Recorded, message: str) -> None:
    recorded.publisher.wait_for_listeners()
    with ledger.announcement(recorded.digest) as announced_here:
        if announced_here:
            recorded.publish_failure(message)


def _identified(
    recording: Recording, robot: RobotConfig, options: Options, folder: Path, identity: Identity
) -> OnceIdentified:
    found = result_of(recording.sha256, folder)
    if found is not None:
        return OnceIdentified(found[1], found[0])
    outcome = identify_recording(recording, robot, options)
    try:
        path, _ = write_identification(outcome, folder, identity)
    except OSError as error:
        raise ArmidentError(
            f"{error.filename or folder}: the result cannot be written: {error.strerror}; fix this; "
            f"a worker of the cell then identifies the recording, or run armident identify {recording.path}"
        ) from error
    return OnceIdentified(outcome.document, path)


@contextmanager
def _renewed(ledger: Ledger) -> Iterator[None]:
    """Renew the claims of a ledger inside the block; afterwards they are released."""
    over = threading.Event()

    def renew() -> None:
        while not over.wait(RENEW_S):
            try:
                ledger.renew()
            except ArmidentError:
                continue

    thread = threading.Thread(target=renew, name="lease", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        with suppress(ArmidentError):
            ledger.release()
