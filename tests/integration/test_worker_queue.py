"""A worker left alone: old files, its backlog, what it passes over, a lost ledger, and ``armident queue``."""

import json
import logging
import os
import shutil
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import yaml

from armident.configs import SessionConfig
from armident.configs.loading import HERE
from armident.daq.streaming import Keys, open_session
from armident.identify.identification.identify_recording import identify_recording
from armident.identify.monitoring.worker import worker as module
from armident.identify.monitoring.worker.ledger import FILE, FoundFiles, Ledger, LedgerLost, open_ledger
from armident.identify.monitoring.worker.worker import Worker
from tests.faults.service import cell_of
from tests.integration.test_worker import LONGEST_S
from tests.integration.test_worker_failures import recorded
from tests.integration.test_worker_intake import ROBOT, entries, wait_for

pytestmark = pytest.mark.slow


@pytest.fixture
def session(tmp_path: Path) -> SessionConfig:
    """A cell whose recordings are in the folder of the test."""
    return cell_of(tmp_path)


def aged(folder: Path, name: str, days: float) -> None:
    then = time.time() - days * 86400.0
    os.utime(folder / f"emps-{name}.mcap", (then, then))


def call(*words: object, cwd: Path | None = None) -> tuple[int, str, str]:
    command = [sys.executable, "-m", "armident.daq.cli", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False, timeout=LONGEST_S)
    return done.returncode, done.stdout, done.stderr


