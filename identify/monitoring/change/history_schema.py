"""Tables of the history, their versions, and their upgrade; databases of version 0.1 have the number 0.

The version is ``PRAGMA user_version`` of SQLite, or a row of ``armident_history_version``.
"""

import os
import re
import socket
import sqlite3
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from armident.configs import ConfigError
from armident.configs.reasons import reason_of

BUSY_S = 15.0
"""Longest wait for another process that writes to the database, and for an answer of a server, s."""
_LOCK_SHARE = 0.9
"""Part of `BUSY_S` after which a server gives up a lock, so that its reason arrives in time."""
CREDENTIAL = "history-password"
"""Name of the systemd credential with the password of the database server."""
_LOCK = 0x61726D69
"""Number of the advisory lock of an upgrade in PostgreSQL."""

_STATES = {
    "55P03": "locked by another process for more than {busy:g} s; try again when that has ended",
    "40P01": "locked by another process (deadlock); try again",
    "57P01": "the server has ended the connection; try again when it runs",
    "25006": "it may not be written (read-only)",
    "42501": "{text}; the user of the URL needs the rights to create, read and write tables",
    "53100": "the disk of the server is full; free space and try again",
}
"""Reasons by the SQLSTATE of PostgreSQL (its manual, appendix A)."""

tables = sa.MetaData()
runs = sa.Table(
    "identifications",
    tables,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("digest", sa.String(64), unique=True, nullable=False),
    sa.Column("robot", sa.String(128), index=True, nullable=False),
    sa.Column("recorded", sa.DateTime, index=True, nullable=False),
    sa.Column("recording", sa.Text),
    sa.Column("sha256", sa.String(64), nullable=False),
    sa.Column("samples", sa.Integer, nullable=False),
    sa.Column("sample_rate_hz", sa.Float, nullable=False),
    sa.Column("method", sa.String(32), nullable=False),
    sa.Column("relative_error_pct", sa.Float, nullable=False),
    sa.Column("converged", sa.Boolean, nullable=False),
    sa.Column("document", sa.Text, nullable=False),
)
"""Identifications of version 1; version 2 adds ``repeated``."""
parameters = sa.Table(
    "parameters",
    tables,
    sa.Column("identification", sa.ForeignKey(runs.c.id), primary_key=True),
    sa.Column("name", sa.String(64), primary_key=True),
    sa.Column("value", sa.Float, nullable=False),
    sa.Column("std", sa.Float, nullable=False),
    sa.Column("unit", sa.String(32), nullable=False),
    sa.Column("essential", sa.Boolean, nullable=False),
)
recordings = sa.Table(
    "recordings",
    tables,
    sa.Column("sha256", sa.String(64), primary_key=True),
    sa.Column("path", sa.Text),
    sa.Column("cell", sa.String(128), index=True),
    sa.Column("duration_s", sa.Float, nullable=False),
    sa.Column("in_gaps", sa.Integer),
    sa.Column("facts", sa.JSON, nullable=False),
    sa.Column("counters", sa.JSON, nullable=False),
)
comparisons = sa.Table(
    "comparisons",
    tables,
    sa.Column("identification", sa.ForeignKey(runs.c.id), primary_key=True),
    sa.Column("baseline", sa.String(64), primary_key=True),
    sa.Column("drifted", sa.Boolean, nullable=False),
    sa.Column("chi_square", sa.Float, nullable=False),
    sa.Column("degrees", sa.Integer, nullable=False),
    sa.Column("p_joint", sa.Float, nullable=False),
    sa.Column("false_alarms", sa.Float, nullable=False),
    sa.Column("changed", sa.JSON, nullable=False),
    sa.Column("words", sa.Text, nullable=False),
)
repeated: sa.ColumnClause[int] = sa.column("repeated", sa.Integer)
"""Column of `runs`: 1 for a further identification of a recording that the history had already."""
runs_as_stored = runs.to_metadata(sa.MetaData())
"""Identifications with all columns of the last version."""
runs_as_stored.append_column(sa.Column("repeated", sa.Integer, nullable=False))


