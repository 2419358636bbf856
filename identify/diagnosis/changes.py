"""Changes of a plant that the catalogue knows, and how well each explains what differs from a baseline."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from armident.identify.diagnosis.baseline import Change, Comparison
from armident.identify.diagnosis.candidates import Workshop, places
from armident.identify.diagnosis.trial import CLOSE
from armident.identify.effects.registry import catalogue

STRUCTURAL = {
    "drive_gain_error": "torque constant changed since the baseline",
    "gravity_direction": "gravity direction changed since the baseline",
    "rotor_inertia": "motor inertia changed since the baseline",
}
"""Effects that a model can also lack, which parameters of an arm take over in part: another number against a baseline,
of either sign; and how to say so."""

USUAL = CLOSE
"""Log-odds of what changes in the life of an arm (friction, loads, offsets) to what does so hardly ever (`STRUCTURAL`):
where a joint's torque is nearly all friction, more friction and another torque per ampere cannot be told apart."""


@dataclass(frozen=True, eq=False)
class Standing:
    """How a candidate does beside others.

    Parameters
    ----------
    change
        The candidate.
    p_value
        That it explains so much of the difference without merit.
    score
        Gain in log-likelihood, less the number of its parameters (Akaike), plus the logarithm of its odds beforehand.
    """

    change: Change
    p_value: float
    score: float


def changes(comparison: Comparison, workshop: Workshop) -> Iterator[Change]:
    """All effects that are other numbers, at all their places."""
    fit = comparison.fit
    motion = workshop.motion(fit.study.train[0], "measured")
    rigid = fit.theta.size - fit.study.model.e
    for effect in catalogue().values():
        if effect.numbers is None and effect.name not in STRUCTURAL:
            continue
        for place in places(effect, fit.study.robot.n):
            if effect.numbers is not None:
                exact = effect.numbers(motion, place)
                directions = np.zeros((fit.theta.size, exact.shape[1]))
                directions[:rigid] = exact[:rigid]
            elif effect.name == "gravity_direction" and effect.visible is not None and effect.visible(motion, place):
                continue
            else:
                directions = fit.absorbed(workshop.columns(effect, place, (), fit.noise).x)
            directions = directions[comparison.known]
            if directions.any():
                yield Change(effect, place, directions)


def p_value(comparison: Comparison, others: Sequence[Change], change: Change) -> float:
    """That a change beside others explains so much of the difference without merit."""
    _, _, _, before, free_before = comparison.solved(others)
    _, _, _, after, free_after = comparison.solved([*others, change])
    if free_before == free_after:
        return 1.0
    return float(stats.chi2.sf(before - after, free_before - free_after))


def ranked(comparison: Comparison, found: Sequence[Change], pool: Sequence[Change]) -> list[Standing]:
    """Candidates by score, the best first."""
    _, _, _, before, free_before = comparison.solved(found)
    standings = []
    for change in pool:
        _, _, _, after, free_after = comparison.solved([*found, change])
        if free_before > free_after:
            gain, size = before - after, free_before - free_after
            score = 0.5 * gain - size + (0.0 if change.effect.name in STRUCTURAL else USUAL)
            standings.append(Standing(change, float(stats.chi2.sf(gain, size)), score))
    return sorted(standings, key=lambda standing: -standing.score)
