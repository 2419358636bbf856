"""Solution of the stacked regression: least squares, instruments, covariances, excitation."""

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import DataError
from armident.identify.estimators.essential import essential_parameters
from armident.identify.estimators.idim_ls import idim_ls
from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.equations import ExperimentEquations
from armident.identify.regression.iterations import iterate
from armident.identify.regression.iv import factored, serial_covariance
from armident.identify.regression.least_squares import inverse_gram, least_squares

SCALES = np.array([1.0, 1e-4, 1e3])


def test_least_squares_is_right_for_columns_of_very_different_size() -> None:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((200, 3)) * SCALES
    theta = np.array([1.0, -2.0, 0.5]) / SCALES
    np.testing.assert_allclose(least_squares(x, x @ theta), theta, rtol=1e-12)
    np.testing.assert_allclose(inverse_gram(x), np.linalg.inv(x.T @ x), rtol=1e-9)


def test_instruments_are_unbiased_where_least_squares_is_not() -> None:
    rng = np.random.default_rng(1)
    clean = rng.standard_normal((20000, 2))
    theta = np.array([1.0, -2.0])
    y = clean @ theta + 0.1 * rng.standard_normal(20000)
    x = clean + 0.7 * rng.standard_normal(clean.shape)
    z = clean + 0.3 * rng.standard_normal(clean.shape)
    # Attenuation of least squares is 1 / (1 + 0.49); the IV error is about 1.5 / sqrt(20000) = 0.01.
    np.testing.assert_allclose(least_squares(x, y), theta / 1.49, atol=0.03)
    np.testing.assert_allclose(factored(z, x, y).theta, theta, atol=0.04)


def test_iv_covariance_is_the_gram_inverse_for_perfect_instruments_and_larger_for_poor_ones() -> None:
    rng = np.random.default_rng(2)
    x = rng.standard_normal((1000, 3)) * SCALES
    np.testing.assert_allclose(factored(x, x, x[:, 0]).covariance, inverse_gram(x), rtol=1e-9)
    poor = x + rng.standard_normal(x.shape) * SCALES
    assert (np.diag(factored(poor, x, x[:, 0]).covariance) > 1.5 * np.diag(inverse_gram(x))).all()


def test_serial_covariance_predicts_the_scatter_under_coloured_noise() -> None:
    rng = np.random.default_rng(3)
    samples, runs = 400, 600
    t = np.arange(samples)
    x = np.stack([np.ones(samples), np.sin(t / 20), np.sin(t / 3)], axis=1)
    noise = ArModel(np.array([-0.9]), 1.0, 0.0)
    found = []
    for _ in range(runs):
        e = np.zeros(samples + 100)
        for k, value in enumerate(rng.standard_normal(samples + 99)):
            e[k + 1] = 0.9 * e[k] + value
        found.append(least_squares(x, e[100:]))
    keep = np.ones((samples, 1), dtype=np.bool_)
    white = ArModel(np.empty(0), 1.0, 0.0)
    predicted = serial_covariance([x[:, None, :]], [x[:, None, :]], [keep], [white], [noise])
    # 600 runs determine a standard deviation to 3 %; the filter starts at rest at one end: a few percent more.
    np.testing.assert_allclose(np.std(found, axis=0), np.sqrt(np.diag(predicted)), rtol=0.12)


def test_serial_covariance_of_experiments_is_that_of_their_products() -> None:
    rng = np.random.default_rng(5)
    x = [rng.standard_normal((size, 2, 3)) * SCALES for size in (50, 80)]
    z = [value + 0.1 * rng.standard_normal(value.shape) * SCALES for value in x]
    z[1][:, 1, 0] = 0.0
    keep = [rng.random(value.shape[:2]) < 0.9 for value in x]
    weights = [ArModel(np.empty(0), variance, 0.0) for variance in (1.0, 4.0)]
    noise = [ArModel(np.array([c]), variance, 0.0) for c, variance in ((-0.5, 0.8), (0.3, 3.0))]
    cross, meat = np.zeros((3, 3)), np.zeros((3, 3))
    for own_z, own_x, used in zip(z, x, keep, strict=True):
        for j in range(2):
            weighted = own_z[used[:, j], j] / weights[j].variance
            cross += weighted.T @ own_x[used[:, j], j]
            lags = np.abs(np.subtract.outer(*(np.flatnonzero(used[:, j]),) * 2))
            # An AR(1) process has the autocovariance variance (-c)^lag / (1 - c^2).
            c = float(noise[j].coefficients[0])
            meat += weighted.T @ ((-c) ** lags * noise[j].variance / (1 - c**2)) @ weighted
    expected = np.linalg.solve(cross, np.linalg.solve(cross, meat).T)
    # The filter starts at rest at one end of each experiment.
    np.testing.assert_allclose(
        np.sqrt(np.diag(serial_covariance(z, x, keep, weights, noise))), np.sqrt(np.diag(expected)), rtol=0.02
    )


