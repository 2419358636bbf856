"""Predictive score: cross-validated log-likelihood of models of the EMPS."""

import numpy as np
import pytest

from armident.configs.schema.robot import Effect
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
    assert true.score.own_log_likelihood > false.score.own_log_likelihood + 100.0
    assert true.score.gain_over(first.score) > 100.0
    assert true.score.rms[0] < 0.5 * first.score.rms[0]


def test_a_parameter_that_the_arm_does_not_have_gains_nothing() -> None:
    gains = []
    for seed in range(1, 5):
        _, first = selection(seed)
        gains.append(with_effects(first, TRUE).score.gain_over(first.score))
    # A parameter without effect gains half a chi-square number less its cost: 8 is exceeded once in 10,000.
    assert max(gains) < 8.0


def test_correlated_innovations_only_increase_the_variance_of_a_gain() -> None:
    for effects in ((), (SPRING,)):
        _, first = selection(1, *effects)
        score = with_effects(first, TRUE).score
        assert (score.inflation_over(first.score) >= 1.0).all()


def test_candidates_of_a_step_share_the_noise_models_of_the_step() -> None:
    _, first = selection(1, SPRING)
    true = with_effects(first, TRUE)
    assert list(true.fit.noise) == list(first.weights)
    own = true.score.innovations(first.weights)
    expected = -0.5 * true.score.rows * np.log(own)
    np.testing.assert_allclose(true.score.log_likelihoods_under(first.weights), expected)
