"""Models with a candidate, each fitted in its own closed loop."""

import numpy as np

from armident.configs.schema.robot import Effect as Entry
from armident.identify.diagnosis.candidate_comparison import FittedCandidate, gain
from armident.identify.diagnosis.candidates import Candidate, Shapes
from armident.identify.diagnosis.model_state import Fitter, ModelState, friction_allowed, with_entries
from armident.identify.diagnosis.shortlist import Starts
from armident.identify.effects.effect import SIGN_TOLERANCE
from armident.identify.effects.registry import known
from armident.identify.effects.terms import entry_of

CORRECTIONS = 3
"""Values of a correction from each start, each refined by the expansion that remains."""


def model_with(
    state: ModelState, candidate: Candidate, shapes: Shapes, starts: Starts, fitter: Fitter
) -> FittedCandidate | None:
    """Return a candidate in the model; ``None`` if the motion does not determine the parameters.

    ``starts``: values from which the correction of a recorded torque starts; empty for a term of the model.
    """
    effect, whole = candidate.effect, known(candidate.effect.key)
    spared = (*(p.name for p in whole.linear if p not in effect.linear), *candidate.without)
    entry = entry_of(effect, candidate.place, state.robot, dict(shapes), spared)
    made = fitter(with_entries(state.robot, [entry]), state)
    if made is None:
        return None
    term = made.term_of(entry)
    values, std = made.values_of(term)
    allowed = whole.allows(term.of_effect(values), term.of_effect(std), dict(term.shapes))
    motion = made.study.motion(made.study.train[0], "measured", made.fit.theta)
    large = bool(np.all(np.abs(values) + SIGN_TOLERANCE * std >= whole.least(motion, term.place, term.shapes)))
    allowed = allowed and large and friction_allowed(made, term)
    one = FittedCandidate(candidate, shapes, entry, made, allowed)
    if not starts:
        return one
    corrected = _corrected(state, candidate, entry, (float(values[0]), *starts) if allowed else starts, fitter)
    return one if corrected is None else max((one, corrected), key=lambda m: (m.allowed, gain(m.state, state)))


def _corrected(
    state: ModelState, candidate: Candidate, entry: Entry, starts: Starts, fitter: Fitter
) -> FittedCandidate | None:
    """Model in which the recordings are corrected for an effect on a recorded torque.

    The first-order expansion refines the value to within its standard deviation; else the largest gain decides. A value
    that the expansion takes back by more than half only makes noise smaller.
    """
    name = candidate.effect.linear[0].name
    found: list[FittedCandidate] = []
    for start in starts:
        value = start
        for _ in range(CORRECTIONS):
            right = entry.model_copy(update={"parameters": {**entry.parameters, name: value}})
            exact = fitter(with_entries(state.robot, [right]), state)
            further = None if exact is None else fitter(with_entries(exact.robot, [entry]), exact)
            if exact is None:
                break
            if further is None:
                break
            rest, std = (float(x[0]) for x in further.values_of(further.term_of(entry)))
            if 2.0 * rest * np.sign(value) < -abs(value):
                break
            allowed = candidate.effect.allows(np.array([value]), np.zeros(1), {})
            found.append(FittedCandidate(candidate, (), right, exact, allowed))
            if abs(rest) < std and allowed:
                return found[-1]
            value += rest
    return max(found, key=lambda made: (made.allowed, gain(made.state, state)), default=None)
