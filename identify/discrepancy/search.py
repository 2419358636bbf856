"""One step after the other: add the effect that predicts unseen data best, take out what is no longer needed."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from configs import DataError, RobotConfig
from configs.robot import Effect as Stanza
from identify.catalogue.terms import Term
from identify.discrepancy.candidates import Workshop, candidates
from identify.discrepancy.regression import Fit, applied, fit
from identify.discrepancy.retrial import in_its_loop, suspects
from identify.discrepancy.screening import shortlist
from identify.discrepancy.stanzas import added, stanza_number, valued, without
from identify.discrepancy.study import Study
from identify.discrepancy.trial import Trial, judge
from identify.discrepancy.whitening import rows_of_joints, whitened
from identify.estimators.noise import ArModel
from identify.model.arm import ArmModel

Array = NDArray[np.float64]
Places = tuple[tuple[str, str, str], ...]

HELD_OUT_LEVEL = 0.05
"""The held-out data alone must speak for a finding at this level, whatever the training data say."""
NEEDED = 0.01
"""Chance of its estimate by accident above which an effect found earlier is taken out again."""
FEEDBACK = 0.05
"""Share of a joint's held-out residual power that an effect must explain which is its own instrument: feedback lets the
motion follow the disturbances, so that terms without merit explain a percent or two."""
SHORTLIST = 15
"""Candidates that get a trial of their own."""
LOOPS = 3
"""Loops in which the nonlinear parameters of one effect are sought."""
ROUNDS = 5
"""Most times that a recording is put right for one finding, each time by what was still missing."""
SETTLED = 0.01
"""Part still missing that ends them."""
MOST = 8
"""Most effects of one diagnosis."""


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
    """

    study: Study
    fit: Fit
    workshop: Workshop
    trials: tuple[Trial, ...]
    tests: int
    hidden: frozenset[tuple[str, int, int | None]]

    def passing(self, settings: Settings) -> list[Trial]:
        """Trials that a finding may come from, best first."""
        level = settings.false_alarms / max(self.tests, 1)
        return [
            t
            for t in self.trials
            if not t.forbidden
            and t.p_value < level
            and t.p_held < HELD_OUT_LEVEL
            and t.gain > 0
            and t.share >= max(settings.material, FEEDBACK if t.candidate.effect.sudden else 0.0)
            and not (t.candidate.effect.negligible and t.candidate.effect.negligible(t.values, self.study.sample))
        ]


