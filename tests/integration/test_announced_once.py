"""Announcements of workers that are killed, that start late, or whose ledger is locked at that moment."""

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Literal

import pytest

from armident.configs import SessionConfig
from armident.daq.identity.certificates import read_authority, write_identity
from armident.daq.identity.plant import enrol, make_authority, renew
from armident.daq.recording import clock, read_recording
from armident.daq.recording.clock import ClockState
from armident.daq.streaming import Keys, open_session
from armident.identify.documents.signing import sign_file, verify_command
from armident.identify.identification.identify_recording import identify_recording
from armident.identify.monitoring.worker.announcements import Announcements
from armident.identify.monitoring.worker.ledger import FILE, Ledger, LedgerEntry, LedgerError
from armident.identify.monitoring.worker.worker import Worker
from armident.identify.monitoring.worker.worker_link import LinkDown, WorkerLink
from armident.identify.report.robot_file import write_identification
from tests.faults.service import Audience, cell_of
from tests.integration.test_worker_failures import recorded

pytestmark = pytest.mark.slow

State = Literal["done", "failed"]
STATES: list[State] = ["done", "failed"]
LONG_S = 600.0
"""Lease that does not end within a test, s."""


class KilledAfterwards(WorkerLink):
    """Link of a process that is killed (SIGKILL) right after its announcement."""

    def announce(self, *messages: tuple[str, bytes]) -> None:
        super().announce(*messages)
        os.kill(os.getpid(), signal.SIGKILL)


def announce(folder: Path, sha256: str, kind: type[WorkerLink]) -> None:
    """Announce a recording that is claimed by ``one``."""
    session = cell_of(folder)
    keys = Keys(session.cell, "emps")
    with linked(session, kind) as link:
        Announcements(keys, link).make(Ledger(folder / FILE, "one"), sha256)


@contextmanager
def linked(session: SessionConfig, kind: type[WorkerLink] = WorkerLink) -> Iterator[WorkerLink]:
    """Yield a link that can announce."""
    with closing(kind(session, Keys(session.cell, "emps"), nothing, nothing, (0, 0), lambda _: b"")) as link:
        link.check()
        while not link.can_announce:
            time.sleep(0.05)
        yield link


def nothing(_data: bytes | None, _size: int) -> None:
    """Take no message."""


def entered(folder: Path, state: State, lease_s: float) -> LedgerEntry:
    """Return a recording whose result or failure was entered by the process ``one``, and not announced."""
    made = recorded(cell_of(folder), "a")
    assert made.path is not None
    path, message = None, "too short"
    if state == "done":
        path, _ = write_identification(identify_recording(made), folder / "emps-a.identification")
        message = "usable"
    ledger = Ledger(folder / FILE, "one", lease_s)
    ledger.add(made.sha256, "emps-a", [made.path])
    assert ledger.claim(made.sha256) is not None
    assert ledger.finish(made.sha256, state, path, message)
    entry = ledger.entry(made.sha256)
    assert entry is not None
    return entry


def announced(folder: Path, sha256: str) -> bool:
    entry = Ledger(folder / FILE, "test").entry(sha256)
    return entry is not None and entry.announced


@pytest.mark.parametrize("state", STATES)
def test_another_worker_enters_the_announcement_of_one_that_was_killed(tmp_path: Path, state: State) -> None:
    """Between announcement and entry, which is the worst moment."""
    entry, session = entered(tmp_path, state, lease_s=LONG_S), cell_of(tmp_path)
    robot = read_recording(entry.paths[0]).robot
    with closing(Audience(session, "emps")) as audience, Worker(session, robot, tmp_path) as other:
        process = multiprocessing.get_context("forkserver").Process(
            target=announce, args=(tmp_path, entry.sha256, KilledAfterwards)
        )
        process.start()
        process.join()
        assert process.exitcode == -signal.SIGKILL
        until = time.monotonic() + 30.0
        while not announced(tmp_path, entry.sha256):
            assert time.monotonic() < until
            time.sleep(0.1)
        assert other.result(2.0) is None
        counted = audience.results if state == "done" else audience.failures
        assert counted == {entry.sha256: 1}


