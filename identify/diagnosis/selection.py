"""Stepwise selection of the effects that a model lacks.

1. Screening: score statistic of every candidate at every place (`shortlist`).
2. Closed loop: the best candidates are added, simulated and estimated with instruments (`candidate_models`).
3. Ranking by cross-validated log-likelihood (`candidate_comparison`).
4. Admission of the best significant, material and physically possible one; then the next step.
5. Superfluous findings are removed. Each competes once more with the effects on its joints.
6. Report part: findings that data not used for selection confirm stay (`confirmation`).
"""

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError, RobotConfig
from armident.configs.schema.robot import Effect as Entry
from armident.identify.diagnosis.candidate_comparison import (
    Addition,
    FittedCandidate,
    SelectionStep,
    advantage,
    compared_candidates,
    gain,
    materiality,
)
from armident.identify.diagnosis.candidate_models import model_with
from armident.identify.diagnosis.candidates import ColumnCache, Key
from armident.identify.diagnosis.confirmation import confirmed
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.model_state import (
    ModelState,
    acted_on,
    fitted,
    with_entries,
    with_first_motions,
    with_own_noise,
    with_references,
    with_report_part,
    without_entry,
)
from armident.identify.diagnosis.noise_beyond import noise_sizes
from armident.identify.diagnosis.precision import p_value_of_effect
from armident.identify.diagnosis.selected import Selected
from armident.identify.diagnosis.shortlist import Incumbent, shortlist
from armident.identify.diagnosis.study import Study
from armident.identify.diagnosis.transitions import with_transitions
from armident.identify.effects.free_shapes import FreeShape
from armident.identify.effects.recording_corrections import of_recording


