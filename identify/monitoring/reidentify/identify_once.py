"""Identification of a recording that a worker of the cell may identify, too: one of them does it and announces it."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from armident.configs import ArmidentError, DataError, RobotConfig
from armident.daq.recording import Recording
from armident.identify.document import IdentificationDocument, load_document, to_json
from armident.identify.identification.api import identify_recording
from armident.identify.identification.options import Options
from armident.identify.monitoring.ledger import FILE, Ledger, unique_owner
from armident.identify.monitoring.recorded import captured_in, result_of
from armident.identify.monitoring.reidentify.record_run import Say
from armident.identify.report.files import write_identification

RENEW_S = 1.0
"""Interval at which the lease is renewed, s."""
POLL_S = 0.5
"""Interval at which the result of a worker is waited for, s."""


@dataclass(frozen=True)
class OnceIdentified:
    """Identification of a recording, its file, and whether this process made it."""

    document: IdentificationDocument
    path: Path
    ours: bool


def identify_once(
    recording: Recording,
    robot: RobotConfig,
    options: Options,
    out: Path,
    publish: Callable[[str], None],
    say: Say,
) -> OnceIdentified:
    """Identify a recording and announce the result, unless a worker does it; then wait for its result.

    Parameters
    ----------
    recording
        The recording.
    robot
        Configuration of its robot.
    options
        Options of the identification.
    out
        Folder of the results, with the ledger that the workers use.
    publish
        Announces the text of a document.
    say
        Takes lines of progress.

    Raises
    ------
    DataError
        If the recording cannot be identified.
    """
    path = recording.path
    beside = [] if path is None else captured_in((path.parent,), robot.name)
    files = [each for each in beside if path is not None and path.resolve() in each.paths]
    name = files[0].name if files else "recording" if path is None else path.name.removesuffix(".mcap")
    folder = out / f"{name}.identification"
    digest = recording.sha256
    try:
        ledger = Ledger(out / FILE, unique_owner())
        ledger.add(digest, name, files[0].paths if files else ())
    except ArmidentError as error:
        say(f"warning: {error}; workers of this cell may identify the recording, too")
        done = _identified(recording, robot, options, folder)
        publish(to_json(done.document))
        return done
    with _renewed(ledger):
        return _claimed(ledger, digest, lambda: _identified(recording, robot, options, folder), publish, say)


def _claimed(
    ledger: Ledger,
    digest: str,
    identify: Callable[[], OnceIdentified],
    publish: Callable[[str], None],
    say: Say,
) -> OnceIdentified:
    """Return the result of the process that has the claim: this one, or a worker."""
    waiting = False
    while True:
        mine = ledger.claim(digest, held=(digest,))
        entry = mine or ledger.entry(digest)
        assert entry is not None
        done = None
        if mine is not None and mine.state == "waiting":
            done = _entered(ledger, digest, identify)
            if done is None:
                continue
        elif entry.state == "done" and entry.result is not None:
            done = OnceIdentified(load_document(entry.result, IdentificationDocument), entry.result, ours=False)
        elif entry.state == "failed":
            with ledger.announcement(digest):
                pass
            raise DataError(entry.message or "the recording cannot be identified")
        if done is not None:
            with ledger.announcement(digest) as announced_here:
                if announced_here:
                    publish(to_json(done.document))
            return done
        if not waiting:
            say("a worker of this cell identifies the recording; waiting for its result")
            waiting = True
        time.sleep(POLL_S)


def _entered(ledger: Ledger, digest: str, identify: Callable[[], OnceIdentified]) -> OnceIdentified | None:
    """Identify, and enter the result; ``None`` if the claim was lost meanwhile."""
    try:
        done = identify()
    except DataError as error:
        ledger.finish(digest, "failed", None, str(error))
        with ledger.announcement(digest):
            pass
        raise
    return done if ledger.finish(digest, "done", done.path, done.document.verdict or "") else None


def _identified(recording: Recording, robot: RobotConfig, options: Options, folder: Path) -> OnceIdentified:
    found = result_of(recording.sha256, folder)
    if found is not None:
        return OnceIdentified(found[1], found[0], ours=True)
    outcome = identify_recording(recording, robot, options)
    path, _ = write_identification(outcome, folder)
    return OnceIdentified(outcome.document, path, ours=True)


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
