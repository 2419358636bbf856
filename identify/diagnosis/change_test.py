"""Test of change between two identifications of an arm: chi-square of parameters, residuals, and what explains them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.special import chdtrc, ndtr

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.identify.diagnosis.baseline_comparison import Difference, difference_of
from armident.identify.diagnosis.changed_parameters import Attribution, Competition, ExplainedChange
from armident.identify.diagnosis.changes import changes
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.residual_test import (
    ResidualChange,
    ResidualTest,
    compare_residuals,
    residual_difference,
    same_motion,
)
from armident.identify.documents.identification import IdentificationDocument, Parameter
from armident.identify.regression.multiple_testing import holm

FALSE_ALARMS = Criteria.change_rate
"""Probability of a false alarm per comparison."""

FRICTION = ("fv", "fc", "off")
"""Kinds of friction parameters of a joint or of a coupling; the others belong to its masses."""

_NAME = re.compile(r"([a-z]+?)(m?\d+)r?(?:_\d+)?$")


@dataclass(frozen=True)
class Group:
    """Parameters of one joint or coupling (``place``), tested together because their estimates are correlated.

    ``chi_square`` is of their differences with all other parameters free; ``p_value`` as in `ParameterChangeTest`.
    """

    kind: Literal["friction", "masses"]
    place: str
    members: tuple[str, ...]
    chi_square: float
    degrees: int
    p_value: float


@dataclass(frozen=True)
class ParameterChangeTest:
    """Differences (k,) of the parameters of two identifications, later less ``before``.

    ``p_values`` are without a change, corrected for all parameters and groups (Holm 1979). ``chi_square`` is ``d' C^-1
    d`` with the covariance C of the difference. ``false_alarms`` is the rate of all tests, `share` that of each.
    ``groups``: friction and masses of each joint, as correlated parameters may change significantly together only.
    ``p_changes``: of the best change of the catalogue, corrected for their number. ``explanation``: changes of the
    plant that explain the difference; ``left``: residuals beyond these changes.
    """

    parameters: tuple[Parameter, ...]
    before: Array
    difference: Array
    std: Array
    p_values: Array
    chi_square: float
    degrees: int
    p_joint: float
    false_alarms: float
    groups: tuple[Group, ...] = ()
    residuals: ResidualTest = field(default_factory=ResidualTest)
    p_changes: float | None = None
    explanation: Attribution | None = None
    left: ResidualTest = field(default_factory=ResidualTest)

    @property
    def share(self) -> float:
        """False-alarm rate of each test: all parameters together; single ones and groups; then those that were made.

        They are the residuals and the changes of the catalogue.
        """
        return self.false_alarms / (2 + bool(self.residuals.tests) + (self.p_changes is not None))

    @property
    def changed_residuals(self) -> tuple[ResidualChange, ...]:
        """Significant changes of the residuals, the most significant first."""
        return self.residuals.changed(self.share)

    @property
    def changed(self) -> tuple[str, ...]:
        """Names of the parameters with a significant change, the most significant first."""
        order = np.argsort(self.p_values, kind="stable")
        return tuple(self.parameters[k].name for k in order if self.p_values[k] < self.share)

    @property
    def changed_groups(self) -> tuple[Group, ...]:
        """Groups with a significant change, the most significant first."""
        clear = [group for group in self.groups if group.p_value < self.share]
        return tuple(sorted(clear, key=lambda group: group.p_value))

    @property
    def parameters_changed(self) -> bool:
        """True if a parameter, a group, all together, or along a change of the catalogue changed significantly."""
        known = self.p_changes is not None and self.p_changes < self.share
        return bool(self.changed or self.changed_groups) or self.p_joint < self.share or known

    @property
    def drifted(self) -> bool:
        """True if parameters or residuals changed significantly."""
        return self.parameters_changed or bool(self.changed_residuals)

    @property
    def explained(self) -> tuple[ExplainedChange, ...]:
        """Changes of the plant that explain the changed parameters."""
        return () if self.explanation is None else self.explanation.changes

    @property
    def entry(self) -> dict[str, object]:
        """Result as a part of a document."""
        return {
            "drifted": self.drifted,
            "changed": list(self.changed),
            "changed_groups": [f"{group.kind} {group.place}" for group in self.changed_groups],
            "chi_square": self.chi_square,
            "degrees": self.degrees,
            "p_joint": self.p_joint,
            "structure_compared": bool(self.residuals.tests),
            "structure_note": self.residuals.reason or None,
            "explained_by": [change.words for change in self.explained],
            "changed_residuals": [each.words for each in self.changed_residuals],
            "p_residuals": min((each.p_value for each in self.residuals.tests), default=None),
            "alpha": {
                "all": self.false_alarms,
                "parameters_together": self.share,
                "parameters_and_groups": self.share,
                "changes_of_the_catalogue": 0.0 if self.p_changes is None else self.share,
                "residuals": self.share if self.residuals.tests else 0.0,
            },
        }

    @property
    def words(self) -> str:
        """Result in one sentence."""
        if not self.drifted:
            note = f"; {self.residuals.reason}" if self.residuals.reason else ""
            return f"no change (chi-square {self.chi_square:.1f} of {self.degrees} degrees of freedom){note}"
        by_name = {p.name: k for k, p in enumerate(self.parameters)}
        parts = [
            f"{name} {self.before[by_name[name]]:.4g} -> {self.parameters[by_name[name]].value:.4g} "
            f"{self.parameters[by_name[name]].unit}".rstrip()
            for name in self.changed
        ]
        known = set(self.changed)
        for group in self.changed_groups:
            if not known & set(group.members):
                parts.append(f"{group.kind} {group.place} ({', '.join(group.members)} together)")
        parts += [each.words for each in self.explained] + [each.words for each in self.changed_residuals[:1]]
        what = ", ".join(parts) or "no single parameter significantly"
        return f"changed: {what} (chi-square {self.chi_square:.1f} of {self.degrees} degrees of freedom)"


def compare(
    baseline: IdentificationDocument,
    now: IdentificationDocument,
    false_alarms: float = FALSE_ALARMS,
    robot: RobotConfig | None = None,
    criteria: Criteria | None = None,
) -> ParameterChangeTest:
    """Test two identifications of one model for a change, explained for a ``robot``; raises as `difference_of`."""
    criteria = criteria or Criteria()
    difference = difference_of(baseline, now)
    if "doubtful" in (baseline.verdict, now.verdict) and not same_motion(baseline, now):
        difference = difference.widened(criteria.other_motion)
    residuals = compare_residuals(baseline, now)
    pool = [] if robot is None else list(changes(robot, now))
    found = _tested(difference, tuple(now.parameters), false_alarms, residuals)
    if not pool:
        return replace(found, left=residuals)
    competition = Competition.of(difference, residual_difference(baseline, now), pool, criteria)
    found = replace(found, p_changes=competition.p_value())
    if not found.drifted:
        return replace(found, left=residuals)
    explanation = competition.explained(found.share)
    return replace(found, explanation=explanation, left=compare_residuals(baseline, now, explanation.residual_scores))


def _tested(
    difference: Difference, parameters: tuple[Parameter, ...], false_alarms: float, residuals: ResidualTest
) -> ParameterChangeTest:
    """Tests of all parameters together, of groups, and of single ones."""
    names = difference.names
    places = _places(names)
    sums = [difference.chi_square(rows) for rows in places.values()]
    single = 2 * ndtr(-np.abs(difference.values) / difference.std)
    p = holm(np.concatenate([single, [chdtrc(dof, value) for value, dof in sums]]))
    groups = tuple(
        Group(kind, place, tuple(names[k] for k in rows), *found, float(chance))
        for ((kind, place), rows), found, chance in zip(places.items(), sums, p[len(names) :], strict=True)
    )
    chi_square, degrees = difference.chi_square()
    return ParameterChangeTest(
        parameters,
        difference.before,
        difference.values,
        difference.std,
        p[: len(names)],
        chi_square,
        degrees,
        difference.p_value,
        false_alarms,
        groups,
        residuals,
    )


def _places(names: Sequence[str]) -> dict[tuple[Literal["friction", "masses"], str], list[int]]:
    """Return the parameter indices of every group of at least two."""
    found: dict[tuple[Literal["friction", "masses"], str], list[int]] = {}
    for k, name in enumerate(names):
        match = _NAME.match(name)
        if match is not None:
            kind: Literal["friction", "masses"] = "friction" if match[1] in FRICTION else "masses"
            found.setdefault((kind, match[2]), []).append(k)
    return {key: rows for key, rows in found.items() if len(rows) > 1}
