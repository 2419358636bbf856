"""Cells of the page: their session files, and what lies in their folders."""

import datetime
import shlex
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from armident.configs import ArmidentError, ConfigError, RobotConfig, SessionConfig, load_robot, load_session
from armident.configs.reasons import reason_of
from armident.identify.diagnosis.baseline_comparison import Inconclusive
from armident.identify.diagnosis.change_test import compare
from armident.identify.documents.base import Document
from armident.identify.documents.diagnosis import DiagnosisDocument
from armident.identify.documents.files import load_document
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.documents.investigation import InvestigationDocument
from armident.identify.monitoring.change.comparison import joint_of, places_of
from armident.identify.monitoring.change.history import History, ParameterSeries
from armident.identify.monitoring.worker.ledger import FILE, LedgerView, view_of
from armident.identify.monitoring.worker.recorded import stamp_of

KINDS: dict[str, type[Document]] = {
    "identification": IdentificationDocument,
    "diagnosis": DiagnosisDocument,
    "investigation": InvestigationDocument,
}
"""Documents that the page shows, by the suffix of their folders; the file has the same name."""
SHOWN = {"identification": 1, "diagnosis": 3, "investigation": 3}
"""Number of documents of each kind that are read."""
LISTED = 40
"""Number of recordings and results of a cell that are listed."""
RUNS = 60
"""Number of runs in a sparkline: a year of weekly ones."""
LARGEST = 16 << 20
"""Largest file that is read, bytes; a document of six axes has 0.1 MB, its report 2 MB."""
HISTORY_FILE = "history.sqlite"
SESSION = "armident/session/"


@dataclass(frozen=True)
class Cell:
    """Session of a cell with its robot, or the reason for which they cannot be used.

    ``name``: of its file, and of the page; ``database``: URL of the history, if it has one.
    """

    name: str
    file: Path
    session: SessionConfig | None
    robot: RobotConfig | None
    problem: str | None
    folders: tuple[Path, ...]
    database: str | None

    @property
    def title(self) -> str:
        """Name of the cell, with that of its file where it differs."""
        cell = self.name if self.session is None else self.session.cell
        return cell if cell == self.name else f"{cell} ({self.name})"


@dataclass(frozen=True)
class ResultFolder:
    """Folder of a result, time of its document or, without one, of the folder, and its files that can be opened."""

    name: str
    kind: str
    made: datetime.datetime
    files: tuple[str, ...]
    document: Document | None = None
    problem: str | None = None


@dataclass(frozen=True)
class Drift:
    """Change against the first run in the history; ``drifted`` is ``None`` where it is not known.

    ``changed``: parameters that have changed; ``series``: essential parameters by joint or coupling; ``command``: lists
    the runs.
    """

    words: str
    drifted: bool | None
    runs: int
    series: dict[str, list[ParameterSeries]]
    command: str
    changed: frozenset[str] = frozenset()


@dataclass(frozen=True)
class CellFiles:
    """State of the files of a cell; ``problems``: parts that cannot be read, with the reasons."""

    problems: dict[str, str]
    ledger: LedgerView | None
    results: tuple[ResultFolder, ...]
    recordings: tuple[tuple[str, int, datetime.datetime], ...]
    free_bytes: int | None

    def documents(self, kind: str) -> list[ResultFolder]:
        """Return the last results of a kind, with their documents or the reason for which these cannot be read."""
        return [each for each in self.results if each.kind == kind and (each.document or each.problem)]


def cells_in(configs: Sequence[Path], out: Path | None, database: str | None) -> list[Cell]:
    """Return the cells of session files and of folders of them; ConfigError if there are none.

    ``out``: folder with the results of each session in a folder of its name; ``database``: URL of the history of all.
    """
    found: dict[str, Cell] = {}
    for file in (file for path in configs for file in _sessions(path)):
        cell = _cell(file, out, database)
        if cell.name in found and found[cell.name].file.resolve() != file.resolve():
            raise ConfigError(f"--config {file}: another session is called {cell.name}, too; rename one of them")
        found[cell.name] = cell
    if not found:
        raise ConfigError(f"--config {', '.join(map(str, configs))}: no session of a cell there (*.yaml)")
    return list(found.values())


def _sessions(path: Path) -> Iterator[Path]:
    """Yield a session file, or those in a folder."""
    if not path.is_dir():
        yield path
        return
    try:
        files = sorted(path.glob("*.yaml"))
        for file in files:
            with file.open("rb") as stream:
                if SESSION.encode() in stream.read(LARGEST):
                    yield file
    except OSError as error:
        raise ConfigError(f"--config {reason_of(error)}; the user of the page must be able to read it") from error


def _cell(file: Path, out: Path | None, database: str | None) -> Cell:
    try:
        # Keys that a capture needs may be blank.
        session = load_session(file, "")
        robot = load_robot(session.robot)
    except ArmidentError as error:
        if not file.exists():
            raise
        return Cell(file.stem, file, None, None, str(error), () if out is None else (out / file.stem,), database)
    own = session.recording.directory if out is None else out / file.stem
    return Cell(
        file.stem, file, session, robot, None, tuple(dict.fromkeys((own, session.recording.directory))), database
    )


