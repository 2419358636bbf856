"""Explanations of a joint's disagreement that a motion shall tell apart, with the torques that they predict."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armident.arrays import Array
from armident.configs import DataError, RobotConfig
from armident.identify.diagnosis.candidates import Candidate, ColumnCache, Shapes, candidates
from armident.identify.diagnosis.model_state import ModelState, fitted_in_loop_of, with_entries
from armident.identify.diagnosis.probabilities import NOTHING
from armident.identify.diagnosis.screening import refined, screened
from armident.identify.documents.diagnosis import Explanation
from armident.identify.effects.recording_corrections import of_recording
from armident.identify.effects.registry import known
from armident.identify.effects.terms import Term, entry_of
from armident.identify.effects.unnamed import NAME as UNNAMED
from armident.identify.robot.motion import Motion

LEAST = 0.02
"""Least probability of a name that is a rival: others cannot be the answer of one more recording."""
OTHERS = 3
"""Effects that share the probability of something without a name: those whose score statistic is largest."""
STEP = 1.1
"""Ratio of a nonlinear parameter by which the derivative of a torque by it is taken."""


@dataclass(frozen=True, eq=False)
class Rival:
    """One explanation of a joint: a ``term`` with its linear ``values`` (k,), SI; both are ``None`` for nothing."""

    name: str
    probability: float
    term: Term | None = None
    values: Array | None = None

    def columns(self, motion: Motion) -> Array:
        """Return the torques (N, n, k + s) per linear parameter, then per change of each nonlinear one."""
        term = self.term
        assert term is not None
        assert self.values is not None
        parts = [term.columns(motion)]
        for name in term.effect.movable(motion.model.robot, term.place, term.shapes):
            ends = [
                replace(term, shapes={**term.shapes, name: factor * term.shapes[name]}).columns(motion)
                for factor in (STEP, 1.0 / STEP)
            ]
            parts.append(((ends[0] - ends[1]) @ self.values)[:, :, None])
        return np.concatenate(parts, axis=2)


def rivals_of(state: ModelState, explanation: Explanation) -> list[Rival]:
    """Return the explanations of a joint with their probabilities; the last one is that nothing is missing."""
    joint = state.study.joints.index(explanation.joint)
    cache, fit = ColumnCache(state.study, state.fit.theta), state.fit.renoised(state.weights)
    best: dict[str, tuple[float, Candidate, Shapes]] = {}
    for candidate in candidates(cache):
        name, place = candidate.effect.name, candidate.place
        here = candidate.effect.scope == "arm" or joint in (place.joint, place.other)
        found = screened(fit, candidate, cache) if here and name != UNNAMED else None
        if found is not None and found[0] > best.get(name, (-np.inf,))[0]:
            best[name] = (found[0], candidate, found[1])
    named = {name: p for name, p in explanation.names.items() if p >= LEAST and name in best}
    others = sorted((name for name in best if name not in named), key=lambda name: -best[name][0])[:OTHERS]
    shared = explanation.names.get(UNNAMED, 0.0) / max(len(others), 1)
    if shared >= LEAST:
        named |= {name: shared for name in others}
    made = [one for name, p in named.items() if (one := _fitted(state, name, p, *best[name])) is not None]
    rest = max(1.0 - sum(one.probability for one in made), LEAST)
    return [*made, Rival(NOTHING, rest)]


def _fitted(
    state: ModelState, name: str, probability: float, statistic: float, candidate: Candidate, shapes: Shapes
) -> Rival | None:
    """Return a rival with its estimated parameters; ``None`` if the recordings do not determine them."""
    effect, place = candidate.effect, candidate.place
    if shapes:
        cache, fit = ColumnCache(state.study, state.fit.theta), state.fit.renoised(state.weights)
        shapes = refined(fit, candidate, cache, (statistic, shapes))
    spared = tuple(p.name for p in known(effect.key).linear if p not in effect.linear)
    entry = entry_of(effect, place, state.robot, dict(shapes), spared)
    made = None if of_recording(entry) else fitted_in_loop_of(state, with_entries(state.robot, [entry]))
    if made is None:
        return None
    term = made.term_of(entry)
    return Rival(name, probability, term, made.values_of(term)[0])


def with_decided(state: ModelState, found: RobotConfig, explanations: Sequence[Explanation]) -> ModelState:
    """Return the model with the effects that are decided: what is asked next stands beside them."""
    decided = {(one.joint, one.likely[0]) for one in explanations if one.likely and not one.doubtful}
    sure = [e for e in found.effects if e not in state.robot.effects and (e.joint, e.effect) in decided]
    return (fitted_in_loop_of(state, with_entries(state.robot, sure)) if sure else None) or state


def uncertain(explanations: Sequence[Explanation]) -> list[Explanation]:
    """Return the explanations of joints that are not decided, the most uncertain one first."""
    doubtful = [one for one in explanations if one.doubtful]
    return sorted(doubtful, key=lambda one: -entropy(list(one.names.values())))


def entropy(probabilities: Sequence[float]) -> float:
    """Return the entropy of probabilities, nats."""
    p = np.array([one for one in probabilities if one > 0.0])
    if p.size == 0:
        raise DataError("an explanation has no probabilities")
    p = p / p.sum()
    return float(-(p * np.log(p)).sum())
