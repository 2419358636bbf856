"""The model as far as a search has come, and what can be said of it."""

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
from armident.identify.effects.registry import known
from armident.identify.effects.terms import Term, arm_model, effect_terms
from armident.identify.regression.ar_noise import ArModel
from armident.identify.robot.arm import ArmModel

Array = NDArray[np.float64]
Places = tuple[tuple[str, str, str], ...]

HELD_OUT_LEVEL = 0.05
"""The held-out data alone must speak for a finding at this level, whatever the training data say."""
FEEDBACK = 0.05
"""Share of a joint's held-out residual power that an effect must explain which is its own instrument: feedback lets the
motion follow the disturbances, so that terms without merit explain a percent or two."""


ANCHORINGS = 4
"""Most times that shares of predicted torques are made anew by what the fit with them predicts."""

ANCHORED = 0.1
"""Change of their parameters, in standard deviations, that ends them."""


@dataclass(frozen=True)
class Settings:
    """What a user may choose of a diagnosis.

    Parameters
    ----------
    false_alarms
        Chance that a plant without a missing effect is said to have one, over all tests of a diagnosis.
    material
        Share of a joint's held-out residual power that an effect must explain to be worth a finding.
    """

    false_alarms: float = 0.01
    material: float = 0.01


@dataclass(frozen=True, eq=False)
class State:
    """The model as far as it has come, and how every candidate would do beside it.

    Parameters
    ----------
    trials
        Of the candidates that looked best, best first; those with a sign that physics forbids are among them.
    tests
        Number of candidates that they were chosen from.
    hidden
        Candidates that the model contains or the motion does not excite.
    others
        Trials of the same candidates with other nonlinear parameters, which scored less.
    """

    study: Study
    fit: Fit
    workshop: Workshop
    trials: tuple[Trial, ...]
    tests: int
    hidden: frozenset[tuple[str, int, int | None]]
    others: tuple[Trial, ...] = ()

    def no_accident(self, settings: Settings) -> list[Trial]:
        """Trials that chance does not make, however little they explain, best first."""
        level = settings.false_alarms / max(self.tests, 1)
        return [
            t for t in self.trials if not t.forbidden and t.p_value < level and t.p_held < HELD_OUT_LEVEL and t.gain > 0
        ]

    def passing(self, settings: Settings) -> list[Trial]:
        """Trials that a finding may come from, best first."""
        return [
            t
            for t in self.no_accident(settings)
            if t.share >= max(settings.material, FEEDBACK if t.candidate.effect.sudden else 0.0)
            and not (t.candidate.effect.negligible and t.candidate.effect.negligible(t.values, self.study.sample))
        ]


def nearer(one: State, other: State, material: float) -> bool:
    """Whether a model comes closer to the held-out torques than another, at measured or at simulated signals.

    Both count: measured positions, differentiated twice for an elastic joint, may bring more noise than the effect has
    torque, and simulated ones are only as good as the loop. Where they alone are for it, the loop with the effect in it
    must be no worse a likeness of the arm: what a model says of itself is no evidence.

    Parameters
    ----------
    material
        Share of the power of a joint's whitened error by which it must be closer where only simulated signals show it.
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
    # Of the error at measured signals, less what of it the change at simulated ones explains: those know no noise.
    ways = [[e - c for e, c in zip(before, _change(other, one), strict=True)]]
    if closer:
        ways.append(one.fit.errors(one.fit.theta, held=True))
    was = _whitened_power(before, noise)
    left = [_whitened_power(errors, noise) for errors in ways]
    return any(now.sum() < was.sum() and bool(np.any(now < (1 - material) * was)) for now in left)


def supersedes(one: State, other: State, material: float) -> bool:
    """Whether a model comes closer to the held-out torques than another that lacks nothing of it but one effect.

    Of two effects in one place each has its loop, and either may be a likeness: what was measured decides.
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
    """Whether recordings put right as in one state make smaller errors, where the loops hardly tell.

    With the filters of both ways in either: a torque put right by a filter has less noise, whether it was wrong or not.
    """
    ours, theirs = one.study.recorded, other.study.recorded
    differ = [s for s in ours if s not in theirs] + [s for s in theirs if s not in ours]
    where = [one.study.joints.index(stanza.joint) for stanza in differ]
    if any(known(stanza.effect).rewires for stanza in differ):
        return False
    lost = one.study.likeness_lost(other.study, where, held=True)
    if not np.isfinite(lost):
        return False
    was, now = power_put_right(other, one), power_put_right(one, other)
    gained = float(np.sum(np.log(now / was)))
    # What a loop loses that hardly differs from the arm anyhow (a stiff controller) the torques make good.
    enough = gained < 0.0 if lost < 1.0 / ALIKE else gained + np.log(lost) < 0.0
    return bool(enough and np.any(now < (1 - material) * was))


