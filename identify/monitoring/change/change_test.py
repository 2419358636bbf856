"""Test of change between two identifications of an arm: chi-square of parameters, and residuals."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from armident.configs import DataError
from armident.identify.documents.identification import IdentificationDocument, Parameter
from armident.identify.monitoring.change.residual_test import ResidualChange, ResidualTest, compare_residuals
from armident.identify.regression.multiple_testing import holm

Array = NDArray[np.float64]

FALSE_ALARMS = 1e-4
"""Probability of a false alarm per comparison: one in 200 years of weekly runs."""

RANK_TOLERANCE = 1e-9
"""Eigenvalues of the difference's correlation, relative to the largest, that count as rounding errors."""


MUCH_WORSE = 10.0
"""Median ratio of standard deviations of the two identifications above which the test is inconclusive: a change by the
three standard deviations that the better one would show is a third of a standard deviation of the worse one."""


class Inconclusive(DataError):
    """Two identifications cannot confirm or exclude a change."""


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

    @property
    def share(self) -> float:
        """False-alarm rate of each test: all parameters together; single ones and groups; residuals if compared."""
        return self.false_alarms / (3 if self.residuals.tests else 2)

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
    def drifted(self) -> bool:
        """True if a parameter, a group, all parameters together, or the residuals changed significantly."""
        return bool(self.changed or self.changed_groups or self.changed_residuals) or self.p_joint < self.share

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
            "changed_residuals": [each.words for each in self.changed_residuals],
            "p_residuals": min((each.p_value for each in self.residuals.tests), default=None),
            "alpha": {
                "all": self.false_alarms,
                "parameters_together": self.share,
                "parameters_and_groups": self.share,
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
        parts += [each.words for each in self.changed_residuals[:1]]
        what = ", ".join(parts) or "no single parameter significantly"
        return f"changed: {what} (chi-square {self.chi_square:.1f} of {self.degrees} degrees of freedom)"


def compare(
    baseline: IdentificationDocument, now: IdentificationDocument, false_alarms: float = FALSE_ALARMS
) -> ParameterChangeTest:
    """Test two identifications of an arm with the same model for a change of its parameters.

    Runs are independent, so that covariances add. All base parameters are tested. Raises DataError for different robots
    or models; Inconclusive if one is unusable, did not converge, or is far less precise than the other.
    """
    for name, document in (("the baseline", baseline), ("the identification", now)):
        if not document.converged:
            raise Inconclusive(
                f"{now.robot}: {name} did not converge ({document.stop_reason}): whether the arm has changed is unknown"
            )
        if document.verdict == "unusable":
            defect = document.reasons[0].message
            raise Inconclusive(f"{now.robot}: {name} is unusable ({defect}): whether the arm has changed is unknown")
    if baseline.robot != now.robot:
        raise DataError(f"the baseline is of robot {baseline.robot!r}, the identification of {now.robot!r}")
    old = {p.name: k for k, p in enumerate(baseline.parameters)}
    new = {p.name: k for k, p in enumerate(now.parameters)}
    if old.keys() != new.keys():
        odd = ", ".join(sorted(old.keys() ^ new.keys())[:5])
        raise DataError(f"{now.robot}: baseline and identification have different base parameters: {odd}")
    order = [old[p.name] for p in now.parameters]
    before = np.array([baseline.parameters[k].value for k in order])
    difference = np.array([p.value for p in now.parameters]) - before
    if not all(p.std > 0 for p in (*now.parameters, *baseline.parameters)):
        raise DataError(f"{now.robot}: a parameter without a standard deviation cannot be compared")
    worse = float(np.median([p.std for p in now.parameters] / np.array([baseline.parameters[k].std for k in order])))
    if not 1.0 / MUCH_WORSE < worse < MUCH_WORSE:
        raise Inconclusive(
            f"{now.robot}: standard deviations are {worse:.2g} times those of the baseline: "
            "whether the arm has changed is unknown"
        )
    covariance = np.array(now.covariance) + np.array(baseline.covariance)[np.ix_(order, order)]
    std = np.sqrt(np.diag(covariance))
    chi_square, degrees = _chi_square(difference, covariance)
    names = [p.name for p in now.parameters]
    places = _places(names)
    sums = [_chi_square(difference[rows], covariance[np.ix_(rows, rows)]) for rows in places.values()]
    single = 2 * stats.norm.sf(np.abs(difference) / std)
    p = holm(np.concatenate([single, [stats.chi2.sf(value, dof) for value, dof in sums]]))
    groups = tuple(
        Group(kind, place, tuple(names[k] for k in rows), *found, float(chance))
        for ((kind, place), rows), found, chance in zip(places.items(), sums, p[len(names) :], strict=True)
    )
    joint = float(stats.chi2.sf(chi_square, degrees))
    return ParameterChangeTest(
        tuple(now.parameters),
        before,
        difference,
        std,
        p[: len(names)],
        chi_square,
        degrees,
        joint,
        false_alarms,
        groups,
        compare_residuals(baseline, now),
    )


def _chi_square(difference: Array, covariance: Array) -> tuple[float, int]:
    """Return ``d' C^-1 d`` and its degrees of freedom, without eigenvalues of rounding size."""
    std = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    kept = values > RANK_TOLERANCE * values[-1]
    return float(np.sum((vectors[:, kept].T @ (difference / std)) ** 2 / values[kept])), int(kept.sum())


def _places(names: Sequence[str]) -> dict[tuple[Literal["friction", "masses"], str], list[int]]:
    """Return the parameter indices of every group of at least two."""
    found: dict[tuple[Literal["friction", "masses"], str], list[int]] = {}
    for k, name in enumerate(names):
        match = _NAME.match(name)
        if match is not None:
            kind: Literal["friction", "masses"] = "friction" if match[1] in FRICTION else "masses"
            found.setdefault((kind, match[2]), []).append(k)
    return {key: rows for key, rows in found.items() if len(rows) > 1}
