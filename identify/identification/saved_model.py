"""Identified models read back from result documents: configuration, parameters and their covariance."""

from collections.abc import Callable
from pathlib import Path

from pydantic import ValidationError

from armident.configs import ConfigError, DataError, RobotConfig, load_robot
from armident.daq.recording import read_recording
from armident.identify.documents.diagnosis import DiagnosisDocument
from armident.identify.documents.files import load_document, read_json
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.effects.terms import arm_model
from armident.identify.identification.identify_recording import identify_recording
from armident.identify.identification.options import Options
from armident.identify.identification.robot_model import RobotModel
from armident.identify.identification.sign_smoothing import with_numbers

REFIT: Options = Options(method="idim-iv")
"""Estimation of a diagnosed model: unbiased in closed loop (thesis section 2.3.3), and needs no noise model."""


def load_model(
    path: Path,
    robot: RobotConfig | None = None,
    *,
    default: RobotConfig | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> RobotModel:
    """Read an identified model from ``identification.json``, ``diagnosis.json``, or the folder of one of them."""
    path = _file(path)
    if str(read_json(path).get("schema", "")).startswith("armident/diagnosis/"):
        return _diagnosed(path, robot, progress)
    return model_of(load_document(path, IdentificationDocument), path, robot, default=default)


def model_of(
    document: IdentificationDocument,
    path: Path,
    robot: RobotConfig | None = None,
    *,
    default: RobotConfig | None = None,
) -> RobotModel:
    """Return the model of an identification that is not judged unusable; its file is for messages."""
    if document.verdict == "unusable":
        reason = document.reasons[0]
        raise DataError(f"{path}: the model is unusable: {reason.message}. Next: {reason.next_step}")
    return RobotModel(used_configuration(document, path, robot, default), identification=document, path=path)


def used_configuration(
    document: IdentificationDocument, path: Path, robot: RobotConfig | None, default: RobotConfig | None = None
) -> RobotConfig:
    """Return the configuration of an identification, with its smoothing of the sign; refuse one of other parameters."""
    config = robot or configuration_of(document, path) or default
    if config is None:
        raise ConfigError(f"{path}: written by a former version, without the robot: add --config ROBOT")
    if config.name != document.robot:
        raise DataError(f"{path}: the model is of robot {document.robot!r}, the configuration of {config.name!r}")
    names = arm_model(config).base.names
    if names != tuple(p.name for p in document.parameters):
        odd = sorted(set(names) ^ {p.name for p in document.parameters}) or ["the same names in another order"]
        raise DataError(
            f"{path}: other base parameters than those of the configuration ({', '.join(odd[:5])}): "
            "add --config with the configuration that was identified"
        )
    smoothing = document.sign_smoothing
    if smoothing is not None:
        if set(smoothing) != {joint.name for joint in config.joints}:
            raise DataError(f"{path}: its joints are {', '.join(smoothing)}, other names than in the configuration")
        config = with_numbers(config, [smoothing[joint.name] for joint in config.joints])
    return config


def _file(path: Path) -> Path:
    """Return the result file of a path that may be its folder."""
    if path.suffix in (".yaml", ".yml", ".mcap"):
        of_recording = path.suffix == ".mcap"
        kind, command = ("recording", f"{path}") if of_recording else ("configuration", f"RECORDING --config {path}")
        raise ConfigError(
            f"{path}: a {kind} has no identified parameters: run `armident identify {command}` and give its "
            "identification.json"
        )
    if not path.is_dir():
        return path
    for name in ("identification.json", "diagnosis.json"):
        if (path / name).is_file():
            return path / name
    raise ConfigError(f"{path}: the folder has neither identification.json nor diagnosis.json: run armident identify")


def configuration_of(document: IdentificationDocument, path: Path) -> RobotConfig | None:
    """Robot configuration of a document, ``None`` in former versions; raises DataError if it is wrong."""
    if document.configuration is None:
        return None
    try:
        return RobotConfig.model_validate(document.configuration)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise DataError(f"{path}: configuration.{key}: {first['msg']}") from error


def _beside(document: Path, name: str | None) -> Path | None:
    """Return a file that a document names, from the working directory or beside the document or its folder."""
    if name is None:
        return None
    folder = document.absolute().parent
    candidates = (Path(name), folder / Path(name).name, folder.parent / Path(name).name)
    return next((file for file in candidates if file.is_file()), None)


def _diagnosed(path: Path, robot: RobotConfig | None, progress: Callable[[str, float], None] | None) -> RobotModel:
    """Identify the structure that a diagnosis found from the recordings that it names."""
    document = load_document(path, DiagnosisDocument)
    recordings = []
    for each in document.recordings:
        file = _beside(path, each.path)
        if file is None:
            raise DataError(
                f"{path}: its recording {each.path or '(from the stream)'} is not here: run `armident identify` on it "
                f"with --config {document.model or 'ROBOT'}, and give that identification.json"
            )
        recording = read_recording(file)
        if recording.sha256 != each.sha256:
            raise DataError(f"{path}: its recording {file} has changed since the diagnosis")
        recordings.append(recording)
    if not recordings:
        raise DataError(f"{path}: the diagnosis names no recording")
    if robot is None and document.model is not None:
        robot = load_robot(_beside(path, document.model) or document.model)
    outcome = identify_recording(recordings, robot or recordings[0].robot, REFIT, progress)
    return model_of(outcome.document, path)
