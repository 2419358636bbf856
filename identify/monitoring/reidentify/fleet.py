"""Command ``armident reidentify --recordings``: identify in parallel by Dask, compare in order."""

import datetime
import json
import logging
import os
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from armident.configs import ArmidentError, ConfigError, DataError, RobotConfig, load_robot
from armident.configs.errors import FOUND
from armident.daq.recording import Recording, read_recording
from armident.daq.recording.objects import ObjectUrl, located, matching
from armident.extras import install_line
from armident.identify.diagnosis.change_test import ParameterChangeTest, compare
from armident.identify.documents.files import from_json, load_document, to_json
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.identification.identify_recording import identify_recording
from armident.identify.identification.options import Options, options_of
from armident.identify.monitoring.change.history import History
from armident.identify.monitoring.reidentify.baseline import doubt_of
from armident.identify.monitoring.reidentify.reidentify_options import ReidentifyOptions
from armident.identify.monitoring.reidentify.results_table import ResultsTable
from armident.identify.monitoring.reidentify.summary import change_lines
from armident.identify.monitoring.worker.recorded import Captured
from armident.identify.report.robot_file import write_identification

if TYPE_CHECKING:
    from distributed import Client

CONNECT_S = 10.0
"""Longest wait for the scheduler, s."""
WORKERLESS_S = 600.0
"""Longest wait for a worker, s: one that was killed may need minutes to start on a busy machine."""
POLL_S = 0.2
"""Interval at which results are asked for, s."""

_Arm = tuple[str, str | None]
"""Names of robot and cell, as arms of one type often share a name."""


@dataclass(frozen=True)
class Identified:
    """Result of a cluster worker: document text, its file, robot, metadata and time of the recording."""

    text: str
    path: str
    robot: RobotConfig
    facts: dict[str, Any]
    recorded: datetime.datetime


@dataclass(frozen=True)
class Row:
    """Result of one recording; ``document`` also where it is an error that it is of no use."""

    recording: str
    error: str | None = None
    drift: ParameterChangeTest | None = None
    words: tuple[str, ...] = ()
    found: Identified | None = None
    document: IdentificationDocument | None = None


@dataclass
class _Baselines:
    """The given baseline, or that of each arm, which an older recording that follows must not replace."""

    given: IdentificationDocument | None
    history: History
    known: dict[_Arm, str | IdentificationDocument] = field(default_factory=dict)

    def of(self, arm: _Arm) -> IdentificationDocument | None:
        """Return the baseline of an arm; ``None`` before its first run."""
        known = self.known.get(arm)
        if self.given is not None:
            return self.given
        if isinstance(known, IdentificationDocument):
            return known
        run = self.history.first(*arm) if known is None else self.history.of_recording(arm[0], known)
        return None if run is None else run.document

    def keep(self, arm: _Arm, document: IdentificationDocument, *, stored: bool) -> None:
        """Keep the baseline of an arm, ``stored`` in the history or not, unless it has one already."""
        self.known.setdefault(arm, document.recording.sha256 if stored else document)


def fleet_command(pattern: str, asked: ReidentifyOptions, *, as_json: bool) -> int:
    """Carry out ``armident reidentify --recordings``; a failed recording does not stop the others."""
    if asked.metrics is not None:
        raise ConfigError("--metrics: not with --recordings; the results of a fleet are in the history (--store)")
    paths = matching(pattern)
    if not paths:
        raise ConfigError(f"--recordings {pattern}: no such file")
    folders = _folders(paths, asked.out)
    robot = None if asked.config is None else load_robot(asked.config, "identify")
    given = None if asked.baseline is None else load_document(asked.baseline, IdentificationDocument)
    baselines = _Baselines(given, History(asked.store))
    table = None if asked.results is None else ResultsTable(asked.results)
    entries: list[dict[str, Any]] = []
    changed = failed = False
    try:
        with cluster(asked.scheduler, asked.workers) as client:
            results = identified(
                client, [(str(path), robot, folder) for path, folder in zip(paths, folders, strict=True)]
            )
            for path, result in zip(paths, results, strict=True):
                row = _judged(path, result, baselines, asked.false_alarms)
                changed |= row.drift is not None and row.drift.drifted
                failed |= row.error is not None
                # Printed at once: a fleet takes hours.
                print(_line(row), file=sys.stderr if as_json else sys.stdout, flush=True)
                if table is not None:
                    cell, recorded = (row.found.facts["cell"], row.found.recorded) if row.found else (None, None)
                    table.add(row.recording, row.error, row.document, cell, recorded, row.drift)
                if as_json:
                    entries.append(_entry(row))
    finally:
        if table is not None:
            table.write()
    if as_json:
        print(json.dumps({"runs": entries}, indent=1))
    if changed:
        return FOUND
    return ArmidentError.exit_code if failed else 0


