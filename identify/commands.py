"""Commands ``identify``, ``check``, ``diagnose``, ``predict`` and ``compare``: read, compute, write, print."""

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from armident.configs import ConfigError, DataError
from armident.identify.diagnosis.diagnosis_options import DiagnosisOptions
from armident.identify.documents.files import load_document, to_json, write_atomically
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.identification.options import Options

UNUSABLE = DataError.exit_code
"""Exit code: the data cannot support the request as they are configured, and the result says why."""

FOUND = 4
"""Exit code: done, with findings, a change, or an unexplained residual."""


def identify_command(path: Path, config: Path | None, options: Options, out: Path | None, *, as_json: bool) -> int:
    """Carry out ``armident identify``; the exit code is `UNUSABLE` if the verdict says so, otherwise 0."""
    from armident.identify.api import identify
    from armident.identify.cli_tables import identification_table, progress, verdict_lines, warn

    with progress(f"identify {path.name}") as report:
        result = identify(path, config, **asdict(options), progress=report)
    folder = out or _beside(path, "identification")
    with _writing(folder):
        document, html = result.save(folder)
    if as_json:
        sys.stdout.write(to_json(result.document))
    else:
        verdict_lines(result.document)
        warn(result.document.warnings)
        identification_table(result.document)
        print(f"result: {document}\nreport: {html}")
    return UNUSABLE if result.verdict == "unusable" else 0


def check_command(paths: Sequence[Path], config: Path | None, *, as_json: bool) -> int:
    """Carry out ``armident check``.

    ``config``: robot configuration; ``None``: that of the first recording. ``as_json``: print the result as JSON on
    stdout instead of a table. Returns the exit code: `UNUSABLE` with a decisive finding or a joint that is not
    understood, otherwise 0. Raises ConfigError or DataError if a file is wrong, or the recordings cannot be checked.
    """
    from armident.identify.api import check
    from armident.identify.cli_tables import progress, setup_table

    with progress("check"):
        result = check(list(paths), config)
    if as_json:
        content = {**vars(result), "findings": [vars(finding) for finding in result.findings]}
        content["torque_shift"] = None if result.torque_shift is None else asdict(result.torque_shift)
        robot = result.corrected_robot
        content["corrected_robot"] = None if robot is None else robot.model_dump(mode="json", by_alias=True)
        sys.stdout.write(json.dumps(content, indent=2) + "\n")
    else:
        setup_table(result)
    wrong = result.joints_not_understood or any(finding.decisive for finding in result.findings)
    return UNUSABLE if wrong else 0


def diagnose_command(
    paths: Sequence[Path],
    config: Path | None,
    validate: Path | None,
    baseline: Path | None,
    options: DiagnosisOptions,
    out: Path | None,
    *,
    as_json: bool,
) -> int:
    """Carry out ``armident diagnose``; the exit code is 0 if the verdict is ``no_gap``, otherwise `FOUND`."""
    from armident.identify.api import diagnose
    from armident.identify.cli_tables import diagnosis_table, progress, warn

    with progress("diagnose") as report:
        found = diagnose(list(paths), config, validate=validate, baseline=baseline, progress=report, **asdict(options))
    folder = out or _beside(paths[0], "diagnosis")
    with _writing(folder):
        document = found.save(folder)
    if as_json:
        sys.stdout.write(to_json(document))
    else:
        warn(document.warnings)
        diagnosis_table(document)
        print(f"result: {folder / 'diagnosis.json'}\nreport: {folder / 'report.html'}")
        if document.model is not None:
            print(f"model:  {document.model}")
    return 0 if document.verdict == "no_gap" else FOUND


