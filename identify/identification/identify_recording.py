"""Identification of recordings: from raw samples to the result and its document."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from armident.configs import DataError, RobotConfig
from armident.daq.recording import Recording
from armident.identify.documents.base import reference
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.identification.document import identification_document
from armident.identify.identification.from_recording import StretchRule, experiments_of
from armident.identify.identification.identification_result import IdentificationResult
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from armident.identify.identification.sign_smoothing import with_numbers
from armident.identify.setup.check import check_setup
from armident.identify.setup.result import SetupCheck
from armident.identify.signals.experiments import Experiment
from armident.identify.signals.streamed import Streamed

CHECKED_VALUES = 6_000_000
"""Number of values (samples times joints) of a long recording by which the set-up is checked."""


@dataclass(frozen=True)
class IdentificationOutcome:
    """An identification with all data of its report; ``robot`` has the smoothing of the sign that was used."""

    recordings: tuple[Recording, ...]
    robot: RobotConfig
    result: IdentificationResult
    document: IdentificationDocument


def identify_recording(
    recordings: Recording | Sequence[Recording],
    robot: RobotConfig | None = None,
    options: Options | None = None,
    progress: Callable[[str, float], None] | None = None,
    check: Callable[[Sequence[Experiment], RobotConfig], SetupCheck] | None = check_setup,
    stretches: StretchRule | None = None,
) -> IdentificationOutcome:
    """Identify recordings of one robot, read from files or assembled from the stream."""
    recordings = (recordings,) if isinstance(recordings, Recording) else tuple(recordings)
    robot = robot or recordings[0].robot
    experiments, notes = experiments_of(
        recordings, robot, name_files=len(recordings) > 1, stretches=stretches or StretchRule()
    )
    setup = None
    if check is not None:
        try:
            setup = check(_checked(experiments), robot)
        except DataError as error:
            # Too short for the check: the identification itself decides if it is long enough for the parameters.
            notes = [*notes, f"the set-up was not checked: {error}"]
    result = identify_experiment(experiments, robot, options or Options(), progress, setup)
    used = with_numbers(robot, result.sign_smoothing)
    document = identification_document(result, [reference(recording) for recording in recordings], used, notes)
    return IdentificationOutcome(recordings, used, result, document)


def _checked(experiments: Sequence[Experiment]) -> Sequence[Experiment]:
    """Experiments by which the set-up is checked: of a long recording the first ones."""
    if not isinstance(experiments, Streamed):
        return experiments
    first: list[Experiment] = []
    while len(first) < len(experiments) and sum(e.q.size for e in first) < CHECKED_VALUES:
        first.append(experiments[len(first)])
    return first
