"""Tasks of the process of diagnoses: diagnose or identify one recording."""

import time
from dataclasses import dataclass
from pathlib import Path

from armident.configs import ConfigError, RobotConfig, load_robot
from armident.daq.recording import read_recording
from armident.identify.documents.base import reference
from armident.identify.documents.diagnosis import DiagnosisDocument
from armident.identify.documents.files import load_document, to_json, write_atomically
from armident.identify.documents.identification import IdentificationDocument


@dataclass(frozen=True)
class DiagnosisTask:
    """Recording to diagnose, without information about the simulated effects.

    Parameters
    ----------
    robot
        Name or file of the robot configuration.
    leave_out
        Part that is removed from the model, see `reduced_model`.
    joints
        Joints of which the part is removed.
    baseline
        Identification document of the healthy arm; ``None`` to diagnose without one.
    validation
        Recording to judge by, with the whole model; ``None``: the end of ``recording``.
    """

    recording: Path
    robot: str
    leave_out: str | None = None
    joints: tuple[str, ...] = ()
    baseline: Path | None = None
    validation: Path | None = None


@dataclass(frozen=True)
class IdentificationTask:
    """Recording to identify, and the file for the identification document."""

    recording: Path
    robot: str
    out: Path


@dataclass(frozen=True)
class TimedDiagnosis:
    """Diagnosis document and the time that the diagnosis took, s."""

    document: DiagnosisDocument
    seconds: float


def reduced_model(robot: RobotConfig, leave_out: str | None, joints: tuple[str, ...]) -> RobotConfig:
    """Return the configuration without ``rotor_inertia`` of some joints, or ``couplings``; refuse any other name."""
    if leave_out is None:
        return robot
    if leave_out == "couplings":
        return robot.model_copy(update={"couplings": ()})
    if leave_out == "rotor_inertia":
        changed = tuple(
            joint.model_copy(update={"rotor_inertia": False}) if joint.name in joints else joint
            for joint in robot.joints
        )
        removed = {f"ia{k}" for k, joint in enumerate(robot.joints, 1) if joint.name in joints}
        known = {name: value for name, value in robot.initial_parameters.items() if name not in removed}
        return robot.model_copy(update={"joints": changed, "initial_parameters": known})
    raise ConfigError(f"leave_out: expected rotor_inertia or couplings, found {leave_out!r}")


def diagnose_file(task: DiagnosisTask) -> TimedDiagnosis:
    """Diagnose a recording; a ConfigError or DataError if the model or the recording does not support it."""
    # Imported here: the process of the command line needs none of it.
    from armident.identify.api.diagnosis_api import diagnose
    from armident.identify.diagnosis.diagnose import run_diagnosis
    from armident.identify.identification.from_recording import experiments_from_recording

    begin = time.perf_counter()
    if task.validation is not None:
        found = diagnose(task.recording, task.robot, validate=task.validation)
        return TimedDiagnosis(found.document, time.perf_counter() - begin)
    robot = reduced_model(load_robot(task.robot), task.leave_out, task.joints)
    recording = read_recording(task.recording)
    baseline = None if task.baseline is None else load_document(task.baseline, IdentificationDocument)
    experiments, notes = experiments_from_recording(recording, robot)
    result = run_diagnosis(experiments, [], robot, [reference(recording)], baseline, notes)
    return TimedDiagnosis(result.document, time.perf_counter() - begin)


def identify_file(task: IdentificationTask) -> None:
    """Identify a recording and write the identification document."""
    from armident.identify.identification.identify_recording import identify_recording

    document = identify_recording(read_recording(task.recording), load_robot(task.robot)).document
    write_atomically(task.out, to_json(document))
