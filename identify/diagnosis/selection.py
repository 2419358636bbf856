"""Stepwise selection of the effects that a model lacks.

1. Screening: the score statistic of every candidate at every place, in one factorisation of the model's equations.
2. Closed loop: each of the best candidates is added to the model, and the loop with it is simulated. All parameters are
   estimated with instruments from that loop.
3. Ranking by cross-validated log-likelihood (`armident.identify.diagnosis.comparison`).
4. Admission of the best one that is significant, material and physically possible; then the next step.
5. Findings that later ones made superfluous are removed. Each finding competes once more with the effects that act on a
   joint on which it acts.
6. Report part: a finding stays if the data that chose nothing confirm it (`armident.identify.diagnosis.confirmation`).
"""

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError, RobotConfig
from armident.configs.schema.robot import Effect as Entry
from armident.identify.diagnosis.candidates import Candidate, ColumnCache, Key, Shapes, candidates
from armident.identify.diagnosis.comparison import Addition, Made, Step, advantage, compared, gain, materiality
from armident.identify.diagnosis.confirmation import Confirmation, confirmed
from armident.identify.diagnosis.corrections import screened_correction
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.model_state import (
    ModelState,
    acted_on,
    fitted,
    viscous_friction_rises,
    with_entries,
    with_first_motions,
    with_own_noise,
    with_references,
    with_report_part,
    without_entry,
)
from armident.identify.diagnosis.order_analysis import motor_orders, nearby_orders
from armident.identify.diagnosis.precision import p_value
from armident.identify.diagnosis.screening import contained, refined, screened
from armident.identify.diagnosis.shaping import both_ends
from armident.identify.diagnosis.study import Study
from armident.identify.diagnosis.transitions import with_transitions
from armident.identify.effects.drive import Correction
from armident.identify.effects.recorded import of_recording
from armident.identify.effects.registry import known
from armident.identify.effects.tables import FreeShape
from armident.identify.effects.terms import entry_of
from armident.identify.effects.transmission import MotorOrder
from armident.identify.effects.unnamed import NAME as UNNAMED

Array = NDArray[np.float64]
Starts = tuple[float, ...]
"""Values from which the correction of a recorded torque starts; empty for a term of the model."""

CORRECTIONS = 3
"""Values of a correction from each start, each refined by the expansion that remains."""
CLEAR = 3.0
"""Gain of log-likelihood from which another shift of all torques is chosen: odds of 20 to 1."""


@dataclass(frozen=True, eq=False)
class Selected:
    """An effect that was selected.

    Parameters
    ----------
    entry
        Its entry in the configuration.
    step
        Step in which it was compared with the others, without it in the model.
    addition
        Test of the effect in that step.
    confirmation
        Comparison of the final models with and without it on the report part; ``None`` before that.
    without
        Final model without it; ``None`` before the comparison.
    p_value
        Probability of its parameters in the final model if it is not there.
    """

    entry: Entry
    step: Step
    addition: Addition
    confirmation: Confirmation | None = None
    without: ModelState | None = None
    p_value: float = 0.0

    def conventional(self, state: ModelState, uncertain: float) -> bool:
        """True if the effect is a part of every model, or within the sampling convention of drives: no finding.

        Parameters
        ----------
        state
            Final model.
        uncertain
            Time by which the common instant of all torques is uncertain, s.
        """
        effect = self.addition.candidate.effect
        if of_recording(self.entry):
            values = np.array([self.entry.parameters[p.name] for p in effect.linear])
        else:
            values = state.values_of(state.term_of(self.entry))[0]
        return effect.is_convention(values, uncertain)


@dataclass(frozen=True, eq=False)
class Contested:
    """A finding with which other effects compete.

    Parameters
    ----------
    gain
        Its gain of log-likelihood beside the other findings, nats.
    joints
        Joints on whose torques it acts, (n,). An effect that acts on none of them cannot take its place.
    """

    gain: float
    joints: NDArray[np.bool_]


