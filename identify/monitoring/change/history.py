"""Database of identifications: a SQLite file, or any other database that SQLAlchemy supports."""

import datetime
import hashlib
import os
import re
from collections.abc import Iterator, Mapping, Set
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from armident.configs import ConfigError
from armident.daq.recording import Recording
from armident.identify.diagnosis.change_test import ParameterChangeTest
from armident.identify.documents.files import from_json, to_json
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.change.history_schema import (
    comparisons,
    engine_for,
    parameters,
    reason,
    recordings,
    repeated,
    runs,
    runs_as_stored,
    shown,
    upgrade,
    writing,
)

DEFAULT = "sqlite:///history.sqlite"
"""SQLAlchemy URL of the default database."""
_STAMP = re.compile(r"(\d{8}T\d{6})-\d{3}Z")


@dataclass(frozen=True)
class HistoryRun:
    """Identification in the history; ``recorded`` is the time of its recording (UTC)."""

    number: int
    recorded: datetime.datetime
    document: IdentificationDocument


@dataclass(frozen=True)
class ParameterSeries:
    """Essential parameter over the last runs: times of the recordings (UTC), values and standard deviations."""

    name: str
    unit: str
    times: tuple[datetime.datetime, ...]
    values: tuple[float, ...]
    deviations: tuple[float, ...]


