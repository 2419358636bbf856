"""Ledger of a worker: the recordings of its cell, who works on them, their results and announcements (SQLite).

A recording, known by its hash, is claimed with a lease that its worker renews; after a crash another takes over. The
result is written, then entered, then announced. The announcement and its entry are one transaction; one that was made
but not entered is entered by the others, which have heard it.
"""

import json
import os
import secrets
import socket
import sqlite3
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from armident.configs import ArmidentError
from armident.configs.reasons import reason_of

FILE = "worker.sqlite"
"""Name of the ledger in the folder of the results."""
LEASE_S = 6.0
"""Time after which a claim ends that is not renewed, s: six renewals of a worker."""
BUSY_S = 10.0
"""Longest wait for another process that writes the ledger, s."""
MOST_ATTEMPTS = 12
"""Number of workers that may end during one identification before the recording is given up. If every second worker
ends for another reason, such as a restart, a good recording is given up once in 4000."""

State = Literal["waiting", "done", "failed"]

_MIGRATIONS = (
    """
    CREATE TABLE experiments (
        sha256 TEXT PRIMARY KEY,
        name TEXT NOT NULL,
        paths TEXT NOT NULL,
        added REAL NOT NULL,
        state TEXT NOT NULL DEFAULT 'waiting',
        attempts INTEGER NOT NULL DEFAULT 0,
        owner TEXT,
        boot TEXT,
        lease_until REAL,
        result TEXT,
        message TEXT,
        finished REAL,
        announced INTEGER NOT NULL DEFAULT 0
    );
    CREATE TABLE files (
        path TEXT PRIMARY KEY,
        stamp TEXT NOT NULL,
        sha256 TEXT
    );
    """,
)
"""Statements that bring a ledger from version k to k + 1; the version is ``PRAGMA user_version``."""


class LedgerError(ArmidentError):
    """The ledger cannot be read or written at present: locked, or the disk is full. Try again."""


class LedgerUnusable(ArmidentError):
    """The ledger is damaged, or of a newer version."""


@dataclass(frozen=True)
class LedgerEntry:
    """Recording in the ledger: ``waiting``, ``done`` or ``failed``; without files it exists in the stream only.

    ``sha256``: of its samples; ``attempts``: claims, this one included; ``message``: verdict or reason of failure.
    """

    sha256: str
    name: str
    paths: tuple[Path, ...]
    state: State
    attempts: int
    result: Path | None
    message: str | None
    announced: bool


_COLUMNS = "sha256, name, paths, state, attempts, result, message, announced"
_LATER = "max(:time, coalesce((SELECT max(finished) FROM experiments), 0) + 0.001)"
"""Time of a result: later than all others, also after a step of the clock back."""
_TOLD = "max(:ms, (SELECT max(announced) FROM experiments) + 1)"
"""Time of an announcement, ms UTC, in column ``announced`` (0: none): later than all others."""
_FREE = "(owner IS NULL OR boot IS NOT :boot OR lease_until < :now OR owner = :owner)"


