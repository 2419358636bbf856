"""Results in a database: each once, in the order of their recordings, and what changed since the first."""

import datetime
import hashlib
import itertools
import json
import multiprocessing
import os
import signal
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import cast

import numpy as np
import psycopg
import pytest
import sqlalchemy as sa
from typer.testing import CliRunner

from armident.configs import ConfigError
from armident.daq.cli import application
from armident.identify.diagnosis.change_test import compare
from armident.identify.documents.files import to_json
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.change import history_schema
from armident.identify.monitoring.change.history import History, recorded_at
from tests.fixtures.postgresql import postgresql, programs
from tests.unit.identify.diagnosis.test_change_test import TRUTH, C, identified

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


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """A PostgreSQL server of this module."""
    folder = programs()
    if folder is None:
        pytest.skip("no PostgreSQL server on this machine; install the Debian package postgresql")
    with postgresql(folder) as url:
        yield url


@pytest.fixture
def postgres_url(server: str) -> str:
    """An empty database on the server."""
    name = f"history_{next(_numbers)}"
    engine = sa.create_engine(driven(f"{server}/postgres"), isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(sa.text(f"CREATE DATABASE {name}"))
    engine.dispose()
    return f"{server}/{name}"


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.slow)])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """An empty database."""
    if request.param == "postgresql":
        return str(request.getfixturevalue("postgres_url"))
    return f"sqlite:///{tmp_path}/h.sqlite"


_numbers = itertools.count()


def driven(url: str) -> str:
    """The URL with the driver of our extra."""
    return url.replace("postgresql://", "postgresql+psycopg://")


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


@pytest.mark.slow
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


@pytest.mark.slow
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


def former(url: str, documents: list[IdentificationDocument]) -> None:
    """A database as version 0.1 has left it: its tables, without a version, and a recording may be there twice."""
    engine = sa.create_engine(driven(url))
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


def version_of(url: str) -> tuple[int, int]:
    """Number of identifications, with those of a recording that was there before, and version of the database."""
    query = "PRAGMA user_version" if url.startswith("sqlite") else "SELECT version FROM armident_history_version"
    engine = sa.create_engine(driven(url))
    with engine.connect() as connection:
        number, version = (
            connection.execute(sa.text(text)).scalar_one() for text in ("SELECT count(*) FROM identifications", query)
        )
    engine.dispose()
    return number, version


def test_a_database_of_the_former_version_is_upgraded_and_loses_nothing(url: str) -> None:
    first, repeated, second = result(0, TRUTH), result(0, TRUTH + 0.1), result(1, TRUTH)
    former(url, [first, repeated, second])
    history = History(url)
    assert [run.document for run in history.runs()] == [first, second]
    assert not history.add(second, START)
    assert version_of(url) == (3, len(history_schema.MIGRATIONS))


