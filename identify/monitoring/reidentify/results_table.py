"""Table of the results of a fleet as Parquet files, one row for each parameter of a run, and one for a failure."""

import datetime
import io
import os
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
    """Adds files to a folder that other processes may add to and read; each is written, then named."""

    def __init__(self, folder: Path) -> None:
        require("--results", "parquet")
        import pyarrow as pa

        self._folder = folder
        self._rows: list[dict[str, Any]] = []
        self._runs = 0
        time, text, number, flag = pa.timestamp("us", tz="UTC"), pa.string(), pa.float64(), pa.bool_()
        self._schema = pa.schema(
            {"identified": time, "armident": text, "recording": text, "sha256": text, "recorded": time, "robot": text}
            | {"cell": text, "method": text, "verdict": text, "error": text, "relative_error_pct": number}
            | {"drifted": flag, "parameter": text, "value": number, "std": number, "unit": text}
            | {"essential": flag, "changed": flag}
        )
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--results {folder}: cannot be written: {error.strerror}") from error
        if not os.access(folder, os.W_OK | os.X_OK):
            raise ConfigError(f"--results {folder}: cannot be written: no permission")

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