def share_explained(one: State, other: State) -> Array:
    """Share of every joint's whitened held-out error at measured signals that one model has less than another, (n,)."""
    was, now = (_whitened_power(s.fit.errors(s.fit.theta, held=True), one.fit.noise) for s in (other, one))
    return np.asarray(1.0 - now / np.maximum(was, 1e-300))


def _foretold(one: State, other: State, material: float) -> bool:
    """Whether a recording put right changes the predicted torques, at simulated motion, to where the held-out ones are.

    Noise of the encoder makes noise of the torque through the controller, in step with it: where that is strong, errors
    at measured signals speak for whatever takes torques out of step, and hide what a loop gains.
    """
    differ = [stanza for stanza in one.study.recorded if stanza not in other.study.recorded]
    where = [one.study.joints.index(stanza.joint) for stanza in differ]
    # What a model says of itself is no evidence: its loop has to be a better likeness there, over all of the data.
    if np.prod([one.study.likeness_lost(other.study, where, held=held) for held in (False, True)]) >= 1.0:
        return False
    found = foretold(other.study, other.fit.theta, one.study, one.fit.theta)
    if found is None:
        return False
    was, now = (_whitened_power(errors, other.fit.noise) for errors in (found.before, found.after))
    return bool(now.sum() < was.sum() and np.any(now < (1 - material) * was))


def power_put_right(state: State, other: State) -> Array:
    """Squared norm of every joint's held-out errors, put right as the recordings of another state are, too, (n,)."""
    study = state.study
    late = tuple(stanza for stanza in other.study.recorded if not known(stanza.effect).rewires)
    total = np.zeros(study.robot.n)
    for e in residuals(study, study.held, state.fit.theta):
        total += np.sum(study.decimation(torque_put_right(e, study, late)) ** 2, axis=0)
    return np.maximum(total, 1e-300)


def _change(before: State, after: State) -> list[Array]:
    """Change of the held-out torques from one model to another at the simulated motion of the second, (M, n) of each.

    Beyond the bandwidth of the controller it is the motion that a model changes and hardly the torque: motions of their
    own would hide what the models disagree about.
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
    """The data with the model of a robot, and its fit.

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
    """Shares of predicted torques by those that the model itself predicts.

    A drive that gives half its torque is a share of another torque than the model without it predicts.
    """
    terms = slice(found.study.model.base.b - found.study.model.e, None)
    for _ in range(ANCHORINGS):
        before, std = found.theta[terms], np.sqrt(np.diag(found.covariance)[terms])
        found = fit(found.study, found.theta)
        if np.all(np.abs(found.theta[terms] - before) <= ANCHORED * std):
            break
    return found


def padded(before: Fit, model: ArmModel) -> Array:
    """Rigid parameters of an earlier fit, zeros for the terms, (b,)."""
    rigid = before.theta[: before.study.model.base.b - before.study.model.e]
    return np.concatenate([rigid, np.zeros(model.e)])


def accident(state: State, term: Term) -> float:
    """Chance that the linear parameters of a term are all zero (Wald test)."""
    names = state.study.model.base.names
    own = [names.index(name) for name in term.names]
    values, covariance = state.fit.theta[own], state.fit.covariance[np.ix_(own, own)]
    return float(stats.chi2.sf(values @ np.linalg.pinv(covariance) @ values, len(own)))


def takes_over(state: State, term: Term, most: float) -> bool:
    """Whether what a term takes over of rigid parameters of its joint is all of them, but for a share of ``most``."""
    estimates = dict(zip(state.study.model.base.names, state.fit.theta, strict=True))
    for name, linear in zip(term.names, term.linear, strict=True):
        whole = estimates.get(f"{linear.replaces}{term.place.joint + 1}", 0.0)
        if linear.through is not None and abs(estimates[name] - whole) > most * abs(whole):
            return False
    return True


def with_values(state: State, shapes: Mapping[int, Mapping[str, float]] | None = None) -> RobotConfig:
    """The robot with the estimated values in its stanzas."""
    stanzas: list[Stanza] = list(state.study.robot.effects)
    for k, term in enumerate(effect_terms(state.study.model)):
        number = stanza_number(state.study.robot, k)
        own = [state.study.model.base.names.index(name) for name in term.names]
        linear = zip((p.name for p in term.linear), state.fit.theta[own], strict=True)
        found = {**term.shapes, **{name: float(value) for name, value in linear}, **dict((shapes or {}).get(k, {}))}
        stanzas[number] = stanzas[number].model_copy(update={"parameters": found})
    return state.study.robot.model_copy(update={"effects": tuple(stanzas)})


def places_of(state: State) -> Places:
    """What the model of a state has beyond the rigid one, and where, whatever the values and the order."""
    return tuple(sorted((e.effect, e.joint, e.other or "") for e in state.study.robot.effects))
