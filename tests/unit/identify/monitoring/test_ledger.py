"""Ledger of the worker: one claim per recording, leases, one announcement; first openers, locks and damage."""

import multiprocessing
import os
import signal
import sqlite3
import time
from pathlib import Path
from typing import cast

import pytest

from armident.configs import ArmidentError
from armident.identify.monitoring.worker import ledger as module
from armident.identify.monitoring.worker.ledger import FILE, LEASE_S, Ledger, LedgerError

A, B = "a" * 64, "b" * 64


class Clock:
    """Clock that a test sets."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def two(tmp_path: Path, clock: Clock) -> tuple[Ledger, Ledger]:
    """The same ledger, opened by two workers."""
    return Ledger(tmp_path / FILE, "one", clock=clock), Ledger(tmp_path / FILE, "two", clock=clock)


def test_a_recording_is_entered_once_and_claimed_by_one_worker(two: tuple[Ledger, Ledger]) -> None:
    one, other = two
    assert one.add(A, "x", [Path("x.mcap")])
    assert not other.add(A, "x", [Path("x.mcap")])
    claimed = one.claim()
    assert claimed is not None
    assert (claimed.sha256, claimed.paths, claimed.attempts) == (A, (Path("x.mcap"),), 1)
    assert other.claim() is None


def test_a_lease_that_is_not_renewed_ends_and_the_result_of_its_worker_does_not_count(
    two: tuple[Ledger, Ledger], clock: Clock
) -> None:
    one, other = two
    one.add(A, "x", [Path("x.mcap")])
    assert one.claim() is not None
    clock.now = 0.9 * LEASE_S
    one.renew()
    clock.now = 1.8 * LEASE_S
    assert other.claim() is None
    clock.now = 1.95 * LEASE_S
    taken = other.claim()
    assert taken is not None
    assert taken.attempts == 2
    assert not one.finish(A, "done", Path("r.json"), "")
    assert other.finish(A, "done", Path("r.json"), "trustworthy")


def test_a_result_is_announced_once_and_again_only_if_the_announcement_failed(two: tuple[Ledger, Ledger]) -> None:
    one, other = two
    one.add(A, "x", [Path("x.mcap")])
    assert one.claim() is not None
    with one.announcement(A) as mine:
        assert not mine, "there is no result yet"
    assert one.finish(A, "done", Path("r.json"), "trustworthy")
    failed = one.announcement(A)
    assert failed.__enter__()
    assert not failed.__exit__(RuntimeError, RuntimeError("not sent"), None)
    with one.announcement(A) as mine:
        assert mine
    for each in two:
        with each.announcement(A) as mine:
            assert not mine
    assert one.claim() is other.claim() is None
    assert one.last_result() == Path.cwd() / "r.json"


def test_the_newest_result_is_the_last_one_also_after_a_step_of_the_clock_back(
    two: tuple[Ledger, Ledger], monkeypatch: pytest.MonkeyPatch
) -> None:
    one, _ = two
    for now, digest, result in ((2000.0, A, "first.json"), (1000.0, B, "second.json")):
        monkeypatch.setattr(time, "time", lambda now=now: now)
        one.add(digest, digest[:1], [Path(f"{digest[:1]}.mcap")])
        assert one.claim(digest) is not None
        assert one.finish(digest, "done", Path(result), "trustworthy")
        with one.announcement(digest) as mine:
            assert mine
    assert one.last_result() == Path.cwd() / "second.json"
    one.add("c" * 64, "z", [Path("z.mcap")])
    assert one.claim() is not None
    assert one.finish("c" * 64, "done", Path("third.json"), "trustworthy")
    one.enter_announced("c" * 64)
    assert one.last_result() == Path.cwd() / "third.json"


def test_a_worker_that_ends_in_order_frees_its_recordings_at_once(two: tuple[Ledger, Ledger]) -> None:
    one, other = two
    one.add(A, "x", [Path("x.mcap")])
    assert one.claim() is not None
    one.release()
    assert other.claim() is not None


def test_a_recording_that_ends_its_workers_does_not_hold_up_others(two: tuple[Ledger, Ledger], clock: Clock) -> None:
    one, other = two
    one.add(A, "x", [Path("x.mcap")])
    one.add(B, "y", [Path("y.mcap")])
    first = one.claim()
    assert first is not None
    clock.now = 2 * LEASE_S
    second = other.claim()
    assert second is not None
    assert {first.sha256, second.sha256} == {A, B}


def test_samples_in_the_memory_of_a_worker_are_claimed_by_it_alone(two: tuple[Ledger, Ledger]) -> None:
    one, other = two
    one.add(A, "x", [])
    assert other.claim() is None
    assert one.claim(held=[A]) is not None


def test_leases_of_an_earlier_start_of_the_machine_have_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = Ledger(tmp_path / FILE, "one")
    one.add(A, "x", [Path("x.mcap")])
    assert one.claim() is not None
    monkeypatch.setattr(module, "_boot_id", lambda: "another")
    assert Ledger(tmp_path / FILE, "two").claim() is not None


def test_a_ledger_that_is_locked_damaged_or_newer_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "BUSY_S", 0.1)
    path = tmp_path / FILE
    Ledger(path, "one")
    with sqlite3.connect(path) as db:
        db.execute("BEGIN IMMEDIATE")
        with pytest.raises(LedgerError, match=r"worker\.sqlite: locked by another process for more than"):
            Ledger(path, "two").add(A, "x", [])
    db.execute("PRAGMA user_version = 99")
    db.close()
    with pytest.raises(ArmidentError, match="ledger of version 99, this program knows 2"):
        Ledger(path, "one")
    path.write_bytes(b"x" * 5000)
    with pytest.raises(ArmidentError, match="the ledger is damaged"):
        Ledger(path, "one")


class Locked:
    """A database that another process locks for the first calls."""

    def __init__(self, calls: int) -> None:
        self.left, self.executed = calls, list[str]()

    def execute(self, statement: str) -> None:
        if self.left > 0:
            self.left -= 1
            raise sqlite3.OperationalError("database is locked")
        self.executed.append(statement)


def test_the_journal_mode_waits_for_another_process_and_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    short, long = Locked(3), Locked(10**9)
    module._use_write_ahead_log(cast(sqlite3.Connection, short))
    assert short.executed == ["PRAGMA journal_mode = WAL", "PRAGMA synchronous = NORMAL"]
    monkeypatch.setattr(module, "BUSY_S", 0.05)
    with pytest.raises(sqlite3.OperationalError, match="locked"):
        module._use_write_ahead_log(cast(sqlite3.Connection, long))


def _open_and_add(path: Path, k: int) -> None:
    Ledger(path, str(k)).add(f"{k:064x}", str(k), [Path("x.mcap")])


def _claim_and_hang(path: Path) -> None:
    assert Ledger(path, "killed", lease_s=1.0).claim() is not None
    path.with_suffix(".claimed").touch()
    time.sleep(60.0)


@pytest.mark.slow
def test_eight_first_openers_at_once_lose_nothing(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    openers = [context.Process(target=_open_and_add, args=(tmp_path / FILE, k)) for k in range(8)]
    for process in openers:
        process.start()
    for process in openers:
        process.join(60.0)
    assert [process.exitcode for process in openers] == [0] * 8
    assert len(Ledger(tmp_path / FILE, "x").entries()) == 8


@pytest.mark.slow
def test_a_killed_worker_is_replaced_within_its_lease(tmp_path: Path) -> None:
    path = tmp_path / FILE
    survivor = Ledger(path, "survivor", lease_s=1.0)
    survivor.add(A, "x", [Path("x.mcap")])
    worker = multiprocessing.get_context("fork").Process(target=_claim_and_hang, args=(path,))
    worker.start()
    while not path.with_suffix(".claimed").exists():
        time.sleep(0.01)
    assert survivor.claim() is None
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGKILL)
    worker.join()
    begin = time.monotonic()
    while survivor.claim() is None:
        assert time.monotonic() - begin < 5.0
        time.sleep(0.05)
