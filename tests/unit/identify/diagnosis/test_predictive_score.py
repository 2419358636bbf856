"""Predictive score: cross-validated log-likelihood of models of the EMPS."""

import numpy as np
import pytest

from armident.configs.schema.robot import Effect
from armident.identify.diagnosis.candidate_comparison import gain
from armident.identify.diagnosis.predictive_score import (
    BLOCKS,
    FOLDS,
    SUMS,
    block_edges,
    block_sums,
    fold_of,
    folds_of,
)
from tests.fixtures.diagnoses import SPRING, selection, with_effects

pytestmark = pytest.mark.slow

TRUE = Effect(effect="joint_spring", joint="joint_1")
FALSE = Effect(effect="asymmetric_viscous_friction", joint="joint_1")


def test_folds_are_blocks_of_equal_length_that_cover_all_rows() -> None:
    fold = fold_of(1000)
    assert set(fold) == set(range(FOLDS))
    assert np.count_nonzero(np.diff(fold)) == BLOCKS - 1
    assert np.ptp(np.bincount(fold)) <= 1


def test_no_fold_lacks_a_whole_recording() -> None:
    of_row = np.full(1230, -1)
    for fold, rows in folds_of([1000, 0, 200, 30]):
        of_row[rows] = fold
    assert (of_row[:1000] == fold_of(1000)).all()
    for recording in (of_row[:1000], of_row[1000:1200], of_row[1200:]):
        assert np.ptp(np.bincount(recording, minlength=FOLDS)) <= 1


def test_blocks_of_sums_have_as_many_rows_in_which_the_joint_moves() -> None:
    used = np.zeros(5000, np.bool_)
    used[300:1300:2] = True
    counts = np.add.reduceat(used, block_edges(used)[:-1])
    assert counts.size == SUMS
    assert np.ptp(counts) <= 1
    values = np.where(used, np.random.default_rng(0).standard_normal(used.size), 0.0)
    # White values: the sums have the variance of white values, however long the joint rests.
    assert np.var(block_sums(values), ddof=1) == pytest.approx(used.sum() / SUMS, rel=0.7)
    assert block_sums(np.zeros(5000)).tolist() == [0.0] * SUMS


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
