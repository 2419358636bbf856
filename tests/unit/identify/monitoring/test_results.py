"""Announced results: what a listener that was away asks for, and deletion of old ones with their entries."""

import datetime
import errno
import json
import os
import shutil
import sqlite3
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from armident.configs import ConfigError
from armident.daq.recording import clock
from armident.daq.recording.clock import ClockState
from armident.daq.recording.retention import KEEP
from armident.identify.monitoring.worker.ledger import FILE, FoundFiles, Ledger
from armident.identify.monitoring.worker.results import prune_results, results_since

A, B, C, D = (letter * 64 for letter in "abcd")
DAY_S = 86_400.0


@dataclass
class Cell:
    """Folder of a cell whose worker has the time of a test."""

    folder: Path
    patched: pytest.MonkeyPatch
    now: float = 1.8e9

    def __post_init__(self) -> None:
        self.patched.setattr(time, "time", lambda: self.now)
        self.synchronised(True)
        self.ledger = Ledger(self.folder / FILE, "one")

    def synchronised(self, value: bool) -> None:
        self.patched.setattr(clock, "clock_state", lambda: ClockState(0.0, 0.0, 0.0, value))

    def finish(self, digest: str, *, recorded: bool = True, failed: bool = False) -> Path:
        """Enter a recording with its result; return its folder."""
        name = f"arm-{digest[0]}"
        path, folder = self.folder / f"{name}.mcap", self.folder / f"{name}.identification"
        if recorded:
            path.touch()
        files = FoundFiles(name, (path,), ("stamp",), self.now)
        self.ledger.enter([files])
        entry = self.ledger.claim(files.key)
        assert entry is not None
        assert self.ledger.settle(entry, digest)
        if failed:
            assert self.ledger.finish(digest, "failed", None, "too short")
            return folder
        folder.mkdir()
        (folder / "identification.json").write_text(json.dumps({"of": digest}))
        (folder / "report.html").touch()
        assert self.ledger.finish(digest, "done", folder / "identification.json", "trustworthy")
        return folder

    def announce(self, digest: str) -> None:
        with self.ledger.announcement(digest) as mine:
            assert mine

    def since(self, text: str, **more: int) -> list[str]:
        """The hashes of an answer."""
        return [entry["sha256"] for entry in json.loads(results_since(self.ledger, text, **more))["results"]]

    @property
    def at(self) -> str:
        return datetime.datetime.fromtimestamp(self.now, datetime.UTC).isoformat()

    @property
    def known(self) -> list[str]:
        return [entry.sha256 for entry in self.ledger.entries()]


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cell:
    return Cell(tmp_path, monkeypatch)


def test_a_listener_that_was_away_gets_all_that_was_announced_meanwhile(cell: Cell) -> None:
    for digest in (A, B, C):
        cell.finish(digest, failed=digest == C)
    cell.announce(B)
    cell.now += 100.0
    left = cell.at
    cell.now += 100.0
    # It was finished first, and announced last.
    cell.announce(C)
    cell.now += 100.0
    cell.announce(A)
    assert cell.since(left) == cell.since(B) == [C, A]
    assert cell.since(A) == []
    assert cell.since(D) == [B, C, A], "a hash that is not known (any more) loses nothing"
    assert cell.since("2020-01-01") == [B, C, A]
    answer = json.loads(results_since(cell.ledger, left))
    assert answer["results"][0] == {
        "sha256": C, "capture": "arm-c", "announced": "2027-01-15T08:03:20.000+00:00", "state": "failed",
        "message": "too short", "document": None,
    }  # fmt: skip
    assert answer["results"][1]["document"] == {"of": A}
    assert cell.since(answer["results"][0]["announced"]) == [A]
    with pytest.raises(ConfigError, match="since=then: expected a time"):
        results_since(cell.ledger, "then")