def identified(
    client: "Client", tasks: Sequence[tuple[str, RobotConfig | None, str]]
) -> "Iterator[Identified | ArmidentError]":
    """Yield the result or error of each task (`identify_one`) in order."""
    from distributed import as_completed

    futures = [client.submit(identify_one, *task, pure=False) for task in tasks]
    places = {future.key: k for k, future in enumerate(futures)}
    waiting: dict[int, Identified | ArmidentError] = {}
    following = as_completed(futures)
    del futures
    for k in range(len(tasks)):
        while k not in waiting:
            future = _next(client, following)
            waiting[places[future.key]] = _fetched(future)
            future.release()
        yield waiting.pop(k)


def _next(client: "Client", following: Any) -> Any:
    """Return the next task that has ended; ArmidentError if the cluster has no worker for `WORKERLESS_S`."""
    until = time.monotonic() + WORKERLESS_S
    while not following.has_ready():
        time.sleep(POLL_S)
        if time.monotonic() > until:
            if not client.scheduler_info()["workers"]:
                raise ArmidentError(f"the cluster has no worker, after {WORKERLESS_S / 60:g} minutes; start workers")
            until = time.monotonic() + WORKERLESS_S
    return next(following)


def _fetched(future: Any) -> Identified | ArmidentError:
    """Return the result of a task, or the error that belongs in the line of its recording."""
    from distributed import KilledWorker

    try:
        found: Identified = future.result()
        return found
    except KilledWorker as error:
        times = error.allowed_failures + 1
        return ArmidentError(f"{times} workers ended while it was identified (killed, or out of memory): given up")
    except CancelledError as error:
        raise ArmidentError("the Dask scheduler has ended; start it and run this again") from error
    except (ArmidentError, OSError, RuntimeError) as error:
        return error if isinstance(error, ArmidentError) else ArmidentError(" ".join(str(error).split()))