def predict_command(paths: Sequence[Path], model: Path, config: Path | None, out: Path | None, *, as_json: bool) -> int:
    """Carry out ``armident predict``.

    ``model``: result with the identified parameters. ``config``: robot configuration; ``None``: that of the model.
    ``out``: folder of the results, of several recordings with a folder for each; ``None``: beside each recording.
    ``as_json``: print the document on stdout instead of a table. Returns the exit code: `FOUND` if the model explains
    the torques of a recording no better than none, otherwise 0. Raises ConfigError or DataError if a file is wrong, the
    model is unusable, or a recording cannot be used.
    """
    from armident.configs import load_robot
    from armident.daq.recording import read_recording
    from armident.identify.cli_tables import prediction_table, predictions_table, progress, warn
    from armident.identify.documents.prediction import predictions_document
    from armident.identify.prediction import predict_recording
    from armident.identify.report.prediction import prediction_report
    from armident.identify.saved_model import load_model

    folders = _prediction_folders(paths, out)
    robot = None if config is None else load_robot(config, "identify")
    loaded, found = None, []
    for path, folder in zip(paths, folders, strict=True):
        with progress(f"predict {path.name}") as report:
            recording = read_recording(path)
            loaded = loaded or load_model(model, robot, default=recording.robot, progress=report)
            prediction = predict_recording(recording, loaded, report)
        with _writing(folder):
            write_atomically(folder / "torques.csv", prediction.csv())
            write_atomically(folder / "report.html", prediction_report(prediction, loaded.robot, loaded.document))
            write_atomically(folder / "prediction.json", to_json(prediction.document))
        found.append(prediction.document)
        if not as_json:
            warn([line if len(paths) == 1 else f"{path}: {line}" for line in prediction.document.warnings])
    if len(paths) == 1:
        if as_json:
            sys.stdout.write(to_json(found[0]))
        else:
            prediction_table(found[0])
            print(f"result: {folders[0] / 'prediction.json'}\ntorques: {folders[0] / 'torques.csv'}")
            print(f"report: {folders[0] / 'report.html'}")
        return FOUND if found[0].worthless else 0
    together = predictions_document(found)
    if out is not None:
        with _writing(out):
            write_atomically(out / "predictions.json", to_json(together))
    if as_json:
        sys.stdout.write(to_json(together))
    else:
        predictions_table(together)
        print(*(f"report: {folder / 'report.html'}" for folder in folders), sep="\n")
        if out is not None:
            print(f"result: {out / 'predictions.json'}")
    return FOUND if together.worthless else 0


def _prediction_folders(paths: Sequence[Path], out: Path | None) -> list[Path]:
    """Return the folder for the results of each recording, all different."""
    if out is None:
        folders = [_beside(path, "prediction") for path in paths]
    else:
        folders = [out] if len(paths) == 1 else [out / path.stem for path in paths]
    twice = next((path for path, folder in zip(paths, folders, strict=True) if folders.count(folder) > 1), None)
    if twice is not None:
        raise ConfigError(f"{twice}: given twice, or two recordings have this name; leave --out out, or rename one")
    return folders


def compare_command(
    baseline: Path, now: Path, out: Path | None, false_alarms: float, *, common: bool, as_json: bool
) -> int:
    """Carry out ``armident compare``.

    Returns the exit code: `FOUND` if the parameters differ significantly, otherwise 0. Raises ConfigError or DataError
    if a file is wrong, or the two cannot be compared.

    Parameters
    ----------
    baseline, now
        Two ``identification.json``, or their folders.
    out
        Folder of the results; ``None``: ``comparison`` beside the later one.
    false_alarms
        Probability of the verdict ``changed`` without a change.
    common
        Compare only the parameters that both have.
    as_json
        Print the document on stdout instead of a table.
    """
    from armident.identify.cli_tables import warn
    from armident.identify.monitoring.comparison import compare_models, comparison_table
    from armident.identify.report.comparison import comparison_report

    files = [each / "identification.json" if each.is_dir() else each for each in (baseline, now)]
    first, second = (load_document(file, IdentificationDocument) for file in files)
    document = compare_models((first, files[0]), (second, files[1]), common=common, false_alarms=false_alarms)
    folder = out or files[1].parent / "comparison"
    with _writing(folder):
        write_atomically(folder / "report.html", comparison_report(document, second))
        write_atomically(folder / "comparison.json", to_json(document))
    if as_json:
        sys.stdout.write(to_json(document))
    else:
        warn(document.warnings)
        comparison_table(document)
        print(f"result: {folder / 'comparison.json'}\nreport: {folder / 'report.html'}")
    return FOUND if document.verdict == "changed" else 0


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    """Turn an error of the file system into one line that names the folder of the results."""
    try:
        yield
    except OSError as error:
        raise ConfigError(f"--out {folder}: cannot be written: {error.strerror}") from error


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(f"{path.name.removesuffix('.mcap')}.{suffix}")
