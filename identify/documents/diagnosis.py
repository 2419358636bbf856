"""The document ``diagnosis.json``."""

from typing import Any, Literal

from pydantic import Field

from armident.identify.documents.base import Document, RecordingReference, SignedDocument

Verdict = Literal["no_gap", "explained", "partly_explained", "unexplained"]

VERDICTS: dict[Verdict, str] = {
    "no_gap": "The model explains the data; these recordings show no missing effect.",
    "explained": "The findings explain the gap; the residual left is compatible with noise or with the baseline.",
    "partly_explained": "The findings explain a part of the gap.",
    "unexplained": "The model lacks something that no effect of the catalogue explains.",
}
"""Meaning of each verdict."""


def _percent(probability: float) -> str:
    """Probability in percent, in words where it is nearly 0 or 1."""
    if probability > 0.999:
        return "> 99.9 %"
    return f"{100 * probability:.1f} %" if probability > 0.001 else "< 0.1 %"


class Alternative(Document):
    """Another effect in place of a finding.

    Parameters
    ----------
    effect
        Name of the effect.
    joint
        Name of its joint.
    score
        Its log-likelihood, of a ``structure`` less that of the finding; a difference of 3 is a factor of twenty.
    """

    effect: str
    joint: str
    score: float


class Finding(Document):
    """One effect that the model lacks; gaps are relative torque errors in percent on held-out data.

    Parameters
    ----------
    effect
        Name of the effect; ``unnamed``: a regular torque without a known cause; ``changed_parameters``: parameters
        that differ from the baseline without a known effect.
    law
        Formula of the effect: empty for the first one of the catalogue, ``table`` for a free shape. For ``unnamed`` the
        variable that the torque depends on.
    joint
        Joint at which it acts.
    other
        Second joint of an effect between two joints.
    kind
        ``structure``: the model lacks a term; ``numbers``: parameters differ from those of the baseline.
    parameters
        Estimated parameters, SI.
    confidence
        Probability that the finding is right, 0 to 1: calibrated on simulated arms; of a term without a name, that
        something is missing at all. Of a change against a baseline, its share of the posterior odds, times the share
        of the difference that is explained.
    alternatives
        Other effects in place of the finding, the best first.
    gap_before
        Torque error of the joint without the finding, percent.
    gap_after
        Torque error of the joint with it, percent.
    evidence
        Further figures: standard deviations, share of the error power, p-value of the confirmation.
    """

    effect: str
    law: str = ""
    joint: str
    other: str | None = None
    kind: Literal["structure", "numbers"]
    parameters: dict[str, float]
    confidence: float
    alternatives: list[Alternative]
    gap_before: float
    gap_after: float
    evidence: dict[str, Any]

    @property
    def probability(self) -> str:
        """Confidence in percent, in words where it is nearly 0 or 1."""
        return _percent(self.confidence)


class Explanation(Document):
    """Possible causes at a joint, in the place of one finding where there is one.

    Parameters
    ----------
    joint
        Name of the joint.
    names
        Calibrated probability of each explanation: names of effects; ``unnamed``: something that has no name here;
        ``nothing``. Their sum is 1.
    likely
        Smallest set of these that holds the truth in nine cases of ten, the most probable one first.
    """

    joint: str
    names: dict[str, float]
    likely: list[str]

    @property
    def doubtful(self) -> bool:
        """True if the set has several members, or one without a name."""
        return self.likely != ["nothing"] and (len(self.likely) > 1 or "unnamed" in self.likely)

    @property
    def sentence(self) -> str:
        """Members of the set with their probabilities, in words."""
        return ", ".join(f"{name.replace('_', ' ')} {_percent(self.names[name])}" for name in self.likely)


class Unexplained(Document):
    """Part of a joint's residual that no effect of the catalogue explains.

    Parameters
    ----------
    joint
        Name of the joint.
    share_of_residual
        Share of the power of the joint's residual that the dependence predicts on held-out data, 0 to 1.
    varies_with
        Variable that it depends on.
    hint
        Probable causes.
    """

    joint: str
    share_of_residual: float
    varies_with: str
    hint: str

    @property
    def sentence(self) -> str:
        """The part in words, with its probable causes."""
        share = 100 * self.share_of_residual
        return f"{self.joint}: {self.varies_with}, {share:.0f} % of the residual. {self.hint}"