def test_a_database_of_every_version_is_upgraded(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for version in range(1, len(history_schema.MIGRATIONS) + 1):
        with monkeypatch.context() as patched:
            patched.setattr(history_schema, "MIGRATIONS", history_schema.MIGRATIONS[:version])
            History(url)
            assert version_of(url) == (0, version)
    assert History(url).add(result(0, TRUTH), START)


def _open_and_add(url: str, week: int) -> None:
    document = result(week, TRUTH)
    assert History(url).add(document, START + week * WEEK)


@pytest.mark.slow
@pytest.mark.parametrize("old", [False, True])
def test_eight_first_openers_at_once_add_eight_runs(url: str, old: bool) -> None:
    if old:
        former(url, [])
    context = multiprocessing.get_context("fork")
    openers = [context.Process(target=_open_and_add, args=(url, k)) for k in range(8)]
    for process in openers:
        process.start()
    for process in openers:
        process.join(60.0)
    assert [process.exitcode for process in openers] == [0] * 8
    assert len(History(url).runs()) == 8


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


@pytest.mark.slow
def test_a_locked_table_on_a_server_is_one_line_and_is_not_waited_for_longer(
    postgres_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history_schema, "BUSY_S", 0.2)
    (document,) = written(tmp_path, [result(0, TRUTH)])
    assert call(document, "--database", postgres_url)[0] == 0
    history = History(postgres_url)
    engine = sa.create_engine(driven(postgres_url))
    with engine.connect() as other:
        other.execute(sa.text("LOCK TABLE identifications"))
        code, _, err = call(document, "--database", postgres_url)
        assert (code, len(err.strip().splitlines())) == (2, 1)
        assert "the history cannot be written: locked by another process for more than 0.18 s; try again" in err
        with pytest.raises(ConfigError, match="the history cannot be read: locked by another process"):
            history.runs()
    engine.dispose()
    assert history.add(result(1, TRUTH), START)


@pytest.mark.slow
def test_a_server_that_ends_a_connection_is_one_line_and_the_next_attempt_succeeds(postgres_url: str) -> None:
    history = History(postgres_url)
    engine = sa.create_engine(driven(postgres_url))
    end = sa.text("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = current_database() "
                  "AND pid != pg_backend_pid()")  # fmt: skip

    def halfway(*_: object) -> None:
        with engine.connect() as other:
            other.execute(end)

    sa.event.listen(history._engine, "before_cursor_execute", halfway, once=True)
    with pytest.raises(ConfigError, match="cannot be written: the server has ended the connection; try again when"):
        history.add(result(0, TRUTH), START)
    assert history.runs() == []
    assert history.add(result(0, TRUTH), START)
    halfway()
    # An idle connection that has ended is replaced.
    assert len(history.runs()) == 1
    engine.dispose()


def of_psycopg(connection: sa.Connection) -> "psycopg.Connection[object]":
    """The connection of the driver."""
    return cast("psycopg.Connection[object]", connection.connection.dbapi_connection)


@contextmanager
def stopped(*processes: int) -> Iterator[None]:
    """Processes of a server that accept connections, which the kernel does, and never answer."""
    for process in processes:
        os.kill(process, signal.SIGSTOP)
    try:
        yield
    finally:
        for process in processes:
            os.kill(process, signal.SIGCONT)


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["before_cursor_execute", "commit"])
def test_a_server_that_hangs_is_left_in_time_whatever_is_waited_for(
    postgres_url: str, moment: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history_schema, "BUSY_S", 1.0)
    history = History(postgres_url)
    with ExitStack() as stack:

        def hang(connection: sa.Connection, *_: object) -> None:
            stack.enter_context(stopped(of_psycopg(connection).info.backend_pid))

        sa.event.listen(history._engine, moment, hang, once=True)
        with pytest.raises(ConfigError, match=r"the history cannot be written: no connection .*silent for 1 s"):
            history.add(result(0, TRUTH), START)
    # A server that was only slow may have committed.
    history.add(result(0, TRUTH), START)
    assert len(history.runs()) == 1


@pytest.mark.slow
def test_a_server_that_does_not_answer_a_new_connection_is_left_in_time(
    postgres_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history_schema, "BUSY_S", 1.0)
    history = History(postgres_url)
    with history._engine.connect() as connection:
        status = Path(f"/proc/{of_psycopg(connection).info.backend_pid}/stat").read_text()
    postmaster = int(status.rpartition(")")[2].split()[1])
    with stopped(postmaster), pytest.raises(ConfigError, match=r"cannot be read: no connection .*timeout expired"):
        history.runs()
    assert history.runs() == []


@pytest.mark.slow
def test_a_reader_without_rights_and_a_server_that_is_not_there_are_one_line(postgres_url: str, server: str) -> None:
    History(postgres_url)
    engine = sa.create_engine(driven(postgres_url))
    with engine.begin() as connection:
        connection.execute(sa.text("CREATE ROLE reader LOGIN"))
    reader = postgres_url.replace("armident@", "reader@")
    with pytest.raises(ConfigError, match=r"permission denied .*; the user of the URL needs the rights"):
        History(reader)
    with engine.begin() as connection:
        connection.execute(sa.text("GRANT SELECT ON ALL TABLES IN SCHEMA public TO reader"))
    assert History(reader).runs() == []
    with pytest.raises(ConfigError, match="permission denied"):
        History(reader).add(result(0, TRUTH), START)
    engine.dispose()
    for wrong, words in (
        (f"{server}/nothing", 'database "nothing" does not exist'),
        ("postgresql://x@127.0.0.1:1/x", "no connection to the server .*[Cc]onnection refused"),
        ("postgresql://x@127.0.0.1:port/x", "the port in the URL is no number"),
    ):
        with pytest.raises(ConfigError, match=words) as caught:
            History(wrong)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "url",
    [
        "postgresql://me:secret@127.0.0.1:1/x",
        "postgresql://me@127.0.0.1:1/x?password=secret",
        "postgresql://me@127.0.0.1:1/x?connect_timeout=2&sslpassword=secret&password=secret",
        "postgresql://me:se@secret@127.0.0.1:1/x",
        "postgresql//me:secret@127.0.0.1/x",
        "me:secret@127.0.0.1/x",
        "postgresql://me@127.0.0.1:1/x?password=p@secret",
        "postgresql://me@127.0.0.1:1/x?PASSWORD=secret",
        "postgresql://me:secret&q?password=x@127.0.0.1:1/x",
        "postgresql+pg8000://me:secret@127.0.0.1/x",
    ],
)
def test_a_password_is_never_printed(url: str) -> None:
    code, out, err = call("--database", url)
    assert code == 2
    assert "cannot be used as history" in err
    assert "secret" not in out + err


