"""Command ``armident reidentify --recordings``: identify in parallel by Dask, compare in order."""

import glob
import json
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from armident.configs import ArmidentError, ConfigError, DataError, RobotConfig, load_robot
from armident.configs.errors import FOUND
from armident.daq.recording import Recording, read_recording
from armident.extras import install_line
from armident.identify.diagnosis.change_test import ParameterChangeTest, compare
from armident.identify.documents.files import from_json, load_document, to_json
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.identification.identify_recording import identify_recording
from armident.identify.identification.options import Options, options_of
from armident.identify.monitoring.change.history import History
from armident.identify.monitoring.reidentify.baseline import doubt_of
from armident.identify.monitoring.reidentify.reidentify_options import ReidentifyOptions
from armident.identify.monitoring.reidentify.summary import change_lines
from armident.identify.report.robot_file import write_identification

if TYPE_CHECKING:
    from distributed import Client

CONNECT_S = 10.0
"""Longest wait for the scheduler, s."""

_Arm = tuple[str, str | None]
"""Names of robot and cell, as arms of one type often share a name."""


@dataclass(frozen=True)
class Identified:
    """Result of a cluster worker: document text, its file, robot, and metadata of the recording."""

    text: str
    path: str
    robot: RobotConfig
    facts: dict[str, Any]


@dataclass(frozen=True)
class Row:
    """Result of one recording."""

    recording: str
    error: str | None = None
    drift: ParameterChangeTest | None = None
    words: tuple[str, ...] = ()
    identification: str | None = None


def fleet_command(pattern: str, asked: ReidentifyOptions, *, as_json: bool) -> int:
    """Carry out ``armident reidentify --recordings``; a failed recording does not stop the others.

    Each is compared with the baseline, or the first run of the arm (robot and cell). Returns 0, `FOUND` or 1.
    Raises ConfigError if nothing matches, there are no workers, or metrics are asked for.
    """
    if asked.metrics is not None:
        raise ConfigError("--metrics: not with --recordings; the results of a fleet are in the history (--store)")
    paths = [Path(name).resolve() for name in sorted(glob.glob(pattern, recursive=True))]
    if not paths:
        raise ConfigError(f"--recordings {pattern}: no such file")
    robot = None if asked.config is None else load_robot(asked.config, "identify")
    known = None if asked.baseline is None else load_document(asked.baseline, IdentificationDocument)
    history = History(asked.store)
    rows: list[Row] = []
    # One baseline per arm: an older recording that follows must not replace it.
    baselines: dict[_Arm, IdentificationDocument] = {}
    with cluster(asked.scheduler, asked.workers) as client:
        futures = [
            client.submit(identify_one, str(path), robot, _folder(path, asked.out), pure=False) for path in paths
        ]
        for path, future in zip(paths, futures, strict=True):
            row = _judged(path, future, history, known, baselines, asked.false_alarms)
            future.release()
            rows.append(row)
            # Printed at once: a fleet takes hours.
            print(_line(row), file=sys.stderr if as_json else sys.stdout, flush=True)
    if as_json:
        print(json.dumps({"runs": [_entry(row) for row in rows]}, indent=1))
    if any(row.drift is not None and row.drift.drifted for row in rows):
        return FOUND
    return ArmidentError.exit_code if any(row.error for row in rows) else 0


@contextmanager
def cluster(scheduler: str | None, workers: int | None) -> "Iterator[Client]":
    """Yield a client of a Dask scheduler, or of a local cluster; raises ConfigError unless exactly one is usable."""
    if scheduler is None and workers is None:
        raise ConfigError("--recordings: needs --scheduler ADDRESS, or --workers N for processes on this machine")
    if scheduler is not None and workers is not None:
        raise ConfigError("--workers: not with --scheduler; its cluster has workers of its own")
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ConfigError(install_line("--recordings", ["fleet"])) from error
    # Failures of a recording are in its line, those of the cluster are raised.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    if scheduler is None:
        local = LocalCluster(n_workers=workers, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0")
        with local, Client(local) as client:
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
        recording = read_recording(Path(path))
        done = identify_recording(recording, robot, _options(recording))
        file, _ = write_identification(done, Path(out))
    except ArmidentError:
        raise
    except OSError as error:
        raise ArmidentError(f"{error.filename or out}: {error.strerror or 'cannot be used'}") from error
    except Exception as error:
        raise ArmidentError(f"internal error ({type(error).__name__})") from error
    return Identified(to_json(done.document), str(file), done.robot, History.facts(recording))


def _options(recording: Recording) -> Options:
    """Return the identification options of the recording's session."""
    session = recording.session
    return Options() if session is None else options_of(session)


def _judged(
    path: Path,
    future: Any,
    history: History,
    known: IdentificationDocument | None,
    baselines: dict[_Arm, IdentificationDocument],
    false_alarms: float,
) -> Row:
    try:
        found: Identified = future.result()
        document = from_json(found.text, IdentificationDocument, str(path))
        arm = document.robot, found.facts["cell"]
        first = known or baselines.get(arm) or _first(history, *arm)
        refused = _entered(history, found, document)
        if not document.converged:
            raise DataError(f"the identification did not converge ({document.stop_reason})")
        if document.verdict == "unusable":
            raise DataError(f"the identification is unusable ({document.reasons[0].message})")
        baselines.setdefault(arm, first or document)
        drift = None if first is None else compare(first, document, false_alarms, found.robot)
        if drift is None or first is None:
            words = (f"first run of {_name(*arm)}: the baseline{doubt_of(document)}", *refused)
            return Row(str(path), words=words, identification=found.path)
        refused = refused or _entered(history, found, document, (first, drift))
    except (ArmidentError, OSError, RuntimeError) as error:
        return Row(str(path), error=" ".join(str(error).split()))
    words = tuple(change_lines(drift, found.robot)) if drift.drifted else (drift.words,)
    return Row(str(path), drift=drift, words=(*words, *refused), identification=found.path)


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
            history.add(document, History.began(found.facts, document, Path(found.path)))
        else:
            history.judge(document, *comparison)
    except ConfigError as error:
        return (f"not in the history: {error}",)
    return ()


def _first(history: History, robot: str, cell: str | None) -> IdentificationDocument | None:
    run = history.first(robot, cell)
    return None if run is None else run.document


def _name(robot: str, cell: str | None) -> str:
    return robot if cell is None else f"{robot} in cell {cell}"


def _folder(path: Path, out: Path | None) -> str:
    name = f"{path.name.removesuffix('.mcap')}.identification"
    return str((path.parent if out is None else out.resolve()) / name)


def _line(row: Row) -> str:
    if row.error is not None:
        return f"{row.recording}: failed: {row.error}"
    verdict = "CHANGED: " if row.drift is not None and row.drift.drifted else ""
    return f"{row.recording}: {verdict}{'; '.join(row.words)}"


def _entry(row: Row) -> dict[str, Any]:
    drift = row.drift
    return {
        "recording": row.recording,
        "identification": row.identification,
        "error": row.error,
        "drift": None if drift is None else drift.entry,
        "words": list(row.words),
    }