class Negligible(Document):
    """Effect or dependence that is significant and smaller than what counts as a cause; it is not in the model.

    Parameters
    ----------
    effect
        Name of the effect; ``unnamed`` for a dependence of the residual.
    joint
        Name of the joint.
    varies_with
        Variable of a dependence.
    change_of_torque_pct
        Torque of an effect, or fall of the error without a dependence, in percent of the torque of the joint.
    share_of_residual
        Share of the power of the joint's residual that it removes, 0 to 1.
    """

    effect: str
    joint: str
    varies_with: str | None = None
    change_of_torque_pct: float
    share_of_residual: float


class NotVisible(Document):
    """Effect that these recordings cannot show at a joint at any size.

    Parameters
    ----------
    effect
        Name of the effect.
    joint
        Name of the joint.
    reason
        Reason for which it is invisible.
    required_motion
        Motion that would show it.
    """

    effect: str
    joint: str
    reason: str
    required_motion: str


class DetectionLimit(Document):
    """Smallest size at which an effect at a joint would be detected with a probability of 0.9.

    Parameters
    ----------
    effect
        Name of the effect.
    joint
        Name of the joint.
    other
        Second joint of an effect between two joints.
    limits
        Size of each linear parameter with the others at zero.
    units
        Unit of each.
    """

    effect: str
    joint: str
    other: str | None = None
    limits: dict[str, float]
    units: dict[str, str]


class Gap(Document):
    """Relative torque error.

    Parameters
    ----------
    all
        Of all joints together, percent.
    by_joint
        Of each joint, percent.
    rms
        Root mean square of the torque error of each joint, N m or N.
    """

    all: float
    by_joint: dict[str, float]
    rms: dict[str, float] = Field(default_factory=dict)


class BeforeAfter(Document):
    """Gap of two models.

    Parameters
    ----------
    before
        Gap of the model as configured.
    after
        Gap of the model with the findings added.
    """

    before: Gap
    after: Gap


class Gaps(Document):
    """Gap on both parts of the data.

    Parameters
    ----------
    train
        Gap on the training data.
    validation
        Gap on the held-out data.
    """

    train: BeforeAfter
    validation: BeforeAfter


class DiagnosisDocument(SignedDocument):
    """``diagnosis.json``: effects that the model lacks, their share of the torque error, and the unexplained rest.

    Parameters
    ----------
    recordings
        Recordings that were diagnosed.
    verdict
        Summary of findings and unexplained parts.
    findings
        Effects that the model lacks, those with a name first.
    explanations
        For every joint, and every finding of it, what may be missing there, with probabilities and a 90 % set.
    unexplained
        Parts of a joint's residual that depend on a variable, without a known effect.
    gap
        Relative torque errors before and after the findings, percent.
    noise_floor
        Torque error that noise alone leaves: the remaining error less its unexplained part.
    recommended_experiment
        Recording that separates a finding from its alternatives, with the command that designs its trajectory.
    model
        Robot configuration with the findings; null if there are none or it was not written.
    timing_s
        Time of each step, s.
    warnings
        Messages of conversion and diagnosis.
    not_visible
        Effects that these recordings cannot show at a joint, with the reason and the required motion.
    detection_limits
        Sizes from which nine diagnoses of ten would find an effect in such recordings. A smaller effect may be present
        without a finding.
    simulated
        Errors of the simulated closed loop, arm and controller along the reference trajectory, with both models,
        percent of the measured motion and torques.
    negligible
        Effects and dependences that are significant and change the torque by less than ``--material``, or the error by
        less than 2 %. They are no cause, and not in the model.
    sign_smoothing
        ``g`` of each joint's ``sign(qd) -> (2/pi) atan(g qd)``, s/rad or s/m.
    transitions
        Velocity over which the dry friction of a joint reverses, rad/s or m/s, where the data show it.
    criteria
        All thresholds.
    alpha
        Division of the false-alarm rate among the tests.
    """

    schema_: Literal["armident/diagnosis/2"] = Field("armident/diagnosis/2", alias="schema")
    robot: str
    recordings: list[RecordingReference]
    verdict: Verdict
    findings: list[Finding]
    unexplained: list[Unexplained]
    gap: Gaps
    noise_floor: Gap
    recommended_experiment: str | None
    model: str | None
    timing_s: dict[str, float]
    versions: dict[str, str]
    warnings: list[str]
    not_visible: list[NotVisible] = Field(default_factory=list)
    detection_limits: list[DetectionLimit] = Field(default_factory=list)
    simulated: dict[str, dict[str, float]] | None = None
    negligible: list[Negligible] = Field(default_factory=list)
    sign_smoothing: dict[str, float] | None = None
    transitions: dict[str, float] | None = None
    criteria: dict[str, float] | None = None
    alpha: dict[str, float] | None = None
    explanations: list[Explanation] = Field(default_factory=list)
