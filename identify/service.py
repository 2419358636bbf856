"""What the commands and the worker do with a recording: identify it, diagnose it, write the results."""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from armident.configs import DataError, RobotConfig, load_robot
from armident.daq.recording import Recording, read_recording
from armident.identify.document import (
    IdentificationDocument,
    identification_document,
    load_document,
    reference,
    to_json,
    write_atomically,
)
from armident.identify.experiment import Experiment
from armident.identify.from_recording import experiments_from_recording
from armident.identify.options import Options, parse_decimation, parse_nvr
from armident.identify.result import Identification
from armident.identify.run import identify_experiment

FOUND = 4
"""Exit code: done, and the answer is that something changed or stays unexplained."""


@dataclass(frozen=True)
class Outcome:
    """An identification with everything its report shows."""

    recording: Recording
    robot: RobotConfig
    result: Identification
    document: IdentificationDocument


def identify_recording(
    recording: Recording,
    robot: RobotConfig | None = None,
    options: Options | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Outcome:
    """Identify a recording, whether it was read from a file or assembled from the stream.

    Parameters
    ----------
    recording
        The recording.
    robot
        Configuration to use; ``None``: the one inside the recording.
    options
        Of the estimator.
    progress
        Called with a stage and the share done.

    Raises
    ------
    ConfigError, DataError
        If configuration or data cannot support the request.
    """
    robot = robot or recording.robot
    experiments, notes = experiments_from_recording(recording, robot)
    result = identify_experiment(experiments, robot, options or Options(), progress)
    return Outcome(recording, robot, result, identification_document(result, recording, robot, notes))


def write_identification(outcome: Outcome, out: Path) -> tuple[Path, Path]:
    """Write ``identification.json`` and ``report.html`` into a folder; returns their paths."""
    from armident.identify.report.identification import identification_report

    document, report = out / "identification.json", out / "report.html"
    write_atomically(document, to_json(outcome.document))
    write_atomically(report, identification_report(outcome.recording, outcome.robot, outcome.result, outcome.document))
    return document, report


def identify_command(
    path: Path, config: Path | None, chosen: Mapping[str, Any], out: Path | None, *, as_json: bool
) -> None:
    """Carry out ``armident identify``; ``chosen`` are the fields of `Options` as the user wrote them."""
    from armident.identify.terminal import identification_table, progress, warn

    as_written = {"nvr": parse_nvr(chosen.get("nvr")), "decimation": parse_decimation(chosen.get("decimation"))}
    options = Options(**{**chosen, **as_written})
    robot = None if config is None else load_robot(config)
    recording = read_recording(path)
    with progress(f"identify {path.name}") as report:
        outcome = identify_recording(recording, robot, options, report)
    document, html = write_identification(outcome, out or _beside(path, "identification"))
    if as_json:
        sys.stdout.write(to_json(outcome.document))
        return
    warn(outcome.document.warnings)
    identification_table(outcome.document)
    print(f"result: {document}\nreport: {html}")


def diagnose_command(
    paths: Sequence[Path],
    config: Path | None,
    validate: Path | None,
    baseline: Path | None,
    chosen: Mapping[str, float],
    out: Path | None,
    *,
    as_json: bool,
) -> int:
    """Carry out ``armident diagnose``; ``chosen`` are the fields of its `Settings`; returns the exit code."""
    from armident.identify.discrepancy.diagnose import diagnose
    from armident.identify.discrepancy.state import Settings
    from armident.identify.report.diagnosis import diagnosis_report
    from armident.identify.terminal import diagnosis_table, progress, warn

    numbers = None if baseline is None else load_document(baseline, IdentificationDocument)
    recordings = [read_recording(path) for path in paths]
    robot = recordings[0].robot if config is None else load_robot(config)
    if numbers is not None and numbers.robot != robot.name:
        raise DataError(f"{baseline}: the numbers of robot {numbers.robot!r}, the recording is of {robot.name!r}")
    notes: list[str] = []
    training = [e for recording in recordings for e in _experiments(recording, robot, notes)]
    validation: list[Experiment] = []
    if validate is not None:
        recordings.append(read_recording(validate))
        validation = _experiments(recordings[-1], robot, notes)
    with progress("diagnose") as report:
        found = diagnose(
            training,
            validation,
            robot,
            [reference(r) for r in recordings],
            numbers,
            list(dict.fromkeys(notes)),
            report,
            Settings(**chosen),
        )
    folder = out or _beside(paths[0], "diagnosis")
    document = found.document
    if found.robot.effects != robot.effects:
        model = folder / "model.yaml"
        write_atomically(model, robot_yaml(found.robot))
        document = document.model_copy(update={"model": str(model)})
    write_atomically(folder / "diagnosis.json", to_json(document))
    write_atomically(folder / "report.html", diagnosis_report(found, document))
    if as_json:
        sys.stdout.write(to_json(document))
    else:
        warn(document.warnings)
        diagnosis_table(document)
        print(f"result: {folder / 'diagnosis.json'}\nreport: {folder / 'report.html'}")
        if document.model is not None:
            print(f"model:  {document.model}")
    return 0 if document.verdict == "no_gap" else FOUND


def robot_yaml(robot: RobotConfig) -> str:
    """A robot configuration as its file."""
    return yaml.safe_dump(robot.model_dump(mode="json", by_alias=True), sort_keys=False)


def _experiments(recording: Recording, robot: RobotConfig, notes: list[str]) -> list[Experiment]:
    experiments, found = experiments_from_recording(recording, robot)
    notes += found if recording.path is None else [f"{recording.path.name}: {note}" for note in found]
    return experiments


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(f"{path.name.removesuffix('.mcap')}.{suffix}")
