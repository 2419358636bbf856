"""One step after the other: add the effect that predicts unseen data best, take out what is no longer needed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError, RobotConfig
from armident.identify.diagnosis.candidates import Workshop, candidates
from armident.identify.diagnosis.excess import excesses
from armident.identify.diagnosis.polishing import polished, training_errors
from armident.identify.diagnosis.retrial import (
    SUSPECT,
    at_measured_signals,
    in_its_loop,
    in_one_of_their_loops,
    neighbours,
    rivals,
    suspects,
)
from armident.identify.diagnosis.screening import shortlist
from armident.identify.diagnosis.stanzas import added, completed, stanza_number, valued, without
from armident.identify.diagnosis.state import (
    FEEDBACK,
    Places,
    Settings,
    State,
    accident,
    nearer,
    places_of,
    refit,
    supersedes,
    takes_over,
)
from armident.identify.diagnosis.study import Study
from armident.identify.diagnosis.trial import Trial, best_trial, judge
from armident.identify.effects.terms import effect_terms
from armident.identify.identification.options import CONTROLLERS

Array = NDArray[np.float64]


NEEDED = 0.01
"""Chance of its estimate by accident above which an effect found earlier is taken out again."""
SHORTLIST = 15
"""Candidates that get a trial of their own."""
LOOPS = 3
"""Loops in which the nonlinear parameters of one effect are sought."""
ROUNDS = 5
"""Most times that a recording is put right for one finding, each time by what was still missing."""
SETTLED = 0.01
"""Part still missing that ends them."""
TAKEN_OVER = 0.25
"""Part of a rigid parameter that an effect may leave, or have too much, where it takes it over."""
EXPLAINED = 0.5
"""Part of what a joint leaves beyond noise that what passes there explains, where the loop is a likeness of the arm."""
MOST = 8
"""Most effects of one diagnosis."""


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
            study, found = refit(self.study, robot, None if before is None else before.fit)
            previous = Workshop(study, found.theta) if before is None else before.workshop
            workshop = previous.with_theta(study, found.theta)
            every = list(candidates(workshop))
            promising, hidden, calm = shortlist(found, workshop, every, SHORTLIST)
            judged = [judge(found, candidate, shapes, workshop, calm) for candidate, shapes in promising]
            ranked = _ranked(judged)
            others = tuple(t for t in judged if t is not None and all(t is not best for best in ranked))
            made = State(study, found, workshop, ranked, len(every) - len(hidden), hidden, others)
            self._states[key] = self._again(made)
        return self._states[key]

    def _again(self, state: State) -> State:
        """With a second look at what the simulated loop without it may have been too far off to show."""
        passing = state.passing(self.settings)
        keys = {t.candidate.key for t in passing}
        failed = [t for t in state.trials if t.candidate.key not in keys]
        second = {}
        doubtful = suspects(failed, state.no_accident(self.settings))
        for trials in [*((t,) for t in doubtful), *self._otherwise(state, passing, failed)]:
            again = in_one_of_their_loops(state.fit, trials)
            if again is not None:
                second[again.candidate.key] = _settled(state, again)
        for trial in rivals(passing):
            own = in_its_loop(state.fit, trial)
            if own is not None and own.score > trial.score and not own.forbidden:
                second[own.candidate.key] = own
        known = {t.candidate.key: t for t in state.trials} | second
        return replace(state, trials=_ranked(list(known.values())))

    def _otherwise(self, state: State, passing: Sequence[Trial], failed: Sequence[Trial]) -> list[tuple[Trial, ...]]:
        """Trials to look at again where nothing explains much of what is more than noise.

        Of what puts recordings right: a controller identified from recordings that are not makes a loop in which the
        right one may score worst. And of what makes the joint reverse at other instants, also where it failed in spite
        of its score.
        """
        joints = {
            excess.joint
            for excess in excesses(state.fit, self.settings.false_alarms)
            if all(t.share < EXPLAINED * excess.share for t in passing if t.candidate.place.joint == excess.joint)
        }
        spoken_for = {t.candidate.key for t in failed if t.score > SUSPECT}
        every = list(candidates(state.workshop))
        there = [c for c in every if c.place.joint in joints]
        recorded = (best_trial(state.fit, c, state.workshop) for c in there if c.effect.undo is not None)
        able = [(t,) for t in recorded if t is not None and not t.forbidden]
        other = [c for c in every if c.place.joint in joints or c.key in spoken_for]
        return [*able, *at_measured_signals(state.fit, other, state.workshop, FEEDBACK)]

    def _extended(self, state: State, own: int, been: set[Places]) -> State | None:
        """The state with the best candidate that passes and really makes the held-out error smaller, pruned.

        States that have been left before are not returned to: two effects could take each other's place for ever.
        """
        passing = state.passing(self.settings)
        if state.study.loop not in CONTROLLERS:
            passing = [*(t for t in passing if self._tells_the_controller(state, t)), *passing]
        for trial in passing:
            self.progress(f"adding {trial.candidate.effect.name} of {state.study.joints[trial.candidate.place.joint]}")
            extended = self.with_trial(state, trial)
            if extended is not None and nearer(extended, state, self.settings.material):
                pruned = self._pruned(extended, own)
                if places_of(pruned) not in been:
                    return pruned
        return None

    def _tells_the_controller(self, state: State, trial: Trial) -> bool:
        """Whether the controller can be identified once the recording is put right, where it could not as it was.

        Nothing speaks more for it, while beside a stand-in scores mean little.
        """
        if trial.candidate.effect.undo is None:
            return False
        extended = self.with_trial(state, trial)
        return extended is not None and extended.study.loop in CONTROLLERS

    def with_trial(self, state: State, trial: Trial) -> State | None:
        """The state with what a trial found; ``None`` if the motion cannot tell it from what the model has.

        Nonlinear parameters of effects that depend on predicted torques are sought again in the loop that they make,
        and in that which these make.
        """
        effect = trial.candidate.effect
        starts = [trial, *(t for t in state.others if t.candidate.key == trial.candidate.key and not t.forbidden)]
        trial = max((_settled(state, start) for start in starts), key=lambda t: t.score)
        try:
            robot = added(state.study.robot, trial)
            if effect.undo is not None:
                robot = polished(self.study, self._put_right(robot, state, trial), state.fit)
            else:
                robot = self._from_near_by(self._completed(robot, state), state, trial)
            return self.state(robot, state)
        except DataError:
            return None

    def _from_near_by(self, robot: RobotConfig, state: State, trial: Trial) -> RobotConfig:
        """With nonlinear parameters of the last stanza from next to where the trial has them, if these come nearer.

        Asked where the joint still leaves more than noise: steps downhill may have ended in a hollow. Of what depends
        on the motion alone, with which they cost no simulation.
        """
        if trial.candidate.effect.predicts:
            return robot
        found = refit(self.study, robot, state.fit)[1]
        joints = {excess.joint for excess in excesses(found, self.settings.false_alarms)}
        if trial.candidate.place.joint not in joints:
            return robot
        for shapes in neighbours(state.study, trial.candidate, trial.shapes):
            start = added(state.study.robot, replace(trial, shapes=shapes))
            try:
                other = self._completed(start, state, whole=completed(start))
                again = refit(self.study, other, state.fit)[1]
            except DataError:
                continue
            if training_errors(again) < training_errors(found):
                robot, found = other, again
        return robot

    def _completed(self, start: RobotConfig, state: State, whole: RobotConfig | None = None) -> RobotConfig:
        """Polished, with what belongs to the last stanza but need not be there where that comes nearer to unseen data.

        A bristle carries all the dry friction of its joint, or what is extra alone: a part of it would be another's.

        Parameters
        ----------
        whole
            With all of it, to polish from there.
        """
        robot = polished(self.study, start, state.fit)
        whole = whole or completed(robot)
        if whole is None:
            return robot
        try:
            whole = polished(self.study, whole, state.fit)
            made = [refit(self.study, one, state.fit) for one in (whole, robot)]
        except DataError:
            return robot
        with_it, without_it = (replace(state, study=study, fit=found) for study, found in made)
        all_of_it = takes_over(with_it, effect_terms(with_it.study.model)[-1], TAKEN_OVER)
        return whole if all_of_it and nearer(with_it, without_it, self.settings.material) else robot

    def _put_right(self, robot: RobotConfig, state: State, trial: Trial) -> RobotConfig:
        """With the value in its last stanza that leaves nothing more of it to find (Newton's method).

        Raises
        ------
        DataError
            If there is no such value that physics allows.
        """
        value = float(trial.values[0])
        for _ in range(ROUNDS):
            study, found = refit(self.study, robot, state.fit)
            rest = judge(found, trial.candidate, trial.shapes, Workshop(study, found.theta))
            if rest is None:
                break
            value += float(rest.values[0])
            if not trial.candidate.effect.allows(np.array([value]), rest.std, {}):
                raise DataError(f"{trial.candidate.effect.name}: the recording cannot be corrected for it")
            robot = valued(robot, trial.candidate.effect.linear[0].name, value)
            if abs(float(rest.values[0])) < SETTLED * abs(value):
                break
        return robot

    def _pruned(self, state: State, own: int) -> State:
        """Without effects that the ones found later have made superfluous; those of the configuration stay."""
        while True:
            doubtful = [
                (accident(state, term), k)
                for k, term in enumerate(effect_terms(state.study.model))
                if stanza_number(state.study.robot, k) >= own
            ]
            if not doubtful or max(doubtful)[0] < NEEDED:
                return state
            worst = stanza_number(state.study.robot, max(doubtful)[1])
            robot = without(state.study.robot, worst)
            self.progress(f"removing {state.study.robot.effects[worst].effect}")
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
                if other is not None and supersedes(other, state, self.settings.material):
                    self.progress(f"{effect.name} instead of {stanza.effect}")
                    state = other
        return state


def _settled(state: State, trial: Trial) -> Trial:
    """A trial with its nonlinear parameters sought in the loop that it makes, and in that which these make.

    Those of effects that depend on nothing but the motion, or leap, stay where they are.
    """
    effect = trial.candidate.effect
    if not effect.predicts or effect.sudden or not any(effect.refinable(state.study.robot, trial.candidate.place)):
        return trial
    for _ in range(LOOPS):
        again = in_its_loop(state.fit, trial)
        if again is None or again.forbidden or again.score < trial.score:
            break
        trial = again
    return trial


def _ranked(trials: Sequence[Trial | None]) -> tuple[Trial, ...]:
    """Best first, every candidate once."""
    best: dict[tuple[str, int, int | None], Trial] = {}
    for trial in sorted((t for t in trials if t is not None), key=lambda t: -t.score):
        best.setdefault(trial.candidate.key, trial)
    return tuple(best.values())
