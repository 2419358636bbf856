"""Changes of a plant in the catalogue, ranked by how well they explain the difference from a baseline."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from armident.identify.diagnosis.baseline_comparison import BaselineComparison, Change
from armident.identify.diagnosis.candidates import ColumnCache
from armident.identify.effects.parameter_change import ParameterChange
from armident.identify.effects.registry import catalogue
from armident.identify.regression.whitening import whitened


@dataclass(frozen=True, eq=False)
class RankedChange:
    """Score of a change: gain in log-likelihood, less its parameters (Akaike), plus the logarithm of its prior odds."""

    change: Change
    p_value: float
    score: float


def changes(comparison: BaselineComparison, column_cache: ColumnCache) -> Iterator[Change]:
    """All effects that change parameters of the model, at all their places."""
    fit = comparison.fit
    motion = column_cache.motion(fit.study.train[0], "measured")
    rigid = fit.theta.size - fit.study.model.e
    for effect in catalogue().values():
        if not isinstance(effect, ParameterChange) and not effect.change_title:
            continue
        for place in effect.places(fit.study.robot.n):
            if isinstance(effect, ParameterChange):
                exact = effect.change(motion, place)
                directions = np.zeros((fit.theta.size, exact.shape[1]))
                directions[:rigid] = exact[:rigid]
            else:
                columns = column_cache.band(effect, place, (), "train", "measured")
                directions = fit.regression.absorbed(whitened(columns, fit.noise))
            directions = directions[comparison.known]
            if directions.any():
                yield Change(effect, place, directions)


def p_value_of_change(comparison: BaselineComparison, others: Sequence[Change], change: Change) -> float:
    """Probability that a change without merit, added to others, reduces the chi-square as much."""
    _, _, _, before, free_before = comparison.solved(others)
    _, _, _, after, free_after = comparison.solved([*others, change])
    if free_before == free_after:
        return 1.0
    return float(stats.chi2.sf(before - after, free_before - free_after))


def ranked(comparison: BaselineComparison, found: Sequence[Change], pool: Sequence[Change]) -> list[RankedChange]:
    """Candidates by score, the best first. ``comparison``: fit and baseline; ``found``: changes already present."""
    _, _, _, before, free_before = comparison.solved(found)
    prior = comparison.fit.study.criteria.close
    found_changes = []
    for change in pool:
        _, _, _, after, free_after = comparison.solved([*found, change])
        if free_before > free_after:
            gain, size = before - after, free_before - free_after
            score = 0.5 * gain - size + (prior if isinstance(change.effect, ParameterChange) else 0.0)
            found_changes.append(RankedChange(change, float(stats.chi2.sf(gain, size)), score))
    return sorted(found_changes, key=lambda one: -one.score)
