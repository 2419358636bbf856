"""Comparison of the candidates of one step of the selection."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from armident.configs.schema.robot import Effect as Entry
from armident.identify.diagnosis.candidates import Candidate, Key, Shapes
from armident.identify.diagnosis.model_state import ModelState, acted_on
from armident.identify.diagnosis.precision import p_value_of_effect
from armident.identify.diagnosis.predictive_score import mean_square
from armident.identify.effects.unnamed import NAME as UNNAMED
from armident.identify.regression.ar_noise import ArModel


@dataclass(frozen=True, eq=False)
class FittedCandidate:
    """A fitted candidate; ``allowed`` is false if a linear parameter has a sign or a size that physics excludes."""

    candidate: Candidate
    shapes: Shapes
    entry: Entry
    state: ModelState
    allowed: bool


@dataclass(frozen=True, eq=False)
class Addition:
    """A candidate in the model, compared with the model without it under the noise models of the step.

    ``raw_gain``: without serial correlation beyond them. ``share``: of a joint's error power that it removes, at most.
    ``material_pct``: change of that joint's torque, percent of its root mean square.
    """

    fitted: FittedCandidate
    state: ModelState
    gain: float
    raw_gain: float
    log_likelihood: float
    share: float
    material_pct: float

    @property
    def candidate(self) -> Candidate:
        """The effect with its place."""
        return self.fitted.candidate

    @property
    def shapes(self) -> Shapes:
        """Nonlinear parameters of the effect."""
        return self.fitted.shapes

    @property
    def entry(self) -> Entry:
        """Entry of the effect in the configuration."""
        return self.fitted.entry

    @property
    def allowed(self) -> bool:
        """False if a linear parameter has a sign or a size that physics does not allow."""
        return self.fitted.allowed

    @cached_property
    def p_value(self) -> float:
        """Probability of its parameters if it is not there, by their own standard deviations."""
        return p_value_of_effect(self.state, self.entry)

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


@dataclass(frozen=True, eq=False)
class SelectionStep:
    """Candidates added to one model, ``state``, with its weights; highest log-likelihood first.

    ``tests``: number of candidates and nonlinear parameters; ``passing``: the significant, material and possible ones.
    """

    state: ModelState
    noise: tuple[ArModel, ...]
    ranked: tuple[Addition, ...]
    passing: tuple[Addition, ...]
    tests: int

    def rivals(self, one: Addition) -> tuple[Addition, ...]:
        """Physically possible explanations in place of an addition: others that pass, and others of the same joint."""
        joint = one.candidate.place.joint
        return tuple(
            a
            for a in self.ranked
            if a.allowed and a.family != one.family and (a in self.passing or a.candidate.place.joint == joint)
        )


def compared_candidates(
    state: ModelState, made: Sequence[FittedCandidate], tests: int, passes: Callable[[Addition, int], bool]
) -> SelectionStep:
    """Compare models with candidates, all under the noise models of the most likely one that physics allows.

    Those of a residual without smooth functions of the motion; else they would take missing effects for noise.
    """
    noise = _noise_of_best([state, *(m.state for m in made if m.allowed)])
    alike = state.under(noise)
    ranked = tuple(sorted((_compared(alike, m, noise) for m in made), key=lambda a: -a.log_likelihood))
    return SelectionStep(alike, noise, ranked, tuple(a for a in ranked if passes(a, tests)), tests)


def advantage(one: ModelState, other: ModelState) -> float:
    """Log-likelihood of a model less that of another one, under the noise models of the more likely of both, nats."""
    noise = _noise_of_best([one, other])
    first, second = (model.under(noise).score.log_likelihood_under(noise) for model in (one, other))
    return first - second


def _noise_of_best(models: Sequence[ModelState]) -> tuple[ArModel, ...]:
    """Noise models that weight and score the equations of all models: of the most likely model, one for each joint."""
    return max(models, key=lambda one: one.score.log_likelihood_under(one.weights)).weights


def _compared(state: ModelState, made: FittedCandidate, noise: tuple[ArModel, ...]) -> Addition:
    """Comparison of a model with an effect with the one without it."""
    with_it = made.state.under(noise)
    share, changed = materiality(state, with_it)
    before, after = (one.score.log_likelihood_under(noise) for one in (state, with_it))
    gained = with_it.score.gain_over(state.score, noise)
    return Addition(made, with_it, gained, after - before, after, share, changed)


def gain(with_it: ModelState, without: ModelState) -> float:
    """Gain of log-likelihood by an effect, with the weights and noise models of the model with it."""
    return with_it.score.gain_over(without.under(with_it.fit.noise).score, with_it.score.own_noise)


def materiality(without: ModelState, with_it: ModelState) -> tuple[float, float]:
    """Return the share of the error power that an effect removes, and its torque in percent of that of the joint.

    Both are of the joint and the recording in which the share is largest: motions that do not show an effect say
    nothing of its size. Joints on which it does not act change with the other parameters, and do not count.
    """
    before, after = without.score.rms_of_recordings, with_it.score.rms_of_recordings
    removed = np.where(acted_on(with_it, without)[:, None], np.maximum(before**2 - after**2, 0.0), 0.0)
    shares = removed / np.maximum(before**2, 1e-300)
    joint, recording = np.unravel_index(int(np.argmax(shares)), shares.shape)
    torque = np.concatenate([s.torques[:, joint] for s in without.study.train])
    size = float(np.sqrt(mean_square(torque)))
    return float(shares[joint, recording]), 100 * float(np.sqrt(removed[joint, recording])) / max(size, 1e-300)