@dataclass
class Search:
    """Greedy search with exchange.

    Parameters
    ----------
    study
        The data, with the model to start from.
    settings
        Error rates.
    progress
        Called with what is being done.
    """

    study: Study
    settings: Settings
    progress: Callable[[str], None] = lambda stage: None
    _states: dict[tuple[str, ...], State] = field(default_factory=dict)

    def start(self) -> State:
        """The model as configured."""
        self.progress("base fit")
        return self.state(self.study.robot, None)

    def run(self) -> State:
        """Add until nothing passes, then see whether another effect does better in each one's place."""
        state = self.start()
        own = len(self.study.robot.effects)
        been = {places_of(state)}
        while len(state.study.robot.effects) - own < MOST:
            better = self._extended(state, own, been)
            if better is None:
                break
            state = better
            been.add(places_of(state))
        return self._exchanged(state, own)

    def state(self, robot: RobotConfig, before: State | None) -> State:
        """Fit the model of a robot and try all candidates beside it; made once."""
        key = tuple(stanza.model_dump_json() for stanza in robot.effects)
        if key not in self._states:
            study, found = refit(self.study, robot, before)
            previous = Workshop(study, found.theta) if before is None else before.workshop
            workshop = previous.with_theta(study, found.theta)
            every = list(candidates(workshop))
            promising, hidden, calm = shortlist(found, workshop, every, SHORTLIST)
            judged = [judge(found, candidate, shapes, workshop, calm) for candidate, shapes in promising]
            trials = [trial for trial in judged if trial is not None]
            made = State(study, found, workshop, _ranked(trials), len(every) - len(hidden), hidden)
            self._states[key] = self._again(made)
        return self._states[key]

    def _again(self, state: State) -> State:
        """With a second look at what the simulated loop without it may have been too far off to show."""
        passing = {t.candidate.key for t in state.passing(self.settings)}
        failed = [t for t in state.trials if t.candidate.key not in passing]
        second = {}
        for trial in suspects(failed):
            again = in_its_loop(state.fit, trial)
            if again is not None:
                second[trial.candidate.key] = again
        return replace(state, trials=_ranked([second.get(t.candidate.key, t) for t in state.trials]))

    def _extended(self, state: State, own: int, been: set[Places]) -> State | None:
        """The state with the best candidate that passes and really makes the held-out error smaller, pruned.

        States that have been left before are not returned to: two effects could take each other's place for ever.
        """
        for trial in state.passing(self.settings):
            self.progress(f"adding {trial.candidate.effect.name} of {state.study.joints[trial.candidate.place.joint]}")
            extended = self.with_trial(state, trial)
            if extended is not None and nearer(extended, state, self.settings.material):
                pruned = self._pruned(extended, own)
                if places_of(pruned) not in been:
                    return pruned
        return None

    def with_trial(self, state: State, trial: Trial) -> State | None:
        """The state with what a trial found; ``None`` if the motion cannot tell it from what the model has.

        Nonlinear parameters of effects that depend on predicted torques are sought again in the loop that they make,
        and in that which these make.
        """
        effect = trial.candidate.effect
        if effect.predicts and not effect.sudden and any(shape.continuous for shape in effect.shapes):
            for _ in range(LOOPS):
                again = in_its_loop(state.fit, trial)
                if again is None or again.forbidden or again.score < trial.score:
                    break
                trial = again
        try:
            robot = added(state.study.robot, trial)
            return self.state(robot if effect.undo is None else self._put_right(robot, state, trial), state)
        except DataError:
            return None

    def _put_right(self, robot: RobotConfig, state: State, trial: Trial) -> RobotConfig:
        """With the value in its last stanza that leaves nothing more of it to find (Newton's method).

        Raises
        ------
        DataError
            If there is no such value that physics allows.
        """
        value = float(trial.values[0])
        for _ in range(ROUNDS):
            study, found = refit(self.study, robot, state)
            rest = judge(found, trial.candidate, trial.shapes, Workshop(study, found.theta))
            if rest is None:
                break
            value += float(rest.values[0])
            if not trial.candidate.effect.allows(np.array([value]), rest.std, {}):
                raise DataError(f"{trial.candidate.effect.name}: the recording cannot be put right")
            robot = valued(robot, trial.candidate.effect.linear[0].name, value)
            if abs(float(rest.values[0])) < SETTLED * abs(value):
                break
        return robot

    def _pruned(self, state: State, own: int) -> State:
        """Without effects that the ones found later have made superfluous; those of the configuration stay."""
        while True:
            doubtful = [
                (accident(state, term), k)
                for k, term in enumerate(state.study.model.terms)
                if stanza_number(state.study.robot, k) >= own
            ]
            if not doubtful or max(doubtful)[0] < NEEDED:
                return state
            worst = stanza_number(state.study.robot, max(doubtful)[1])
            robot = without(state.study.robot, worst)
            self.progress(f"taking out {state.study.robot.effects[worst].effect}")
            state = self.state(robot, state)

    def _exchanged(self, state: State, own: int) -> State:
        """Every finding competes once more, with all others in the model."""
        for k in range(own, len(state.study.robot.effects)):
            if k >= len(state.study.robot.effects):
                break
            stanza = state.study.robot.effects[k]
            rest = self.state(without(state.study.robot, k), state)
            for trial in rest.passing(self.settings)[:1]:
                effect, place = trial.candidate.effect, trial.candidate.place
                if (effect.name, state.study.joints[place.joint]) == (stanza.effect, stanza.joint):
                    continue
                other = self.with_trial(rest, trial)
                if other is not None and nearer(other, state, self.settings.material):
                    self.progress(f"{effect.name} instead of {stanza.effect}")
                    state = other
        return state


def _ranked(trials: Sequence[Trial]) -> tuple[Trial, ...]:
    return tuple(sorted(trials, key=lambda t: -t.score))