@dataclass
class StepwiseSelection:
    """Selection of the effects of one diagnosis; ``shifts``: undecided common shifts of all torques, samples.

    ``progress``, ``tested``: called with the name of each step, and the share of its candidates done. At ``deadline``
    of `time.monotonic`, s, the current step is dropped.
    """

    study: Study
    progress: Callable[[str], None] = lambda stage: None
    deadline: float = float("inf")
    tested: Callable[[float], None] = lambda share: None
    shifts: tuple[float, ...] = ()
    stopped: bool = False
    hidden: frozenset[Key] = frozenset()
    immaterial: tuple[Addition, ...] = ()
    absent: tuple[Addition, ...] = ()
    _states: dict[str, ModelState | None] = field(default_factory=dict)
    _steps: dict[str, SelectionStep] = field(default_factory=dict)
    _studies: dict[str, Study] = field(default_factory=dict)
    _visited: set[str] = field(default_factory=set)
    _alike: set[Key] = field(default_factory=set)

    @property
    def criteria(self) -> Criteria:
        """Thresholds."""
        return self.study.criteria

    def start(self) -> ModelState:
        """Model as configured, with the transition of dry friction at reversals that the configuration leaves free."""
        state = self._aligned(fitted(self.study, self.study.robot, None))
        self.study = state.study
        if not self.study.sign_given:
            state = with_own_noise(with_transitions(self._with_noise_sizes(state), self._state))
        state = self._with_noise_sizes(state)
        state = with_references(with_first_motions(state))
        own = state.study
        self.study = replace(self.study, robot=state.robot, model=own.model, references=own.references, tied=own.tied)
        self._states[_key(state.robot)] = state
        return state

    def run(self, first: ModelState) -> tuple[ModelState, tuple[Selected, ...]]:
        """Select effects, from a model of `start`; those with a name come first, then by reduction of the errors."""
        state = first
        found: tuple[Selected, ...] = ()
        seen = {_key(first.robot)}
        while len(found) < self.criteria.most_findings and not self._late():
            step = self.step(state)
            best = self.admitted(step)
            if best is None:
                break
            name = self.study.joints[best.candidate.place.joint]
            self.progress(f"adding {best.candidate.effect.name.replace('_', ' ')} of {name}")
            found = (*found, Selected(best.entry, step, best))
            state, found = self._reduced(best.state, found)
            if _key(state.robot) in seen:
                # Effects that make each other superfluous: one of them is in the model, and competes with the other.
                break
            seen.add(_key(state.robot))
            state = with_first_motions(state)
        # Removing a finding changes the comparison of the others of its joints.
        changed: NDArray[np.bool_] | None = None
        while True:
            state, found = self._exchanged(state, found, changed)
            less, kept = self._confirmed(state, found)
            if len(kept) == len(found):
                return (with_own_noise(less), kept) if kept else (first, ())
            changed = acted_on(state, less)
            state, found = less, kept

    def step(self, state: ModelState, incumbent: Incumbent | None = None) -> SelectionStep:
        """Compare all candidates in a model; with an ``incumbent``, those on its joints that promise hardly less."""
        key = _key(state.robot)
        if key in self._steps:
            return self._steps[key]
        found = shortlist(state, incumbent, self._alike)
        if not self._steps:
            self.hidden = found.hidden
        made: list[FittedCandidate] = []
        for k, one in enumerate(found.chosen):
            self.tested(k / len(found.chosen))
            if self._late():
                # An effect is admitted only against all others.
                return SelectionStep(state, (), (), (), found.tests)
            made += [m for m in (model_with(state, *one, self._state),) if m is not None]
        step = compared_candidates(state, made, found.tests, self.passes)
        if incumbent is None:
            self._steps[key] = step
        self._release()
        return step

    def _release(self) -> None:
        """Free the equations of all models: hundreds are compared, and few are used again."""
        for state in self._states.values():
            if state is not None:
                state.release()

    @property
    def compared(self) -> int:
        """Number of models in which all candidates were compared."""
        return len(self._steps)

    def last(self, state: ModelState) -> SelectionStep | None:
        """Comparison of all candidates in a model, if it has been made."""
        return self._steps.get(_key(state.robot))

    def passes(self, addition: Addition, tests: int) -> bool:
        """True if an addition, found among ``tests`` candidates, is significant, material and physically possible.

        Without the effect, a likelihood ratio of ``r`` has at most the probability ``1 / r`` (Ville 1939).
        """
        return (
            addition.allowed
            and addition.gain > self.criteria.needed_gain(tests)
            and addition.share >= self.criteria.least_share
            and addition.material_pct >= self.criteria.material_pct
            and addition.p_value < self.criteria.selection_level(tests)
        )

    def admitted(self, step: SelectionStep) -> Addition | None:
        """Addition that the step admits: the best law of the best effect; ``None`` if there is none.

        A named effect is admitted if no explanation of its joint, even one too small for a finding, is clearly better.
        It comes first if it explains most of what the best unnamed term does. Of laws that explain about as much, the
        fewest parameters come first.
        """
        able = [a for a in step.passing if not (a.named and self._superseded(a, step))]
        if not able:
            return None
        best = able[0]
        if not best.named:
            named = [a for a in able if a.named and a.share >= self.criteria.named_share * best.share]
            best = named[0] if named else best
        same = [a for a in able if a.family == best.family and not self._explains_more(best, a)]
        return min(same, key=lambda a: (isinstance(a.candidate.effect, FreeShape), len(a.candidate.effect.linear)))

    def _explains_more(self, one: Addition, other: Addition) -> bool:
        """True if a law of an effect is clearly better than another one, and by as much as a finding has to be."""
        share = (one.share - other.share) / max(1.0 - other.share, 1e-300)
        changed = float(np.sqrt(max(one.material_pct**2 - other.material_pct**2, 0.0)))
        return (
            one.log_likelihood > other.log_likelihood + self.criteria.close
            and share >= self.criteria.least_share
            and changed >= self.criteria.material_pct
        )

    def _superseded(self, addition: Addition, step: SelectionStep) -> bool:
        """True if another explanation of the same joint is better than an addition.

        One that does not pass has to be clearly more likely, and to reduce the errors of a joint. The likelihood of
        corrected torques rewards smaller noise, too: for them, significance decides against effects that pass, and has
        to agree with the likelihood otherwise.
        """
        for a in step.rivals(addition):
            corrections = of_recording(a.entry), of_recording(addition.entry)
            clearer = corrections[0] == corrections[1] or a.p_value < addition.p_value
            better = a.log_likelihood > addition.log_likelihood + self.criteria.close
            if a not in step.passing and a.share > 0.0 and better and clearer:
                return True
            alike = a.named and a.candidate.place.joint == addition.candidate.place.joint
            if a in step.passing and alike and corrections == (False, True) and clearer:
                return True
        return False

    def _late(self) -> bool:
        self.stopped = self.stopped or time.monotonic() > self.deadline
        return self.stopped

    def _aligned(self, state: ModelState) -> ModelState:
        """Model with the common shift of the torques with which the base fit predicts clearly better.

        The evidence of each joint is limited: an effect, or feedback of disturbances, may look like a shift.
        """
        if not self.shifts:
            return state
        models = [fitted(state.study.with_torque_shift(shift), state.robot, state) for shift in self.shifts]
        scores = np.array([model.score.log_likelihoods_under(state.weights) for model in models])
        close = self.criteria.close
        evidence = np.clip(scores - scores[0], -close, close).sum(axis=1)
        best = int(np.argmax(evidence))
        if evidence[best] <= close:
            return state
        line = (
            f"all torques are late by {self.shifts[best]:.2f} samples against torques held until the next sample: the "
            "base fit shows it, the check of the set-up does not decide; the diagnosis aligns its equations with it"
        )
        study = models[best].study
        return models[best].of_study(replace(study, warnings=(*study.warnings, line)))

    def _with_noise_sizes(self, state: ModelState) -> ModelState:
        """Return the model fitted again with the size of the noise of each recording."""
        if len(state.study.train) == 1:
            return state
        sizes = noise_sizes(state.fit, ColumnCache(state.study, state.fit.theta))
        state = with_own_noise(fitted(state.study.with_noise(sizes), state.robot, state))
        self.study, self._states = state.study, {}
        return state

    def _state(self, robot: RobotConfig, before: ModelState) -> ModelState | None:
        """Fit of a model in its own closed loop, cached; ``None`` if the motion does not determine its parameters."""
        key = _key(robot)
        if key not in self._states:
            try:
                self._states[key] = fitted(self._study_of(robot), robot, before)
            except (DataError, np.linalg.LinAlgError):
                self._states[key] = None
        return self._states[key]

    def _study_of(self, robot: RobotConfig) -> Study:
        """The study with the torques that a model corrects, and with the controller that these identify.

        The controller of a late torque may make a loop that swings, whose motion shows nothing.
        """
        recorded = tuple(entry for entry in robot.effects if of_recording(entry))
        if recorded == self.study.recorded:
            return self.study
        key = _key(robot.model_copy(update={"effects": recorded}))
        if key not in self._studies:
            study = self.study.of_robot(robot)
            with contextlib.suppress(DataError):
                study = study.with_own_controller()
            self._studies[key] = study
        return self._studies[key]

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
        """True if a finding, selected among ``tests``, is insignificant or immaterial beside the others of a model."""
        share, changed = materiality(less, state)
        material = share >= self.criteria.least_share and changed >= self.criteria.material_pct
        return not material or gain(state, less) < self.criteria.needed_gain(tests)

    def _exchanged(
        self, state: ModelState, found: tuple[Selected, ...], changed: NDArray[np.bool_] | None = None
    ) -> tuple[ModelState, tuple[Selected, ...]]:
        """Model whose findings have competed with the other effects on joints ``changed`` (n,), beside later findings.

        A rival makes a finding superfluous. No return to an earlier model: each could prefer its own noise models.
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
            step = self.step(less, Incumbent(gain(state, less), joints))
            best = self.admitted(step)
            if best is None or best.family == one.addition.family or _key(best.state.robot) in self._visited:
                continue
            both = self._state(with_entries(best.state.robot, [one.entry]), best.state)
            rival = both is None or self._superfluous(both, best.state, one.step.tests)
            if rival and advantage(best.fitted.state, state) > self.criteria.close:
                other = Selected(best.entry, step, best)
                state, found = with_first_motions(best.state), tuple(other if f is one else f for f in found)
                self._visited.add(_key(state.robot))
        return state, found

    def _confirmed(self, state: ModelState, found: tuple[Selected, ...]) -> tuple[ModelState, tuple[Selected, ...]]:
        """Model with the findings that the report part confirms: those with a name, then by reduction of the errors.

        Each model is estimated under the noise models of its own residual, as it is reported.
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
                    tested = replace(
                        one, confirmation=report, without=final, p_value=p_value_of_effect(held, one.entry)
                    )
                    checked.append((tested, less))
            failed = [(one, less) for one, less in checked if not self._holds(one)]
            if not failed:
                return state, tuple(sorted((one for one, _ in checked), key=_order, reverse=True))
            gone, state = max(
                failed, key=lambda one: 1.0 if one[0].confirmation is None else one[0].confirmation.p_value
            )
            assert gone.confirmation is not None
            if not gone.confirmation.is_material(self.criteria, named=gone.addition.named):
                self.immaterial = (*self.immaterial, gone.addition)
            strong = gone.addition.named and gone.addition.share >= self.criteria.named_share
            if strong and gone.confirmation.absent:
                self.absent = (*self.absent, gone.addition)
            found = tuple(one for one in found if one.entry is not gone.entry)

    def _holds(self, one: Selected) -> bool:
        """True if the report part confirms a finding: same direction, material, and parameters still significant."""
        report = one.confirmation
        assert report is not None
        determined = one.p_value < self.criteria.selection_level(one.step.tests)
        significant = report.p_value < self.criteria.confirmation_level
        material = report.is_material(self.criteria, named=one.addition.named)
        return determined and significant and report.smaller and material


def _order(one: Selected) -> tuple[bool, float]:
    """True if a finding has a name, and its reduction of the errors of the report part, beside all others."""
    assert one.confirmation is not None
    return one.addition.named, one.confirmation.reduction


def _key(robot: RobotConfig) -> str:
    """Identity of a model: its effects, whatever their order."""
    return "\n".join(sorted(entry.model_dump_json() for entry in robot.effects))
