"""The documents ``prediction.json`` and ``comparison.json``: a model on a recording, and beside another model."""

from collections.abc import Sequence
from typing import Literal

from pydantic import Field

from armident.identify.document import Document, RecordingReference

ALL_PCT = 100.0
"""Torque error of no model at all, percent."""

LEVEL_95 = 1.959964
"""Half width of a 95 % interval of a normal distribution, standard deviations."""


class PredictionDocument(Document):
    """Content of ``prediction.json``: error of an identified model on a recording.

    Torques are low-passed as in the identification, at twice the closed-loop bandwidth.

    Parameters
    ----------
    schema_
        Key ``schema``: version of the document.
    robot
        Name of the robot.
    model
        File of the model.
    method
        Method of its identification.
    recording
        Recording whose torques are predicted.
    held_out
        False if the model was identified from this recording.
    relative_error_pct, relative_error_pct_by_joint
        ``||y - X theta|| / ||y||``, percent, in total and by joint.
    identification_error_pct, identification_error_pct_by_joint
        The same of the model on its own data.
    error_rms, torque_rms
        Root mean square of the error and of the measured torque by joint, each in its unit.
    units
        Unit of the torque by joint: N m or N.
    samples
        Number of instants after the decimation.
    rate_hz
        Rate of these instants, Hz.
    warnings
        Remarks: motion beyond that of the identification, mistakes of the set-up.
    versions
        Versions of Python and libraries.
    """

    schema_: Literal["armident/prediction/1"] = Field("armident/prediction/1", alias="schema")
    robot: str
    model: str
    method: str
    recording: RecordingReference
    held_out: bool
    relative_error_pct: float
    relative_error_pct_by_joint: dict[str, float]
    identification_error_pct: float
    identification_error_pct_by_joint: dict[str, float]
    error_rms: dict[str, float]
    torque_rms: dict[str, float]
    units: dict[str, str]
    samples: int
    rate_hz: float
    warnings: list[str]
    versions: dict[str, str]

    @property
    def worthless(self) -> bool:
        """True if the model explains the torques no better than none."""
        return not self.relative_error_pct < ALL_PCT

    @property
    def sentence(self) -> str:
        """Result in words: the data it holds for, and the error in total."""
        data = "held-out data: the model was not identified from this recording"
        if not self.held_out:
            data = "not held out: the model was identified from this recording, so the error is too favourable"
        worse = ". The model explains these torques no better than none" if self.worthless else ""
        own = f"on its own data {self.identification_error_pct:.2f} %"
        return f"Torque error {self.relative_error_pct:.2f} % ({data}); {own}{worse}."


class PredictionsDocument(Document):
    """Content of ``predictions.json``: errors of an identified model on several recordings.

    Parameters
    ----------
    schema_
        Key ``schema``: version of the document.
    robot
        Name of the robot.
    model
        File of the model.
    worst_recording
        Recording with the largest torque error.
    worst_error_pct
        Its torque error, percent.
    predictions
        Prediction of each recording, in the given order.
    """

    schema_: Literal["armident/predictions/1"] = Field("armident/predictions/1", alias="schema")
    robot: str
    model: str
    worst_recording: str | None
    worst_error_pct: float
    predictions: list[PredictionDocument]

    @property
    def worthless(self) -> bool:
        """True if the model explains the torques of a recording no better than none."""
        return any(each.worthless for each in self.predictions)


def predictions_document(predictions: Sequence[PredictionDocument]) -> PredictionsDocument:
    """Return the document of several predictions by one model.

    Parameters
    ----------
    predictions
        Predictions, at least one.
    """
    worst = max(predictions, key=lambda each: each.relative_error_pct)
    return PredictionsDocument(
        robot=worst.robot,
        model=worst.model,
        worst_recording=worst.recording.path,
        worst_error_pct=worst.relative_error_pct,
        predictions=list(predictions),
    )