def read_files(cell: Cell) -> CellFiles:
    """Return the state of the files of a cell; what cannot be read is a problem of its part."""
    problems, ledger = dict[str, str](), None
    folders = {folder.resolve(): None for folder in cell.folders if folder.is_dir()}
    results, recordings, free = list[ResultFolder](), list[tuple[str, int, datetime.datetime]](), None
    for folder in folders:
        try:
            free = shutil.disk_usage(folder).free if free is None else free
            results += _results(folder)
            recordings += _recordings(folder)
            if ledger is None and (folder / FILE).is_file():
                ledger = view_of(folder / FILE, LISTED)
        except OSError as error:
            problems["results"] = reason_of(error)
        except ArmidentError as error:
            problems["ledger"] = str(error)
    results.sort(key=lambda each: each.made, reverse=True)
    recordings.sort(key=lambda each: each[2], reverse=True)
    return CellFiles(problems, ledger, tuple(results[:LISTED]), tuple(recordings[:LISTED]), free)


def _time(path: Path) -> datetime.datetime:
    return datetime.datetime.fromtimestamp(path.stat().st_mtime, datetime.UTC)


def _recordings(folder: Path) -> list[tuple[str, int, datetime.datetime]]:
    """Return the last recordings of a folder: name, size in bytes, time of the last change."""
    files = sorted(folder.glob("*.mcap"), key=lambda path: path.name, reverse=True)[:LISTED]
    return [(path.name, path.stat().st_size, _time(path)) for path in files if path.is_file()]


def _results(folder: Path) -> Iterator[ResultFolder]:
    """Yield the last results of a folder, the newest of each kind with their documents."""
    left = dict(SHOWN)
    for path in _newest(folder, folder.stat().st_mtime_ns):
        kind = path.suffix[1:]
        files = tuple(name for name in ("report.html", f"{kind}.json") if file_in((folder,), path.name, name))
        if not files:
            continue
        file, found = path / files[-1], None
        if file.suffix == ".json" and left[kind]:
            left[kind] -= 1
            found = _document(file, stamp_of(file), kind)
        document, problem = (None, found) if isinstance(found, str) else (found, None)
        yield ResultFolder(path.name, kind, _time(file), files, document, problem)


@lru_cache(maxsize=1024)
def _newest(folder: Path, changed_ns: int) -> tuple[Path, ...]:
    """Return the last folders of results; a new one changes the time of the folder, ``changed_ns``."""
    found = [path for path in folder.iterdir() if path.suffix[1:] in KINDS and path.is_dir()]
    return tuple(sorted(found, key=lambda path: path.stat().st_mtime, reverse=True)[:LISTED])


def file_in(folders: Sequence[Path], result: str, name: str) -> Path | None:
    """Return a file of a result inside one of the folders, ``None`` if there is none: links lead nowhere else."""
    if Path(result).name != result or Path(result).suffix[1:] not in KINDS:
        return None
    if name not in ("report.html", f"{Path(result).suffix[1:]}.json"):
        return None
    for folder in folders:
        path = folder / result / name
        if path.is_file() and path.resolve().is_relative_to(folder.resolve()):
            return path
    return None


@lru_cache(maxsize=1024)
def _document(path: Path, _stamp: str, kind: str) -> Document | str:
    """Return a document, or the reason for which it cannot be read."""
    try:
        if (size := path.stat().st_size) > LARGEST:
            return f"{path}: {size / 1e6:.0f} MB, more than a document has; it is not read"
        return load_document(path, KINDS[kind])
    except (ArmidentError, OSError) as error:
        reason = str(error) if isinstance(error, ArmidentError) else f"{path}: cannot be read ({type(error).__name__})"
        return reason.replace(f"{path.parent.parent}/", "", 1)


def read_drift(cell: Cell) -> Drift | None:
    """Return the change against the first run in the history; ``None`` without a history or runs."""
    url, files = cell.database, list[Path]()
    if url is None:
        files = [folder / HISTORY_FILE for folder in cell.folders if (folder / HISTORY_FILE).is_file()]
        url = f"sqlite:///{files[0].resolve().as_uri()}?mode=ro&uri=true" if files else None
    if url is None or cell.session is None or cell.robot is None:
        return None
    history, arm = History(url), (cell.robot.name, cell.session.cell)
    first, last = history.first(*arm), history.last(*arm)
    if last is None:
        return None
    places = places_of(last.document)
    series: dict[str, list[ParameterSeries]] = {}
    for each in history.series(*arm, RUNS):
        series.setdefault(joint_of(each.name, *places), []).append(each)
    runs = max((len(each.values) for group in series.values() for each in group), default=1)
    where = history.url if cell.database else f"sqlite:///{files[0].resolve()}"
    words = shlex.join(["--database", where, "--robot", arm[0], "--cell", arm[1]])
    more = (runs, series, f"armident history {words}")
    if first is None or first.number == last.number:
        return Drift("one run so far, which is the baseline" if first else "no run has converged", None, *more)
    try:
        test = compare(first.document, last.document)
    except Inconclusive as error:
        return Drift(f"inconclusive: {error}", None, *more)
    return Drift(test.words, test.drifted, *more, frozenset(test.changed))