def nearer(one: State, other: State, material: float) -> bool:
    """Whether a model comes closer to the held-out torques than another, at measured or at simulated signals.

    Both count: measured positions, differentiated twice for an elastic joint, may bring more noise than the effect has
    torque, and simulated ones are only as good as the loop. Where they alone are for it, the loop with the effect in it
    must move more like the arm, too: what a model says of itself is no evidence.

    Parameters
    ----------
    material
        Share of the power of a joint's whitened error by which it must be closer where only simulated signals show it.
    """
    closer = one.study.moves_more_like_the_arm_than(other.study, held=True)
    if one.study.recorded != other.study.recorded:
        # A torque put right by a filter has less noise, whether it was wrong or not.
        return closer
    if _power(one) < _power(other):
        return True
    if not closer:
        return False
    noise = one.fit.noise
    before = other.fit.errors(other.fit.theta, held=True)
    # Of the error at measured signals, less what of it the change at simulated ones explains: those know no noise.
    after = [e - c for e, c in zip(before, _change(other, one), strict=True)]
    was, now = (_whitened_power(e, noise) for e in (before, after))
    return bool(now.sum() < was.sum() and np.any(now < (1 - material) * was))


def _power(state: State) -> float:
    """Squared norm of the held-out errors at measured signals."""
    return float(sum(np.sum(e**2) for e in state.fit.errors(state.fit.theta, held=True)))


def _change(before: State, after: State) -> list[Array]:
    """Change of the held-out torques at simulated signals from one model to another, (M, n) of every stretch."""
    pairs = zip(before.fit.equations.held, after.fit.equations.held, strict=True)
    return [applied(z1, after.fit.theta) - applied(z0, before.fit.theta) for (_, z0, _), (_, z1, _) in pairs]


def _whitened_power(errors: Sequence[Array], noise: Sequence[ArModel]) -> Array:
    """Squared norm of every joint's errors, whitened, (n,)."""
    white = whitened(errors, noise)
    joints = rows_of_joints([e.shape[0] for e in errors], noise)
    return np.array([float(white[rows] @ white[rows]) for rows in joints])


def refit(study: Study, robot: RobotConfig, before: State | None) -> tuple[Study, Fit]:
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
    elif any(term.effect.predicts for term in model.terms):
        bare = robot.model_copy(update={"effects": ()})
        rigid = fit(replace(changed, robot=bare, model=ArmModel.from_config(bare)))
        theta = np.concatenate([rigid.theta, np.zeros(model.e)])
    first = fit(changed, theta)
    moved = changed.resimulated(first.theta)
    if moved is not changed:
        first = fit(moved, first.theta if model.e else None)
    return moved, first


def padded(before: State, model: ArmModel) -> Array:
    """Rigid parameters of an earlier fit, zeros for the terms, (b,)."""
    rigid = before.fit.theta[: before.study.model.base.b - before.study.model.e]
    return np.concatenate([rigid, np.zeros(model.e)])


def accident(state: State, term: Term) -> float:
    """Chance that the linear parameters of a term are all zero (Wald test)."""
    names = state.study.model.base.names
    own = [names.index(name) for name in term.names]
    values, covariance = state.fit.theta[own], state.fit.covariance[np.ix_(own, own)]
    return float(stats.chi2.sf(values @ np.linalg.pinv(covariance) @ values, len(own)))


def with_values(state: State, shapes: Mapping[int, Mapping[str, float]] | None = None) -> RobotConfig:
    """The robot with the estimated values in its stanzas."""
    stanzas: list[Stanza] = list(state.study.robot.effects)
    for k, term in enumerate(state.study.model.terms):
        number = stanza_number(state.study.robot, k)
        own = [state.study.model.base.names.index(name) for name in term.names]
        linear = zip((p.name for p in term.linear), state.fit.theta[own], strict=True)
        found = {**term.shapes, **{name: float(value) for name, value in linear}, **dict((shapes or {}).get(k, {}))}
        stanzas[number] = stanzas[number].model_copy(update={"parameters": found})
    return state.study.robot.model_copy(update={"effects": tuple(stanzas)})


def places_of(state: State) -> Places:
    """What the model of a state has beyond the rigid one, and where, whatever the values and the order."""
    return tuple(sorted((e.effect, e.joint, e.other or "") for e in state.study.robot.effects))
