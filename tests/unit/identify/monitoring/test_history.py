"""Results in a database: each once, in the order of their recordings, and what changed since the first."""

import datetime
import hashlib
import json
import multiprocessing
import os
import sqlite3
import sys
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa
from typer.testing import CliRunner

from armident.configs import ConfigError
from armident.daq.cli import application
from armident.identify.document import IdentificationDocument, to_json
from armident.identify.monitoring import history_schema
from armident.identify.monitoring.history import History, recorded_at
from tests.unit.identify.monitoring.test_change_test import TRUTH, C, identified

WEEK = datetime.timedelta(days=7)
START = datetime.datetime(2026, 1, 5, 6, tzinfo=datetime.UTC)


def result(week: int, theta: np.ndarray, robot: str = "arm") -> IdentificationDocument:
    document = identified(theta, robot=robot)
    name = f"{robot}-{START + week * WEEK:%Y%m%dT%H%M%S}-000Z.mcap"
    digest = hashlib.sha256(name.encode()).hexdigest()
    source = document.recording.model_copy(update={"path": f"/data/{name}", "sha256": digest})
    return document.model_copy(update={"recording": source})


def written(folder: Path, documents: list[IdentificationDocument]) -> list[str]:
    paths = []
    for k, document in enumerate(documents):
        path = folder / f"{document.robot}{k}.json"
        path.write_text(to_json(document))
        paths.append(str(path))
    return paths


def call(*arguments: str) -> tuple[int, str, str]:
    done = CliRunner().invoke(application(["history"]), ["history", *arguments], env={"COLUMNS": "200"})
    return done.exit_code, done.stdout, done.stderr


@pytest.fixture
def url(tmp_path: Path) -> str:
    """An empty database: SQLite, or the PostgreSQL that ARMIDENT_TEST_POSTGRES names, whose tables are dropped."""
    given = os.environ.get("ARMIDENT_TEST_POSTGRES")
    if given is None:
        return f"sqlite:///{tmp_path}/h.sqlite"
    engine = sa.create_engine(given)
    tables = sa.MetaData()
    tables.reflect(engine)
    tables.drop_all(engine)
    engine.dispose()
    return given


def test_a_result_is_kept_once_and_comes_back_as_it_was(url: str, tmp_path: Path) -> None:
    history = History(url)
    late, early = result(2, TRUTH), result(0, TRUTH + 0.01)
    for document in (late, early):
        assert history.add(document, recorded_at(document, tmp_path))
        assert not history.add(document, recorded_at(document, tmp_path))
    again = History(url)
    assert [run.document for run in again.runs("arm")] == [early, late]
    assert [run.recorded for run in again.runs()] == [START, START + 2 * WEEK]
    assert again.arms() == [("arm", None)]


