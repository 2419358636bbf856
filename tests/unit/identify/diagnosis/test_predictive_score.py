"""Predictive score: cross-validated log-likelihood of models of the EMPS."""

import numpy as np
import pytest

from armident.configs.schema.robot import Effect
from armident.identify.diagnosis.candidate_comparison import gain
from armident.identify.diagnosis.predictive_score import BLOCKS, FOLDS, fold_of
from tests.fixtures.diagnoses import SPRING, selection, with_effects

pytestmark = pytest.mark.slow

TRUE = Effect(effect="joint_spring", joint="joint_1")
FALSE = Effect(effect="asymmetric_viscous_friction", joint="joint_1")


def test_folds_are_blocks_of_equal_length_that_cover_all_rows() -> None:
    fold = fold_of(1000)
    assert set(fold) == set(range(FOLDS))
    assert np.count_nonzero(np.diff(fold)) == BLOCKS - 1
    assert np.ptp(np.bincount(fold)) <= 1


def test_the_log_likelihood_favours_the_true_model() -> None:
    _, first = selection(1, SPRING)
    true, false = with_effects(first, TRUE), with_effects(first, FALSE)
    common = first.weights
    assert true.score.log_likelihood_under(common) > false.score.log_likelihood_under(common) + 100.0
    assert true.score.own_log_likelihoods.sum() > false.score.own_log_likelihoods.sum() + 100.0
    assert true.score.gain_over(first.score, true.score.own_noise) > 100.0
    assert true.score.rms[0] < 0.5 * first.score.rms[0]


def test_a_parameter_that_the_arm_does_not_have_gains_nothing() -> None:
    gains = []
    for seed in range(1, 5):
        _, first = selection(seed)
        gains.append(gain(with_effects(first, TRUE), first))
    # A parameter without effect gains half a chi-square number less its cost: 8 is exceeded once in 10,000.
    assert max(gains) < 8.0


def test_correlated_innovations_only_increase_the_variance_of_a_gain() -> None:
    for effects in ((), (SPRING,)):
        _, first = selection(1, *effects)
        score = with_effects(first, TRUE).score
        assert (score.inflation_over(first.score, score.own_noise) >= 1.0).all()


def test_models_of_a_step_are_estimated_and_scored_alike() -> None:
    steps, first = selection(1, SPRING)
    step = steps.step(first)
    best = step.ranked[0]
    for state in (step.state, best.state):
        assert all(a is b for a, b in zip(state.fit.noise, best.state.fit.noise, strict=True))
    assert best.log_likelihood == best.state.score.log_likelihood_under(step.noise)
    assert best.gain == best.state.score.gain_over(step.state.score, step.noise)


def test_noise_models_of_a_step_do_not_take_the_effect_for_noise() -> None:
    steps, first = selection(1, SPRING)
    (of_step,), (of_first,) = steps.step(first).noise, first.score.own_noise
    assert steps.step(first).ranked[0].state.score.rms[0] < 0.5 * first.score.rms[0]
    assert of_step.variance < of_first.variance