def test_a_step_of_the_clock_back_hides_no_result(cell: Cell) -> None:
    for digest in (A, B):
        cell.finish(digest)
        cell.announce(digest)
        cell.now -= 40 * DAY_S
    assert cell.since(A) == [B]
    announced = json.loads(results_since(cell.ledger, A))["results"][0]["announced"]
    assert cell.since(announced) == []


def test_a_large_answer_goes_on_after_its_last_hash(cell: Cell) -> None:
    for digest in (A, B, C):
        cell.finish(digest)
        cell.announce(digest)
    answer = json.loads(results_since(cell.ledger, "2020-01-01", largest=1))
    assert [entry["sha256"] for entry in answer["results"]] == [A]
    assert answer["more"]
    assert cell.since(A) == [B, C]


def test_entries_of_a_former_ledger_count_by_the_time_of_their_results(cell: Cell) -> None:
    for digest in (A, B):
        cell.finish(digest)
        cell.announce(digest)
        cell.now += 100.0
    db = sqlite3.connect(cell.folder / FILE)
    with db:
        db.execute("UPDATE experiments SET announced = 1")
    db.close()
    cell.finish(C)
    cell.announce(C)
    assert cell.since(A) == [B, C]
    cell.now -= 150.0
    assert cell.since(cell.at) == [B, C]


def test_old_results_go_with_their_entries_when_their_recordings_have_gone(cell: Cell) -> None:
    gone, kept, marked = cell.finish(A, recorded=False), cell.finish(B), cell.finish(C, recorded=False)
    waiting = cell.finish(D)
    (cell.folder / f"{marked.name}{KEEP}").touch()
    for digest in (A, B, C):
        cell.announce(digest)
    cell.now += 100 * DAY_S
    last = cell.finish("e" * 64, failed=True)
    cell.announce("e" * 64)
    prune_results(cell.ledger, 101.0)
    assert gone.exists()
    cell.synchronised(False)
    prune_results(cell.ledger, 99.0)
    assert gone.exists()
    cell.synchronised(True)
    prune_results(cell.ledger, None)
    assert gone.exists()
    for _ in range(2):
        prune_results(cell.ledger, 99.0)
        assert [folder.exists() for folder in (gone, kept, marked, waiting, last)] == [False, False, True, True, False]
        # The recording of B is there: without its entry it would be identified again.
        assert cell.known == [B, C, D, "e" * 64]
    assert cell.folder / "arm-a.mcap" not in cell.ledger.files()
    assert cell.ledger.key_of(cell.folder / "arm-b.mcap") == B
    os.unlink(cell.folder / "arm-b.mcap")
    prune_results(cell.ledger, 99.0)
    assert cell.known == [C, D, "e" * 64]


def test_a_damaged_result_and_one_that_cannot_be_deleted_hold_up_no_other(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    damaged, refused, gone = (cell.finish(digest, recorded=False) for digest in (A, B, C))
    cell.finish(D)
    for digest in (A, B, C, D):
        cell.announce(digest)
    (damaged / "identification.json").write_text('{"of": "a')
    answers = json.loads(results_since(cell.ledger, "2020-01-01"))["results"]
    assert [each["document"] for each in answers] == [None, {"of": B}, {"of": C}, {"of": D}]
    cell.now += 100 * DAY_S
    rmtree = shutil.rmtree

    def of_another_user(folder: Path) -> None:
        if folder == refused:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(folder))
        rmtree(folder)

    monkeypatch.setattr(shutil, "rmtree", of_another_user)
    with pytest.raises(PermissionError):
        prune_results(cell.ledger, 99.0)
    assert [folder.exists() for folder in (damaged, refused, gone)] == [False, True, False]
    assert cell.known == [B, D]


def test_the_newest_result_stays_however_old(cell: Cell) -> None:
    folder = cell.finish(A, recorded=False)
    cell.announce(A)
    cell.now += 1000 * DAY_S
    prune_results(cell.ledger, 1.0)
    assert folder.exists()
    assert cell.known == [A]