def test_weeks_of_the_same_arm_are_no_change_and_a_change_is_exit_code_4(url: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    weeks = [result(k, d) for k, d in enumerate(rng.multivariate_normal(TRUTH, C, 8))]
    code, out, err = call(*written(tmp_path, weeks), "--database", url, "--json")
    assert code == 0, err
    entries = json.loads(out)
    assert [e["drift"] is None or e["drift"]["drifted"] for e in entries] == [True] + 7 * [False]
    stiff = rng.multivariate_normal(TRUTH, C)
    stiff[12] *= 1.25
    (path,) = written(tmp_path, [result(8, stiff)])
    code, out, _ = call(path, "--database", url, "--parameter", "p12", "--plot", str(tmp_path / "p.svg"))
    assert code == 4
    assert f"changed: p12 {weeks[0].parameters[12].value:.4g} ->" in " ".join(out.split())
    assert (tmp_path / "p.svg").stat().st_size > 5000
    assert call("--database", url)[0] == 4


def test_robots_are_kept_apart(url: str, tmp_path: Path) -> None:
    two = written(tmp_path, [result(0, TRUTH), result(0, 2 * TRUTH, "other")])
    for path in two:
        assert call(path, "--database", url)[0] == 0
    code, _, err = call("--database", url)
    assert code == 2
    assert "--robot: choose one of the robots in the history: arm, other" in err
    assert call("--database", url, "--robot", "other")[0] == 0


def facts(document: IdentificationDocument, cell: str | None) -> dict[str, object]:
    """What a job keeps of a recording."""
    entries = {"duration_s": 7.5, "in_gaps": 0, "facts": {}, "counters": {}}
    return {"sha256": document.recording.sha256, "path": document.recording.path, "cell": cell} | entries


def of(number: int, document: IdentificationDocument) -> IdentificationDocument:
    """From a recording of its own."""
    source = document.recording.model_copy(update={"sha256": f"{number:064x}"})
    return document.model_copy(update={"recording": source})


def test_arms_of_one_name_in_two_cells_are_kept_apart(url: str, tmp_path: Path) -> None:
    history = History(url)
    left, right = of(1, result(0, TRUTH)), of(2, result(1, 2 * TRUTH))
    for document, cell in ((left, "left"), (right, "right")):
        history.describe(facts(document, cell))
        history.add(document, recorded_at(document, tmp_path))
    assert history.arms() == [("arm", "left"), ("arm", "right")]
    for cell, document in (("left", left), ("right", right)):
        run = history.first("arm", cell)
        assert run is not None
        assert run.document == document
    assert history.first("arm", "middle") is None
    code, _, err = call("--database", url)
    assert code == 2
    assert "--cell: choose a cell; arm is known in left, right" in err
    assert "--cell: no 'middle'; arm is known in left, right" in call("--database", url, "--cell", "middle")[2]
    code, out, err = call("--database", url, "--cell", "right", "--plot", str(tmp_path / "p.svg"))
    assert code == 0, err
    assert "arm in cell right" in out
    # A result that is known already says itself where its arm stands.
    (path,) = written(tmp_path, [left])
    code, out, err = call(path, "--database", url)
    assert code == 0, err
    assert "arm in cell left" in out


def test_runs_whose_cell_nobody_knows_may_be_of_any(url: str, tmp_path: Path) -> None:
    history = History(url)
    old, new = of(1, result(0, TRUTH)), of(2, result(1, TRUTH))
    for document in (old, new):
        history.add(document, recorded_at(document, tmp_path))
    history.describe(facts(new, "left"))
    assert [run.document for run in history.runs("arm", "left")] == [old, new]
    assert call("--database", url)[0] == 0


def test_what_is_wrong_is_said_in_one_line(url: str, tmp_path: Path) -> None:
    (path,) = written(tmp_path, [result(0, TRUTH)])
    assert "no 'fv9' of arm; there are p0, p1" in call(path, "--database", url, "--parameter", "fv9")[2]
    assert call(path, "--database", url, "--plot", "a.txt")[0] == 2
    assert call(str(tmp_path / "gone.json"), "--database", url)[0] == 2
    (tmp_path / "text").write_text("no database")
    for wrong in (f"sqlite:///{tmp_path}/text", "sqlite:////nowhere/at/all.sqlite", "oracle9i://x", "nonsense"):
        with pytest.raises(ConfigError, match="cannot be used as history"):
            History(wrong)
    with pytest.raises(ConfigError) as caught:
        History("postgresql+pg8000://me:secret@localhost/x")
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize("scheme", ["postgresql", "postgres", "postgresql+psycopg"])
def test_postgresql_is_reached_by_the_driver_of_our_extra(scheme: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"cannot be used as history: .*[Cc]onnection refused") as caught:
        History(f"{scheme}://me:secret@127.0.0.1:1/x")
    assert "secret" not in str(caught.value)
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(ConfigError, match=r"install it with: pip install 'armident\[postgresql\]'"):
        History(f"{scheme}://me:secret@127.0.0.1:1/x")


def test_a_recording_that_is_identified_again_gets_no_second_entry(url: str, tmp_path: Path) -> None:
    history = History(url)
    first, again = result(0, TRUTH), result(0, TRUTH + 0.001)
    assert history.add(first, recorded_at(first, tmp_path))
    assert not history.add(again, recorded_at(again, tmp_path))
    assert [run.document for run in history.runs()] == [first]


def test_a_name_that_only_looks_like_a_time_is_none(tmp_path: Path) -> None:
    document = result(0, TRUTH)
    odd = document.recording.model_copy(update={"path": "arm-20260101T000061-000Z.mcap"})
    file = tmp_path / "r.json"
    file.touch()
    found = recorded_at(document.model_copy(update={"recording": odd}), file)
    assert found.timestamp() == pytest.approx(file.stat().st_mtime)


def former(path: Path, documents: list[IdentificationDocument]) -> None:
    """A database as version 0.1 has left it: its tables, without a version, and a recording may be there twice."""
    engine = sa.create_engine(f"sqlite:///{path}")
    history_schema.tables.create_all(engine)
    with engine.begin() as connection:
        for k, document in enumerate(documents):
            row = {
                "digest": f"{k:064x}", "robot": document.robot, "recorded": START.replace(tzinfo=None) + k * WEEK,
                "recording": document.recording.path, "sha256": document.recording.sha256, "samples": 1,
                "sample_rate_hz": 1.0, "method": "idim-piv", "relative_error_pct": 1.0, "converged": True,
                "document": to_json(document),
            }  # fmt: skip
            connection.execute(sa.insert(history_schema.runs).values(row))
    engine.dispose()


def test_a_database_of_the_former_version_is_upgraded_and_loses_nothing(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    first, repeated, second = result(0, TRUTH), result(0, TRUTH + 0.1), result(1, TRUTH)
    former(path, [first, repeated, second])
    history = History(f"sqlite:///{path}")
    assert [run.document for run in history.runs()] == [first, second]
    assert not history.add(second, START)
    with sqlite3.connect(path) as db:
        assert db.execute("SELECT count(*) FROM identifications").fetchone() == (3,)
        assert db.execute("PRAGMA user_version").fetchone() == (2,)
    db.close()


def _open_and_add(url: str, week: int) -> None:
    document = result(week, TRUTH)
    assert History(url).add(document, START + week * WEEK)


@pytest.mark.slow
@pytest.mark.parametrize("old", [False, True])
def test_eight_first_openers_at_once_add_eight_runs(tmp_path: Path, old: bool) -> None:
    path = tmp_path / "h.sqlite"
    if old:
        former(path, [])
    context = multiprocessing.get_context("fork")
    openers = [context.Process(target=_open_and_add, args=(f"sqlite:///{path}", k)) for k in range(8)]
    for process in openers:
        process.start()
    for process in openers:
        process.join(60.0)
    assert [process.exitcode for process in openers] == [0] * 8
    assert len(History(f"sqlite:///{path}").runs()) == 8


def test_a_locked_damaged_or_newer_database_is_one_line_with_exit_code_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history_schema, "BUSY_S", 0.1)
    path = tmp_path / "h.sqlite"
    (document,) = written(tmp_path, [result(0, TRUTH)])
    db = sqlite3.connect(path)
    db.execute("BEGIN EXCLUSIVE")
    code, _, err = call(document, "--database", f"sqlite:///{path}")
    db.rollback()
    assert code == 2
    assert "locked by another process for more than" in err
    assert call(document, "--database", f"sqlite:///{path}")[0] == 0
    db.execute("PRAGMA user_version = 99")
    db.close()
    assert "written by a newer armident (version 99" in call("--database", f"sqlite:///{path}")[2]
    content = bytearray(path.read_bytes())
    content[100:] = b"x" * (len(content) - 100)
    content[60:64] = b"\0\0\0\0"
    path.write_bytes(bytes(content))
    code, _, err = call("--database", f"sqlite:///{path}")
    assert code == 2
    assert "damaged" in err
    assert len(err.strip().splitlines()) == 1
