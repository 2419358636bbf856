"""Variance of sums of serially correlated terms."""

import numpy as np

from armident.identify.regression.hac import newey_west, newey_west_matrix

LAGS = 7


def test_the_covariance_matrix_has_the_variances_of_the_sums() -> None:
    rng = np.random.default_rng(3)
    series = [np.cumsum(rng.standard_normal((n, 3)), axis=0) * 0.1 + rng.standard_normal((n, 3)) for n in (200, 5)]
    series = [s - s.mean(axis=0) for s in series]
    mixed = np.array([[1.0, 0.5, 0.0], [0.0, -2.0, 1.0], [0.3, 0.0, 1.0]])
    matrix = newey_west_matrix(series, LAGS)
    np.testing.assert_allclose(np.diag(matrix), newey_west(series, LAGS), rtol=1e-12)
    expected = newey_west([s @ mixed for s in series], LAGS)
    np.testing.assert_allclose(np.diag(mixed.T @ matrix @ mixed), expected, rtol=1e-12)