class History:
    """Identifications in a database (SQLAlchemy URL); missing or former tables are created or upgraded."""

    def __init__(self, url: str = DEFAULT) -> None:
        self.url = shown(url)
        try:
            self._engine = engine_for(_driven(url))
            upgrade(self._engine)
        except (sa.exc.SQLAlchemyError, ImportError, OSError, ConfigError) as error:
            missing = getattr(error, "name", None) == "psycopg"
            hint = "; install it with: pip install 'armident[postgresql]'" if missing else ""
            said = reason(error).replace(url, self.url)
            raise ConfigError(f"{self.url}: cannot be used as history: {said}{hint}") from error

    def add(self, document: IdentificationDocument, recorded: datetime.datetime) -> bool:
        """Add an identification; False if its recording is known. Raises ConfigError if it cannot be written."""
        text = to_json(document)
        digest = _digest(document)
        source = document.recording
        row = {
            "digest": digest,
            "robot": document.robot,
            "recorded": recorded.astimezone(datetime.UTC).replace(tzinfo=None),
            "recording": source.path,
            "sha256": source.sha256,
            "samples": source.samples,
            "sample_rate_hz": source.sample_rate_hz,
            "method": document.method,
            "relative_error_pct": document.relative_error_pct,
            "converged": document.converged,
            "document": text,
        }
        try:
            with self._writing() as connection:
                done = connection.execute(sa.insert(runs).values(row))
                (number,) = done.inserted_primary_key or (None,)
                rows = [
                    {
                        "identification": number,
                        "name": p.name,
                        "value": p.value,
                        "std": p.std,
                        "unit": p.unit,
                        "essential": p.essential,
                    }
                    for p in document.parameters
                ]
                connection.execute(sa.insert(parameters), rows)
        except sa.exc.IntegrityError:
            return False
        return True

    @staticmethod
    def facts(recording: Recording) -> dict[str, Any]:
        """Return the metadata of a recording, as `describe` stores them."""
        return {
            "sha256": recording.sha256,
            "path": None if recording.path is None else str(recording.path),
            "cell": recording.metadata.get("cell"),
            "duration_s": recording.samples.sync.size / recording.sample_rate_hz,
            "in_gaps": recording.counters.get("samples.in_gaps"),
            "facts": dict(recording.metadata),
            "counters": dict(recording.counters),
        }

    @staticmethod
    def began(facts: Mapping[str, Any], document: IdentificationDocument, file: Path) -> datetime.datetime:
        """Start of a recording by its metadata or, if it was imported, by `recorded_at`."""
        started = facts["facts"].get("started_utc")
        return recorded_at(document, file) if started is None else datetime.datetime.fromisoformat(started)

    def describe(self, facts: Mapping[str, Any]) -> None:
        """Add the metadata of a recording unless the history has them already."""
        self._insert_once(recordings, facts)

    def judge(
        self, document: IdentificationDocument, baseline: IdentificationDocument, drift: ParameterChangeTest
    ) -> None:
        """Add the comparison of an identification, added before, with its baseline."""
        same = (runs.c.robot == document.robot) & (runs.c.sha256 == document.recording.sha256) & (repeated == 0)
        number = sa.select(runs.c.id).where(same).scalar_subquery()
        row = {
            "identification": number,
            "baseline": _digest(baseline),
            "drifted": drift.drifted,
            "chi_square": drift.chi_square,
            "degrees": drift.degrees,
            "p_joint": drift.p_joint,
            "false_alarms": drift.false_alarms,
            "changed": list(drift.changed),
            "words": drift.words,
        }
        self._insert_once(comparisons, row)

    def _insert_once(self, table: sa.Table, row: Mapping[str, Any]) -> None:
        with suppress(sa.exc.IntegrityError), self._writing() as connection:
            connection.execute(sa.insert(table).values(row))

    @contextmanager
    def _writing(self) -> Iterator[sa.Connection]:
        """Yield a connection whose transaction is committed; IntegrityError means that a row is known already."""
        try:
            with writing(self._engine) as connection:
                yield connection
        except sa.exc.IntegrityError:
            raise
        except sa.exc.SQLAlchemyError as error:
            raise ConfigError(f"{self.url}: the history cannot be written: {reason(error)}") from error

    def copy_to(self, other: "History") -> int:
        """Add the runs that another history lacks, with recordings and comparisons; return their number."""
        numbers = [number for (number,) in self._rows(sa.select(runs.c.id).order_by(runs.c.id))]
        try:
            with other._writing() as target:
                known = set(target.execute(sa.select(recordings.c.sha256)).scalars())
                lacking = [dict(row._mapping) for row in self._rows(sa.select(recordings)) if row.sha256 not in known]
                if lacking:
                    target.execute(sa.insert(recordings), lacking)
                digests = set(target.execute(sa.select(runs.c.digest)).scalars())
                identified = {tuple(row) for row in target.execute(sa.select(runs.c.robot, runs.c.sha256))}
                return sum(self._copy_run(number, target, digests, identified) for number in numbers)
        except sa.exc.IntegrityError as error:
            raise ConfigError(f"{other.url}: another process writes to it; try again") from error

    def _copy_run(
        self, number: int, target: sa.Connection, digests: Set[str], identified: Set[tuple[str, str]]
    ) -> bool:
        """Add one run with its parameters and comparisons unless it or its recording is known already."""
        ((*values,),) = self._rows(sa.select(runs_as_stored).where(runs_as_stored.c.id == number))
        run = dict(zip(runs_as_stored.c.keys(), values, strict=True))
        if run["digest"] in digests or ((run["robot"], run["sha256"]) in identified and not run["repeated"]):
            return False
        del run["id"]
        (new,) = target.execute(sa.insert(runs_as_stored).values(run)).inserted_primary_key or (None,)
        for table in (parameters, comparisons):
            rows = self._rows(sa.select(table).where(table.c.identification == number))
            if rows:
                target.execute(sa.insert(table), [dict(row._mapping) | {"identification": new} for row in rows])
        return True

    def save(self, file: Path) -> int:
        """Write a copy to a file (SQLite), which is replaced as a whole; return the number of its runs."""
        if self._engine.dialect.name == "sqlite" and Path(self._engine.url.database or "").resolve() == file.resolve():
            raise ConfigError(f"{file}: the history itself; name another file")
        temporary = file.with_name(f".{file.name}.{os.getpid()}")
        try:
            saved = self.copy_to(History(f"sqlite:///{temporary}"))
            if not saved:
                raise ConfigError(f"{file}: not written, because the history is empty")
            os.replace(temporary, file)
        finally:
            temporary.unlink(missing_ok=True)
        return saved

    def first(self, robot: str, cell: str | None = None) -> HistoryRun | None:
        """Oldest converged identification of an arm; runs whose cell the history does not know are included."""
        found = self._read(_of(robot, cell).where(runs.c.converged).limit(1))
        return found[0] if found else None

    def of_recording(self, robot: str, sha256: str) -> HistoryRun | None:
        """Return the identification of a recording by the SHA-256 of its samples."""
        found = self._read(_of(robot, None).where(runs.c.sha256 == sha256).limit(1))
        return found[0] if found else None

    def runs(self, robot: str | None = None, cell: str | None = None) -> list[HistoryRun]:
        """Return identifications in the order of their recordings, of all robots and cells by default."""
        return self._read(_of(robot, cell))

    def last(self, robot: str, cell: str | None = None) -> HistoryRun | None:
        """Newest identification of an arm; runs whose cell the history does not know are included."""
        found = self._read(_latest(robot, cell, 1))
        return found[0] if found else None

    def series(self, robot: str, cell: str | None, most: int) -> list[ParameterSeries]:
        """Return the essential parameters of the last ``most`` runs of an arm, without reading their documents."""
        newest = _latest(robot, cell, most).with_only_columns(runs.c.id, runs.c.recorded).subquery()
        columns = (newest.c.recorded, parameters.c.name, parameters.c.unit, parameters.c.value, parameters.c.std)
        query = sa.select(*columns).join(newest, parameters.c.identification == newest.c.id)
        query = query.where(parameters.c.essential).order_by(newest.c.recorded, newest.c.id)
        found: dict[tuple[str, str], list[tuple[datetime.datetime, float, float]]] = {}
        for recorded, name, unit, value, std in self._rows(query):
            found.setdefault((name, unit), []).append((recorded.replace(tzinfo=datetime.UTC), value, std))
        return [ParameterSeries(*key, *zip(*points, strict=True)) for key, points in found.items()]

    def arms(self) -> list[tuple[str, str | None]]:
        """Return robots and their cells; ``None`` for an unknown cell."""
        query = sa.select(runs.c.robot, recordings.c.cell).select_from(_WHERE).distinct()
        found = [(robot, cell) for robot, cell in self._rows(query)]
        return sorted(found, key=lambda arm: (arm[0], arm[1] or ""))

    def cell(self, document: IdentificationDocument) -> str | None:
        """Return the cell of an identification's recording, ``None`` if the history does not know it."""
        query = sa.select(recordings.c.cell).where(recordings.c.sha256 == document.recording.sha256)
        found = self._rows(query)
        return found[0][0] if found else None

    def _rows(self, query: sa.Select[Any]) -> list[Any]:
        try:
            with self._engine.connect() as connection:
                return list(connection.execute(query).all())
        except sa.exc.SQLAlchemyError as error:
            raise ConfigError(f"{self.url}: the history cannot be read: {reason(error)}") from error

    def _read(self, query: sa.Select[Any]) -> list[HistoryRun]:
        return [
            HistoryRun(
                number, recorded.replace(tzinfo=datetime.UTC), from_json(text, IdentificationDocument, f"run {number}")
            )
            for number, recorded, text in self._rows(query)
        ]


