"""The banded smoother against its definition and against filterpy's Kalman filter and RTS smoother."""

from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from armident.configs import DataError
from armident.identify.signals.irwsm import (
    automatic_nvr,
    cross_validated_nvr,
    cross_validation,
    irwsm,
    kept_share,
    negative_log_likelihood,
    optimal_nvr,
)

TRANSITION = {2: np.array([[1.0, 1.0], [0.0, 1.0]]), 3: np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])}


def noisy_sine(samples: int, seed: int = 0) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    return np.sin(2 * np.pi * np.arange(samples) / 500) + 1e-3 * rng.standard_normal(samples)


def kalman(order: int, nvr: float) -> Any:
    kf: Any = KalmanFilter(dim_x=order, dim_z=1)
    kf.F, kf.H = TRANSITION[order], np.eye(order)[:1]
    kf.Q, kf.R = np.zeros((order, order)), np.eye(1)
    kf.Q[-1, -1] = nvr
    kf.x, kf.P = np.zeros((order, 1)), 1e7 * np.eye(order)
    return kf


@pytest.mark.parametrize(("order", "nvr"), [(2, 1e-4), (2, 0.1), (3, 1e-6), (3, 1.0)])
def test_level_and_slope_are_those_of_the_rts_smoother(order: int, nvr: float) -> None:
    y = noisy_sine(2000)
    kf = kalman(order, nvr)
    means, covariances, _, _ = kf.batch_filter(y)
    states, _, _, _ = kf.rts_smoother(means, covariances)
    smooth = irwsm(y, order, nvr)
    # The oracle's prior of 1e7 instead of a diffuse one moves levels of size 1 by about 1e-7.
    np.testing.assert_allclose(smooth.level, states[:, 0, 0], atol=1e-6)
    np.testing.assert_allclose(smooth.slope, states[:-1, 1, 0], atol=1e-6)


@pytest.mark.parametrize("order", [2, 3])
def test_likelihood_differs_from_the_kalman_filters_by_a_constant(order: int) -> None:
    y = noisy_sine(600)
    differences = []
    for nvr in (1e-5, 1e-3, 1e-1):
        kf = kalman(order, nvr)
        squares, logs = 0.0, 0.0
        for k, value in enumerate(y):
            kf.predict()
            kf.update(value)
            if k >= order:  # the first innovations only fix the diffuse state
                squares += float(kf.y[0, 0] ** 2 / kf.S[0, 0])
                logs += float(np.log(kf.S[0, 0]))
        differences.append(
            negative_log_likelihood(np.diff(y, n=order), order, nvr) - ((y.size - order) * np.log(squares) + logs)
        )
    # log|V| of the banded form exceeds the innovations' by a constant that the diffuse start absorbs.
    assert np.ptp(differences) < 1e-2


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("nvr", [1e-6, 1e-2, 10.0])
def test_smoother_and_likelihood_equal_the_dense_definition(order: int, nvr: float) -> None:
    y = noisy_sine(300)
    d = np.diff(np.eye(y.size), n=order, axis=0)
    v = nvr * np.eye(y.size - order) + d @ d.T
    w = d @ y
    level = np.linalg.solve(np.eye(y.size) + d.T @ d / nvr, y)
    np.testing.assert_allclose(irwsm(y, order, nvr).level, level, atol=1e-9)
    dense = (y.size - order) * np.log(w @ np.linalg.solve(v, w)) + np.linalg.slogdet(v)[1]
    assert negative_log_likelihood(np.diff(y, n=order), order, nvr) == pytest.approx(dense, rel=1e-9)


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("nvr", [1e-6, 1e-2, 10.0])
def test_cross_validation_score_equals_the_dense_definition(order: int, nvr: float) -> None:
    y = noisy_sine(700)
    d = np.diff(np.eye(y.size), n=order, axis=0)
    smoother = np.linalg.inv(np.eye(y.size) + d.T @ d / nvr)
    residual = np.sum((y - smoother @ y) ** 2)
    score = np.log(residual) - 2 * np.log(1 - np.trace(smoother) / y.size)
    # The trace is that of a series without ends, which add about as many degrees of freedom as the order.
    assert cross_validation(np.diff(y, n=order), order, nvr) == pytest.approx(score, abs=4 * order / y.size)
    assert kept_share(order, nvr) == pytest.approx(np.trace(smoother) / y.size, abs=order / y.size)


