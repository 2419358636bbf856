"""Ledger of a worker: the recordings of its cell, who works on them, their results and announcements (SQLite).

Files are entered before they are read, under a key of their names and stamps; a worker claims them, reads them, and
then enters their hash. A claim has a lease that its worker renews; after a crash another takes over. The result is
written, then entered, then announced. The announcement and its entry are one transaction; one that was made but not
entered is entered by the others, which have heard it.
"""

import fcntl
import hashlib
import json
import logging
import os
import secrets
import socket
import sqlite3
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from armident.configs import ArmidentError
from armident.configs.reasons import reason_of

log = logging.getLogger(__name__)

FILE = "worker.sqlite"
"""Name of the ledger in the folder of the results."""
LEASE_S = 6.0
"""Time after which a claim ends that is not renewed, s: six renewals of a worker."""
BUSY_S = 10.0
"""Longest wait for another process that writes the ledger, s."""
MOST_ATTEMPTS = 12
"""Number of workers that may end while they read or identify a recording before it is given up. If every second worker
ends for another reason, such as a restart, a good recording is given up once in 4000."""

State = Literal["waiting", "done", "failed", "passed", "ignored"]

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
    """
    ALTER TABLE experiments ADD COLUMN made REAL NOT NULL DEFAULT 0;
    ALTER TABLE experiments ADD COLUMN any_cell INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE experiments ADD COLUMN version TEXT;
    UPDATE experiments SET made = added;
    DELETE FROM files WHERE sha256 IS NULL;
    """,
)
"""Statements that bring a ledger from version k to k + 1; the version is ``PRAGMA user_version``."""


class LedgerError(ArmidentError):
    """The ledger cannot be read or written at present: locked, or the disk is full. Try again."""


class LedgerUnusable(ArmidentError):
    """The ledger is damaged, deleted, or of a newer version."""


class LedgerLost(LedgerUnusable):
    """The ledger is damaged or was deleted: a new one finds the results."""


_UNREAD = "file:"
"""Begin of the key of files that were not read yet."""


@dataclass(frozen=True)
class FoundFiles:
    """Files of one recording with their stamps; ``made``: time of the last change, s since 1970.

    ``any_cell``: the cell's capture has announced them, so the cell that they name does not count.
    """

    name: str
    paths: tuple[Path, ...]
    stamps: tuple[str, ...]
    made: float
    any_cell: bool = False

    @property
    def key(self) -> str:
        """Key in the ledger until the files are read."""
        text = json.dumps([_texts(self.paths), self.stamps])
        return _UNREAD + hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class LedgerEntry:
    """Recording: ``waiting``, ``done``, ``failed``, ``passed`` over (none of this cell), or ``ignored`` by a user.

    ``sha256``: of its samples, or the key of files that were not read; ``paths``: none if it exists in the stream only.
    ``attempts``: claims, this one included; ``message``: verdict, or reason of a failure or of passing over.
    ``version``: of the program, if the failure may be its fault.
    """

    sha256: str
    name: str
    paths: tuple[Path, ...]
    state: State
    attempts: int
    result: Path | None
    message: str | None
    announced: bool
    any_cell: bool
    version: str | None

    @property
    def digest(self) -> str | None:
        """SHA-256 of its samples, hexadecimal; ``None`` if its files were not read yet."""
        return None if self.sha256.startswith(_UNREAD) else self.sha256


@dataclass(frozen=True)
class LedgerSummary:
    """Numbers of recordings by state, entry time of the oldest that waits, and the newest end; times in s since 1970.

    ``verdict``: of the newest result, or ``failed``; ``ended``: its time; ``result``: file of the newest result.
    """

    states: dict[str, int]
    waits_since: float | None
    verdict: str | None
    ended: float | None
    result: Path | None


@dataclass(frozen=True)
class LedgerView:
    """Ledger as a reader sees it; ``last``: entries with the time of their result, or else of their files, s."""

    summary: LedgerSummary
    last: tuple[tuple[LedgerEntry, float], ...]


_COLUMNS = "sha256, name, paths, state, attempts, result, message, announced, any_cell, version"
_LATER = "max(:time, coalesce((SELECT max(finished) FROM experiments), 0) + 0.001)"
"""Time of a result: later than all others, also after a step of the clock back."""
_TOLD = "max(:ms, (SELECT max(announced) FROM experiments) + 1)"
"""Time of an announcement, ms UTC, in column ``announced`` (0: none): later than all others."""
ACTIONS = {"retry": {"state": "waiting", "announced": 0}, "ignore": {"state": "ignored", "announced": 1}}
"""Columns of a recording without a result after each action of a user on it."""
_RESET = (
    "UPDATE experiments SET state = :state, announced = :announced, attempts = 0, owner = NULL, message = NULL, "
    "version = NULL"
)
_REVIVE = (
    "UPDATE experiments SET name = :name, paths = :paths, state = 'waiting', announced = 0 "
    "WHERE sha256 = :sha256 AND (state = 'passed' OR (state = 'waiting' AND :paths != '[]'))"
)
"""A recording that was passed over, or whose files may have gone, is here again in other files."""
_FREE = "(owner IS NULL OR boot IS NOT :boot OR lease_until < :now OR owner = :owner)"


