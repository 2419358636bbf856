"""Recursive filters against those of scipy, whose import a command does without."""

import numpy as np
import pytest
from scipy import signal

from armident.identify.signals.bandwidth import velocity_spectra
from armident.identify.signals.decimate import STOPBAND_DB, TRANSITION, design
from armident.identify.signals.recursive import butterworth_sections, recursive_filter, zero_phase


@pytest.mark.parametrize("shape", [(300,), (300, 5), (4, 2), (300, 2, 3)])
def test_a_filter_begins_at_rest_as_that_of_scipy(shape: tuple[int, ...]) -> None:
    random = np.random.default_rng(3)
    x = random.standard_normal(shape)[::-1]
    poles = np.append(1.0, 0.1 * random.standard_normal(9))
    taps = random.standard_normal(6)
    expected = signal.lfilter(taps, poles, x, axis=0)
    np.testing.assert_allclose(recursive_filter(taps, poles, x), expected, atol=1e-12)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 7])
@pytest.mark.parametrize("cutoff", [0.001, 0.05, 0.5, 0.95])
def test_a_butterworth_filter_to_and_fro_is_that_of_scipy(order: int, cutoff: float) -> None:
    x = 5.0 + np.random.default_rng(order).standard_normal((500, 2))
    expected = signal.sosfiltfilt(signal.butter(order, cutoff, output="sos"), x, axis=0, padlen=3 * order)
    np.testing.assert_allclose(zero_phase(butterworth_sections(order, cutoff), x, 3 * order), expected, atol=1e-9)


@pytest.mark.parametrize("cutoff_hz", [5.2, 6.6, 7.77, 100.0])
def test_the_taps_of_a_decimation_are_a_kaiser_window_of_scipy(cutoff_hz: float) -> None:
    length, beta = signal.kaiserord(STOPBAND_DB, TRANSITION * 2e-3 * cutoff_hz)
    expected = signal.firwin(length | 1, 2e-3 * cutoff_hz, window=("kaiser", beta))
    np.testing.assert_allclose(design(1e-3, cutoff_hz).taps, expected, atol=1e-15)


@pytest.mark.parametrize("samples", [400, 401])
def test_the_spectrum_of_the_velocity_is_that_of_scipy_below_the_nyquist_frequency(samples: int) -> None:
    q = np.random.default_rng(1).standard_normal((samples, 2)).cumsum(axis=0)
    frequency, power = signal.periodogram(np.diff(q, axis=0) / 0.01, 100.0, window="hann", axis=0)
    ours, density, _ = velocity_spectra(q, 0.01)
    np.testing.assert_allclose(ours, frequency[1:])
    np.testing.assert_allclose(density[:-1], power[1:-1], rtol=1e-9)
