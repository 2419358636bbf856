"""Commands ``identify`` and ``diagnose``: read, compute, write, print."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from armident.configs import DataError, RobotConfig, load_robot
from armident.daq.recording import Recording, read_recording
from armident.identify.document import IdentificationDocument, load_document, reference, to_json, write_atomically
from armident.identify.experiment import Experiment
from armident.identify.identification.api import identify_recording
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.identification.options import Options, parse_decimation, parse_nvr
from armident.identify.report.files import robot_yaml, write_identification

FOUND = 4
"""Exit code: done, with findings or an unexplained residual."""


def identify_command(
    path: Path, config: Path | None, chosen: Mapping[str, Any], out: Path | None, *, as_json: bool
) -> None:
    """Carry out ``armident identify``.

    Parameters
    ----------
    path
        Recording.
    config
        Robot configuration; ``None``: that of the recording.
    chosen
        Fields of `Options` as the user wrote them.
    out
        Folder of the results; ``None``: beside the recording.
    as_json
        Print the document on stdout instead of a table.

    Raises
    ------
    ConfigError, DataError
        If an option or a file is wrong, or the recording cannot be identified.
    """
    from armident.identify.cli_tables import identification_table, progress, warn

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
    """Carry out ``armident diagnose``.

    Parameters
    ----------
    paths
        Recordings to fit.
    config
        Robot configuration; ``None``: that of the first recording.
    validate
        Held-out recording; ``None``: the last part of the data.
    baseline
        Identification whose parameters are tested for change.
    chosen
        Fields of `armident.identify.diagnosis.state.Settings`.
    out
        Folder of the results; ``None``: beside the first recording.
    as_json
        Print the document on stdout instead of a table.

    Returns
    -------
    int
        Exit code: 0 if the verdict is ``no_gap``, otherwise `FOUND`.

    Raises
    ------
    ConfigError, DataError
        If an option or a file is wrong, or the recordings cannot support a diagnosis.
    """
    from armident.identify.cli_tables import diagnosis_table, progress, warn
    from armident.identify.diagnosis.diagnose import diagnose
    from armident.identify.diagnosis.state import Settings
    from armident.identify.report.diagnosis import diagnosis_report

    numbers = None if baseline is None else load_document(baseline, IdentificationDocument)
    recordings = [read_recording(path) for path in paths]
    robot = recordings[0].robot if config is None else load_robot(config)
    if numbers is not None and numbers.robot != robot.name:
        raise DataError(f"{baseline}: the baseline is of robot {numbers.robot!r}, the recording of {robot.name!r}")
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


def _experiments(recording: Recording, robot: RobotConfig, notes: list[str]) -> list[Experiment]:
    experiments, found = experiments_from_recording(recording, robot)
    notes += found if recording.path is None else [f"{recording.path.name}: {note}" for note in found]
    return experiments


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(f"{path.name.removesuffix('.mcap')}.{suffix}")