@contextmanager
def cluster(scheduler: str | None, workers: int | None) -> "Iterator[Client]":
    """Yield a client of a Dask scheduler, or of a local cluster; raises ConfigError unless exactly one is usable."""
    if scheduler is None and workers is None:
        raise ConfigError("--recordings: needs --scheduler ADDRESS, or --workers N for processes on this machine")
    if scheduler is not None and workers is not None:
        raise ConfigError("--workers: not with --scheduler; its cluster has workers of its own")
    try:
        import dask.config
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ConfigError(install_line("--recordings", ["fleet"])) from error
    # Failures of a recording are in its line, those of the cluster are raised.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    if scheduler is None:
        settings = {
            # A worker holds one task at a time, so that no other is blamed for its end.
            "distributed.scheduler.worker-saturation": 1.0,
            # Dask gives up a worker that has not started again by then: 15 s, with none left in the end.
            "distributed.deploy.lost-worker-timeout": WORKERLESS_S,
        }
        with (
            dask.config.set(settings),
            LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
            ) as local,
            Client(local) as client,
        ):
            yield client
        return
    try:
        remote = Client(scheduler, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--scheduler {scheduler}: no Dask scheduler answers there ({error})") from error
    with remote:
        yield remote


def identify_one(path: str, robot: RobotConfig | None, out: str) -> Identified:
    """Identify one recording on a worker; raises ArmidentError for any failure, as others may not be picklable."""
    try:
        Captured("", (located(path),)).check_size()
        recording = read_recording(path)
        done = identify_recording(recording, robot, _options(recording))
        file, _ = write_identification(done, Path(out))
    except ArmidentError:
        raise
    except OSError as error:
        raise ArmidentError(f"{error.filename or out}: {error.strerror or 'cannot be used'}") from error
    except Exception as error:
        raise ArmidentError(f"internal error ({type(error).__name__})") from error
    facts = History.facts(recording)
    return Identified(to_json(done.document), str(file), done.robot, facts, History.began(facts, done.document, file))


def _options(recording: Recording) -> Options:
    """Return the identification options of the recording's session."""
    session = recording.session
    return Options() if session is None else options_of(session)


def _judged(path: Path, found: Identified | ArmidentError, baselines: _Baselines, false_alarms: float) -> Row:
    if isinstance(found, ArmidentError):
        return Row(str(path), error=str(found))
    document = None
    try:
        document = from_json(found.text, IdentificationDocument, str(path))
        arm = document.robot, found.facts["cell"]
        first = baselines.of(arm)
        refused = _entered(baselines.history, found, document)
        if not document.converged:
            raise DataError(f"the identification did not converge ({document.stop_reason})")
        if document.verdict == "unusable":
            raise DataError(f"the identification is unusable ({document.reasons[0].message})")
        baselines.keep(arm, first or document, stored=not refused)
        drift = None if first is None else compare(first, document, false_alarms, found.robot)
        if drift is None or first is None:
            words = (f"first run of {_name(*arm)}: the baseline{doubt_of(document)}", *refused)
            return Row(str(path), words=words, found=found, document=document)
        refused = refused or _entered(baselines.history, found, document, (first, drift))
    except (ArmidentError, OSError, RuntimeError) as error:
        return Row(str(path), error=" ".join(str(error).split()), found=found, document=document)
    words = tuple(change_lines(drift, found.robot)) if drift.drifted else (drift.words,)
    return Row(str(path), drift=drift, words=(*words, *refused), found=found, document=document)


def _entered(
    history: History,
    found: Identified,
    document: IdentificationDocument,
    comparison: tuple[IdentificationDocument, ParameterChangeTest] | None = None,
) -> tuple[str, ...]:
    """Enter a run, or its comparison, in the history; return the reason if the database refuses it."""
    try:
        if comparison is None:
            history.describe(found.facts)
            history.add(document, found.recorded)
        else:
            history.judge(document, *comparison)
    except ConfigError as error:
        return (f"not in the history: {error}",)
    return ()


def _name(robot: str, cell: str | None) -> str:
    return robot if cell is None else f"{robot} in cell {cell}"


def _folders(paths: Sequence[Path], out: Path | None) -> list[str]:
    """Return the folder of the results of each recording: beside it, or in ``out`` below the folders that differ."""
    names = [f"{path.name.removesuffix('.mcap')}.identification" for path in paths]
    if out is None:
        if any(isinstance(path, ObjectUrl) for path in paths):
            raise ConfigError("--out: missing; name a folder for the results of recordings in an object store")
        return [str(path.parent / name) for path, name in zip(paths, names, strict=True)]
    common = os.path.commonpath([path.parent for path in paths])
    folders = [out.resolve() / path.parent.relative_to(common) for path in paths]
    return [str(folder / name) for folder, name in zip(folders, names, strict=True)]


def _line(row: Row) -> str:
    if row.error is not None:
        return f"{row.recording}: failed: {row.error}"
    verdict = "CHANGED: " if row.drift is not None and row.drift.drifted else ""
    return f"{row.recording}: {verdict}{'; '.join(row.words)}"


def _entry(row: Row) -> dict[str, Any]:
    drift = row.drift
    return {
        "recording": row.recording,
        "identification": None if row.found is None or row.error is not None else row.found.path,
        "error": row.error,
        "drift": None if drift is None else drift.entry,
        "words": list(row.words),
    }