_WHERE = runs.outerjoin(recordings, runs.c.sha256 == recordings.c.sha256)


def _of(robot: str | None, cell: str | None) -> sa.Select[Any]:
    """Return the query of the runs of an arm in the order of their recordings."""
    query = sa.select(runs.c.id, runs.c.recorded, runs.c.document).select_from(_WHERE).where(repeated == 0)
    if robot is not None:
        query = query.where(runs.c.robot == robot)
    if cell is not None:
        query = query.where(sa.or_(recordings.c.cell == cell, recordings.c.cell.is_(None)))
    return query.order_by(runs.c.recorded, runs.c.id)


def _latest(robot: str, cell: str | None, most: int) -> sa.Select[Any]:
    """Return the query of the last runs of an arm, the newest first."""
    return _of(robot, cell).order_by(None).order_by(runs.c.recorded.desc(), runs.c.id.desc()).limit(most)


def _digest(document: IdentificationDocument) -> str:
    return hashlib.sha256(to_json(document).encode()).hexdigest()


def recorded_at(document: IdentificationDocument, file: Path) -> datetime.datetime:
    """Return the time of a recording: from its name, otherwise that of the result's file."""
    found = _STAMP.search(document.recording.path or "")
    if found is not None:
        # A name that only looks like a time is none.
        with suppress(ValueError):
            return datetime.datetime.strptime(found[1] + "+0000", "%Y%m%dT%H%M%S%z")
    return datetime.datetime.fromtimestamp(file.stat().st_mtime, datetime.UTC)


def _driven(url: str) -> str:
    """Return the URL with the driver of the extra ``postgresql`` unless it names one."""
    return re.sub(r"^postgres(ql)?://", "postgresql+psycopg://", url)