class Ledger:
    """Ledger in a file, shared by all processes that work on the recordings of a folder.

    It is on a local disk (SQLite's write-ahead log). ``lease_s``: end of a claim that is not renewed, s. ``clock``: one
    that nobody sets. Raises LedgerError if locked or full, LedgerUnusable if damaged or newer.
    """

    def __init__(
        self, path: Path, owner: str, lease_s: float = LEASE_S, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.path, self.owner = path, owner
        self._lease_s, self._clock = lease_s, clock
        self._boot = _boot_id()
        with self._errors():
            path.parent.mkdir(parents=True, exist_ok=True)
        with self._transaction() as db:
            version = int(db.execute("PRAGMA user_version").fetchone()[0])
            if version > len(_MIGRATIONS):
                raise LedgerUnusable(
                    f"{path}: ledger of version {version}, this program knows {len(_MIGRATIONS)}; "
                    "use the newer armident"
                )
            for number, script in enumerate(_MIGRATIONS[version:], start=version + 1):
                for statement in script.split(";"):
                    db.execute(statement)
                db.execute(f"PRAGMA user_version = {number}")

    def add(self, sha256: str, name: str, paths: Sequence[Path]) -> bool:
        """Enter a recording, or files of one without any; return True if the ledger did not know it."""
        row = {"sha256": sha256, "name": name, "paths": _texts(paths), "added": time.time()}
        with self._transaction() as db:
            fresh = db.execute(
                "INSERT INTO experiments (sha256, name, paths, added) VALUES (:sha256, :name, :paths, :added) "
                "ON CONFLICT DO NOTHING",
                row,
            ).rowcount
            if not fresh and paths:
                db.execute(
                    "UPDATE experiments SET name = :name, paths = :paths "
                    "WHERE sha256 = :sha256 AND state = 'waiting' AND paths = '[]'",
                    row,
                )
        return bool(fresh)

    def adopt(self, sha256: str, name: str, paths: Sequence[Path], result: Path, message: str) -> bool:
        """Enter a recording whose result was announced before this ledger existed; return True if it is new."""
        with self._transaction() as db:
            done = db.execute(
                "INSERT INTO experiments (sha256, name, paths, added, state, result, message, finished, announced) "
                f"VALUES (:sha256, :name, :paths, :time, 'done', :result, :message, {_LATER}, 1) "
                "ON CONFLICT DO NOTHING",
                {"sha256": sha256, "name": name, "paths": _texts(paths), "time": time.time()}
                | {"result": str(result), "message": message},
            )
            return bool(done.rowcount)

    def claim(
        self, sha256: str | None = None, held: Sequence[str] = (), *, announce: bool = True
    ) -> LedgerEntry | None:
        """Claim a recording without a result or announcement, and return it; ``None`` if there is none.

        Fewest attempts come first, so that one that ends its workers holds up no others. ``held``: streams in memory.
        """
        names = {f"h{k}": value for k, value in enumerate(held)}
        here = ", ".join(f":{name}" for name in names)
        query = (
            f"SELECT {_COLUMNS} FROM experiments WHERE announced = 0 AND (:announce OR state = 'waiting') AND {_FREE} "
            f"AND (:sha256 IS NULL OR sha256 = :sha256) "
            f"AND (paths != '[]' OR state != 'waiting' OR sha256 IN ({here})) "
            "ORDER BY state = 'waiting', attempts, added, name LIMIT 1"
        )
        with self._transaction() as db:
            row = db.execute(query, names | self._me() | {"sha256": sha256, "announce": announce}).fetchone()
            if row is None:
                return None
            db.execute(
                "UPDATE experiments SET owner = :owner, boot = :boot, lease_until = :until, "
                "attempts = attempts + (state = 'waiting') WHERE sha256 = :sha256",
                self._me() | {"sha256": row[0]},
            )
            return _entry(db.execute(f"SELECT {_COLUMNS} FROM experiments WHERE sha256 = ?", row[:1]).fetchone())

    def renew(self) -> None:
        """Renew the leases of all claims of this process."""
        with self._transaction() as db:
            db.execute("UPDATE experiments SET lease_until = :until WHERE owner = :owner", self._me())

    def release(self) -> None:
        """End all claims of this process: another worker may continue at once."""
        with self._transaction() as db:
            db.execute("UPDATE experiments SET owner = NULL WHERE owner = :owner", self._me())

    def finish(self, sha256: str, state: State, result: Path | None, message: str) -> bool:
        """Enter a result or failure; False if the claim was lost to another worker, whose result counts."""
        values = {"sha256": sha256, "state": state, "result": None if result is None else str(result)}
        with self._transaction() as db:
            done = db.execute(
                f"UPDATE experiments SET state = :state, result = :result, message = :message, finished = {_LATER} "
                "WHERE sha256 = :sha256 AND owner = :owner AND state = 'waiting'",
                values | {"message": message, "time": time.time()} | self._me(),
            )
            return bool(done.rowcount)

    @contextmanager
    def announcement(self, sha256: str) -> Iterator[bool]:
        """Enter an announcement made inside the block, and end its claim; yield False if it must not be made."""
        with self._transaction() as db:
            done = db.execute(
                f"UPDATE experiments SET announced = {_TOLD}, owner = NULL "
                "WHERE sha256 = :sha256 AND owner = :owner AND announced = 0 AND state != 'waiting'",
                {"sha256": sha256, "ms": round(time.time() * 1e3)} | self._me(),
            )
            yield bool(done.rowcount)

    def unannounced(self) -> list[LedgerEntry]:
        """Return the entries with a result or a failure that has not been announced."""
        query = f"SELECT {_COLUMNS} FROM experiments WHERE announced = 0 AND state != 'waiting'"
        with self._transaction() as db:
            return [_entry(row) for row in db.execute(query)]

    def enter_announced(self, sha256: str) -> None:
        """Enter an announcement that another process has made, and end the claim."""
        with self._transaction() as db:
            db.execute(
                f"UPDATE experiments SET announced = {_TOLD}, owner = NULL "
                "WHERE sha256 = :sha256 AND announced = 0 AND state != 'waiting'",
                {"sha256": sha256, "ms": round(time.time() * 1e3)},
            )

    def entry(self, sha256: str) -> LedgerEntry | None:
        """Return the entry of a recording, or ``None``."""
        with self._transaction() as db:
            row = db.execute(f"SELECT {_COLUMNS} FROM experiments WHERE sha256 = ?", (sha256,)).fetchone()
        return None if row is None else _entry(row)

    def entries(self) -> list[LedgerEntry]:
        """Return all entries in the order in which they were added."""
        with self._transaction() as db:
            return [_entry(row) for row in db.execute(f"SELECT {_COLUMNS} FROM experiments ORDER BY added, name")]

    def last_result(self) -> Path | None:
        """Return the file of the newest announced result, or ``None``."""
        with self._transaction() as db:
            row = db.execute(
                "SELECT result FROM experiments WHERE announced AND result IS NOT NULL ORDER BY finished DESC LIMIT 1"
            ).fetchone()
        return None if row is None else Path(row[0])

    def file_hash(self, path: Path, stamp: str) -> tuple[str | None] | None:
        """Hash that was entered for a file of this stamp (size and time of change); ``None`` if it was not entered."""
        with self._transaction() as db:
            row = db.execute("SELECT sha256 FROM files WHERE path = ? AND stamp = ?", (str(path), stamp)).fetchone()
        return None if row is None else (row[0],)

    def enter_file(self, path: Path, stamp: str, sha256: str | None) -> None:
        """Enter a file that was read, and the hash of its recording; ``None`` if it is none of this cell."""
        with self._transaction() as db:
            db.execute("INSERT OR REPLACE INTO files VALUES (?, ?, ?)", (str(path), stamp, sha256))

    def announced(self) -> list[tuple[int, LedgerEntry]]:
        """Return the announced entries with the times of their announcements, ms UTC, in that order."""
        # Ledgers of former versions have the time of the result only.
        told = "max(announced, CAST(1000 * finished AS INTEGER))"
        query = f"SELECT {told} AS told, {_COLUMNS} FROM experiments WHERE announced ORDER BY told, finished"
        with self._transaction() as db:
            return [(row[0], _entry(row[1:])) for row in db.execute(query)]

    def forget(self, hashes: Sequence[str]) -> None:
        """Remove entries, and their files, which exist no more."""
        with self._transaction() as db:
            for table in ("experiments", "files"):
                db.executemany(f"DELETE FROM {table} WHERE sha256 = ?", [(sha256,) for sha256 in hashes])

    def _me(self) -> dict[str, object]:
        now = self._clock()
        return {"owner": self.owner, "boot": self._boot, "now": now, "until": now + self._lease_s}

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        """Yield a connection in a transaction that excludes other writers; it is committed at the end of the block."""
        with self._errors():
            db = sqlite3.connect(self.path, timeout=BUSY_S, isolation_level=None)
            try:
                _use_write_ahead_log(db)
                db.execute("BEGIN IMMEDIATE")
                try:
                    yield db
                    db.execute("COMMIT")
                except BaseException:
                    if db.in_transaction:
                        db.execute("ROLLBACK")
                    raise
            finally:
                db.close()

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.OperationalError, OSError) as error:
            raise LedgerError(f"{self.path}: {reason_of(error, BUSY_S, named=False)}") from error
        except sqlite3.DatabaseError as error:
            raise LedgerUnusable(
                f"{self.path}: the ledger is damaged ({error}); move it away and start again, results are found"
            ) from error


def unique_owner() -> str:
    """Return a name for this process in its claims."""
    return f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(4)}"


def _use_write_ahead_log(db: sqlite3.Connection) -> None:
    """Set the journal mode; SQLite does not wait by itself for other processes that do the same at first."""
    until = time.monotonic() + BUSY_S
    while True:
        try:
            db.execute("PRAGMA journal_mode = WAL")
            # A commit then survives the end of any process, and a loss of power costs the last ones at most.
            db.execute("PRAGMA synchronous = NORMAL")
            return
        except sqlite3.OperationalError as error:
            if "locked" not in str(error) or time.monotonic() > until:
                raise
            time.sleep(0.02)


def _entry(row: tuple[str, str, str, State, int, str | None, str | None, int]) -> LedgerEntry:
    sha256, name, paths, state, attempts, result, message, announced = row
    files = tuple(Path(path) for path in json.loads(paths))
    found = None if result is None else Path(result)
    return LedgerEntry(sha256, name, files, state, attempts, found, message, bool(announced))


def _texts(paths: Sequence[Path]) -> str:
    return json.dumps([str(path) for path in paths])


def _boot_id() -> str:
    """Return the number of this start of the machine: leases of an earlier one have ended."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""
