"""Stepwise selection: add the effect with the best prediction of held-out data, remove effects no longer needed."""

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
"""P-value (Wald) above which an effect found earlier is removed."""
SHORTLIST = 15
"""Number of candidates with a full test."""
LOOPS = 3
"""Most loops in which the nonlinear parameters of one effect are estimated."""
ROUNDS = 5
"""Most Newton steps for the value of one correction."""
SETTLED = 0.01
"""Relative size of the step that ends them."""
TAKEN_OVER = 0.25
"""Relative difference allowed where an effect takes over a rigid parameter."""
EXPLAINED = 0.5
"""Share of the lack of fit of a joint that a passing effect explains, if the loop simulates the arm well."""
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
        Called with the name of the step.
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
        """Model after stepwise selection: effects are added until none passes, then each is tested against others."""
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
        """Fit of the model of a robot, with trials of all candidates; cached.

        Parameters
        ----------
        robot
            Configuration of the model.
        before
            Earlier state to start from; ``None`` for the first one.
        """
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
        """State with a second test of candidates for which the simulated loop without them may be too inaccurate."""
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
        """Trials to repeat where nothing explains most of a lack of fit.

        They are corrections of recordings: with a controller identified from uncorrected recordings, the right
        correction may have the lowest score. And they are effects that make the joint reverse at other instants, also
        where they failed in spite of their score.
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
        """State with the best candidate that passes and reduces the held-out error, pruned; ``None`` if there is none.

        Earlier states are not repeated: otherwise two effects could replace each other for ever.
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
        """True if the controller can be identified after a correction of the recording, and could not before.

        This is the strongest evidence for the correction; with a stiff nominal controller scores mean little.
        """
        if trial.candidate.effect.undo is None:
            return False
        extended = self.with_trial(state, trial)
        return extended is not None and extended.study.loop in CONTROLLERS

    def with_trial(self, state: State, trial: Trial) -> State | None:
        """State with the effect of a trial; ``None`` if the motion cannot distinguish it from the model.

        Nonlinear parameters of effects that depend on predicted torques are estimated again in the loop that contains
        them, repeatedly.

        Parameters
        ----------
        state
            Model without the effect.
        trial
            Trial of the effect.
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
        """Robot with the last effect refined from neighbouring nonlinear parameters, if these fit better.

        This is done where the joint still has a lack of fit: Gauss-Newton steps may have ended in a local minimum. It
        is done for effects that depend on the motion alone, which need no simulation.
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
        """Robot with the last effect refined, with its optional parameters where they fit held-out data better.

        A bristle model carries all the dry friction of its joint, or the additional part alone.

        Parameters
        ----------
        start
            Robot with the effect without optional parameters.
        state
            Model without the effect.
        whole
            Robot with the optional parameters, as another start.
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
        """Robot with the value of its last correction at which no further correction remains (Newton's method).

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
        """State without effects that later findings have made superfluous; those of the configuration stay."""
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
        """State after every finding has competed once more, with all others in the model."""
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
    """Trial with its nonlinear parameters estimated in the loop that contains them, repeatedly.

    Those of effects that depend on the motion alone, or have jumps, stay as they are.
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
