"""Job of re-identification beside a locked history and a worker that has the recording already."""

import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest

from armident.configs import ArmidentError, DataError, config_path, load_session
from armident.daq.identity.signatures import signer_for
from armident.daq.recording import Recording, read_recording, write_recording
from armident.identify.monitoring.change import history_schema
from armident.identify.monitoring.change.history import History
from armident.identify.monitoring.reidentify import identify_once, keep, run
from armident.identify.monitoring.reidentify.baseline import Baseline
from armident.identify.monitoring.reidentify.publish import StatusPublisher
from armident.identify.monitoring.reidentify.run import Job, carry_out
from armident.identify.monitoring.worker import ledger as ledger_module
from armident.identify.monitoring.worker.ledger import FILE, Ledger
from tests.fixtures import arms

pytestmark = pytest.mark.slow


class Published:
    """Takes what a job publishes."""

    def __init__(self, reachable: bool = True) -> None:
        self.results: list[str] = []
        self.states: list[str] = []
        self.more: list[dict[str, Any]] = []
        self.reachable = reachable
        self.signer = signer_for(load_session("emps_cell.yaml"), "worker")

    def status(self, state: str, **more: Any) -> None:
        self.states.append(state)
        self.more.append(more)

    def failure(self, message: str, name: str, sha256: str) -> None:
        self.status("failed", message=message, capture=name, sha256=sha256)

    def wait_for_listeners(self) -> None:
        """Return at once."""

    def result(self, text: str) -> bool:
        self.results.append(text)
        return self.reachable


@pytest.fixture
def recorded(tmp_path: Path) -> Recording:
    session = load_session("emps_cell.yaml")
    path = tmp_path / "emps-20260105T060000-000Z.mcap"
    write_recording(replace(arms.recording("emps", "emps_excitation", 2), session=session), path)
    return read_recording(path)


def job(folder: Path) -> Job:
    session = load_session("emps_cell.yaml")
    baseline = arms.identified("emps", "emps_excitation", 1)
    store = f"sqlite:///{folder}/h.sqlite"
    return Job(
        config_path("emps_cell.yaml"), session, baseline.robot, Baseline(baseline.document, "b"), store, folder, 1e-4
    )


@pytest.fixture
def quickly(monkeypatch: pytest.MonkeyPatch, recorded: Recording) -> None:
    """Short waits, and the recording in place of a motion."""
    monkeypatch.setattr(history_schema, "BUSY_S", 0.1)
    monkeypatch.setattr(keep, "RETRY_S", 0.5)
    monkeypatch.setattr(run, "record_run", lambda *_: recorded)


@pytest.mark.usefixtures("quickly")
def test_a_locked_history_is_reported_and_the_verdict_is_published(tmp_path: Path, recorded: Recording) -> None:
    work = job(tmp_path)
    History(work.store)
    heard, said = Published(), list[str]()
    db = sqlite3.connect(tmp_path / "h.sqlite")
    db.execute("BEGIN EXCLUSIVE")
    outcome = carry_out(work, cast(StatusPublisher, heard), said.append)
    db.rollback()
    db.close()
    assert outcome.drift is not None
    assert not outcome.changed
    assert len(heard.results) == 1
    assert heard.states[-1] == "done"
    assert any("locked by another process" in line for line in said)
    assert any("the history lacks this run" in line for line in said)
    # Again, as after a crash: the result is taken from its file, entered, and not announced again.
    again = Published()
    carry_out(work, cast(StatusPublisher, again), said.append)
    assert again.results == []
    assert [r.document for r in History(work.store).runs()] == [outcome.document]
    entry = Ledger(tmp_path / FILE, "x").entry(recorded.sha256)
    assert entry is not None
    assert entry.announced


@pytest.mark.usefixtures("quickly")
def test_the_history_is_written_after_the_verdict_is_published(tmp_path: Path) -> None:
    work = job(tmp_path)
    history = History(work.store)
    known: dict[str, int] = {}

    class Listener(Published):
        def status(self, state: str, **more: Any) -> None:
            known[state] = len(history.runs())

    carry_out(work, cast(StatusPublisher, Listener()), lambda _: None)
    assert known["done"] == 0
    assert len(history.runs()) == 1


@pytest.mark.usefixtures("quickly")
def test_a_result_that_zenoh_has_not_taken_is_left_to_a_worker(tmp_path: Path, recorded: Recording) -> None:
    work = job(tmp_path)
    carry_out(work, cast(StatusPublisher, Published(reachable=False)), lambda _: None)
    ledger = Ledger(tmp_path / FILE, "worker")
    entry = ledger.claim(recorded.sha256)
    assert entry is not None
    assert (entry.state, entry.announced) == ("done", False)


@pytest.mark.usefixtures("quickly")
def test_a_ledger_that_locks_or_is_damaged_stops_neither_verdict_nor_announcement(
    tmp_path: Path, recorded: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ledger_module, "BUSY_S", 0.1)
    monkeypatch.setattr(identify_once, "RETRY_S", 0.5)
    work = job(tmp_path)
    Ledger(tmp_path / FILE, "worker")
    db = sqlite3.connect(tmp_path / FILE)
    db.execute("BEGIN EXCLUSIVE")
    for _ in ("locked", "damaged"):
        heard, said = Published(), list[str]()
        outcome = carry_out(work, cast(StatusPublisher, heard), said.append)
        assert not outcome.changed
        assert len(heard.results) == 1
        assert any(FILE in line and "may identify and announce" in line for line in said)
        db.close()
        for name in (FILE, f"{FILE}-wal", f"{FILE}-shm"):
            (tmp_path / name).unlink(missing_ok=True)
        (tmp_path / FILE).write_bytes(b"no ledger" * 100)


@pytest.mark.usefixtures("quickly")
def test_a_failure_is_published_once_with_its_reason(
    tmp_path: Path, recorded: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise DataError("too short")

    work = job(tmp_path)
    monkeypatch.setattr(identify_once, "identify_recording", fails)
    heard = Published()
    for _ in range(2):
        with pytest.raises(DataError, match="too short"):
            carry_out(work, cast(StatusPublisher, heard), lambda _: None)
    assert heard.states.count("failed") == 1
    failure = heard.more[heard.states.index("failed")]
    assert failure == {"message": "too short", "capture": "emps-20260105T060000-000Z", "sha256": recorded.sha256}
    entry = Ledger(tmp_path / FILE, "x").entry(recorded.sha256)
    assert entry is not None
    assert (entry.state, entry.announced) == ("failed", True)


@pytest.mark.usefixtures("quickly")
def test_a_result_that_cannot_be_written_is_one_line_and_left_to_a_worker(tmp_path: Path, recorded: Recording) -> None:
    work = job(tmp_path)
    (tmp_path / "emps-20260105T060000-000Z.identification").write_text("a file is where the folder belongs")
    with pytest.raises(ArmidentError, match=r"the result cannot be written: .*; fix this; a worker"):
        carry_out(work, cast(StatusPublisher, Published()), lambda _: None)
    entry = Ledger(tmp_path / FILE, "worker").claim(recorded.sha256)
    assert entry is not None
    assert entry.state == "waiting"