@pytest.mark.parametrize(("order", "nvr"), [(2, 1e-6), (2, 1.0), (3, 1e-8), (3, 1.0)])
def test_score_of_a_series_longer_than_the_transient_equals_that_of_its_smoother(order: int, nvr: float) -> None:
    # Beyond the transient the factors are taken as constant; the smoother itself computes every row.
    y = noisy_sine(20000)
    squares = np.sum((y - irwsm(y, order, nvr).level) ** 2)
    score = np.log(squares) - 2 * np.log(1 - kept_share(order, nvr))
    assert cross_validation(np.diff(y, n=order), order, nvr) == pytest.approx(score, abs=1e-6)


@pytest.mark.parametrize("order", [2, 3])
def test_automatic_ratio_is_the_smoother_of_two(order: int) -> None:
    y = noisy_sine(5000)
    validated, likeliest = cross_validated_nvr(y, order), optimal_nvr(y, 3)
    assert automatic_nvr(y, order) == min(validated, likeliest ** (order / 3))
    assert automatic_nvr(np.full(1000, 1.25), order) == 1.0


@pytest.mark.parametrize("order", [2, 3])
def test_cross_validated_ratio_is_a_minimum_near_the_least_true_error(order: int) -> None:
    rng = np.random.default_rng(5)
    truth = np.sin(2 * np.pi * np.arange(20000) / 2500)
    y = truth + 1e-4 * rng.standard_normal(truth.size)
    best = cross_validated_nvr(y, order)
    for other in (best / 2, best * 2):
        assert cross_validation(np.diff(y, n=order), order, best) < cross_validation(np.diff(y, n=order), order, other)
    errors = {g: np.linalg.norm(irwsm(y, order, 10.0**g).level - truth) for g in np.arange(-14.0, 0.0, 0.5)}
    assert np.linalg.norm(irwsm(y, order, best).level - truth) < 1.2 * min(errors.values())


@pytest.mark.parametrize(("order", "truth"), [(2, 1e-4), (2, 1e-1), (3, 1e-3)])
def test_likelihood_finds_the_ratio_that_made_the_data(order: int, truth: float) -> None:
    rng = np.random.default_rng(3)
    walk = np.sqrt(truth) * rng.standard_normal(20000)
    for _ in range(order):
        walk = np.cumsum(walk)
    y = walk + rng.standard_normal(walk.size)
    # 20000 samples give the ratio to about 5 %, three of that is 0.06 decades; the search adds 0.02.
    assert abs(np.log10(optimal_nvr(y, order) / truth)) < 0.1


def test_the_optimum_is_a_minimum() -> None:
    y = noisy_sine(5000)
    best = optimal_nvr(y, 2)
    at = negative_log_likelihood(np.diff(y, n=2), 2, best)
    assert at < negative_log_likelihood(np.diff(y, n=2), 2, best * 2)
    assert at < negative_log_likelihood(np.diff(y, n=2), 2, best / 2)


def test_a_standstill_is_left_as_it_is() -> None:
    y = np.full(1000, 1.25)
    assert optimal_nvr(y, 2) == 1.0
    np.testing.assert_array_equal(irwsm(y, 2, 1.0).level, y)


def test_what_is_not_a_number_is_named() -> None:
    y = np.ones(100)
    y[17] = np.nan
    with pytest.raises(DataError, match="sample 17"):
        irwsm(y, 2, 1.0)


def test_too_short_a_series_is_refused() -> None:
    with pytest.raises(DataError, match="more than 4 samples"):
        irwsm(np.ones(4), 2, 1.0)
