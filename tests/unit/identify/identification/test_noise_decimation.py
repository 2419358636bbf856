"""Decimation by the correlation time of the noise (thesis section 6.2.3)."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal

from armident.configs import DataError
from armident.identify.identification.noise_decimation import decimation_from_noise
from armident.identify.regression.ar_noise import whiteness
from armident.identify.signals.decimate import design


def coloured(coefficients: list[float], samples: int, seed: int = 0) -> NDArray[np.float64]:
    white = np.random.default_rng(seed).standard_normal(samples)
    filtered: NDArray[np.float64] = signal.lfilter([1.0], [1.0, *coefficients], white)
    return filtered


def test_factor_is_the_order_of_the_longest_memory() -> None:
    lag_12 = [0.0] * 11 + [-0.8]
    orders = []
    for seed in range(15):
        models: tuple[list[float], ...] = ([], [-0.9], lag_12)
        noise = np.stack([coloured(c, 20000, 3 * seed + j) for j, c in enumerate(models)], axis=1)
        found = decimation_from_noise([noise], max_order=40)
        assert found.factor == max(1, found.orders.max())
        orders.append(found.orders)
    # AIC takes orders too many now and then (three in ten times at least one), never one too few of this size.
    assert (np.min(orders, axis=0) >= [0, 1, 12]).all()
    assert (np.median(orders, axis=0) <= [1, 2, 13]).all()


def test_what_is_kept_is_nearly_white_where_the_noise_was_not() -> None:
    # Noise after a low-pass of 25 taps, like the torque filter of a drive.
    window = np.hanning(27)[1:-1]
    noise = np.convolve(np.random.default_rng(1).standard_normal(60000), window, mode="valid")
    found = decimation_from_noise([noise[:, None]])
    dt = 1e-3
    kept = design(dt, 0.5 / (dt * found.factor), found.factor)(noise)
    before, after = whiteness([noise]), whiteness([kept])
    assert before.fraction_outside > 0.9
    assert np.abs(after.autocorrelation).max() < 0.25 * np.abs(before.autocorrelation).max()


def test_several_experiments_are_one_noise() -> None:
    pieces = [coloured([-0.95], 4000, seed)[:, None] for seed in range(4)]
    assert 1 <= decimation_from_noise(pieces, max_order=30).factor <= 6


def test_it_says_when_the_memory_is_longer_than_was_looked() -> None:
    noise = coloured([0.0] * 29 + [-0.9], 20000)[:, None]
    assert decimation_from_noise([noise], max_order=30).bounded
    assert not decimation_from_noise([noise], max_order=100).bounded


@pytest.mark.parametrize(
    ("series", "message"),
    [
        ([], "expected residuals"),
        ([np.zeros(50)], "expected residuals"),
        ([np.zeros((50, 2)), np.zeros((50, 3))], "expected residuals"),
        ([np.full((50, 1), np.nan)], "not a finite number"),
    ],
)
def test_what_is_not_residuals_is_refused(series: list[NDArray[np.float64]], message: str) -> None:
    with pytest.raises(DataError, match=message):
        decimation_from_noise(series)