def test_unexcited_parameters_are_named() -> None:
    rng = np.random.default_rng(4)
    x = rng.standard_normal((100, 1, 3))
    x[:, 0, 2] = 2 * x[:, 0, 1]
    keep = np.ones((100, 1), dtype=np.bool_)
    with pytest.raises(DataError, match="not excited: fv1, off1"):
        idim_ls([ExperimentEquations(x[:, :, 0], x, keep, np.arange(100.0))], ["zz1", "fv1", "off1"])


def test_a_joint_that_is_noisier_counts_less() -> None:
    rng = np.random.default_rng(5)
    x = np.ones((5000, 2, 1))
    y = np.stack([1 + 0.01 * rng.standard_normal(5000), 3 + 10 * rng.standard_normal(5000)], axis=1)
    estimate = idim_ls([ExperimentEquations(y, x, np.ones((5000, 2), dtype=np.bool_), np.arange(5000.0))], ["off1"])
    assert abs(estimate.theta[0] - 1) < 0.05


@pytest.mark.slow
def test_ordinary_least_squares_knows_its_scatter_where_joints_differ() -> None:
    found, promised = [], np.zeros(2)
    keep, t = np.ones((200, 2), dtype=np.bool_), np.arange(200.0)
    for seed in range(300):
        rng = np.random.default_rng(seed)
        x = rng.standard_normal((200, 2, 2))
        y = x @ np.array([1.0, -2.0]) + rng.standard_normal((200, 2)) * [0.1, 3.0]
        estimate = idim_ls([ExperimentEquations(y, x, keep, t)], ["a", "b"], weighted=False)
        np.testing.assert_allclose(estimate.theta, np.linalg.lstsq(x.reshape(-1, 2), y.ravel(), rcond=None)[0])
        found.append(estimate.theta)
        promised = estimate.std
    # 300 runs determine a standard deviation to 4 %, the residuals of one run to 5 %.
    np.testing.assert_allclose(np.std(found, axis=0), promised, rtol=0.25)


def test_elimination_keeps_what_matters_and_drops_what_does_not() -> None:
    rng = np.random.default_rng(6)
    x = rng.standard_normal((500, 6))
    theta = np.array([1.0, 0.0, 0.5, 0.0, 0.0, -2.0])
    y = x @ theta + rng.standard_normal(500)
    essential = essential_parameters(least_squares(x, y), inverse_gram(x), 500)
    np.testing.assert_array_equal(essential, theta != 0)


def test_of_two_parameters_that_can_stand_for_each_other_one_stays() -> None:
    rng = np.random.default_rng(7)
    a = rng.standard_normal(500)
    x = np.stack([a, a + 0.02 * rng.standard_normal(500)], axis=1)
    y = x @ np.array([1.0, 0.0]) + rng.standard_normal(500)
    assert essential_parameters(least_squares(x, y), inverse_gram(x), 500).sum() == 1


def test_iterations_stop_and_say_why() -> None:
    theta, done, converged, reason = iterate(lambda t, k: (1 + 0.1 * (t - 1), 1.0), np.zeros(2), 20, 1e-4)
    assert converged
    assert done < 8
    assert "theta changed" in reason
    np.testing.assert_allclose(theta, 1.0, atol=1e-4)
    _, done, converged, reason = iterate(lambda t, k: (-t, 1.0), np.ones(2), 20, 1e-4)
    assert (done, converged, reason) == (20, False, "stopped after 20 iterations")


def test_iterations_that_do_not_settle_keep_the_best_iterate() -> None:
    norms = iter([3.0, 1.0, 2.0, 4.0])
    theta, done, converged, _ = iterate(lambda t, k: (np.array([float(k)]), next(norms)), np.zeros(1), 4, 1e-4)
    assert (theta[0], done, converged) == (2.0, 4, False)


def test_equations_without_a_finite_solution_end_the_iterations() -> None:
    def step(theta: NDArray[np.float64], k: int) -> tuple[NDArray[np.float64], float]:
        if k == 3:
            raise np.linalg.LinAlgError
        return theta + 1, 1.0 / k

    theta, done, converged, reason = iterate(step, np.zeros(1), 20, 1e-4)
    assert (theta[0], done, converged) == (2.0, 3, False)
    assert "iteration 3" in reason