class SimulationDocument(Document):
    """Output of ``armident simulate --json``: the file that was written and what it was simulated from.

    Parameters
    ----------
    schema_
        Key ``schema``: version of the document.
    robot
        Name of the robot.
    physics
        ``virtual`` (Pinocchio) or ``identified`` (equations of the identification).
    trajectory, model, scenario
        Files of the reference, of the model and of the hidden effects; null without.
    seed, noise
        Seed, and factor on the noise, of the virtual arm; null for an identified model, which has no noise.
    recording
        File that was written, hash of the samples, sampling rate and number of samples.
    duration_s
        Time from the first to the last sample, s.
    """

    schema_: Literal["armident/simulation/1"] = Field("armident/simulation/1", alias="schema")
    robot: str
    physics: Literal["virtual", "identified"]
    trajectory: str
    model: str | None
    scenario: str | None
    seed: int | None
    noise: float | None
    recording: RecordingReference
    duration_s: float


class ComparedModel(Document):
    """One of the two identifications.

    Parameters
    ----------
    path
        File of the identification.
    method
        Method of the identification.
    recording
        Recording that it was identified from.
    relative_error_pct
        Relative torque error on its own data, percent.
    """

    path: str
    method: str
    recording: RecordingReference
    relative_error_pct: float


class ComparedParameter(Document):
    """One parameter in both identifications, SI.

    Parameters
    ----------
    name
        Name of the parameter.
    joint
        Joint or coupling that it belongs to.
    unit
        Unit of the values and standard deviations.
    before, now
        Earlier and later value.
    before_std, now_std
        Their standard deviations.
    std_of_difference
        Standard deviation of ``now - before``.
    p_value
        Probability of such a difference without a change, corrected for all parameters and groups (Holm).
    changed
        True if the difference is significant.
    essential
        True if the parameter is essential in one of them.
    """

    name: str
    joint: str
    unit: str
    before: float
    before_std: float
    now: float
    now_std: float
    std_of_difference: float
    p_value: float
    changed: bool
    essential: bool


class ComparisonDocument(Document):
    """Content of ``comparison.json``: the change test of two identifications of one robot.

    Parameters
    ----------
    schema_
        Key ``schema``: version of the document.
    robot
        Name of the robot.
    verdict
        Result of all tests together.
    baseline, now
        The earlier and the later identification.
    parameters
        Parameters that both have, joint by joint.
    changed_groups
        Friction or masses of a joint that changed together.
    changed_residuals
        Changes of the residuals, in words.
    chi_square, degrees, p_value
        Test of all parameters together: statistic, degrees of freedom, and probability without a change.
    false_alarm_rate
        Probability of the verdict ``changed`` without a change.
    left_out
        Parameters that only one of them has, or that are other combinations; they are not compared.
    warnings
        Limits of the comparison.
    """

    schema_: Literal["armident/comparison/1"] = Field("armident/comparison/1", alias="schema")
    robot: str
    verdict: Literal["changed", "unchanged"]
    baseline: ComparedModel
    now: ComparedModel
    parameters: list[ComparedParameter]
    changed_groups: list[str]
    changed_residuals: list[str]
    chi_square: float
    degrees: int
    p_value: float
    false_alarm_rate: float
    left_out: list[str]
    warnings: list[str]

    @property
    def by_joint(self) -> dict[str, list[ComparedParameter]]:
        """Parameters by joint or coupling, in the order of the document."""
        found: dict[str, list[ComparedParameter]] = {}
        for each in self.parameters:
            found.setdefault(each.joint, []).append(each)
        return found

    @property
    def sentence(self) -> str:
        """Verdict in one sentence."""
        test = f"chi-square {self.chi_square:.1f} of {self.degrees} degrees of freedom, p = {self.p_value:.2g}"
        names = [each.name for each in self.parameters if each.changed]
        parts = [*names, *self.changed_groups, *self.changed_residuals] or ["no single parameter significantly"]
        if self.verdict == "changed":
            return f"{self.robot} has changed: {', '.join(parts)} ({test})"
        return f"{self.robot} has not changed significantly ({test})"
