"""Commands ``identify``, ``check``, ``diagnose``, ``predict`` and ``compare``: read, compute, write, print."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from armident.configs import ConfigError, DataError
from armident.configs.errors import FOUND
from armident.daq.recording.objects import ObjectUrl, located
from armident.identify.diagnosis.diagnosis_options import DiagnosisOptions
from armident.identify.documents.files import to_json, write_atomically
from armident.identify.identification.options import Options

if TYPE_CHECKING:
    from armident.identify.api.result_base import Result
    from armident.identify.documents.prediction import PredictionDocument
    from armident.identify.identification.robot_model import RobotModel

UNUSABLE = DataError.exit_code
"""Exit code: the data cannot support the request as they are configured, and the result says why."""


def identify_command(path: Path, config: Path | None, options: Options, out: Path | None, *, as_json: bool) -> int:
    """Carry out ``armident identify``; the exit code is `UNUSABLE` if the verdict says so, otherwise 0."""
    from armident.identify.api.identification_api import identify
    from armident.identify.cli.progress import progress, warn
    from armident.identify.cli.terminal import identification_table, verdict_lines

    with progress(f"identify {path.name}") as report:
        result = identify(path, config, options=options, progress=report)
    document, html = _saved(result, out or beside(path, "identification"))
    if as_json:
        sys.stdout.write(result.to_json())
    else:
        verdict_lines(result.document)
        warn(result.document.warnings)
        identification_table(result.document)
        print(f"result: {document}\nreport: {html}")
    return UNUSABLE if result.verdict == "unusable" else 0


def check_command(paths: Sequence[Path], config: Path | None, *, as_json: bool) -> int:
    """Carry out ``armident check``; exit code `UNUSABLE` with a decisive finding or an unexplained joint, else 0."""
    from armident.identify.api.setup_api import check
    from armident.identify.cli.progress import progress

    with progress("check"):
        result = check(list(paths), config)
    print(result.to_json() if as_json else result, end="" if as_json else "\n")
    return 0 if result.passed else UNUSABLE


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
    from armident.identify.api.diagnosis_api import diagnose
    from armident.identify.cli.progress import progress, warn
    from armident.identify.cli.terminal import diagnosis_table

    with progress("diagnose") as report:
        found = diagnose(list(paths), config, validate=validate, baseline=baseline, progress=report, **asdict(options))
    written, html, *model = _saved(found, out or beside(paths[0], "diagnosis"))
    document = found.document
    if as_json:
        sys.stdout.write(written.read_text(encoding="utf-8"))
    else:
        warn(document.warnings)
        diagnosis_table(document)
        print(f"result: {written}\nreport: {html}")
        if model:
            print(f"model:  {model[0]}")
    return 0 if document.verdict == "no_gap" else FOUND


def predict_command(paths: Sequence[Path], model: Path, config: Path | None, out: Path | None, *, as_json: bool) -> int:
    """Carry out ``armident predict``; exit code `FOUND` if the model explains a recording no better than none."""
    from armident.daq.recording import read_recording
    from armident.identify.api.prediction_api import predict
    from armident.identify.cli.progress import progress, warn
    from armident.identify.cli.terminal import prediction_table, predictions_table
    from armident.identify.documents.prediction import predictions_document

    folders = _prediction_folders(paths, out)
    found: list[PredictionDocument] = []
    used: Path | RobotModel = model
    for path, folder in zip(paths, folders, strict=True):
        with progress(f"predict {path.name}") as report:
            prediction = predict(read_recording(path), used, config if used is model else None, progress=report)
        used = prediction.model
        written, html, torques = _saved(prediction, folder)
        found.append(prediction.document)
        if not as_json:
            warn([line if len(paths) == 1 else f"{path}: {line}" for line in prediction.document.warnings])
    if len(paths) == 1:
        if as_json:
            sys.stdout.write(prediction.to_json())
        else:
            prediction_table(found[0])
            print(f"result: {written}\ntorques: {torques}\nreport: {html}")
        return FOUND if found[0].worthless else 0
    together = predictions_document(found)
    if out is not None:
        with writing(out):
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
        folders = [beside(path, "prediction") for path in paths]
    else:
        folders = [out] if len(paths) == 1 else [out / path.stem for path in paths]
    twice = next((path for path, folder in zip(paths, folders, strict=True) if folders.count(folder) > 1), None)
    if twice is not None:
        raise ConfigError(f"{twice}: given twice, or two recordings have this name; leave --out out, or rename one")
    return folders


def compare_command(
    baseline: Path, now: Path, out: Path | None, false_alarms: float, *, common: bool, as_json: bool
) -> int:
    """Carry out ``armident compare``; exit code `FOUND` if the parameters differ significantly."""
    from armident.identify.api.comparison_api import compare
    from armident.identify.cli.progress import warn
    from armident.identify.monitoring.change.comparison import comparison_table

    test = compare(baseline, now, common=common, false_alarm_rate=false_alarms)
    written, html = _saved(test, out or (now if now.is_dir() else now.parent) / "comparison")
    if as_json:
        sys.stdout.write(test.to_json())
    else:
        warn(test.document.warnings)
        comparison_table(test.document)
        print(f"result: {written}\nreport: {html}")
    return FOUND if test.changed else 0


def _saved(result: "Result", folder: Path) -> tuple[Path, ...]:
    """Write a result to the folder of the results."""
    with writing(folder):
        return result.save(folder)


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Turn an error of the file system into one line that names the folder of the results."""
    try:
        yield
    except OSError as error:
        raise ConfigError(f"--out {folder}: cannot be written: {error.strerror}") from error


def beside(path: Path, suffix: str) -> Path:
    """Return the name of a folder or file beside a recording that belongs to it; of an object in the working folder."""
    if isinstance(located(path), ObjectUrl):
        path = Path(path.name)
    return path.with_name(f"{path.name.removesuffix('.mcap')}.{suffix}")
