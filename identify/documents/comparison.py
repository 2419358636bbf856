"""The document ``comparison.json``: two identifications of one robot."""

from typing import Literal

from pydantic import Field

from armident.identify.documents.base import Document, RecordingReference, SignedDocument
from armident.identify.documents.rounding import chance

LEVEL_95 = 1.959964
"""Half width of a 95 % interval of a normal distribution, standard deviations."""


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


class NamedChange(Document):
    """Change of the plant that explains the difference.

    Parameters
    ----------
    effect
        Name of the effect in the catalogue.
    joints
        Its joint, or the two joints of a coupling.
    words
        The change in one sentence.
    parameters
        Its parameters that the motion determines one by one, SI.
    std
        Their standard deviations.
    probability
        Posterior probability among all changes in its place, 0 to 1.
    not_excluded
        Other changes in its place within odds of 20 to 1, the best first.
    """

    effect: str
    joints: list[str]
    words: str
    parameters: dict[str, float]
    std: dict[str, float]
    probability: float
    not_excluded: list[str]


class ComparisonDocument(SignedDocument):
    """Content of ``comparison.json``: the change test of two identifications of one robot.

    Parameters
    ----------
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
    changes
        Changes of the plant that explain the differences.
    unexplained
        Changes of parameters and residuals beyond these, in words.
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
    changes: list[NamedChange] = Field(default_factory=list)
    unexplained: list[str] = Field(default_factory=list)

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
        test = f"chi-square {self.chi_square:.1f} of {self.degrees} degrees of freedom, {chance(self.p_value)}"
        names = [each.name for each in self.parameters if each.changed]
        parts = [*names, *self.changed_groups, *self.changed_residuals] or ["no single parameter significantly"]
        if self.changes:
            return f"{self.robot} has changed: {'; '.join(change.words for change in self.changes)} ({test})"
        if self.verdict == "changed":
            return f"{self.robot} has changed: {', '.join(parts)} ({test})"
        return f"{self.robot} has not changed significantly ({test})"