@dataclass
class StepwiseSelection:
    """Selection of the effects of one diagnosis.

    Parameters
    ----------
    study
        Data with the model as configured.
    criteria
        Thresholds.
    progress
        Called with the name of each step.
    deadline
        Time of `time.monotonic` after which no further step begins and the current one is dropped, s.
    tested
        Called with the share of a step's candidates that have been tested, 0 to 1.
    shifts
        Common shifts of all torques between which the check of the set-up could not decide, samples.
    """

    study: Study
    criteria: Criteria = field(default_factory=Criteria)
    progress: Callable[[str], None] = lambda stage: None
    deadline: float = float("inf")
    tested: Callable[[float], None] = lambda share: None
    shifts: tuple[float, ...] = ()
    stopped: bool = False
    hidden: frozenset[Key] = frozenset()
    immaterial: tuple[Addition, ...] = ()
    _states: dict[str, ModelState | None] = field(default_factory=dict)
    _steps: dict[str, Step] = field(default_factory=dict)
    _visited: set[str] = field(default_factory=set)

    def start(self) -> ModelState:
        """Model as configured, with the transition of dry friction at reversals where the configuration leaves it free.

        Raises
        ------
        DataError
            If the motion does not determine the parameters of the model.
        """
        state = self._aligned(fitted(self.study, self.study.robot, None))
        self.study = state.study
        if not self.study.sign_given:
            state = with_own_noise(with_transitions(state, self._state))
        state = with_references(with_first_motions(state))
        self.study = replace(self.study, robot=state.robot, model=state.study.model, references=state.study.references)
        self._states[_key(state.robot)] = state
        return state

    def run(self, first: ModelState) -> tuple[ModelState, tuple[Selected, ...]]:
        """Select effects.

        Parameters
        ----------
        first
            Model to start from, of `start`.

        Returns
        -------
        tuple
            Model with the effects, and the effects: those with a name first, then by reduction of the errors.
        """
        state = first
        found: tuple[Selected, ...] = ()
        while len(found) < self.criteria.most_findings and not self._late():
            step = self.step(state)
            best = self.admitted(step)
            if best is None:
                break
            name = self.study.joints[best.candidate.place.joint]
            self.progress(f"adding {best.candidate.effect.name.replace('_', ' ')} of {name}")
            found = (*found, Selected(best.entry, step, best))
            state, found = self._reduced(best.state, found)
            state = with_first_motions(state)
        # Removing a finding changes the comparison of the others of its joints.
        changed: NDArray[np.bool_] | None = None
        while True:
            state, found = self._exchanged(state, found, changed)
            less, kept = self._confirmed(state, found)
            if len(kept) == len(found):
                return (self._final(less), kept) if kept else (first, ())
            changed = acted_on(state, less)
            state, found = less, kept

    def _final(self, state: ModelState) -> ModelState:
        """Model with noise models of its own residual, and with the controller that its corrected torques identify."""
        if state.study.recorded != self.study.recorded:
            with contextlib.suppress(DataError):
                state = fitted(state.study.with_own_controller(), state.robot, state)
        return with_own_noise(state)

    def step(self, state: ModelState, contested: Contested | None = None) -> Step:
        """Compare all candidates in a model.

        Parameters
        ----------
        state
            Model without them.
        contested
            Finding that the model is without, if only effects that could take its place are compared: those that act
            on a joint on which it acts, and do not promise much less.
        """
        key = _key(state.robot)
        if key in self._steps:
            return self._steps[key]
        shortlist, tests = self._shortlist(state, contested)
        made: list[Made] = []
        for k, one in enumerate(shortlist):
            self.tested(k / len(shortlist))
            if self._late():
                # An effect is admitted only against all others.
                return Step(state, (), (), (), tests)
            made += [m for m in (self._made(state, *one),) if m is not None]
        step = compared(state, made, tests, self.passes)
        if contested is None:
            self._steps[key] = step
        self._release()
        return step

    def _needed(self, tests: int) -> float:
        """Gain of log-likelihood of a significant effect, found among a number of candidates."""
        return -float(np.log(self._level(tests)))

    def _level(self, tests: int) -> float:
        """Significance level of one of a number of candidates."""
        return self.criteria.alpha["selection"] / max(tests, 1)

    def _release(self) -> None:
        """Free the equations of all models: hundreds are compared, and few are used again."""
        for state in self._states.values():
            if state is not None:
                state.release()

    @property
    def compared(self) -> int:
        """Number of models in which all candidates were compared."""
        return len(self._steps)

    def last(self, state: ModelState) -> Step | None:
        """Comparison of all candidates in a model, if it has been made.

        Parameters
        ----------
        state
            The model.
        """
        return self._steps.get(_key(state.robot))

    def passes(self, addition: Addition, tests: int) -> bool:
        """True if an addition is significant, material and physically possible.

        A ratio of likelihoods of ``r`` has at most the probability ``1 / r`` without the effect (Ville 1939), so that
        no null distribution is needed. The parameters of the effect differ from zero at the same level by their own
        standard deviations.

        Parameters
        ----------
        addition
            The addition.
        tests
            Number of candidates among which it was found.
        """
        return (
            addition.allowed
            and addition.gain > self._needed(tests)
            and addition.share >= self.criteria.least_share
            and addition.material_pct >= self.criteria.material_pct
            and addition.p_value < self._level(tests)
        )

    def admitted(self, step: Step) -> Addition | None:
        """Addition that the step admits: the best law of the best effect; ``None`` if there is none.

        An effect with a name is admitted only if no other explanation of the same joint is clearly better. Even one
        that is too small to be a finding counts. A term without a name claims no cause. An effect with a name comes
        first if it explains most of what the best term without a name does. Of the laws of one effect that predict as
        well, that with the fewest parameters comes first, and a free shape last.

        Parameters
        ----------
        step
            The step.
        """
        able = [a for a in step.passing if not (a.named and self._superseded(a, step))]
        if not able:
            return None
        best = able[0]
        if not best.named:
            named = [a for a in able if a.named and a.share >= self.criteria.named_share * best.share]
            best = named[0] if named else best
        close = best.log_likelihood - self.criteria.close
        same = [a for a in able if a.family == best.family and a.log_likelihood > close]
        return min(same, key=lambda a: (isinstance(a.candidate.effect, FreeShape), len(a.candidate.effect.linear)))

    def _superseded(self, addition: Addition, step: Step) -> bool:
        """True if an explanation of the same joint that does not pass is clearly better than an addition.

        It has to reduce the errors of a joint. Corrections of recorded torques may only make them whiter.
        """
        better = (a for a in step.rivals(addition) if a not in step.passing and a.share > 0.0)
        return any(a.log_likelihood > addition.log_likelihood + self.criteria.close for a in better)

    def _late(self) -> bool:
        self.stopped = self.stopped or time.monotonic() > self.deadline
        return self.stopped

    def _aligned(self, state: ModelState) -> ModelState:
        """Model with the common shift of the torques with which the base fit predicts clearly better.

        A joint may have an effect that looks like a shift: the evidence of each is limited. A loop that follows the
        measured motion contains disturbances, whose feedback looks like a shift, too.
        """
        if state.study.loop == "nominal" or not self.shifts:
            return state
        models = [fitted(state.study.with_torque_shift(shift), state.robot, state) for shift in self.shifts]
        scores = np.array([model.score.log_likelihoods_under(state.weights) for model in models])
        evidence = np.clip(scores - scores[0], -CLEAR, CLEAR).sum(axis=1)
        best = int(np.argmax(evidence))
        if evidence[best] <= CLEAR:
            return state
        line = (
            f"all torques are late by {self.shifts[best]:.2f} samples against torques held until the next sample: the "
            "base fit shows it, the check of the set-up does not decide; the diagnosis aligns its equations with it"
        )
        study = models[best].study
        return replace(models[best], study=replace(study, warnings=(*study.warnings, line)))

    def _shortlist(
        self, state: ModelState, contested: Contested | None
    ) -> tuple[list[tuple[Candidate, Shapes, Starts]], int]:
        """Candidates with the highest statistics less their numbers of parameters, and the number of all.

        Each has its nonlinear parameters, or the values from which its correction of recorded torques starts.
        """
        column_cache = ColumnCache(state.study, state.fit.theta)
        noise = state.fit.renoised(state.weights)
        looks: list[tuple[float, Candidate, tuple[float, Shapes], Starts]] = []
        tests, hidden = 0, set()
        for every in candidates(column_cache):
            candidate = every
            tests += 1
            if contested is not None and not contested.joints[column_cache.joints(candidate)].any():
                continue
            if isinstance(candidate.effect, MotorOrder):
                candidate = replace(candidate, grid=motor_orders(state.study, state.fit.theta, candidate.place.joint))
            found: tuple[float, Shapes] | None
            starts: Starts = ()
            if isinstance(candidate.effect, Correction):
                statistic, starts = screened_correction(noise, candidate, column_cache)
                found = statistic, ()
            else:
                found = screened(noise, candidate, column_cache)
            if found is None:
                hidden.add(candidate.key)
            else:
                looks.append((found[0] - 2.0 * len(candidate.effect.linear), candidate, found, starts))
        if not self._steps:
            self.hidden = frozenset(hidden)
        # A score statistic is twice the gain of log-likelihood that it promises. A correction needs all of it: its
        # likelihood also rewards smaller noise.
        needed, promising = self._needed(tests), self.criteria.promising
        present = 0.0 if contested is None else contested.gain
        looks = [x for x in looks if 0.5 * x[2][0] > max(needed * (1.0 if x[3] else promising), promising * present)]
        looks.sort(key=lambda look: -look[0])
        named = [x for x in looks if x[1].effect.name != UNNAMED][: self.criteria.shortlist]
        unnamed = [x for x in looks if x[1].effect.name == UNNAMED][: self.criteria.unnamed]
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
            for ends in both_ends(noise, candidate, column_cache, shapes):
                without = contained(noise, candidate, column_cache, ends)
                chosen.append((replace(candidate, without=without), ends, ()))
        return chosen, tests

    def _made(self, state: ModelState, candidate: Candidate, shapes: Shapes, starts: Starts) -> Made | None:
        effect, whole = candidate.effect, known(candidate.effect.key)
        spared = (*(p.name for p in whole.linear if p not in effect.linear), *candidate.without)
        entry = entry_of(effect, candidate.place, state.robot, dict(shapes), spared)
        made = self._state(with_entries(state.robot, [entry]), state)
        if made is None:
            return None
        term = made.term_of(entry)
        values, std = made.values_of(term)
        allowed = whole.allows(term.of_effect(values), term.of_effect(std), dict(term.shapes))
        allowed = allowed and viscous_friction_rises(made, term)
        one = Made(candidate, shapes, entry, made, allowed)
        if not starts:
            return one
        corrected = self._corrected(state, candidate, entry, (float(values[0]), *starts) if allowed else starts)
        return one if corrected is None else max((one, corrected), key=lambda m: (m.allowed, gain(m.state, state)))

    def _corrected(self, state: ModelState, candidate: Candidate, entry: Entry, starts: Starts) -> Made | None:
        """Model in which the recordings are corrected for an effect on a recorded torque.

        The first-order expansion beside the corrected torque refines the value, until what remains is within its
        standard deviation. Where that does not come about, the value with the largest gain is chosen.

        Parameters
        ----------
        state
            Model without the effect.
        candidate
            The effect.
        entry
            Its entry without a value: the first-order expansion.
        starts
            Values to start from.
        """
        name = candidate.effect.linear[0].name
        found: list[Made] = []
        for start in starts:
            value = start
            for _ in range(CORRECTIONS):
                right = entry.model_copy(update={"parameters": {**entry.parameters, name: value}})
                exact = self._state(with_entries(state.robot, [right]), state)
                further = None if exact is None else self._state(with_entries(exact.robot, [entry]), exact)
                if exact is None:
                    break
                allowed = candidate.effect.allows(np.array([value]), np.zeros(1), {})
                found.append(Made(candidate, (), right, exact, allowed))
                if further is None:
                    break
                rest, std = (float(x[0]) for x in further.values_of(further.term_of(entry)))
                if abs(rest) < std and allowed:
                    return found[-1]
                value += rest
        return max(found, key=lambda made: (made.allowed, gain(made.state, state)), default=None)

    def _state(self, robot: RobotConfig, before: ModelState) -> ModelState | None:
        """Fit of a model in its own closed loop, cached; ``None`` if the motion does not determine its parameters."""
        key = _key(robot)
        if key not in self._states:
            try:
                self._states[key] = fitted(self.study, robot, before)
            except (DataError, np.linalg.LinAlgError):
                self._states[key] = None
        return self._states[key]

    def _without(self, state: ModelState, entry: Entry) -> ModelState | None:
        """The model without one of its effects."""
        return self._state(without_entry(state.robot, entry), state)

    def _reduced(self, state: ModelState, found: tuple[Selected, ...]) -> tuple[ModelState, tuple[Selected, ...]]:
        """Model without findings that later ones made insignificant or immaterial."""
        while len(found) > 1:
            weak: list[tuple[float, ModelState, Selected]] = []
            for one in found[:-1]:
                less = self._without(state, one.entry)
                if less is None:
                    continue
                if self._superfluous(state, less, one.step.tests):
                    weak.append((gain(state, less), less, one))
            if not weak:
                break
            _, state, gone = min(weak, key=lambda one: one[0])
            found = tuple(one for one in found if one is not gone)
        return state, found

    def _superfluous(self, state: ModelState, less: ModelState, tests: int) -> bool:
        """True if a finding is insignificant or immaterial beside the others of a model.

        Parameters
        ----------
        state, less
            Models with and without it.
        tests
            Number of candidates among which it was found.
        """
        share, changed = materiality(less, state)
        material = share >= self.criteria.least_share and changed >= self.criteria.material_pct
        return not material or gain(state, less) < self._needed(tests)

    def _exchanged(
        self, state: ModelState, found: tuple[Selected, ...], changed: NDArray[np.bool_] | None = None
    ) -> tuple[ModelState, tuple[Selected, ...]]:
        """Model whose findings have competed with the other effects on their joints, beside the findings made later.

        A rival makes the finding superfluous; an effect beside which it stays explains something else. No exchange
        returns to an earlier model: each could prefer its own noise models.

        Parameters
        ----------
        state, found
            Model with the findings, and the findings.
        changed
            Joints whose models changed since the findings last competed, (n,); ``None`` for all.
        """
        self._visited.add(_key(state.robot))
        for one in found:
            less = None if self._late() else self._without(state, one.entry)
            if less is None:
                continue
            joints = acted_on(state, less)
            if changed is not None and not joints[changed].any():
                continue
            self.progress(f"exchanging {one.entry.effect.replace('_', ' ')} of {one.entry.joint}")
            step = self.step(less, Contested(gain(state, less), joints))
            best = self.admitted(step)
            if best is None or best.family == one.addition.family or _key(best.state.robot) in self._visited:
                continue
            both = self._state(with_entries(best.state.robot, [one.entry]), best.state)
            rival = both is None or self._superfluous(both, best.state, one.step.tests)
            if rival and advantage(best.made.state, state) > self.criteria.close:
                other = Selected(best.entry, step, best)
                state, found = with_first_motions(best.state), tuple(other if f is one else f for f in found)
                self._visited.add(_key(state.robot))
        return state, found

    def _confirmed(self, state: ModelState, found: tuple[Selected, ...]) -> tuple[ModelState, tuple[Selected, ...]]:
        """Model with the findings that the report part confirms: those with a name, then by reduction of the errors.

        The models are compared as they are reported: each estimated under the noise models of its own residual.
        """
        self.progress("confirmation by the report part")
        while True:
            held = with_report_part(with_own_noise(state))
            checked: list[tuple[Selected, ModelState]] = []
            for one in found:
                less = self._without(state, one.entry)
                if less is not None:
                    final = with_own_noise(less)
                    report = confirmed(held, with_report_part(final))
                    tested = replace(one, confirmation=report, without=final, p_value=p_value(held, one.entry))
                    checked.append((tested, less))
            failed = [(one, less) for one, less in checked if not self._holds(one)]
            if not failed:
                return state, tuple(sorted((one for one, _ in checked), key=_order, reverse=True))
            gone, state = max(
                failed, key=lambda one: 1.0 if one[0].confirmation is None else one[0].confirmation.p_value
            )
            assert gone.confirmation is not None
            if not self._material(gone.confirmation):
                self.immaterial = (*self.immaterial, gone.addition)
            found = tuple(one for one in found if one.entry is not gone.entry)

    def _holds(self, one: Selected) -> bool:
        """True if the report part confirms a finding: the change goes the same way, and is material there, too.

        Its parameters still differ from zero beside all others.
        """
        report = one.confirmation
        assert report is not None
        determined = one.p_value < self._level(one.step.tests)
        significant = report.p_value < self.criteria.confirmation_level
        return determined and significant and report.smaller and self._material(report)

    def _material(self, report: Confirmation) -> bool:
        """True if the errors of one joint on which it acts fall by enough, relative to them and to its torque."""
        enough = (report.share >= self.criteria.least_share) & (report.change >= self.criteria.material_pct)
        return bool((enough & report.acts).any())


def _order(one: Selected) -> tuple[bool, float]:
    """True if a finding has a name, and its reduction of the errors of the report part, beside all others."""
    assert one.confirmation is not None
    return one.addition.named, one.confirmation.reduction


def _key(robot: RobotConfig) -> str:
    """Identity of a model: its effects, whatever their order."""
    return "\n".join(sorted(entry.model_dump_json() for entry in robot.effects))
