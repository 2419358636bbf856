"""Stepwise selection of the effects that a model lacks.

Each step adds the candidate with the highest predictive score, if it is significant, material and physically possible:

1. Screening: the score statistic of every candidate at every place, in one factorisation of the model's equations.
2. Closed loop: each of the best candidates is added to the model, the loop with it is simulated, and all parameters are
   estimated with instruments from that loop.
3. Ranking by cross-validated log-likelihood (see `armident.identify.diagnosis.predictive_score`).
4. Admission of the first that is significant, material and physically possible.

Then findings that the later ones made superfluous are removed, and each finding competes once more with all others.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import special

from armident.configs import DataError, RobotConfig
from armident.identify.diagnosis.candidates import Candidate, Shapes, Workshop, candidates, grid
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.lines import residuals
from armident.identify.diagnosis.order_analysis import strongest_orders
from armident.identify.diagnosis.predictive_score import PredictiveScore
from armident.identify.diagnosis.regression import Fit
from armident.identify.diagnosis.screening import noise_beyond_shapes
from armident.identify.diagnosis.shaping import both_ends
from armident.identify.diagnosis.state import refit
from armident.identify.diagnosis.study import Study
from armident.identify.diagnosis.trial import refined, screened
from armident.identify.effects.effect import Place
from armident.identify.effects.friction import TRANSITION
from armident.identify.effects.registry import known
from armident.identify.effects.terms import Term, effect_terms, stanza_of
from armident.identify.effects.unnamed import NAME as UNNAMED

CLEAR = 3.0
"""Standard deviations of a transition of dry friction from which it is a part of the friction model."""

Array = NDArray[np.float64]
Key = tuple[str, int, int | None]


@dataclass(frozen=True, eq=False)
class ModelState:
    """Model of one step: data with its own closed loop, fit, and predictive score.

    Parameters
    ----------
    study
        Data with the model and the motion of its closed loop.
    fit
        Fit of the model.
    """

    study: Study
    fit: Fit

    @property
    def robot(self) -> RobotConfig:
        """Configuration of the model."""
        return self.study.robot

    @cached_property
    def score(self) -> PredictiveScore:
        """Predictive score on the training data."""
        return PredictiveScore(self.fit)

    @property
    def terms(self) -> tuple[Term, ...]:
        """Effects of the model."""
        return effect_terms(self.study.model)

    def values_of(self, term: Term) -> tuple[Array, Array]:
        """Linear parameters of a term and their standard deviations, (k,) each.

        Parameters
        ----------
        term
            Term of the model.
        """
        own = [self.study.model.base.names.index(name) for name in term.names]
        return self.fit.theta[own], np.sqrt(np.maximum(np.diag(self.fit.covariance)[own], 0.0))


@dataclass(frozen=True, eq=False)
class Addition:
    """A candidate in the model, tested in the closed loop that it makes.

    Parameters
    ----------
    candidate, shapes
        The effect with its place, and its nonlinear parameters.
    state
        Model with the effect.
    gain
        Gain of log-likelihood over the model without it.
    own_gain
        The same with each model under its own noise models.
    share
        Largest share of the power of a joint's predicted errors that it removes.
    material_pct
        Change of that joint's torque, percent of the root mean square of its torque.
    allowed
        False if a linear parameter has a sign or a size that physics does not allow.
    """

    candidate: Candidate
    shapes: Shapes
    state: ModelState
    gain: float
    own_gain: float
    share: float
    material_pct: float
    allowed: bool

    @property
    def named(self) -> bool:
        """True if the effect has a name."""
        return self.candidate.effect.name != UNNAMED

    @property
    def family(self) -> Key:
        """Name of the effect, whatever its law, and its place."""
        place = self.candidate.place
        name = self.candidate.effect.name if self.named else self.candidate.effect.key
        return name, place.joint, place.other


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
        Time of `time.monotonic` after which no further step begins, s.
    """

    study: Study
    criteria: Criteria = field(default_factory=Criteria)
    progress: Callable[[str], None] = lambda stage: None
    deadline: float = float("inf")
    _states: dict[str, ModelState | None] = field(default_factory=dict)
    steps: list[tuple[Addition, ...]] = field(default_factory=list)

    def start(self) -> ModelState:
        """Model as configured."""
        state = self._state(self.study.robot, None)
        assert state is not None
        if not self.study.sign_given:
            state = self._with_transitions(state)
            self.study = replace(self.study, robot=state.robot, model=state.study.model, sign_given=True)
        return state

    def _with_transitions(self, state: ModelState) -> ModelState:
        """Model with the transition of dry friction at the reversals of each joint, where it predicts better.

        The smoothed sign of the model approaches its limits slowly; other laws of friction near standstill look like
        friction that depends on the velocity (Stribeck) beside it.
        """
        effect = known(TRANSITION)
        workshop = Workshop(state.study, state.fit.theta)
        noise = state.fit.renoised(noise_beyond_shapes(state.fit, workshop))
        motion = workshop.motion(state.study.train[0], "measured")
        entries = []
        for j in range(state.robot.n):
            candidate = Candidate(effect, Place(j), grid(effect, motion, Place(j)))
            found = screened(noise, candidate, workshop)
            if found is not None and found[0] > CLEAR**2:
                shapes = refined(noise, candidate, workshop, found)
                entries.append(stanza_of(effect, Place(j), state.robot, dict(shapes)))
        while entries:
            made = self._state(state.robot.model_copy(update={"effects": (*state.robot.effects, *entries)}), state)
            if made is None:
                return state
            ratios = []
            for term in made.terms[-len(entries) :]:
                values, std = made.values_of(term)
                ratios.append(float(values[0] / std[0]))
            if min(ratios) > CLEAR:
                better = made.score.log_likelihood > state.score.log_likelihood
                return made if better else state
            entries.pop(int(np.argmin(ratios)))
        return state

    def run(self) -> ModelState:
        """Model after stepwise selection."""
        state = self.start()
        own = len(self.study.robot.effects)
        while len(state.robot.effects) - own < self.criteria.most_findings and time.monotonic() < self.deadline:
            best = self._best(state)
            if best is None:
                break
            self.progress(f"adding {best.candidate.effect.name} of {self.study.joints[best.candidate.place.joint]}")
            state = self._reduced(best.state, own)
        return state

    def additions(self, state: ModelState) -> tuple[Addition, ...]:
        """Candidates in the model, each in its own closed loop, highest log-likelihood first.

        Parameters
        ----------
        state
            Model without them.
        """
        found = [self._added(state, *one) for one in self._shortlist(state)]
        able = [a for a in found if a is not None]
        ranked = tuple(sorted(able, key=lambda a: -a.state.score.log_likelihood))
        self.steps.append(ranked)
        return ranked

    def passes(self, addition: Addition, tests: int) -> bool:
        """True if an addition is significant, material and physically possible.

        Parameters
        ----------
        addition
            The addition.
        tests
            Number of candidates among which it was found.
        """
        effect = addition.candidate.effect
        term = addition.state.terms[-1]
        values, _ = addition.state.values_of(term)
        return (
            addition.allowed
            and min(addition.gain, addition.own_gain) > np.log(max(tests, 1) / self.criteria.false_alarm_rate)
            and addition.share >= self.criteria.least_share
            and addition.material_pct >= self.criteria.material_pct
            and not (effect.negligible is not None and effect.negligible(values, self.study.sample))
        )

    def _best(self, state: ModelState) -> Addition | None:
        ranked = self.additions(state)
        tests = len(list(candidates(Workshop(state.study, state.fit.theta))))
        return next((a for a in ranked if self.passes(a, tests)), None)

    def _shortlist(self, state: ModelState) -> list[tuple[Candidate, Shapes]]:
        """Candidates with the highest score statistics less their numbers of parameters, with nonlinear parameters."""
        workshop = Workshop(state.study, state.fit.theta)
        noise = state.fit.renoised(noise_beyond_shapes(state.fit, workshop))
        looks: list[tuple[float, Candidate, tuple[float, Shapes]]] = []
        for candidate in self._with_orders(state, candidates(workshop)):
            found = screened(noise, candidate, workshop)
            if found is not None:
                looks.append((found[0] - 2.0 * len(candidate.effect.linear), candidate, found))
        looks.sort(key=lambda look: -look[0])
        named = [x for x in looks if x[1].effect.name != UNNAMED][: self.criteria.shortlist]
        unnamed = [x for x in looks if x[1].effect.name == UNNAMED][: self.criteria.unnamed]
        chosen: list[tuple[Candidate, Shapes]] = []
        for _, candidate, found in (*named, *unnamed):
            if candidate.effect.order_of:
                candidate = self._finer(state, candidate, found[1][0][1])
                found = screened(noise, candidate, workshop) or found
            shapes = refined(noise, candidate, workshop, found)
            chosen += [(candidate, ends) for ends in both_ends(noise, candidate, workshop, shapes)]
        return chosen

    def _with_orders(self, state: ModelState, every: Sequence[Candidate]) -> list[Candidate]:
        """Candidates whose order is found by order analysis get the strongest orders of the residual as their grid."""
        left = residuals(state.study, state.study.train, state.fit.theta)
        out = []
        for candidate in every:
            if candidate.effect.order_of == "motor":
                grid = tuple((("harmonic", order),) for order in self._orders(state, candidate.place, left))
                candidate = replace(candidate, grid=grid)
            out.append(candidate)
        return out

    def _orders(self, state: ModelState, place: Place, left: Sequence[Array]) -> list[float]:
        """Orders per radian of the motor of the strongest ripples of a joint's residual."""
        study, motor = state.study, place.joint
        ratios = study.robot.transmission_matrix[motor]
        angles = [s.measured.q @ ratios for s in study.train]
        speed = np.concatenate([np.abs(s.measured.qd @ ratios) for s in study.train])
        moving = speed[speed > 0.02 * speed.max()]
        slow = float(np.quantile(moving, 0.2)) if moving.size else 1.0
        cutoff = 0.5 / (study.dt * study.decimation.factor)
        joint = int(np.argmax(np.abs(ratios)))
        found = strongest_orders(angles, [e[:, joint] for e in left], 2 * np.pi * cutoff / slow)
        apart = 2 * np.pi / max(float(np.ptp(np.concatenate(angles))), 1e-12)
        return [order + shift * apart for order, _ in found for shift in (-0.5, -0.25, 0.0, 0.25, 0.5)]

    def _finer(self, state: ModelState, candidate: Candidate, order: float) -> Candidate:
        """Candidate with orders close to one order, at a sixteenth of the resolution of the motion."""
        ratios = state.study.robot.transmission_matrix[candidate.place.joint]
        apart = 2 * np.pi / max(float(np.ptp(np.concatenate([s.measured.q @ ratios for s in state.study.train]))), 1e-12)
        near = tuple((("harmonic", order + float(k) * apart / 16),) for k in range(-3, 4))
        return replace(candidate, grid=near)

    def _added(self, state: ModelState, candidate: Candidate, shapes: Shapes) -> Addition | None:
        effect = candidate.effect
        spared = tuple(p.name for p in known(effect.key).linear if p.through is not None)
        entry = stanza_of(effect, candidate.place, state.robot, dict(shapes), spared)
        made = self._state(state.robot.model_copy(update={"effects": (*state.robot.effects, entry)}), state)
        if made is None:
            return None
        term = made.terms[-1]
        values, std = made.values_of(term)
        allowed = known(effect.key).allows(term.of_effect(values), term.of_effect(std), dict(term.shapes))
        share, changed = materiality(state, made)
        return Addition(candidate, shapes, made, made.score.gain_over(state.score), made.score.log_likelihood - state.score.log_likelihood, share, changed, allowed)

    def _state(self, robot: RobotConfig, before: ModelState | None) -> ModelState | None:
        """Fit of a model in its own closed loop, cached; ``None`` if the motion does not determine its parameters."""
        key = "\n".join([str(robot.sign_smoothing), *(entry.model_dump_json() for entry in robot.effects)])
        if key not in self._states:
            try:
                self._states[key] = ModelState(*refit(self.study, robot, None if before is None else before.fit))
            except (DataError, np.linalg.LinAlgError):
                self._states[key] = None
        return self._states[key]

    def _reduced(self, state: ModelState, own: int) -> ModelState:
        """Model without findings that are not significant or material beside the others."""
        while len(state.robot.effects) - own > 1:
            weakest: tuple[float, ModelState] | None = None
            for k in range(own, len(state.robot.effects)):
                effects = (*state.robot.effects[:k], *state.robot.effects[k + 1 :])
                less = self._state(state.robot.model_copy(update={"effects": effects}), state)
                if less is None:
                    continue
                share, _ = materiality(less, state)
                gain = state.score.gain_over(less.score)
                if share < self.criteria.least_share or gain < -np.log(self.criteria.false_alarm_rate):
                    weakest = min(weakest or (gain, less), (gain, less), key=lambda one: one[0])
            if weakest is None:
                return state
            state = weakest[1]
        return state


