"""Shortlist of a step: the candidates whose score statistics promise the largest gains of log-likelihood."""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError
from armident.identify.diagnosis.candidates import Candidate, ColumnCache, Key, Shapes, candidates
from armident.identify.diagnosis.corrections import screened_correction
from armident.identify.diagnosis.model_state import ModelState, with_entries
from armident.identify.diagnosis.order_analysis import motor_orders, nearby_orders
from armident.identify.diagnosis.screening import contained, refined, screened
from armident.identify.diagnosis.shaping import shapes_of_both_signals
from armident.identify.diagnosis.stretch import distances
from armident.identify.effects.drive import Correction
from armident.identify.effects.terms import entry_of
from armident.identify.effects.transmission import MotorOrder
from armident.identify.effects.unnamed import NAME as UNNAMED

Starts = tuple[float, ...]
"""Values from which the correction of a recorded torque starts; empty for a term of the model."""

Look = tuple[float, Candidate, tuple[float, Shapes], Starts]
"""Statistic less the parameters of a candidate; the candidate; what the screening found; starting values."""


@dataclass(frozen=True, eq=False)
class Incumbent:
    """A finding with which effects compete that act on one of its joints (n,); ``gain``: of log-likelihood, nats."""

    gain: float
    joints: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Shortlist:
    """Candidates of a step, with nonlinear parameters or starting values; ``hidden``: not shown by the motion."""

    chosen: list[tuple[Candidate, Shapes, Starts]]
    tests: int
    hidden: frozenset[Key]


def shortlist(state: ModelState, incumbent: Incumbent | None, alike: set[Key]) -> Shortlist:
    """Return the candidates with the highest statistics less their parameters; with ``incumbent``, its rivals alone.

    ``alike``: corrections that make no better loop, from one step to the next.
    """
    criteria, column_cache = state.study.criteria, ColumnCache(state.study, state.fit.theta)
    noise = state.fit.renoised(state.weights)
    looks: list[Look] = []
    tests, hidden = 0, set()
    for every in candidates(column_cache):
        candidate = every
        tests += 1
        if incumbent is not None and not incumbent.joints[column_cache.joints(candidate)].any():
            continue
        if isinstance(candidate.effect, MotorOrder):
            candidate = replace(candidate, grid=motor_orders(state.study, state.fit.theta, candidate.place.joint))
        found: tuple[float, Shapes] | None
        starts: Starts = ()
        if isinstance(candidate.effect, Correction):
            (statistic, start), (gained, likely) = screened_correction(noise, candidate, column_cache)
            starts = (start, likely)
            if candidate.key not in alike and 0.5 * statistic < criteria.needed_gain(1) < 0.5 * gained:
                if _loop_improves(state, candidate, likely):
                    statistic, starts = gained, (likely,)
                else:
                    alike.add(candidate.key)
            found = (statistic, ())
        else:
            found = screened(noise, candidate, column_cache)
        if found is None:
            hidden.add(candidate.key)
        else:
            looks.append((found[0] - 2.0 * len(candidate.effect.linear), candidate, found, starts))
    # A score statistic is twice the gain of log-likelihood that it promises. A correction needs all of it: its
    # likelihood also rewards smaller noise.
    needed, promising = criteria.needed_gain(tests), criteria.promising
    present = 0.0 if incumbent is None else incumbent.gain
    looks = [x for x in looks if 0.5 * x[2][0] > max(needed * (1.0 if x[3] else promising), promising * present)]
    looks.sort(key=lambda look: -look[0])
    named = _first([x for x in looks if x[1].effect.name != UNNAMED], criteria.shortlist, criteria.of_each_joint)
    unnamed = _first([x for x in looks if x[1].effect.name == UNNAMED], criteria.unnamed, 1)
    chosen: list[tuple[Candidate, Shapes, Starts]] = []
    for _, own, first, starts in (*named, *unnamed):
        candidate, found = own, first
        if starts:
            chosen.append((candidate, (), starts))
            continue
        if isinstance(candidate.effect, MotorOrder):
            near = nearby_orders(state.study, candidate.place.joint, found[1][0][1])
            candidate = replace(candidate, grid=near)
            found = screened(noise, candidate, column_cache) or found
        shapes = refined(noise, candidate, column_cache, found)
        for ends in shapes_of_both_signals(noise, candidate, column_cache, shapes):
            without = contained(noise, candidate, column_cache, ends)
            chosen.append((replace(candidate, without=without), ends, ()))
    return Shortlist(chosen, tests, frozenset(hidden))


def _first(looks: list[Look], most: int, of_each_joint: int) -> list[Look]:
    """Return the first ``most``, and the first of each joint: the errors of one joint do not hide those of another."""
    count: Counter[int] = Counter()
    found: list[Look] = []
    for look in looks:
        joint = look[1].place.joint
        if len(found) < most or count[joint] < of_each_joint:
            found.append(look)
            count[joint] += 1
    return found


def _loop_improves(state: ModelState, candidate: Candidate, value: float) -> bool:
    """True if the controller that corrected torques identify follows the joint clearly better than that of the model.

    Late torques, for example, give a controller whose loop swings: its motion shows no effect of the joint.
    """
    entry = entry_of(candidate.effect, candidate.place, state.robot, {})
    parameters = {**entry.parameters, candidate.effect.linear[0].name: value}
    corrected = with_entries(state.robot, [entry.model_copy(update={"parameters": parameters})])
    try:
        loop = state.study.of_robot(corrected).with_own_controller()
    except DataError:
        return False
    before, after = (distances(study.train)[candidate.place.joint] for study in (state.study, loop))
    return bool(before > state.study.criteria.stiff_loop * after)