class Ledger:
    """Ledger in a file, shared by all processes that work on the recordings of a folder.

    It is on a local disk (SQLite's write-ahead log). ``lease_s``: end of a claim that is not renewed, s. ``clock``: one
    that nobody sets. Raises LedgerError if locked or full, LedgerUnusable if damaged, deleted meanwhile, or newer.
    """

    def __init__(
        self, path: Path, owner: str, lease_s: float = LEASE_S, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.path, self.owner = path, owner
        self._lease_s, self._clock = lease_s, clock
        self._boot = _boot_id()
        with self._errors():
            path.parent.mkdir(parents=True, exist_ok=True)
        with self._transaction("rwc") as db:
            if (found := db.execute("PRAGMA integrity_check(1)").fetchone()[0]) != "ok":
                raise sqlite3.DatabaseError(found)
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
        row = {"sha256": sha256, "name": name, "paths": _texts(paths), "now": time.time()}
        with self._transaction() as db:
            fresh = db.execute(
                "INSERT INTO experiments (sha256, name, paths, added, made) VALUES (:sha256, :name, :paths, :now, :now)"
                " ON CONFLICT DO NOTHING",
                row,
            ).rowcount
            if not fresh:
                db.execute(_REVIVE, row)
        return bool(fresh)

    def enter(self, found: Sequence[FoundFiles], passed: str | None = None) -> None:
        """Enter unknown files to be read in place of others of these names; ``passed``: why they are passed over."""
        state = {"state": "passed" if passed else "waiting", "message": passed, "announced": bool(passed)}
        with self._transaction() as db:
            for each in found:
                row = {"key": each.key, "name": each.name, "paths": _texts(each.paths), "any_cell": each.any_cell}
                named = dict(zip(map(str, each.paths), each.stamps, strict=True))
                known = {path: _file(db, path) for path in named}
                if all(known[path][0] == stamp for path, stamp in named.items()):
                    db.execute(
                        "UPDATE experiments SET any_cell = 1, state = 'waiting', announced = 0 "
                        "WHERE sha256 = ? AND state = 'passed' AND ? AND NOT any_cell",
                        (known[str(each.paths[0])][1], each.any_cell),
                    )
                    continue
                db.executemany(
                    f"DELETE FROM experiments WHERE sha256 = ? AND sha256 LIKE '{_UNREAD}%' "
                    "AND state IN ('waiting', 'passed')",
                    {(key,) for _, key in known.values()},
                )
                db.execute(
                    "INSERT OR REPLACE INTO experiments "
                    "(sha256, name, paths, added, made, any_cell, state, message, announced) "
                    "VALUES (:key, :name, :paths, :added, :made, :any_cell, :state, :message, :announced)",
                    row | state | {"added": time.time(), "made": each.made},
                )
                db.executemany(
                    "INSERT OR REPLACE INTO files VALUES (?, ?, ?)",
                    [(path, stamp, each.key) for path, stamp in named.items()],
                )

    def files(self) -> dict[Path, str]:
        """Return the stamps of all files that were entered."""
        with self._transaction() as db:
            return {Path(path): stamp for path, stamp in db.execute("SELECT path, stamp FROM files")}

    def key_of(self, path: Path) -> str:
        """Return the hash of the recording of a file that was entered, or its key if it was not read."""
        with self._transaction() as db:
            return str(_file(db, str(path))[1])

    def forget(self, paths: Sequence[Path]) -> None:
        """Forget files: the next search enters them again if they are there."""
        with self._transaction() as db:
            db.executemany("DELETE FROM files WHERE path = ?", [(str(path),) for path in paths])

    def alone(self, paths: Sequence[Path]) -> bool:
        """Return True if one of these files was entered as a recording of its own."""
        query = "SELECT paths FROM files JOIN experiments USING (sha256) WHERE path = ?"
        with self._transaction() as db:
            return any(row[0] == _texts([path]) for path in paths for row in db.execute(query, (str(path),)))

    def settle(self, entry: LedgerEntry, sha256: str) -> bool:
        """Enter the hash of files that were read under a claim; False if it was lost, or the recording is known."""
        row = {"key": entry.sha256, "sha256": sha256, "name": entry.name, "paths": _texts(entry.paths)} | self._me()
        with self._transaction() as db:
            query = "SELECT 1 FROM experiments WHERE sha256 = :key AND owner = :owner AND state = 'waiting'"
            if db.execute(query, row).fetchone() is None:
                return False
            if entry.sha256 == sha256:
                return True
            db.execute("UPDATE files SET sha256 = :sha256 WHERE sha256 = :key", row)
            if db.execute("SELECT 1 FROM experiments WHERE sha256 = :sha256", row).fetchone() is None:
                db.execute("UPDATE experiments SET sha256 = :sha256 WHERE sha256 = :key", row)
                return True
            db.execute("DELETE FROM experiments WHERE sha256 = :key", row)
            db.execute(_REVIVE, row)
            return False

    def claim(
        self, sha256: str | None = None, held: Sequence[str] = (), *, announce: bool = True
    ) -> LedgerEntry | None:
        """Claim a recording without a result or announcement, and return it; ``None`` if there is none.

        Fewest attempts come first, so that one that ends its workers holds up no others; then the newest recording.
        ``held``: streams in memory.
        """
        names = {f"h{k}": value for k, value in enumerate(held)}
        here = ", ".join(f":{name}" for name in names)
        query = (
            f"SELECT {_COLUMNS} FROM experiments WHERE announced = 0 AND (:announce OR state = 'waiting') AND {_FREE} "
            f"AND (:sha256 IS NULL OR sha256 = :sha256) "
            f"AND (paths != '[]' OR state != 'waiting' OR sha256 IN ({here})) "
            "ORDER BY state = 'waiting', attempts, made DESC, name DESC LIMIT 1"
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

    def finish(self, sha256: str, state: State, result: Path | None, message: str, version: str | None = None) -> bool:
        """Enter a result or failure, with ``version`` if that may be at fault; False if the claim was lost."""
        values = {"sha256": sha256, "state": state, "result": None if result is None else str(result.absolute())}
        with self._transaction() as db:
            done = db.execute(
                f"UPDATE experiments SET state = :state, result = :result, message = :message, finished = {_LATER}, "
                "version = :version, announced = :state = 'passed' "
                "WHERE sha256 = :sha256 AND owner = :owner AND state = 'waiting'",
                values | {"message": message, "version": version, "time": time.time()} | self._me(),
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

    def summary(self) -> LedgerSummary:
        """Return what the ledger has; those under way are among the waiting ones."""
        with self._transaction() as db:
            return _summary_of(db)

    def retry_after_upgrade(self, version: str) -> None:
        """Let recordings wait again that failed under another version of the program."""
        with self._transaction() as db:
            db.execute(
                f"{_RESET} WHERE state = 'failed' AND version != :version", {"version": version, **ACTIONS["retry"]}
            )

    def change(self, action: str, patterns: Sequence[str]) -> list[str]:
        """Retry or ignore recordings without a result whose names are these or match them (GLOB); return the names."""
        changed = []
        with self._transaction() as db:
            for pattern in patterns:
                row = {"pattern": pattern, **ACTIONS[action]}
                where = " WHERE (name = :pattern OR name GLOB :pattern) AND state NOT IN ('done', :state)"
                changed += [name for (name,) in db.execute(f"SELECT name FROM experiments{where} ORDER BY name", row)]
                db.execute(_RESET + where, row)
        return changed

    def announced(self) -> list[tuple[int, LedgerEntry]]:
        """Return the announced entries with the times of their announcements, ms UTC, in that order."""
        # Ledgers of former versions have the time of the result only.
        told = "max(announced, CAST(1000 * finished AS INTEGER))"
        ended = "announced AND state IN ('done', 'failed')"
        query = f"SELECT {told} AS told, {_COLUMNS} FROM experiments WHERE {ended} ORDER BY told"
        with self._transaction() as db:
            return [(row[0], _entry(row[1:])) for row in db.execute(query)]

    def remove(self, hashes: Sequence[str]) -> None:
        """Remove entries, and their files, which exist no more."""
        with self._transaction() as db:
            for table in ("experiments", "files"):
                db.executemany(f"DELETE FROM {table} WHERE sha256 = ?", [(sha256,) for sha256 in hashes])

    def _me(self) -> dict[str, object]:
        now = self._clock()
        return {"owner": self.owner, "boot": self._boot, "now": now, "until": now + self._lease_s}

    @contextmanager
    def _transaction(self, mode: str = "rw") -> Iterator[sqlite3.Connection]:
        """Yield a connection in a transaction that excludes other writers; it is committed at the end of the block."""
        with self._errors():
            uri = f"{self.path.absolute().as_uri()}?mode={mode}"
            db = sqlite3.connect(uri, timeout=BUSY_S, isolation_level=None, uri=True)
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
            if self.path.parent.is_dir() and not self.path.exists():
                raise LedgerLost(f"{self.path}: the ledger was deleted") from error
            raise LedgerError(f"{self.path}: {reason_of(error, BUSY_S, named=False)}") from error
        except sqlite3.DatabaseError as error:
            reason = " ".join(str(error).split())
            raise LedgerLost(
                f"{self.path}: the ledger is damaged ({reason}); restart a worker, which begins a new one"
            ) from error


def open_ledger(path: Path, owner: str) -> Ledger:
    """Return a ledger; a damaged one is moved aside and a new one is begun. Raises as `Ledger`."""
    with suppress(LedgerLost):
        return Ledger(path, owner)
    with path.with_name(f"{path.name}.lock").open("w") as lock:
        # Of several workers that start at once the first moves it.
        fcntl.flock(lock, fcntl.LOCK_EX)
        with suppress(LedgerLost):
            return Ledger(path, owner)
        aside = path.with_name(f"{path.name}.damaged-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}")
        for suffix in ("", "-wal", "-shm"):
            with suppress(FileNotFoundError):
                path.with_name(path.name + suffix).rename(aside.with_name(aside.name + suffix))
        log.warning("%s: the ledger was damaged, and is now %s; a new one finds the results", path, aside.name)
        return Ledger(path, owner)


def view_of(path: Path, most: int) -> LedgerView:
    """Return the state and the last ``most`` recordings of a ledger, without writing or waiting; LedgerUnusable."""
    when = "coalesce(finished, made)"
    try:
        with closing(_reading(path)) as db:
            version = int(db.execute("PRAGMA user_version").fetchone()[0])
            if version != len(_MIGRATIONS):
                raise LedgerUnusable(f"{path}: ledger of version {version}, not {len(_MIGRATIONS)}; restart its worker")
            rows = db.execute(
                f"SELECT {when}, {_COLUMNS} FROM experiments ORDER BY {when} DESC, name DESC LIMIT ?", (most,)
            ).fetchall()
            return LedgerView(_summary_of(db), tuple((_entry(row[1:]), float(row[0])) for row in rows))
    except (sqlite3.Error, ValueError, TypeError) as error:
        reason = reason_of(error) if isinstance(error, sqlite3.Error) else "damaged (a row has other values)"
        raise LedgerUnusable(f"{path}: {reason}") from error


def _summary_of(db: sqlite3.Connection) -> LedgerSummary:
    newest = "SELECT CASE state WHEN 'done' THEN message ELSE state END, finished, result FROM experiments WHERE "
    order = " AND finished ORDER BY finished DESC LIMIT 1"
    rows = db.execute("SELECT state, count(*), min(added) FROM experiments GROUP BY state").fetchall()
    ended = db.execute(f"{newest} state IN ('done', 'failed') {order}").fetchone()
    result = db.execute(f"{newest} result IS NOT NULL {order}").fetchone()
    numbers = dict.fromkeys(get_args(State), 0) | {state: number for state, number, _ in rows}
    since = next((added for state, _, added in rows if state == "waiting"), None)
    verdict, moment, _ = ended or (None, None, None)
    return LedgerSummary(numbers, since, verdict, moment, Path(result[2]) if result else None)


def _reading(path: Path) -> sqlite3.Connection:
    """Return a connection that only reads, and creates no files beside the ledger."""
    # Without a write-ahead log no process has the ledger open, and SQLite would make one to read it.
    alone = "" if path.with_name(f"{path.name}-wal").exists() else "&immutable=1"
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro{alone}", 1.0, isolation_level=None, uri=True)


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


def _file(db: sqlite3.Connection, path: str) -> tuple[str | None, str | None]:
    """Return the stamp and the key of a file that was entered."""
    row = db.execute("SELECT stamp, sha256 FROM files WHERE path = ?", (path,)).fetchone()
    return (None, None) if row is None else (row[0], row[1])


def _entry(row: tuple[str, str, str, State, int, str | None, str | None, int, int, str | None]) -> LedgerEntry:
    sha256, name, paths, state, attempts, result, message, announced, any_cell, version = row
    files = tuple(Path(path) for path in json.loads(paths))
    found = None if result is None else Path(result)
    return LedgerEntry(sha256, name, files, state, attempts, found, message, bool(announced), bool(any_cell), version)


def _texts(paths: Sequence[Path]) -> str:
    return json.dumps([str(path) for path in paths])


def _boot_id() -> str:
    """Return the number of this start of the machine: leases of an earlier one have ended."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""
