"""The document ``check.json``: the set-up of recordings against the configuration."""

from typing import Any, Literal

from pydantic import Field

from armident.identify.documents.base import Document, RecordingReference, SignedDocument


class SetupMistake(Document):
    """One mistake of the set-up.

    Parameters
    ----------
    kind
        Kind of the mistake, for example ``torque_sign``.
    joints
        Joints concerned.
    probability
        Probability that the finding is right, 0 to 1, calibrated on recordings with a known set-up.
    message
        Mistake in one sentence with figures.
    remedy
        Line of the configuration, or option of a command, that corrects it; the next step where it is no correction.
    decisive
        True if results without the correction are unusable.
    correction
        True if the remedy is certain enough to be copied; false for the best of what was tried.
    """

    kind: str
    joints: list[str]
    probability: float
    message: str
    remedy: str
    decisive: bool
    correction: bool = True


class SetupDocument(SignedDocument):
    """Content of ``check.json``, which ``armident check --json`` prints.

    Parameters
    ----------
    recordings
        Recordings that were checked.
    passed
        True if results would be usable: no decisive mistake, and no joint that the model does not explain.
    findings
        Mistakes of the set-up; empty if it is right.
    relative_error_pct_by_joint
        Norm of the torque residual of the rigid model over that of the torque, percent; null where there is no torque.
    corrected_error_pct_by_joint
        The same with the corrections, percent.
    unexplained_joints
        Joints of which the rigid model leaves more than a third of the torque, and no hypothesis explains it.
    tried
        Hypotheses tried, in words.
    corrected_configuration
        Robot configuration with the corrections that it can express; null without any.
    clock
        True over recorded duration: the sampling period has to be multiplied by it.
    torque_shift
        Estimated common shift of the torques, samples, with its standard deviation and those of the joints; null if it
        was not estimated.
    repairs
        Faults of the signals: wraps, impossible rows, drives that were off, positions outside limits; or empty.
    """

    schema_: Literal["armident/check/1"] = Field("armident/check/1", alias="schema")
    robot: str
    recordings: list[RecordingReference]
    passed: bool
    findings: list[SetupMistake]
    relative_error_pct_by_joint: dict[str, float | None]
    corrected_error_pct_by_joint: dict[str, float | None]
    unexplained_joints: list[str]
    tried: list[str]
    corrected_configuration: dict[str, Any] | None
    clock: float
    torque_shift: dict[str, Any] | None
    repairs: list[str] = Field(default_factory=list)
    versions: dict[str, str]
