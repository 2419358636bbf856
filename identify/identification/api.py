"""What the commands and the worker do with a recording: identify it, diagnose it, write the results."""

from collections.abc import Callable
from dataclasses import dataclass

from armident.configs import RobotConfig
from armident.daq.recording import Recording
from armident.identify.document import IdentificationDocument, identification_document
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from armident.identify.identification.result import Identification


@dataclass(frozen=True)
class IdentificationOutcome:
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
) -> IdentificationOutcome:
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
    return IdentificationOutcome(recording, robot, result, identification_document(result, recording, robot, notes))