def _one_run_per_recording(connection: sa.Connection) -> None:
    """Mark all but the first run of each recording as repeated, and allow one that is not."""
    for statement in (
        "ALTER TABLE identifications ADD COLUMN repeated INTEGER NOT NULL DEFAULT 0",
        "UPDATE identifications SET repeated = 1 WHERE EXISTS (SELECT 1 FROM identifications AS earlier WHERE "
        "earlier.robot = identifications.robot AND earlier.sha256 = identifications.sha256 "
        "AND earlier.id < identifications.id)",
        "CREATE UNIQUE INDEX one_run_per_recording ON identifications (robot, sha256) WHERE repeated = 0",
    ):
        connection.execute(sa.text(statement))


MIGRATIONS: tuple[Callable[[sa.Connection], None], ...] = (tables.create_all, _one_run_per_recording)
"""Steps from version k to k + 1."""


def engine_for(url: str) -> sa.Engine:
    """Return the engine of a database, whose transactions on SQLite wait for other processes."""
    if not url.startswith("sqlite"):
        if url.count("@") > 1 or re.search("password=[^&]*@", url, re.IGNORECASE):
            raise ConfigError("an @ in user or password of the URL is written %40")
        try:
            return _server_engine(sa.make_url(url))
        except ValueError as error:
            raise ConfigError("the port in the URL is no number") from error
    engine = sa.create_engine(url, connect_args={"timeout": BUSY_S})
    # The driver begins transactions late, and none for changes of tables: they are begun here.
    sa.event.listen(engine, "connect", _without_own_transactions)
    sa.event.listen(engine, "begin", _begin)
    return engine


def shown(url: str) -> str:
    """Return a URL with its passwords masked, also those of its query and those with characters not quoted."""
    masked = re.sub(r":(?!//)(.*password=[^&]*@[^&]*|.*@)", ":***@", url, flags=re.IGNORECASE)
    return re.sub(r"([?&][^=&]*password=)[^&]*", r"\1***", masked, flags=re.IGNORECASE)


def _server_engine(url: sa.URL) -> sa.Engine:
    """Return the engine of a database server; on PostgreSQL nothing is waited for longer than `BUSY_S`."""
    credential = Path(os.environ.get("CREDENTIALS_DIRECTORY", "/nowhere"), CREDENTIAL)
    if url.password is None and "password" not in url.query and credential.is_file():
        url = url.set(password=credential.read_text(encoding="utf-8").rstrip("\n"))
    # Transactions are hours apart, so that none begins on a connection that has ended since.
    engine = sa.create_engine(url, poolclass=sa.NullPool)
    if url.get_backend_name() == "postgresql":
        sa.event.listen(engine, "begin", _limit_locks)
    if url.get_driver_name() == "psycopg":
        sa.event.listen(engine, "do_connect", _connected)
    return engine


def _limit_locks(connection: sa.Connection) -> None:
    connection.exec_driver_sql(f"SET LOCAL lock_timeout = {round(1000 * _LOCK_SHARE * BUSY_S)}")


def _connected(_dialect: Any, _record: Any, words: list[Any], options: dict[str, Any]) -> Any:
    """Return a connection of psycopg that is closed when the server is silent: a stopped one keeps TCP alive."""
    import psycopg

    class Impatient(psycopg.Connection[Any]):
        def wait(self, gen: Generator[Any, Any, Any], *args: Any, **kwargs: Any) -> Any:
            return super().wait(self._limited(gen), *args, **kwargs)

        def _limited(self, gen: Generator[Any, Any, Any]) -> Generator[Any, Any, Any]:
            """Pass on a generator that waits for the server; psycopg sends 0 every 0.1 s while nothing arrives."""
            heard, ready = time.monotonic(), None
            try:
                while True:
                    wanted = gen.send(ready)
                    ready = yield wanted
                    if ready:
                        heard = time.monotonic()
                    elif time.monotonic() - heard > BUSY_S:
                        self.close()
                        raise psycopg.OperationalError(f"it has been silent for {BUSY_S:g} s")
            except StopIteration as done:
                return done.value

    addresses: list[Any] = [None]
    with suppress(OSError):
        addresses = socket.getaddrinfo(options.get("host"), options.get("port"), type=socket.SOCK_STREAM)
    # Each address of a host is tried for this time.
    waits = {"connect_timeout": max(int(BUSY_S / len(addresses)), 1), "tcp_user_timeout": round(1000 * BUSY_S)}
    return Impatient.connect(*words, **waits | options)


