"""A second look at candidates, in the closed loop that they would make.

Candidates are judged at simulated signals, and the loop that these come from does not have them in it. Where a missing
effect moves the arm visibly otherwise (elasticity, a late torque), that loop is a poor likeness and the candidate may
fail although much speaks for it. Simulated once more with the candidate inside, it makes instruments that still know
nothing of the noise.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from armident.configs import DataError
from armident.identify.diagnosis.candidates import Candidate, Shapes, Workshop
from armident.identify.diagnosis.regression import Fit
from armident.identify.diagnosis.regression import fit as fitted
from armident.identify.diagnosis.screening import noise_beyond_shapes
from armident.identify.diagnosis.shaping import both_ends
from armident.identify.diagnosis.stanzas import added
from armident.identify.diagnosis.study import ALIKE, Study
from armident.identify.diagnosis.trial import Trial, best_trial, judge, refined, replaced, screened
from armident.identify.effects.terms import arm_model

SECOND_LOOKS = 2
"""Most candidates of one state that are looked at again."""

SUSPECT = 20.0
"""Score that makes it worth while: what passes has about ten, without merit there is hardly any."""

NEAR = 0.5
"""Score over that of the best one at the same joint from which on two are rivals."""

APART = 0.9
"""Values of a nonlinear parameter that differ by less are one."""


def suspects(failed: Sequence[Trial], no_accident: Sequence[Trial]) -> list[Trial]:
    """Trials that failed in spite of their score, or although chance does not make them, those first that have most.

    What explains too little to be worth a finding in a loop without it may explain much in its own.
    """
    able = [t for t in failed if t.candidate.effect.predicts and not t.candidate.effect.sudden and not t.forbidden]
    doubtful = (t for t in able if t.score > SUSPECT or any(t is other for other in no_accident))
    return sorted(doubtful, key=lambda t: -t.score)[:SECOND_LOOKS]


def rivals(passing: Sequence[Trial]) -> list[Trial]:
    """Trials that pass at one joint and are near each other, the best of each joint first.

    Each may have the better of the others in the loop that it makes: a torque that comes late looks like a joint that
    yields where the arm is simulated with neither.
    """
    found: list[Trial] = []
    for joint in dict.fromkeys(t.candidate.place.joint for t in passing):
        here = [t for t in passing if t.candidate.place.joint == joint and not t.candidate.effect.sudden]
        near = [t for t in here if t.score > NEAR * here[0].score]
        found += near[: SECOND_LOOKS + 1] if len(near) > 1 else []
    return found


def at_measured_signals(
    fit: Fit, candidates: Iterable[Candidate], workshop: Workshop, least: float
) -> list[tuple[Trial, ...]]:
    """Trials with measured signals as instruments, of what goes with way and speed alone, those that explain most.

    A joint that yields before it slides, or sticks, reverses at other instants in a loop without that: the simulated
    columns have nothing of the measured ones, and the parameters that they make are of any size. Feedback lets measured
    ones explain a little without merit, so these trials are no evidence; the loop that they make is one to look in.

    Parameters
    ----------
    least
        Share of a joint's held-out residual power that a trial has to explain.

    Returns
    -------
    list
        Of every candidate the trials at the values that screening finds and next to them on the grid, best first.
    """
    tried = []
    for candidate in candidates:
        effect = candidate.effect
        if effect.predicts or effect.sudden or effect.undo is not None:
            continue
        measured = replace(candidate, effect=replace(effect, sudden=True))
        best = best_trial(fit, measured, workshop)
        if best is None or best.forbidden or best.score < SUSPECT or best.share < least:
            continue
        beside = (judge(fit, measured, shapes, workshop) for shapes in neighbours(fit.study, candidate, best.shapes))
        able = sorted([best, *(t for t in beside if t is not None and not t.forbidden)], key=lambda t: -t.score)
        tried.append(tuple(replace(trial, candidate=candidate) for trial in able))
    return sorted(tried, key=lambda trials: -trials[0].score)[:SECOND_LOOKS]


def neighbours(study: Study, candidate: Candidate, shapes: Shapes) -> list[Shapes]:
    """The values next to a candidate's continuous shapes on its grid, one at a time."""
    found = []
    for k, free in enumerate(candidate.effect.refinable(study.robot, candidate.place)):
        values = sorted({grid[k][1] for grid in candidate.grid})
        below = [v for v in values if v < APART * shapes[k][1]]
        above = [v for v in values if v * APART > shapes[k][1]]
        if free:
            found += [replaced(shapes, k, v) for v in (*below[-1:], *above[:1])]
    return found


def in_one_of_their_loops(fit: Fit, trials: Iterable[Trial]) -> Trial | None:
    """The first of some trials that makes a loop which is a better likeness of the arm, judged in it."""
    return next((again for trial in trials if (again := in_its_loop(fit, trial)) is not None), None)


def in_its_loop(fit: Fit, trial: Trial) -> Trial | None:
    """The trial repeated with instruments from the loop that has its candidate inside.

    Returns
    -------
    Trial or None
        ``None`` where that loop diverges or is no better likeness of the arm. That of what depends on the motion alone
        must be no worse: a joint that its controller holds moves the same with any friction.
    """
    study, candidate = fit.study, trial.candidate
    robot = added(study.robot, trial)
    if candidate.effect.undo is not None:
        try:
            # That of the fit has been simulated with its parameters, too: likenesses are compared at equal terms.
            moved = study.of_robot(robot).resimulated(trial.beside)
        except DataError:
            return None
        if not moved.moves_more_like_the_arm_than(study, held=False):
            return None
    else:
        whole = replace(study, robot=robot, model=arm_model(robot))
        worse = 1.0 if candidate.effect.predicts else 1.0 / ALIKE
        moved = whole.resimulated(np.concatenate([trial.beside, trial.kept]), worse=worse)
        if moved is whole:
            return None
    return in_loop_of(moved, fit, candidate)


def in_loop_of(moved: Study, fit: Fit, candidate: Candidate) -> Trial | None:
    """A candidate beside the model of a fit, with the simulated motion of another study of the same recordings.

    The torques stay as they are in the fit: what is judged is what they lack.
    """
    pairs = [(fit.study.train, moved.train), (fit.study.held, moved.held)]
    train, held = (
        tuple(replace(s, simulated=m.simulated, before=m.before) for s, m in zip(own, other, strict=True))
        for own, other in pairs
    )
    again = fitted(replace(fit.study, train=train, held=held), fit.theta)
    bench = Workshop(again.study, again.theta)
    calm = again.renoised(noise_beyond_shapes(again, bench))
    candidate = candidate.closer()
    look = screened(calm, candidate, bench)
    if look is None:
        return None
    ends = both_ends(calm, candidate, bench, refined(calm, candidate, bench, look))
    judged = [judge(again, candidate, shapes, bench, calm.noise) for shapes in ends]
    return max((trial for trial in judged if trial is not None), key=lambda trial: trial.score, default=None)
