"""Table of the results of a fleet as Parquet files, one row for each parameter of a run, and one for a failure."""

import datetime
import io
import secrets
from pathlib import Path
from typing import Any

from armident.configs import ConfigError
from armident.extras import require
from armident.identify.diagnosis.change_test import ParameterChangeTest
from armident.identify.documents.base import versions
from armident.identify.documents.files import write_atomically
from armident.identify.documents.identification import IdentificationDocument

RUNS_PER_FILE = 100
"""Recordings after which a file is written, so that a fleet that is killed loses no more of them."""


class ResultsTable:
    """Adds files to a folder that other processes may add to and read; each is written, then named.

    Raises ConfigError if PyArrow is missing or the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        require("--results", "parquet")
        import pyarrow as pa

        self._folder = folder
        self._rows: list[dict[str, Any]] = []
        self._runs = 0
        time = pa.timestamp("us", tz="UTC")
        self._schema = pa.schema(
            [
                pa.field("identified", time, nullable=False),
                pa.field("armident", pa.string(), nullable=False),
                pa.field("recording", pa.string(), nullable=False),
                *(pa.field(name, pa.string()) for name in ("sha256", "robot", "cell")),
                pa.field("recorded", time),
                *(pa.field(name, pa.string()) for name in ("method", "verdict", "error")),
                pa.field("relative_error_pct", pa.float64()),
                pa.field("drifted", pa.bool_()),
                pa.field("parameter", pa.string()),
                *(pa.field(name, pa.float64()) for name in ("value", "std")),
                pa.field("unit", pa.string()),
                *(pa.field(name, pa.bool_()) for name in ("essential", "changed")),
            ]
        )
        # An empty table tells now, not after hours, that the folder cannot be written.
        try:
            folder.mkdir(parents=True, exist_ok=True)
            trial = folder / f".{secrets.token_hex(4)}"
            trial.touch()
            trial.unlink()
        except OSError as error:
            raise ConfigError(f"--results {folder}: cannot be written: {error.strerror}") from error

    def add(
        self,
        recording: str,
        error: str | None,
        document: IdentificationDocument | None = None,
        cell: str | None = None,
        recorded: datetime.datetime | None = None,
        drift: ParameterChangeTest | None = None,
    ) -> None:
        """Add the parameters of a run, or one row without any; ``drift`` is ``None`` for a first run."""
        run: dict[str, Any] = {
            "identified": datetime.datetime.now(datetime.UTC),
            "armident": versions()["armident"],
            "recording": recording,
            "error": error,
            "cell": cell,
            "recorded": recorded,
            "drifted": None if drift is None else drift.drifted,
        }
        if document is None:
            self._rows.append(run)
        else:
            source = document.recording
            run |= {"recording": source.path or recording, "sha256": source.sha256, "robot": document.robot}
            run |= {name: getattr(document, name) for name in ("method", "verdict", "relative_error_pct")}
            for p in document.parameters:
                one = {
                    "parameter": p.name,
                    **{name: getattr(p, name) for name in ("value", "std", "unit", "essential")},
                }
                self._rows.append(run | one | {"changed": None if drift is None else p.name in drift.changed})
        self._runs += 1
        if self._runs >= RUNS_PER_FILE:
            self.write()

    def write(self) -> None:
        """Write what was added since the last file; raises ConfigError if that fails, and keeps it for the next."""
        if not self._rows:
            return
        import pyarrow as pa
        from pyarrow import parquet

        table = io.BytesIO()
        parquet.write_table(pa.Table.from_pylist(self._rows, self._schema), table, compression="zstd")
        name = f"{datetime.datetime.now(datetime.UTC):%Y%m%dT%H%M%SZ}-{secrets.token_hex(4)}.parquet"
        try:
            write_atomically(self._folder / name, table.getvalue())
        except OSError as error:
            raise ConfigError(f"--results {self._folder}: cannot be written: {error.strerror}") from error
        self._rows, self._runs = [], 0