@pytest.mark.slow
def test_the_password_comes_from_a_credential_of_systemd(
    postgres_url: str, server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    history = History(postgres_url)
    (tmp_path / history_schema.CREDENTIAL).write_text("p@ss word\n")
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    with History(postgres_url)._engine.connect() as connection:
        assert of_psycopg(connection).pgconn.password == b"p@ss word"
    # One in the URL counts.
    own = History(postgres_url.replace("armident@", "armident:own@"))
    assert own._engine.url.password == "own"
    assert history._engine.url.password is None


def filled(url: str, tmp_path: Path) -> tuple[History, list[IdentificationDocument]]:
    """A history of three runs, the last one with its comparison, and one recording that was identified twice."""
    documents = [result(0, TRUTH), result(0, TRUTH + 0.1), result(1, TRUTH), result(2, TRUTH, "other")]
    former(url, documents)
    history = History(url)
    for document, cell in ((documents[0], "left"), (documents[3], None)):
        history.describe(facts(document, cell))
    history.judge(documents[2], documents[0], compare(documents[0], documents[2], 1e-4))
    return history, documents


def contents(url: str) -> list[list[tuple[object, ...]]]:
    """All rows of the tables, without the numbers of the runs."""
    engine = sa.create_engine(driven(url))
    with engine.connect() as connection:
        found = [
            [tuple(row) for row in connection.execute(query)]
            for query in (
                sa.select(*[c for c in history_schema.runs_as_stored.c if c.name != "id"]).order_by(sa.text("digest")),
                sa.select(history_schema.recordings).order_by(sa.text("sha256")),
                sa.select(history_schema.runs.c.digest, *history_schema.parameters.c[1:])
                .join_from(history_schema.runs, history_schema.parameters)
                .order_by(history_schema.runs.c.digest, history_schema.parameters.c.name),
                sa.select(history_schema.runs.c.digest, *history_schema.comparisons.c[1:]).join_from(
                    history_schema.runs, history_schema.comparisons
                ),
            )
        ]
    engine.dispose()
    return found


@pytest.mark.slow
def test_a_backup_restores_all_that_the_history_had(url: str, tmp_path: Path) -> None:
    history, documents = filled(url, tmp_path)
    added = result(3, TRUTH)
    assert history.add(added, START + 3 * WEEK)
    copy = tmp_path / "copy"
    code, out, err = call("backup", str(copy), "--database", url)
    assert (code, out) == (0, f"saved 5 identifications in {copy}\n"), err
    assert contents(f"sqlite:///{copy}") == contents(url)
    fresh = f"sqlite:///{tmp_path}/fresh.sqlite"
    # A history that has begun again keeps its own runs; their numbers differ from those of the copy.
    later = result(4, TRUTH)
    assert History(fresh).add(later, START + 4 * WEEK)
    for number in (5, 0):
        code, out, err = call("restore", str(copy), "--database", fresh)
        assert (code, out.startswith(f"restored {number} identifications")) == (0, True), err
    restored = History(fresh)
    assert [run.document for run in restored.runs("arm")] == [documents[0], documents[2], added, later]
    assert all(row in now for was, now in zip(contents(url), contents(fresh), strict=True) for row in was)
    assert restored.cell(documents[0]) == "left"


@pytest.mark.slow
def test_a_backup_goes_back_to_a_server_which_then_takes_new_runs(postgres_url: str, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/h.sqlite"
    filled(url, tmp_path)
    copy = tmp_path / "copy"
    assert call("backup", str(copy), "--database", url)[0] == 0
    code, _, err = call("restore", str(copy), "--database", postgres_url)
    assert code == 0, err
    assert contents(postgres_url) == contents(url)
    assert History(postgres_url).add(result(5, TRUTH), START)


def test_a_backup_is_not_replaced_by_an_empty_one_nor_by_itself(tmp_path: Path) -> None:
    url, copy = f"sqlite:///{tmp_path}/h.sqlite", tmp_path / "copy"
    copy.write_text("the last backup")
    for words, reason in (
        (["backup", str(copy)], "not written, because the history is empty"),
        (["backup", str(tmp_path / "h.sqlite")], "the history itself"),
        (["restore", str(tmp_path / "gone")], "no such file"),
        (["restore", str(copy)], f"armident: {copy}: cannot be used as history: damaged"),
        (["backup"], "expected one file"),
    ):
        code, _, err = call(*words, "--database", url)
        assert code == 2
        assert reason in err
    assert copy.read_text() == "the last backup"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["copy", "h.sqlite"]
