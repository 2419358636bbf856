"""Results of a suite on disk: one JSON line per case, so that a run that was stopped goes on where it was."""

import hashlib
import json
import os
import threading
from pathlib import Path
from typing import Any

from armident import configs
from armident.configs import DataError

Record = dict[str, Any]

DECIDING = ("configs", "identify", "virtual_robot", "daq/recording")
"""Folders whose code and data decide a result."""
DECIDING_SUFFIXES = (".py", ".yaml")
NOT_DECIDING = ("configs/suites/", "identify/report/")
"""What of the cases decides is in each of them, and a report draws what has been decided."""


def code_version(root: Path = Path(configs.__file__).parents[1]) -> str:
    """Hash of the code that results depend on."""
    digest = hashlib.sha256()
    for folder in DECIDING:
        for path in sorted((root / folder).rglob("*")):
            name = path.relative_to(root).as_posix()
            if path.suffix in DECIDING_SUFFIXES and not name.startswith(NOT_DECIDING):
                digest.update(name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


class Store:
    """The file of results; lines of another version of the code are kept in it.

    Parameters
    ----------
    path
        The file, made when the first result comes.
    version
        Of the code that is running.
    any_version
        Use the lines of other versions, too.

    Raises
    ------
    DataError
        If a line other than the last is not JSON; a torn last line is what a stopped run leaves.
    """

    def __init__(self, path: Path, version: str, *, any_version: bool = False) -> None:
        self.path, self.version = path, version
        self._lock = threading.Lock()
        self._records: dict[str, Record] = {}
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        for number, line in enumerate(lines, 1):
            try:
                record = json.loads(line)
            except json.JSONDecodeError as error:
                if number == len(lines):
                    self._drop_torn_line()
                    break
                raise DataError(f"{path}:{number}: not JSON: {error.msg}") from error
            if any_version or record["code"] == version:
                self._records[record["key"]] = record

    def get(self, key: str) -> Record | None:
        """The result of a case, unless there is none or it failed."""
        with self._lock:
            record = self._records.get(key)
        return None if record is None or "error" in record else record

    def failure(self, key: str) -> Record | None:
        """The last failure of a case, unless it has a result."""
        with self._lock:
            record = self._records.get(key)
        return record if record is not None and "error" in record else None

    def add(self, record: Record) -> None:
        """Append a result; it is on disk when this returns."""
        record = {**record, "code": self.version}
        line = json.dumps(record) + "\n"
        with self._lock:
            self._records[record["key"]] = record
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a", encoding="utf-8") as file:
                file.write(line)
                file.flush()
                os.fsync(file.fileno())

    def _drop_torn_line(self) -> None:
        content = self.path.read_bytes()
        with self.path.open("r+b") as file:
            file.truncate(content.rfind(b"\n", 0, len(content) - 1) + 1)
