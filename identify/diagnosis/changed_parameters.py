"""Test of the parameters of a baseline, and the changes of the plant that explain a difference.

Of the same plant, ``d = theta - theta_0`` has the covariance ``S = C + C_0``. A change of the plant (payload, friction,
drive gain) moves d along few directions, ``d = B p``. It must also predict held-out torques better than the baseline.
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

from armident.identify.diagnosis.baseline_comparison import BaselineComparison, Change, conservative_fit, with_baseline
from armident.identify.diagnosis.candidates import ColumnCache
from armident.identify.diagnosis.changes import changes, p_value_of_change, ranked
from armident.identify.diagnosis.precision import variance_of_sum
from armident.identify.diagnosis.regression import IvFit, relative_fit_errors
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.regression.multiple_testing import holm

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NumbersFinding:
    """Change of the plant that explains why parameters differ from a baseline.

    ``effect``: ``changed_parameters`` if no entry of the catalogue explains it. ``parameters``, ``std``: changes
    estimable one by one; includes the uncertainty of the baseline. ``p_value``: corrected for the number of candidates.
    ``gap_before``, ``gap_after``: relative torque error on held-out data, percent, without and with this finding: of
    the joint, or of all for the whole arm. ``confidence``: share of the posterior odds times the probability of any
    change. ``ambiguous_with``: effects at odds below 20 to 1.
    """

    effect: str
    joint: str
    other: str | None
    parameters: dict[str, float]
    std: dict[str, float]
    p_value: float
    gap_before: float
    gap_after: float
    confidence: float
    ambiguous_with: tuple[str, ...]
    alternatives: tuple[tuple[str, str, float], ...]
    words: str


def stale_numbers(
    fit: IvFit, column_cache: ColumnCache, baseline: IdentificationDocument, alpha: float = 0.01
) -> list[NumbersFinding]:
    """Changes of the plant since a baseline of the same robot was identified, at the false-alarm rate ``alpha``."""
    comparison = with_baseline(conservative_fit(fit), baseline)
    if not _stale(comparison, alpha):
        return []
    pool = list(changes(comparison, column_cache))
    found: list[Change] = []
    barred: list[Change] = []
    while True:
        others = ranked(comparison, found, [c for c in pool if c not in found and c not in barred])
        passing = [other.change for other in others if other.p_value * len(pool) <= alpha]
        if not passing:
            break
        best = passing[0]
        if _closes(comparison, found, [*found, best], alpha):
            found.append(best)
            found = [
                c
                for c in found
                if p_value_of_change(comparison, [o for o in found if o is not c], c) * len(pool) <= alpha
            ]
            if best not in found:
                barred.append(best)
        else:
            barred.append(best)
    findings = []
    for k, change in enumerate(found):
        findings.append(_described(comparison, found[:k], change, found, pool))
    return [*findings, *_rest(comparison, found, alpha)]


def _stale(comparison: BaselineComparison, alpha: float) -> bool:
    """True if all parameters together, or any of them by itself, differ; half the false alarms for either test."""
    _, _, _, rest, free = comparison.solved([])
    together = float(stats.chi2.sf(rest, free))
    return together < alpha / 2 or bool(_changed_names(comparison, [], alpha / 2))


def _changed_names(
    comparison: BaselineComparison, changes: Sequence[Change], alpha: float
) -> list[tuple[int, float, float]]:
    """Known parameters that differ beyond the changes: number, difference and standard deviation, by Holm's method."""
    stack = np.column_stack([comparison.absorbed, *(c.directions for c in changes)])
    rest = comparison.difference - stack @ comparison.solved(changes)[0]
    std = np.sqrt(np.diag(comparison.covariance))
    p = 2 * stats.norm.sf(np.abs(rest) / std)
    adjusted = holm(p)
    return [(int(k), float(rest[k]), float(std[k])) for k in np.argsort(p) if adjusted[k] <= alpha]


def _closes(comparison: BaselineComparison, before: Sequence[Change], after: Sequence[Change], alpha: float) -> bool:
    """True if held-out torques follow the change."""
    return _held_out(comparison, comparison.predicted(before), comparison.predicted(after)) > stats.norm.isf(alpha)


def _held_out(comparison: BaselineComparison, before: Array, after: Array) -> float:
    """Projection of the held-out residual on the change of prediction, in standard deviations.

    Its variance comes from the noise, its serial correlation (Newey-West), and the baseline.
    """
    x, z, y = comparison.fit.held
    change = z @ (after - before)
    size = float(change @ change)
    if size == 0.0:
        return 0.0
    residual = y - x @ before
    inflation = max(1.0, variance_of_sum(change * (residual - change)) / size)
    through = change @ x[:, comparison.known]
    spread = float(through @ comparison.covariance0 @ through)
    return float(change @ residual) / float(np.sqrt(size * inflation + spread))


