"""State of the model selection, and comparisons between states."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from armident.configs import RobotConfig
from armident.configs.schema.robot import Effect as Stanza
from armident.identify.diagnosis.candidates import Workshop
from armident.identify.diagnosis.foretold import foretold, torque_put_right
from armident.identify.diagnosis.lines import residuals
from armident.identify.diagnosis.regression import Fit, applied, fit, regressors
from armident.identify.diagnosis.stanzas import stanza_number
from armident.identify.diagnosis.study import ALIKE, Study
from armident.identify.diagnosis.trial import Trial
from armident.identify.diagnosis.whitening import rows_of_joints, whitened
from armident.identify.effects.registry import known, of_entry
from armident.identify.effects.terms import Term, arm_model, effect_terms
from armident.identify.regression.ar_noise import ArModel
from armident.identify.robot.arm import ArmModel

Array = NDArray[np.float64]
Places = tuple[tuple[str, str, str], ...]

HELD_OUT_LEVEL = 0.05
"""Significance level of the held-out data alone for a finding, whatever the training data."""
FEEDBACK = 0.05
"""Share of a joint's held-out residual power that an effect must explain which is its own instrument: feedback lets the
motion follow the disturbances, so that terms without merit explain a percent or two."""


ANCHORINGS = 4
"""Most iterations between terms that scale predicted torques and the torques that the fit predicts."""

ANCHORED = 0.1
"""Change of their parameters, in standard deviations, that ends the iterations."""


@dataclass(frozen=True)
class Settings:
    """Options of a diagnosis.

    Parameters
    ----------
    false_alarms
        Probability of a false alarm for a plant without a missing effect, over all tests of a diagnosis.
    material
        Share of a joint's held-out residual power that an effect must explain to be reported.
    """

    false_alarms: float = 0.01
    material: float = 0.01


@dataclass(frozen=True, eq=False)
class State:
    """Model of one step of the selection, with the trials of all candidates in addition to it.

    Parameters
    ----------
    study
        Data with the model.
    fit
        Fit of the model.
    workshop
        Cache of the columns of the same fit.
    trials
        Trials of the best candidates, best first; those with a sign that physics forbids are among them.
    tests
        Number of candidates from which they were selected.
    hidden
        Candidates that the model contains or the motion does not excite.
    others
        Trials of the same candidates with other nonlinear parameters and lower scores.
    """

    study: Study
    fit: Fit
    workshop: Workshop
    trials: tuple[Trial, ...]
    tests: int
    hidden: frozenset[tuple[str, int, int | None]]
    others: tuple[Trial, ...] = ()

    def no_accident(self, settings: Settings) -> list[Trial]:
        """Significant trials, however little they explain, best first."""
        level = settings.false_alarms / max(self.tests, 1)
        return [
            t for t in self.trials if not t.forbidden and t.p_value < level and t.p_held < HELD_OUT_LEVEL and t.gain > 0
        ]

    def passing(self, settings: Settings) -> list[Trial]:
        """Trials that may become a finding, best first."""
        return [
            t
            for t in self.no_accident(settings)
            if t.share >= max(settings.material, FEEDBACK if t.candidate.effect.sudden else 0.0)
            and not (t.candidate.effect.negligible and t.candidate.effect.negligible(t.values, self.study.sample))
        ]


def nearer(one: State, other: State, material: float) -> bool:
    """True if a model fits the held-out torques better than another, at measured or at simulated signals.

    Both count. Measured positions, differentiated twice for an elastic joint, may add more noise than the effect has
    torque; simulated ones are only as good as the loop. Where only simulated signals favour the model, its loop must
    simulate the arm no worse, since the model would otherwise be its own evidence.

    Parameters
    ----------
    one, other
        The model, and the one to improve on.
    material
        Share of the power of a joint's whitened error by which it must be better where only simulated signals show it.
    """
    closer = one.study.moves_more_like_the_arm_than(other.study, held=True)
    if one.study.recorded != other.study.recorded:
        return closer or _recorded_right(one, other, material) or _foretold(one, other, material)
    if _closer_at_measured_signals(one, other):
        return True
    if one.study.likeness_lost(other.study, range(one.study.robot.n), held=True) > 1.0 / ALIKE:
        return False
    noise = one.fit.noise
    before = other.fit.errors(other.fit.theta, held=True)
    # Error at measured signals less the change at simulated ones, which are free of noise.
    ways = [[e - c for e, c in zip(before, _change(other, one), strict=True)]]
    if closer:
        ways.append(one.fit.errors(one.fit.theta, held=True))
    was = _whitened_power(before, noise)
    left = [_whitened_power(errors, noise) for errors in ways]
    return any(now.sum() < was.sum() and bool(np.any(now < (1 - material) * was)) for now in left)


def supersedes(one: State, other: State, material: float) -> bool:
    """True if a model fits the held-out torques better than another one that differs in one effect.

    Each of two effects in one place has its own loop, and either loop may be right: measured signals decide.

    Parameters
    ----------
    one, other
        The model, and the one to improve on.
    material
        Share of the power of a joint's whitened error, for corrections of recordings, see `nearer`.
    """
    if one.study.recorded != other.study.recorded:
        return nearer(one, other, material)
    return _closer_at_measured_signals(one, other)


def _closer_at_measured_signals(one: State, other: State) -> bool:
    # Relative to each other joint by joint: a wrist's errors are small beside those of a shoulder, or in other units.
    return bool(np.sum(np.log(_power(one))) < np.sum(np.log(_power(other))))


def _power(state: State) -> Array:
    """Squared norm of every joint's held-out errors at measured signals, (n,)."""
    errors = np.concatenate(state.fit.errors(state.fit.theta, held=True))
    return np.asarray(np.maximum(np.sum(errors**2, axis=0), 1e-300))