def materiality(without: ModelState, with_it: ModelState) -> tuple[float, float]:
    """Return the largest share of a joint's error power that an effect removes, and its torque in percent there.

    Parameters
    ----------
    without, with_it
        Models without and with the effect.
    """
    before, after = without.score.rms, with_it.score.rms
    removed = np.maximum(before**2 - after**2, 0.0)
    joint = int(np.argmax(removed / np.maximum(before**2, 1e-300)))
    torque = np.concatenate([s.y[:, joint] for s in without.study.train])
    size = float(np.sqrt(np.mean(torque**2)))
    return float(removed[joint] / max(before[joint] ** 2, 1e-300)), 100 * float(np.sqrt(removed[joint])) / max(
        size, 1e-300
    )


def posterior_shares(ranked: Sequence[Addition]) -> dict[Key, float]:
    """Return the posterior probability of each effect among those tested in one step, whatever its law.

    Parameters
    ----------
    ranked
        Additions to the same model.
    """
    best: dict[Key, float] = {}
    for addition in ranked:
        if addition.allowed:
            best[addition.family] = max(best.get(addition.family, -np.inf), addition.state.score.log_likelihood)
    if not best:
        return {}
    total = special.logsumexp(list(best.values()))
    return {key: float(np.exp(value - total)) for key, value in best.items()}