def test_the_newest_recording_comes_first_and_older_ones_than_since_not_at_all(
    session: SessionConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    for seed, (name, days) in enumerate({"a": 0.1, "b": 0.0, "c": 10.0, "d": 20.0}.items()):
        recorded(session, name, seed)
        aged(tmp_path, name, days)
    with Worker(session, ROBOT, tmp_path, since=time.time() - 86400.0) as worker:
        assert worker.result(LONGEST_S) == 0
        assert entries(tmp_path)["emps-b"].state == "done"
        assert worker.result(LONGEST_S) == 0
        assert worker.result(6.0) is None
    states = {name: (entry.state, entry.attempts) for name, entry in entries(tmp_path).items()}
    old = "passed", 0
    assert states == {"emps-a": ("done", 1), "emps-b": ("done", 1), "emps-c": old, "emps-d": old}
    assert caplog.text.count("2 recordings from before --since are passed over") == 1


def test_the_backlog_is_published_and_thousands_of_old_files_hold_up_no_new_one(
    session: SessionConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    Ledger(tmp_path / FILE, "before").enter(
        [FoundFiles(f"emps-old{k}", (tmp_path / f"emps-old{k}.mcap",), ("",), float(k)) for k in range(3000)]
    )
    recorded(session, "new")
    heard: list[dict[str, object]] = []
    with open_session(session, "observer") as observer:
        observer.declare_subscriber(
            Keys(session.cell, "emps").status, lambda sample: heard.append(json.loads(bytes(sample.payload)))
        )
        with Worker(session, ROBOT, tmp_path) as worker:
            assert worker.result(LONGEST_S) == 0
    assert entries(tmp_path)["emps-new"].state == "done"
    assert any(message.get("capture") == "emps-new" and message["backlog"] == 3001 for message in heard)
    assert "3001 recordings wait; armident queue lists them" in caplog.text


def test_what_is_passed_over_or_waits_is_said_once_with_its_reason(
    session: SessionConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    recorded(session.model_copy(update={"cell": "other"}), "a")
    (tmp_path / "emps-b.mcap").symlink_to(tmp_path / "nowhere")
    for name in (b"emps-\xe9.mcap", b"emps-\n.mcap", b"emps-" + 230 * b"n" + b".mcap"):
        shutil.copy(os.fsencode(tmp_path / "emps-a.mcap"), os.path.join(os.fsencode(tmp_path), name))
    (tmp_path / "emps-c.mcap").write_bytes(b"no recording\x89MCAP0\r\n")
    os.mkfifo(tmp_path / "emps-d.mcap")
    (tmp_path / "monday.mcap").touch()
    (tmp_path / "tx40-20260105T060000-000Z.mcap").touch()
    made = recorded(session, "e")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "emps-e.mcap").rename(tmp_path / "elsewhere" / "x.mcap")
    (tmp_path / "emps-e.mcap").symlink_to(tmp_path / "elsewhere" / "x.mcap")
    with Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(LONGEST_S) == 0
        assert worker.result(11.0) is None
    for text in (
        f"emps-a.mcap: of cell other, not {session.cell}; passed over",
        "emps-b.mcap: no file, but a link that leads nowhere, a folder or a pipe; it waits",
        "emps-c.mcap: not a recording (not an MCAP file); passed over",
        "emps-d.mcap: no file, but a link that leads nowhere, a folder or a pipe; it waits",
        "nnn.mcap: its name has more than 230 bytes; rename it; it waits",
        "monday.mcap: its name does not begin with emps-; passed over",
    ):
        assert caplog.text.count(text) == 1, caplog.text
    assert caplog.text.count("its name is not UTF-8, or has control characters") == 2
    assert "tx40" not in caplog.text  # a capture of another robot, which has a worker of its own
    assert entries(tmp_path)["emps-e"].digest == made.sha256


def test_a_worker_says_that_a_folder_is_missing_and_refuses_a_file(
    session: SessionConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    missing = session.model_copy(
        update={"recording": session.recording.model_copy(update={"directory": tmp_path / "later"})}
    )
    text = f"{tmp_path / 'later'}: no such folder; it is searched as soon as it is there"
    with Worker(missing, ROBOT, tmp_path / "out") as worker:
        wait_for(lambda: text in caplog.text)
        (tmp_path / "later").mkdir()
        recorded(missing, "a")
        assert worker.result(LONGEST_S) == 0
    assert caplog.text.count(text) == 1
    (tmp_path / "file").touch()
    code, _, err = call("worker", "--config", "emps_cell.yaml", "--out", tmp_path / "file")
    assert (code, err) == (2, f"armident: {tmp_path / 'file'}: a file, expected a folder\n")


def test_an_internal_error_is_tried_again_by_another_version_and_by_queue_retry(
    session: SessionConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded(session, "a")
    identify = identify_recording

    def upgraded_meanwhile(*_: object) -> object:
        raise ImportError("cannot import name 'x'")

    monkeypatch.setattr(module, "identify_recording", upgraded_meanwhile)
    with Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(LONGEST_S) is not None
    failed = entries(tmp_path)["emps-a"]
    assert (failed.state, failed.announced, failed.version) == ("failed", True, module.VERSION)
    assert f"internal error of armident {module.VERSION} (ImportError: cannot import name 'x')" in (
        failed.message or ""
    )
    with Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(3.0) is None, "the same version fails again"
        assert call("queue", "retry", "emps-*", "--out", tmp_path)[:2] == (0, "emps-a: retry\n")
        assert worker.result(LONGEST_S) is not None
    assert entries(tmp_path)["emps-a"].state == "failed"
    monkeypatch.setattr(module, "identify_recording", identify)
    monkeypatch.setattr(module, "VERSION", "99.0")
    with Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(LONGEST_S) == 0
    assert (entries(tmp_path)["emps-a"].state, entries(tmp_path)["emps-a"].version) == ("done", None)


def test_queue_lists_and_ignores_and_refuses_what_is_not_there(session: SessionConfig, tmp_path: Path) -> None:
    recorded(session.model_copy(update={"cell": "other"}), "a")
    recorded(session, "b")
    code, _, err = call("queue", "list", "--out", tmp_path)
    assert (code, err.count("\n")) == (2, 1)
    assert "no worker has used this folder" in err
    with Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(LONGEST_S) == 0
        wait_for(lambda: entries(tmp_path)["emps-a"].state == "passed")
    code, out, _ = call("queue", "list", "--out", tmp_path)
    assert code == 0
    assert f"passed   emps-a: {tmp_path}/emps-a.mcap: of cell other, not {session.cell}\n" in out
    assert out.endswith("1 done, 1 passed\n")
    assert call("queue", "ignore", "emps-a", "--out", tmp_path)[0] == 0
    document = json.loads(call("queue", "list", "--out", tmp_path, "--json")[1])
    assert document["counts"] == {"ignored": 1, "done": 1}
    assert [(each["name"], each["state"]) for each in document["recordings"]] == [
        ("emps-a", "ignored"),
        ("emps-b", "done"),
    ]
    for words in (("retry",), ("retry", "emps-b"), ("ignore", "emps-z"), ("forget", "emps-a")):
        code, out, err = call("queue", *words, "--out", tmp_path)
        assert (code, out, err.count("\n")) == (2, "", 1), words


def test_a_ledger_that_is_damaged_is_moved_aside_and_the_results_are_found(
    session: SessionConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    recorded(session, "a")
    with Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(LONGEST_S) == 0
    path = tmp_path / FILE
    for suffix in ("-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    path.write_bytes(path.read_bytes()[:4096] + b"\xff" * (path.stat().st_size - 4096))
    with pytest.raises(LedgerLost, match="restart a worker, which begins a new one"):
        Ledger(path, "job")
    with Worker(session, ROBOT, tmp_path) as worker:
        wait_for(lambda: "a new one finds the results" in caplog.text and (tmp_path / FILE).exists())
        wait_for(lambda: [entry.state for entry in entries(tmp_path).values()] == ["done"])
        assert worker.result(1.0) is None, "it was announced before"
    assert "the ledger was damaged, and is now worker.sqlite.damaged-" in caplog.text
    assert len([each for each in tmp_path.iterdir() if ".damaged-" in each.name]) == 1


def test_of_several_workers_one_moves_a_damaged_ledger(tmp_path: Path) -> None:
    (tmp_path / FILE).write_bytes(b"x" * 5000)
    opened: list[Ledger] = []
    threads = [threading.Thread(target=lambda: opened.append(open_ledger(tmp_path / FILE, "one"))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(opened) == 4
    assert len(list(tmp_path.glob("*.damaged-*"))) == 1
    opened[0].add("a" * 64, "x", [])
    assert [len(each.entries()) for each in opened] == [1] * 4


def test_a_ledger_that_is_deleted_while_a_worker_runs_is_begun_again(
    session: SessionConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    recorded(session, "a", 1)
    with Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(LONGEST_S) == 0
        for path in tmp_path.glob(f"{FILE}*"):
            path.unlink()
        recorded(session, "b", 2)
        assert worker.result(LONGEST_S) == 0
        wait_for(lambda: [entry.state for entry in entries(tmp_path).values()] == ["done", "done"])
    assert "worker.sqlite: the ledger was deleted; a new one is begun" in caplog.text


def test_a_ledger_of_the_former_version_keeps_its_results_and_looks_again_at_what_it_passed_over(
    session: SessionConfig, tmp_path: Path
) -> None:
    made = recorded(session, "a")
    stat = (tmp_path / "emps-a.mcap").stat()
    with sqlite3.connect(tmp_path / FILE) as db:
        from armident.identify.monitoring.worker.ledger import _MIGRATIONS

        db.executescript(_MIGRATIONS[0] + "PRAGMA user_version = 1;")
        db.execute(
            "INSERT INTO experiments (sha256, name, paths, added, state, result, message, finished, announced) "
            "VALUES (?, 'emps-a', ?, 1.0, 'done', 'r.json', 'trustworthy', 2.0, 1)",
            (made.sha256, json.dumps([str(tmp_path / "emps-a.mcap")])),
        )
        db.executemany(
            "INSERT INTO files VALUES (?, ?, ?)",
            [
                (str(tmp_path / "emps-a.mcap"), f"emps-a.mcap:{stat.st_size}:{stat.st_mtime_ns}", made.sha256),
                (str(tmp_path / "emps-b.mcap"), "stamp", None),
            ],
        )
    db.close()
    ledger = Ledger(tmp_path / FILE, "one")
    assert list(ledger.files()) == [tmp_path / "emps-a.mcap"]
    with Worker(session, ROBOT, tmp_path) as worker:
        assert worker.result(6.0) is None
    assert [(entry.name, entry.state) for entry in ledger.entries()] == [("emps-a", "done")]


def test_a_relative_folder_of_results_is_kept_as_an_absolute_one(session: SessionConfig, tmp_path: Path) -> None:
    recorded(session, "a")
    data = yaml.safe_load((HERE / "cells" / "emps_cell.yaml").read_text(encoding="utf-8"))
    data |= {"cell": session.cell, "robot": "emps.yaml", "recording": {"directory": str(tmp_path)}}
    (tmp_path / "cell.yaml").write_text(yaml.safe_dump(data | {"identification": {"method": "idim-ls"}}))
    words = ("worker", "--config", tmp_path / "cell.yaml", "--once", "--out", "results")
    code, _, err = call(*words, cwd=tmp_path)
    assert code == 0, err
    result = Ledger(tmp_path / "results" / FILE, "test").last_result()
    assert result == tmp_path / "results" / "emps-a.identification" / "identification.json"