def _described(
    comparison: BaselineComparison,
    before: Sequence[Change],
    change: Change,
    found: Sequence[Change],
    pool: Sequence[Change],
) -> NumbersFinding:
    """A change with its values in the model of all changes, the gaps of the order in which they were found."""
    fit, criteria = comparison.fit, comparison.fit.study.criteria
    others = [c for c in found if c is not change]
    values, covariance, own, _, _ = comparison.solved([*others, change])
    m = change.directions.shape[1]
    names = [p.name for p in change.effect.linear]
    known_values = {n: float(v) for n, v, o in zip(names, values[-m:], own[-m:], strict=True) if o}
    std = {n: float(np.sqrt(v)) for n, v, o in zip(names, np.diag(covariance)[-m:], own[-m:], strict=True) if o}
    gap_before = _gap(fit, comparison.predicted(before), change)
    gap_after = _gap(fit, comparison.predicted([*before, change]), change)
    p = min(1.0, p_value_of_change(comparison, others, change) * len(pool))
    every = ranked(comparison, others, [change, *(c for c in pool if c not in found)])
    own_score = next((s.score for s in every if s.change is change), -np.inf)
    rivals = [s for s in every if s.change is not change]
    share = float(np.exp(own_score - special.logsumexp([s.score for s in every]))) if every else 0.0
    joint = _joint(fit, change)
    return NumbersFinding(
        effect=change.effect.name,
        joint=joint,
        other=None,
        parameters=known_values,
        std=std,
        p_value=p,
        gap_before=gap_before,
        gap_after=gap_after,
        confidence=share * (1.0 - p),
        ambiguous_with=tuple(s.change.effect.name for s in rivals if s.score > own_score - criteria.close),
        alternatives=tuple(
            (s.change.effect.name, _joint(fit, s.change), s.score) for s in rivals[: criteria.alternatives]
        ),
        words=change.effect.change_in_words(joint, known_values, std),
    )


def _joint(fit: IvFit, change: Change) -> str:
    """Name of the joint; a payload belongs to the last one, as in the configuration."""
    joints = fit.study.joints
    return joints[-1] if change.effect.name == "payload" else joints[change.place.joint]


def _gap(fit: IvFit, theta: Array, change: Change) -> float:
    """Relative torque error on held-out data, percent, of the joint or of all."""
    overall, each = relative_fit_errors(fit, theta, held=True)
    return overall if change.effect.scope == "arm" else float(each[change.place.joint])


def _rest(comparison: BaselineComparison, found: Sequence[Change], alpha: float) -> list[NumbersFinding]:
    """Finding of the changed parameters that no candidate explains, if there are any."""
    fit = comparison.fit
    _, _, _, left, free = comparison.solved(found)
    p = float(stats.chi2.sf(left, free))
    changed = _changed_names(comparison, found, alpha)
    # All parameters together may differ without a significant single one; that is no finding.
    if not changed:
        return []
    before = comparison.predicted(found)
    if _held_out(comparison, before, fit.theta) <= stats.norm.isf(alpha):
        return []
    model = fit.study.model
    names = [model.base.names[comparison.known[k]] for k, _, _ in changed]
    numbers = Counter(m.group(1) for name in names if (m := re.search(r"(\d)r?(?:_\d+)?$", name)))
    joint = model.robot.joints[min(int(numbers.most_common(1)[0][0]), model.n) - 1 if numbers else 0].name
    each = "; ".join(
        f"{name} was {comparison.theta0[k]:.4g}, differs by {rest:+.3g} (standard deviation {std:.2g})"
        for name, (k, rest, std) in zip(names, changed, strict=True)
    )
    return [
        NumbersFinding(
            effect="changed_parameters",
            joint=joint,
            other=None,
            parameters={name: rest for name, (_, rest, _) in zip(names, changed, strict=True)},
            std={name: std for name, (_, _, std) in zip(names, changed, strict=True)},
            p_value=p,
            gap_before=relative_fit_errors(fit, before, held=True)[0],
            gap_after=relative_fit_errors(fit, held=True)[0],
            confidence=1.0 - p,
            ambiguous_with=(),
            alternatives=(),
            words=f"parameters differ from the baseline, and no effect of the catalogue explains it: {each}",
        )
    ]