def _recorded_right(one: State, other: State, material: float) -> bool:
    """True if the corrections of one state make smaller errors, where the loops hardly differ.

    Both corrections are applied to either: a correction by a filter reduces noise even where the torque was right.
    """
    ours, theirs = one.study.recorded, other.study.recorded
    differ = [s for s in ours if s not in theirs] + [s for s in theirs if s not in ours]
    where = [one.study.joints.index(stanza.joint) for stanza in differ]
    if any(of_entry(stanza).rewires for stanza in differ):
        return False
    lost = one.study.likeness_lost(other.study, where, held=True)
    if not np.isfinite(lost):
        return False
    was, now = power_put_right(other, one), power_put_right(one, other)
    gained = float(np.sum(np.log(now / was)))
    # A loop that hardly differs from the arm anyhow (a stiff controller) may be worse; then the torques decide.
    enough = gained < 0.0 if lost < 1.0 / ALIKE else gained + np.log(lost) < 0.0
    return bool(enough and np.any(now < (1 - material) * was))


def share_explained(one: State, other: State) -> Array:
    """Relative reduction of every joint's whitened held-out error power by one model against another, (n,).

    Parameters
    ----------
    one, other
        The model with smaller errors, and the one it is compared with.
    """
    was, now = (_whitened_power(s.fit.errors(s.fit.theta, held=True), one.fit.noise) for s in (other, one))
    return np.asarray(1.0 - now / np.maximum(was, 1e-300))


def _foretold(one: State, other: State, material: float) -> bool:
    """True if a correction of recordings improves the torques predicted at the simulated motion.

    The controller turns encoder noise into torque noise in phase with it. Where that noise is strong, errors at
    measured signals favour any effect that shifts the torque in time, and hide the improvement of the loop.
    """
    differ = [stanza for stanza in one.study.recorded if stanza not in other.study.recorded]
    where = [one.study.joints.index(stanza.joint) for stanza in differ]
    # A model is no evidence for itself: its loop has to simulate the arm better there, over all of the data.
    if np.prod([one.study.likeness_lost(other.study, where, held=held) for held in (False, True)]) >= 1.0:
        return False
    found = foretold(other.study, other.fit.theta, one.study, one.fit.theta)
    if found is None:
        return False
    was, now = (_whitened_power(errors, other.fit.noise) for errors in (found.before, found.after))
    return bool(now.sum() < was.sum() and np.any(now < (1 - material) * was))


def power_put_right(state: State, other: State) -> Array:
    """Squared norm of every joint's held-out errors, with the corrections of another state applied as well, (n,).

    Parameters
    ----------
    state
        The model.
    other
        State whose corrections are applied.
    """
    study = state.study
    late = tuple(stanza for stanza in other.study.recorded if not of_entry(stanza).rewires)
    total = np.zeros(study.robot.n)
    for e in residuals(study, study.held, state.fit.theta):
        total += np.sum(study.decimation(torque_put_right(e, study, late)) ** 2, axis=0)
    return np.maximum(total, 1e-300)


def _change(before: State, after: State) -> list[Array]:
    """Change of the held-out torques from one model to another at the simulated motion of the second, (M, n) of each.

    Beyond the bandwidth of the controller a model changes the motion and hardly the torque. With separate motions the
    difference of the models would be hidden.
    """
    study, theta = before.study, padded(before.fit, before.study.model)
    changes = []
    for own, other, (_, z, _) in zip(study.held, after.study.held, after.fit.equations.held, strict=True):
        there = replace(own, simulated=other.simulated, before=other.before)
        changes.append(applied(z, after.fit.theta) - applied(regressors(study, there, theta)[1], before.fit.theta))
    return changes


