"""Calibration of the set-up check: the map is fitted by other arms, and its error is that of the printed shares."""

import numpy as np

from tests.evaluation.setup_calibration import cross_fitted, expected_error, fitted


def test_the_fit_recovers_a_logistic_map() -> None:
    rng = np.random.default_rng(1)
    x = rng.normal(size=(4000, 2))
    right = (rng.random(4000) < 1.0 / (1.0 + np.exp(-(2.0 * x[:, 0] - 1.0 * x[:, 1] + 0.5)))).astype(float)
    coefficients, intercept = fitted(x, right)
    np.testing.assert_allclose([*coefficients, intercept], [2.0, -1.0, 0.5], atol=0.2)
    assert expected_error(cross_fitted(x, right, np.arange(4000) // 10), right) < 0.03


def test_an_arm_has_no_part_in_its_own_probability() -> None:
    x, arms = np.repeat([[1.0], [-1.0]], 40, axis=0), np.tile(np.arange(8), 10)
    right = (x[:, 0] > 0).astype(float)
    right[arms == 0] = 1.0 - right[arms == 0]
    p = cross_fitted(x, right, arms)
    assert p[(arms == 0) & (right == 0)].min() > 0.9


def test_certain_and_wrong_is_the_largest_error() -> None:
    right = np.zeros(10)
    assert expected_error(np.full(10, 0.99), right) == 0.99
    assert expected_error(np.full(10, 0.2), np.array([1.0, 1.0, *np.zeros(8)])) < 1e-12
