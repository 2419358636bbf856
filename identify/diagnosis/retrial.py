"""Test of candidates in the closed loop that contains them.

Candidates are tested at simulated signals of a loop without them. A missing effect may change the motion of the arm
visibly (elasticity, a torque delay). Then that loop differs from the arm, and the candidate may fail in spite of its
high score. A second simulation with the candidate in the model gives instruments still independent of the noise.
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
"""Most candidates of one state with a second test."""

SUSPECT = 20.0
"""Least score for a second test: passing candidates have about ten, those without merit hardly any."""

NEAR = 0.5
"""Score, over the best one at the same joint, above which two candidates are rivals."""

APART = 0.9
"""Ratio of two values of a nonlinear parameter above which they count as equal."""


def suspects(failed: Sequence[Trial], no_accident: Sequence[Trial]) -> list[Trial]:
    """Trials that failed in spite of their score or significance, highest score first.

    An effect that explains too little in a loop without it may explain much in its own.

    Parameters
    ----------
    failed
        Trials that do not pass.
    no_accident
        Significant trials.
    """
    able = [t for t in failed if t.candidate.effect.predicts and not t.candidate.effect.sudden and not t.forbidden]
    doubtful = (t for t in able if t.score > SUSPECT or any(t is other for other in no_accident))
    return sorted(doubtful, key=lambda t: -t.score)[:SECOND_LOOKS]


def rivals(passing: Sequence[Trial]) -> list[Trial]:
    """Passing trials of one joint with similar scores, the best of each joint first.

    Their order may change in the loops that contain them. A torque delay resembles joint elasticity where the arm is
    simulated with neither.
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
    """Trials with measured signals as instruments, of effects that depend on the motion alone, highest score first.

    Friction with presliding or stiction reverses at other instants in a loop without it. The simulated columns are then
    uncorrelated with the measured ones, and the estimates have any size. With feedback, measured signals explain a
    little without merit. So these trials are no evidence; they only select the loop for another test.

    Parameters
    ----------
    fit
        Fit of the model.
    candidates
        Candidates to try.
    workshop
        Cache of the columns of the same fit.
    least
        Share of a joint's held-out residual power that a trial has to explain.

    Returns
    -------
    list
        Of every candidate the trials at the values found by screening and next to them on the grid, best first.
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
    """Neighbours on the grid of each continuous nonlinear parameter of a candidate, one parameter at a time.

    Parameters
    ----------
    study
        Data with the robot.
    candidate
        Candidate with its grid.
    shapes
        Present values.
    """
    found = []
    for k, free in enumerate(candidate.effect.refinable(study.robot, candidate.place)):
        values = sorted({grid[k][1] for grid in candidate.grid})
        below = [v for v in values if v < APART * shapes[k][1]]
        above = [v for v in values if v * APART > shapes[k][1]]
        if free:
            found += [replaced(shapes, k, v) for v in (*below[-1:], *above[:1])]
    return found


def in_one_of_their_loops(fit: Fit, trials: Iterable[Trial]) -> Trial | None:
    """First of some trials whose own loop simulates the arm better, tested in that loop; ``None`` if there is none.

    Parameters
    ----------
    fit
        Fit of the model.
    trials
        Trials in order of preference.
    """
    return next((again for trial in trials if (again := in_its_loop(fit, trial)) is not None), None)


def in_its_loop(fit: Fit, trial: Trial) -> Trial | None:
    """Trial repeated with instruments from the loop that contains its candidate.

    Parameters
    ----------
    fit
        Fit of the model.
    trial
        The trial to repeat.

    Returns
    -------
    Trial or None
        ``None`` where that loop diverges or does not simulate the arm better. For effects that depend on the motion
        alone it must only not be worse: a joint under stiff control moves the same with any friction.
    """
    study, candidate = fit.study, trial.candidate
    robot = added(study.robot, trial)
    if candidate.effect.undo is not None:
        try:
            # The loop of the fit was simulated with its parameters, too: the comparison is fair.
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
    """Trial of a candidate in the model of a fit, with the simulated motion of another study of the same recordings.

    The torques are those of the fit, because the candidate has to explain its residual.

    Parameters
    ----------
    moved
        Study whose simulated motion is used.
    fit
        Fit of the model.
    candidate
        Candidate to test.
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
