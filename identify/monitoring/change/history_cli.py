"""Command ``armident history``: list identifications, test for change, plot parameters over time."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from armident.configs import ConfigError
from armident.configs.errors import FOUND
from armident.identify.diagnosis.baseline_comparison import Inconclusive
from armident.identify.diagnosis.change_test import ParameterChangeTest, compare
from armident.identify.documents.files import load_document
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.documents.rounding import plus_minus
from armident.identify.monitoring.change.history import History, HistoryRun, recorded_at


def history_command(
    documents: Sequence[Path],
    database: str,
    robot: str | None,
    cell: str | None,
    parameters: Sequence[str],
    plot: Path | None,
    false_alarms: float,
    *,
    as_json: bool,
) -> int:
    """Carry out ``armident history``: add documents, compare runs with the first one, plot parameters."""
    if documents and str(documents[0]) in ("backup", "restore"):
        return _copied(str(documents[0]), documents[1:], database)
    loaded = [(load_document(path, IdentificationDocument), path) for path in documents]
    history = History(database)
    for document, path in loaded:
        history.add(document, recorded_at(document, path))
    wanted = _robot(history, robot, [document.robot for document, _ in loaded])
    here = _cell(history, wanted, cell, [document for document, _ in loaded])
    runs = history.runs(wanted, here)
    title = wanted if here is None else f"{wanted} in cell {here}"
    first = next((k for k, run in enumerate(runs) if run.document.converged), len(runs))
    drifts = [_compared(runs[first], run, false_alarms) if k > first else None for k, run in enumerate(runs)]
    _check(parameters, runs)
    if plot is not None:
        _plot(plot, title, runs, parameters or _most_changed(drifts, runs))
    if as_json:
        print(json.dumps([_entry(run, drift) for run, drift in zip(runs, drifts, strict=True)], indent=1))
    else:
        _table(title, runs, drifts, parameters)
    last = drifts[-1]
    return FOUND if last is not None and last.drifted else 0


def _copied(word: str, files: Sequence[Path], database: str) -> int:
    """Carry out ``armident history backup FILE``, or ``restore FILE``."""
    if len(files) != 1:
        raise ConfigError(f"history {word}: expected one file")
    (file,) = files
    if file.is_dir():
        raise ConfigError(f"{file}: a folder, expected a file")
    if word == "backup":
        print(f"saved {History(database).save(file)} identifications in {file}")
        return 0
    if not file.is_file():
        raise ConfigError(f"{file}: no such file")
    try:
        copy = History(f"sqlite:///{file}")
    except ConfigError as error:
        raise ConfigError(str(error).removeprefix("sqlite:///")) from error
    added = copy.copy_to(History(database))
    print(f"restored {added} identifications; those that the history had already are unchanged")
    return 0


def _compared(first: HistoryRun, run: HistoryRun, false_alarms: float) -> ParameterChangeTest | None:
    try:
        return compare(first.document, run.document, false_alarms)
    except Inconclusive:
        return None


def _robot(history: History, wanted: str | None, added: Sequence[str]) -> str:
    known = sorted({name for name, _ in history.arms()})
    names = set(added) if wanted is None else {wanted}
    if wanted is None and not added:
        names = set(known)
    if len(names) != 1 or not names <= set(known):
        have = ", ".join(known) or "none yet"
        raise ConfigError(f"--robot: choose one of the robots in the history: {have}")
    return names.pop()


def _cell(history: History, robot: str, wanted: str | None, added: Sequence[IdentificationDocument]) -> str | None:
    """Return the cell of the arm; ``None`` if the history knows no cell of this robot."""
    known = sorted({cell for name, cell in history.arms() if name == robot and cell is not None})
    if wanted is not None:
        if wanted not in known:
            raise ConfigError(f"--cell: no {wanted!r}; {robot} is known in {', '.join(known) or 'no cell'}")
        return wanted
    cells = {cell for cell in map(history.cell, added) if cell is not None} or set(known)
    if len(cells) > 1:
        raise ConfigError(f"--cell: choose a cell; {robot} is known in {', '.join(known)}")
    return cells.pop() if cells else None


def _check(parameters: Sequence[str], runs: Sequence[HistoryRun]) -> None:
    known = [p.name for p in runs[0].document.parameters]
    for name in parameters:
        if name not in known:
            raise ConfigError(f"--parameter: no {name!r} of {runs[0].document.robot}; there are {', '.join(known)}")


def _most_changed(drifts: Sequence[ParameterChangeTest | None], runs: Sequence[HistoryRun], most: int = 6) -> list[str]:
    """Return the parameters with the largest difference from the first run, in standard deviations."""
    names = [p.name for p in runs[0].document.parameters if p.essential]
    compared = [drift for drift in drifts if drift is not None]
    if not compared:
        return names[:most]
    far: dict[str, float] = dict.fromkeys(names, 0.0)
    for drift in compared:
        for p, z in zip(drift.parameters, np.abs(drift.difference) / drift.std, strict=True):
            if p.name in far:
                far[p.name] = max(far[p.name], float(z))
    return sorted(names, key=lambda name: -far[name])[:most]


def _entry(run: HistoryRun, drift: ParameterChangeTest | None) -> dict[str, object]:
    document = run.document
    return {
        "recorded": run.recorded.isoformat(),
        "recording": document.recording.path,
        "method": document.method,
        "relative_error_pct": document.relative_error_pct,
        "parameters": {p.name: {"value": p.value, "std": p.std, "unit": p.unit} for p in document.parameters},
        "drift": None if drift is None else drift.entry | {"words": drift.words},
    }


def _table(
    title: str, runs: Sequence[HistoryRun], drifts: Sequence[ParameterChangeTest | None], parameters: Sequence[str]
) -> None:
    from rich.table import Table

    from armident.identify.cli.print_table import print_table

    table = Table(title=title)
    for heading in ("recorded (UTC)", "recording", "error", *parameters, "compared with the first"):
        table.add_column(heading, justify="left" if heading in ("recording", "compared with the first") else "right")
    first = next((run for run in runs if run.document.converged), None)
    for run, drift in zip(runs, drifts, strict=True):
        values = {p.name: plus_minus(p.value, p.std) for p in run.document.parameters}
        table.add_row(
            f"{run.recorded:%Y-%m-%d %H:%M}",
            Path(run.document.recording.path or "-").name,
            f"{run.document.relative_error_pct:.2f} %",
            *(values[name] for name in parameters),
            drift.words if drift is not None else "baseline" if run is first else "inconclusive",
        )
    print_table(table)


def _plot(path: Path, title: str, runs: Sequence[HistoryRun], parameters: Sequence[str]) -> None:
    """Plot parameters over the time of the recordings, one row each, with two standard deviations."""
    import matplotlib.pyplot as plt

    if path.suffix not in {".png", ".svg", ".pdf"}:
        raise ConfigError(f"--plot {path}: expected a name that ends in .png, .svg or .pdf")
    times = [run.recorded for run in runs]
    figure, axes = plt.subplots(len(parameters), 1, sharex=True, squeeze=False, figsize=(8, 1 + 1.4 * len(parameters)))
    for axis, name in zip(axes[:, 0], parameters, strict=True):
        found = [next(p for p in run.document.parameters if p.name == name) for run in runs]
        values, deviations = np.array([p.value for p in found]), np.array([p.std for p in found])
        axis.axhspan(values[0] - 2 * deviations[0], values[0] + 2 * deviations[0], color="0.9")
        axis.errorbar(times, values, 2 * deviations, fmt="o", markersize=3, linewidth=1, capsize=2)
        axis.set_ylabel(f"{name}\n{found[0].unit}")
    axes[0, 0].set_title(f"{title}: two standard deviations; the band is that of the first run")
    figure.autofmt_xdate()
    figure.tight_layout()
    try:
        figure.savefig(path)
    except OSError as error:
        raise ConfigError(f"--plot {path}: cannot be written: {error.strerror}") from error
    finally:
        plt.close(figure)
