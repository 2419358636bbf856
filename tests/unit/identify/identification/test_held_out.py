"""Held-out torque error: that of the noise for a right model, more for one with too many parameters."""

import numpy as np
import pytest

from armident.identify.identification.held_out import held_out_errors
from armident.identify.regression.equations import ExperimentEquations

NOISE, SIZE = 0.3, 400


def equations(seed: int, unused: int = 0) -> tuple[list[ExperimentEquations], np.ndarray]:
    """Two joints, five parameters and some without effect on the torques; two experiments."""
    rng = np.random.default_rng(seed)
    theta = np.concatenate([rng.normal(size=5), np.zeros(unused)])
    blocks = []
    for _ in range(2):
        x = rng.normal(size=(SIZE, 2, theta.size))
        y = x @ theta + NOISE * np.array([1.0, 2.0]) * rng.normal(size=(SIZE, 2))
        blocks.append(
            ExperimentEquations(y, x, np.ones((SIZE, 2), dtype=bool), np.arange(SIZE, dtype=np.float64) * 0.01)
        )
    return blocks, theta


def test_a_right_model_predicts_held_out_data_up_to_the_noise() -> None:
    blocks, theta = equations(0)
    found = held_out_errors(blocks, theta)
    assert found is not None
    power = np.mean([np.mean(block.y**2, axis=0) for block in blocks], axis=0)
    expected = 100 * NOISE * np.array([1.0, 2.0]) / np.sqrt(power)
    # Standard deviation of a noise power of 800 samples: 5 %, of its root 2.5 %; four of them.
    np.testing.assert_allclose(found[1], expected, rtol=0.1)


def test_parameters_without_effect_make_held_out_data_worse_and_fitted_data_better() -> None:
    lean, wide = equations(1), equations(1, unused=200)
    held = [held_out_errors(*each) for each in (lean, wide)]
    assert held[0] is not None
    assert held[1] is not None
    assert held[1][0] > 1.05 * held[0][0]


def test_a_parameter_that_one_part_alone_determines_has_no_held_out_error() -> None:
    blocks, theta = equations(2)
    for block in blocks:
        block.x[SIZE // 5 :, :, 0] = 0.0
    assert held_out_errors(blocks, theta) is None


def test_equations_that_are_not_used_do_not_count() -> None:
    blocks, theta = equations(3)
    before = held_out_errors(blocks, theta)
    for block in blocks:
        block.keep[::7, 0] = False
        block.y[::7, 0] = 1e6
    after = held_out_errors(blocks, theta)
    assert before is not None
    assert after is not None
    assert after[0] == pytest.approx(before[0], rel=0.1)