def _without_own_transactions(connection: sqlite3.Connection, _record: Any) -> None:
    connection.isolation_level = None


def _begin(connection: sa.Connection) -> None:
    writes = connection.get_execution_options().get("writes", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")


@contextmanager
def writing(engine: sa.Engine) -> Iterator[sa.Connection]:
    """Yield a connection in a transaction that writes; it is committed at the end of the block."""
    with engine.connect().execution_options(writes=True) as connection, connection.begin():
        yield connection


def upgrade(engine: sa.Engine) -> None:
    """Create or upgrade the tables, safely in many processes; raises ConfigError if the database is newer."""
    with engine.connect() as connection:
        if _version(connection) == len(MIGRATIONS):
            return
    with writing(engine) as connection:
        if engine.dialect.name == "postgresql":
            connection.execute(sa.text(f"SELECT pg_advisory_xact_lock({_LOCK})"))
        version = _version(connection)
        if version > len(MIGRATIONS):
            raise ConfigError(f"written by a newer armident (version {version}, this one knows {len(MIGRATIONS)})")
        for migrate in MIGRATIONS[version:]:
            migrate(connection)
        if version < len(MIGRATIONS):
            _set_version(connection, len(MIGRATIONS))


def _version(connection: sa.Connection) -> int:
    if connection.dialect.name == "sqlite":
        return int(connection.exec_driver_sql("PRAGMA user_version").scalar_one())
    if not sa.inspect(connection).has_table("armident_history_version"):
        return 0
    version = connection.execute(sa.text("SELECT version FROM armident_history_version")).scalar()
    if version is None:
        raise ConfigError("damaged (armident_history_version has no row); restore a copy")
    return int(version)


def _set_version(connection: sa.Connection, version: int) -> None:
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql(f"PRAGMA user_version = {version}")
        return
    connection.execute(sa.text("CREATE TABLE IF NOT EXISTS armident_history_version (version INTEGER NOT NULL)"))
    connection.execute(sa.text("DELETE FROM armident_history_version"))
    connection.execute(sa.text("INSERT INTO armident_history_version VALUES (:version)"), {"version": version})


def reason(error: Exception) -> str:
    """Return one line that says why a database cannot be used, without the words of the library for known causes."""
    cause = getattr(error, "orig", None) or error
    if isinstance(cause, ImportError):
        return f"the Python package {cause.name} is not installed"
    # libpq adds a question after the reason.
    text = " ".join(str(cause).partition("\n\tIs the server")[0].split())[:200]
    state = getattr(cause, "sqlstate", None)
    if state in _STATES:
        return _STATES[state].format(busy=_LOCK_SHARE * BUSY_S, text=text)
    if isinstance(error, sa.exc.OperationalError) and not isinstance(cause, sqlite3.Error):
        text = text.removeprefix("connection failed: ")
        return f"no connection to the server ({text}); check that it runs, and host, port, user and database of the URL"
    if isinstance(cause, sqlite3.Error):
        text = reason_of(cause, BUSY_S)
        damaged = "; restore a copy, or begin a new history and add the results to it"
        return text + damaged if text.startswith("damaged") else text
    return text


def wait_and_try(action: Callable[[], None], seconds: float, say: Callable[[str], None]) -> bool:
    """Try an action for some seconds while the database refuses it, each reason once; False if the time is over."""
    until, wait, said = time.monotonic() + seconds, 1.0, ""
    while True:
        try:
            action()
        except ConfigError as error:
            if str(error) != said:
                say(f"warning: {error}")
            said = str(error)
            if time.monotonic() + wait > until:
                return False
            time.sleep(wait)
            wait = min(2 * wait, 10.0)
        else:
            return True