def _whitened_power(errors: Sequence[Array], noise: Sequence[ArModel]) -> Array:
    """Squared norm of every joint's errors, whitened, (n,)."""
    white = whitened(errors, noise)
    joints = rows_of_joints([e.shape[0] for e in errors], noise)
    return np.array([float(white[rows] @ white[rows]) for rows in joints])


def refit(study: Study, robot: RobotConfig, before: Fit | None) -> tuple[Study, Fit]:
    """Data with the model of a robot, and its fit.

    Parameters
    ----------
    study
        Data with another model of the same recordings.
    robot
        Configuration of the model.
    before
        Earlier fit, whose rigid parameters predict the torques on which terms depend; ``None``: fit a rigid model
        first.

    Raises
    ------
    DataError
        If the motion does not determine the parameters of the model.
    """
    changed = study.of_robot(robot)
    model = changed.model
    theta: Array | None = None
    if before is not None:
        theta = padded(before, model)
    elif any(term.depends_on_torque for term in effect_terms(model)):
        bare = robot.model_copy(update={"effects": ()})
        rigid = fit(replace(changed, robot=bare, model=arm_model(bare)))
        theta = np.concatenate([rigid.theta, np.zeros(model.e)])
    first = fit(changed, theta)
    moved = changed.resimulated(first.theta)
    if moved is not changed:
        first = fit(moved, first.theta if model.e else None)
    if any(term.scales_torque for term in effect_terms(model)):
        first = _anchored(first)
    return moved, first


def _anchored(found: Fit) -> Fit:
    """Fit whose terms scale the torques predicted by the model itself, by iteration.

    A drive that gives half its torque scales another torque than the model without it predicts.
    """
    terms = slice(found.study.model.base.b - found.study.model.e, None)
    for _ in range(ANCHORINGS):
        before, std = found.theta[terms], np.sqrt(np.diag(found.covariance)[terms])
        found = fit(found.study, found.theta)
        if np.all(np.abs(found.theta[terms] - before) <= ANCHORED * std):
            break
    return found


def padded(before: Fit, model: ArmModel) -> Array:
    """Rigid parameters of an earlier fit, zeros for the terms, (b,).

    Parameters
    ----------
    before
        Earlier fit.
    model
        Model with terms.
    """
    rigid = before.theta[: before.study.model.base.b - before.study.model.e]
    return np.concatenate([rigid, np.zeros(model.e)])


def accident(state: State, term: Term) -> float:
    """P-value of the hypothesis that the linear parameters of a term are all zero (Wald test).

    Parameters
    ----------
    state
        Model with the term.
    term
        Term of the model.
    """
    names = state.study.model.base.names
    own = [names.index(name) for name in term.names]
    values, covariance = state.fit.theta[own], state.fit.covariance[np.ix_(own, own)]
    return float(stats.chi2.sf(values @ np.linalg.pinv(covariance) @ values, len(own)))


def takes_over(state: State, term: Term, most: float) -> bool:
    """True if a term takes over the rigid parameters of its joint entirely, up to a share of ``most``.

    Parameters
    ----------
    state
        Model with the term.
    term
        Term of the model.
    most
        Greatest relative difference of the parameter.
    """
    estimates = dict(zip(state.study.model.base.names, state.fit.theta, strict=True))
    for name, linear in zip(term.names, term.linear, strict=True):
        whole = estimates.get(f"{linear.replaces}{term.place.joint + 1}", 0.0)
        if linear.through is not None and abs(estimates[name] - whole) > most * abs(whole):
            return False
    return True


def with_values(state: State, shapes: Mapping[int, Mapping[str, float]] | None = None) -> RobotConfig:
    """Robot with the estimated values in its effect entries.

    Parameters
    ----------
    state
        The model.
    shapes
        Other nonlinear parameters, by number of the term and name.
    """
    stanzas: list[Stanza] = list(state.study.robot.effects)
    for k, term in enumerate(effect_terms(state.study.model)):
        number = stanza_number(state.study.robot, k)
        own = [state.study.model.base.names.index(name) for name in term.names]
        linear = zip((p.name for p in term.linear), state.fit.theta[own], strict=True)
        found = {**term.shapes, **{name: float(value) for name, value in linear}, **dict((shapes or {}).get(k, {}))}
        stanzas[number] = stanzas[number].model_copy(update={"parameters": found})
    return state.study.robot.model_copy(update={"effects": tuple(stanzas)})


def places_of(state: State) -> Places:
    """Effects of a model and their places, whatever the values and the order."""
    return tuple(sorted((e.effect, e.joint, e.other or "") for e in state.study.robot.effects))
