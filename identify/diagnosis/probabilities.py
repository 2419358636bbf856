"""Calibrated probabilities of what is missing at a joint, and sets that hold the truth in nine cases of ten.

Odds of likelihoods are wrong where every model is wrong. A logistic function that rises with each figure of the
evidence turns them into probabilities. ``python -m tests.evaluation.calibrate`` fits it to development arms, and the
level of the sets by conformal prediction (Angelopoulos, Bates 2023, Foundations and Trends in Machine Learning 16(4)).
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from armident.identify.documents.diagnosis import Explanation, Finding, Unexplained
from armident.identify.effects.unnamed import NAME as UNNAMED

NOTHING = "nothing"
"""Outcome that nothing is missing."""

FILE = Path(__file__).with_name("calibration.json")

MOST_EVIDENCE = 100.0
"""Evidence in nats that counts as certain."""

STATES = ("named", "unnamed", "left", "left_beside", "clear")
"""States of a joint after a diagnosis: a name, a term without one, only a dependence of the residual (without or with a
finding at another joint, whose disturbance of the motion it may be), and nothing."""


@dataclass(frozen=True)
class Calibration:
    """Map from evidence to probabilities.

    ``weights``, ``intercept``: of the logistic function of `features`. ``shares``: for each of `STATES`, if the name is
    wrong: probabilities of another name (``rival``), of something without a name, and of nothing. ``temper``: power of
    the odds among other names. ``level``: sum of the probabilities of a set.
    """

    intercept: float
    weights: Mapping[str, float]
    shares: Mapping[str, Mapping[str, float]]
    temper: float
    level: float

    def probability(self, evidence: Mapping[str, float]) -> float:
        """Probability that a name is right."""
        value = self.intercept + sum(weight * evidence[name] for name, weight in self.weights.items())
        return float(1.0 / (1.0 + np.exp(-value)))

    def likely(self, names: Mapping[str, float]) -> list[str]:
        """Return the smallest set of outcomes whose probabilities have the sum `level`, the most probable one first."""
        found: list[str] = []
        total = 0.0
        for name in sorted(names, key=lambda one: -names[one]):
            if total >= self.level:
                break
            found.append(name)
            total += names[name]
        return found


@cache
def calibration(*, several: bool = False) -> Calibration:
    """Calibration of this version, for one recording or ``several``: those of other motions are worth more."""
    content = json.loads(FILE.read_text(encoding="utf-8"))["several" if several else "one"]
    return Calibration(**{name: content[name] for name in Calibration.__dataclass_fields__})


def features(finding: Finding) -> dict[str, float]:
    """Return the figures of a finding that its probability rises with, each of order 1.

    ``margin``: evidence over the next name. ``confirmed``: significance on the report part. ``fall``: of its error, in
    the recording that shows it most.
    ``explained``: share of the error that is known not to be noise.
    """
    evidence = finding.evidence
    return {
        "margin": float(np.log1p(np.clip(evidence["margin"], 0.0, MOST_EVIDENCE))),
        "confirmed": float(np.log1p(min(-np.log(max(evidence["p_value"], 1e-300)), MOST_EVIDENCE))),
        "fall": evidence["fall"],
        "explained": evidence["share_explained"],
    }


def outcomes(finding: Finding, known: Calibration) -> dict[str, float]:
    """Return the probability of everything that may be missing in place of a finding; their sum is 1."""
    if "odds" not in finding.evidence:
        # Mistakes of the set-up and changes of parameters have posterior probabilities of their own.
        rest = 1.0 - finding.confidence
        rivals = {a.effect: float(np.exp(min(a.score, 0.0))) for a in finding.alternatives}
        scale = min(finding.confidence, rest / max(sum(rivals.values()), 1e-300))
        found = {name: scale * ratio for name, ratio in rivals.items() if name != finding.effect}
        return {finding.effect: finding.confidence, UNNAMED: rest - sum(found.values()), **found}
    named = finding.effect != UNNAMED
    right = known.probability(features(finding)) if named else 0.0
    found = _rest(finding.evidence["odds"], known.shares["named" if named else "unnamed"], known.temper)
    return ({finding.effect: right} if named else {}) | {name: (1.0 - right) * share for name, share in found.items()}


def joint_state(left: bool, beside: bool) -> str:
    """Return the state of a joint without a finding. ``beside``: another joint has one."""
    return "clear" if not left else "left_beside" if beside else "left"


def joint_outcomes(state: str, known: Calibration) -> dict[str, float]:
    """Return the probability of everything that may be missing at a joint without a finding."""
    return _rest({}, known.shares[state], known.temper)


def _rest(odds: Mapping[str, float], shares: Mapping[str, float], temper: float) -> dict[str, float]:
    """Outcomes beside a name: other names by their odds, something without a name, and nothing."""
    weights = {name: max(ratio, 1e-300) ** temper for name, ratio in odds.items()}
    total = sum(weights.values())
    found = {UNNAMED: shares[UNNAMED] + (0.0 if total > 0.0 else shares["rival"]), NOTHING: shares[NOTHING]}
    return found | {name: shares["rival"] * weight / total for name, weight in weights.items()}


def judged(
    findings: Sequence[Finding], left: Sequence[Unexplained], joints: Sequence[str], known: Calibration
) -> tuple[list[Finding], list[Explanation]]:
    """Return the findings, set-up and changes included, with probabilities, and what may be missing at each joint."""
    entries: list[Explanation] = []
    probable = []
    for finding in findings:
        names = outcomes(finding, known)
        entry = Explanation(joint=finding.joint, names=_sorted(names), likely=known.likely(names))
        entries.append(entry)
        if "odds" in finding.evidence:
            rivals = [name for name in entry.likely if name not in (finding.effect, UNNAMED, NOTHING)]
            confidence = names[finding.effect] if finding.effect != UNNAMED else 1.0 - names[NOTHING]
            evidence = {**finding.evidence, "ambiguous_with": rivals}
            finding = finding.model_copy(update={"confidence": confidence, "evidence": evidence})
        probable.append(finding)
    rest = {entry.joint for entry in left}
    for joint in joints:
        if all(entry.joint != joint for entry in entries):
            names = joint_outcomes(joint_state(joint in rest, bool(findings)), known)
            entries.append(Explanation(joint=joint, names=_sorted(names), likely=known.likely(names)))
    return probable, sorted(entries, key=lambda entry: joints.index(entry.joint))


def _sorted(names: Mapping[str, float]) -> dict[str, float]:
    return dict(sorted(names.items(), key=lambda item: -item[1]))
