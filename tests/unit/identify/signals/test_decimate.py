"""The parallel filter: zero phase, unit gain, the same whatever passes through it, no filtered edges."""

import numpy as np
import pytest

from armident.configs import DataError
from armident.identify.signals.decimate import STOPBAND_DB, design
from armident.identify.signals.published_filters import chebyshev_decimate, kept_samples

DT = 2e-4


def test_factor_is_that_of_the_thesis() -> None:
    assert design(DT, 20.0).factor == 125


def test_slow_signals_pass_without_lag_and_fast_ones_do_not_pass() -> None:
    t = np.arange(40000) * DT
    low_pass = design(DT, 20.0)
    kept = t[low_pass.instants(t.size)]
    slow, fast = np.sin(2 * np.pi * 5 * t), np.sin(2 * np.pi * 31 * t)
    tolerance = 2 * 10 ** (-STOPBAND_DB / 20)
    np.testing.assert_allclose(low_pass(slow), np.sin(2 * np.pi * 5 * kept), atol=tolerance)
    assert np.abs(low_pass(fast)).max() < tolerance


def test_columns_of_an_array_are_filtered_alike() -> None:
    x = np.random.default_rng(0).standard_normal((6000, 2, 3))
    low_pass = design(DT, 50.0)
    # Up to the order in which about a thousand products are summed.
    np.testing.assert_allclose(low_pass(x)[:, 1, 2], low_pass(x[:, 1, 2]), rtol=0, atol=1e-13)


def test_too_short_a_record_is_refused() -> None:
    with pytest.raises(DataError, match="decimation by 125"):
        design(DT, 20.0)(np.zeros(100))


@pytest.mark.parametrize("samples", [1000, 1003, 1009])
def test_published_decimation_keeps_the_last_sample(samples: int) -> None:
    kept = kept_samples(samples, 10)
    assert kept[-1] == samples - 1
    assert kept.size == -(-samples // 10)


def test_chebyshev_of_order_8_is_sound_at_a_decimation_where_its_transfer_function_is_not() -> None:
    constant = np.ones(60000)
    # Ripple of 0.05 dB, twice: an even order has its minimum at zero frequency.
    np.testing.assert_allclose(chebyshev_decimate(constant, 50, 8, 0.05, 24), 10 ** (-2 * 0.05 / 20), rtol=1e-6)


@pytest.mark.parametrize("cutoff_hz", [12.0, 20.0, 37.0, 50.0, 700.0])
def test_few_samples_give_the_same_filtered_signal_without_the_steps_of_set_points(cutoff_hz: float) -> None:
    t = np.arange(30011) * DT
    slow, steps = np.sin(2 * np.pi * cutoff_hz / 5 * t), 0.1 * np.sin(2 * np.pi * 1000 * t)
    low_pass = design(DT, cutoff_hz)
    thinned = low_pass.thin((slow + steps)[:, None])[:, 0]
    filtered = low_pass.of_thin(thinned)[: low_pass.count(t.size)]
    # The mean of an eighth of a period at the cut-off takes (pi / 40)^2 / 6 from a fifth of it.
    np.testing.assert_allclose(filtered, low_pass(slow + steps), atol=2e-3)
    assert 1 / (DT * low_pass.every) >= min(8 * cutoff_hz, 1 / DT)