@pytest.mark.parametrize("state", STATES)
def test_a_listener_that_lost_a_worker_hears_the_next_one(tmp_path: Path, state: State) -> None:
    """It tries to connect once a second by then, and the worker has something to announce when it starts."""
    entry, session = entered(tmp_path, state, lease_s=0.0), cell_of(tmp_path)
    with closing(Audience(session, "emps")) as audience:
        with open_session(session, "worker"):
            time.sleep(1.0)
        time.sleep(3.0)
        with Worker(session, read_recording(entry.paths[0]).robot, tmp_path) as worker:
            assert worker.result(60.0) == (3 if state == "failed" else 0)
            time.sleep(0.5)
            counted = audience.results if state == "done" else audience.failures
            assert counted == {entry.sha256: 1}


def test_an_announcement_is_not_repeated_if_the_ledger_refuses_its_entry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry, session = entered(tmp_path, "done", lease_s=LONG_S), cell_of(tmp_path)
    ledger, transaction = Ledger(tmp_path / FILE, "one", LONG_S), Ledger.announcement

    @contextmanager
    def full(self: Ledger, sha256: str) -> Iterator[bool]:
        with transaction(self, sha256) as mine:
            yield mine
            raise LedgerError("database or disk is full")

    with closing(Audience(session, "emps")) as audience, linked(session) as link:
        announcements = Announcements(Keys(session.cell, "emps"), link)
        monkeypatch.setattr(Ledger, "announcement", full)
        with pytest.raises(LedgerError):
            announcements.make(ledger, entry.sha256)
        assert not announced(tmp_path, entry.sha256)
        monkeypatch.setattr(Ledger, "announcement", transaction)
        assert announcements.make(ledger, entry.sha256) is not None
        assert announced(tmp_path, entry.sha256)
        time.sleep(0.5)
        assert audience.results == {entry.sha256: 1}


def test_each_announcement_deletes_results_that_are_too_old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clock, "clock_state", lambda: ClockState(0.0, 0.0, 0.0, True))
    ledger, old = Ledger(tmp_path / FILE, "one"), tmp_path / "emps-old.identification"
    old.mkdir()
    with monkeypatch.context() as long_ago:
        long_ago.setattr(time, "time", lambda: 1.0e9)
        ledger.add("0" * 64, "emps-old", [tmp_path / "gone.mcap"])
        assert ledger.claim("0" * 64) is not None
        assert ledger.finish("0" * 64, "done", old / "identification.json", "usable")
        with ledger.announcement("0" * 64) as mine:
            assert mine
    entry, session = entered(tmp_path, "failed", lease_s=LONG_S), cell_of(tmp_path)
    with linked(session) as link:
        Announcements(Keys(session.cell, "emps"), link, keep_days=365.0).make(ledger, entry.sha256)
    assert not old.exists()
    assert [each.sha256 for each in ledger.entries()] == [entry.sha256]


def test_a_result_signed_by_an_expired_certificate_is_signed_again_and_announced_after_the_renewal(
    tmp_path: Path,
) -> None:
    entry, keys = entered(tmp_path, "done", lease_s=LONG_S), tmp_path / "keys"
    assert entry.result is not None
    session = cell_of(tmp_path)
    session = session.model_copy(update={"zenoh": session.zenoh.model_copy(update={"keys": keys})})
    make_authority(keys, "werk")
    name = enrol(keys, "worker", session.cell, None, [], 365).name
    then = datetime.now(UTC) - timedelta(days=10)
    expired = read_authority(keys).issue("worker", session.cell, name, [], 9, then)
    write_identity(keys, expired)
    sign_file(entry.result, expired)
    assert verify_command([entry.result], keys, as_json=False) == 1
    ledger, names = Ledger(tmp_path / FILE, "one", LONG_S), Keys(session.cell, "emps")
    with closing(WorkerLink(session, names, nothing, nothing, (0, 0), lambda _: b"")) as link:
        link.check()
        while link._announcer is None or link._announcer.ready_in_s > 0.0:
            time.sleep(0.05)
        with pytest.raises(LinkDown):
            Announcements(names, link).make(ledger, entry.sha256)
        renew(keys, name, (), 365)
        assert link.can_announce
        document = Announcements(names, link).make(ledger, entry.sha256)
    assert document == entry.result.read_bytes()
    assert verify_command([entry.result], keys, as_json=False) == 0
