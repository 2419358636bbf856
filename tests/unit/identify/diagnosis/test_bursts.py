"""Kurtosis test for transient disturbances: false-alarm rate for coloured and speed-dependent noise, detection."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal

from armident.identify.diagnosis.bursts import MATERIAL, Bursts, bursts_of

Array = NDArray[np.float64]

DT, BANDWIDTH, LENGTH = 0.004, 10.0, 4000
T = np.asarray(DT * np.arange(LENGTH), dtype=np.float64)
SPEED = np.abs(np.sin(2 * np.pi * 0.3 * DT * np.arange(LENGTH)))


def noise(seed: int, length: int = LENGTH) -> Array:
    """Gaussian noise of unit power, coloured as in a control loop."""
    x = signal.lfilter([1.0], [1.0, -1.3, 0.5], np.random.default_rng(seed).normal(size=length + 200))[200:]
    return np.asarray(x / x.std())


def events(seed: int, share: float) -> Array:
    """Torque pulses of 0.1 s once a second at random times, with a share of the power of unit noise."""
    every, long = round(1.0 / DT), round(0.1 / DT)
    x = np.zeros(LENGTH)
    for k, at in enumerate(np.random.default_rng(seed).integers(0, every - long, LENGTH // every)):
        x[k * every + at : k * every + at + long] = np.hanning(long)
    return np.asarray(x * np.sqrt(share / np.mean(x**2)))


def judged(*residuals: Array, speed: Array = SPEED) -> Bursts:
    times = [T[: e.size] for e in residuals]
    found = bursts_of(residuals, [speed[: e.size] for e in residuals], times, DT, BANDWIDTH)
    assert found is not None
    return found


def test_noise_of_any_colour_is_called_bursts_as_often_as_promised() -> None:
    p = np.array([judged(noise(seed)).p_value for seed in range(400)])
    assert 1 <= np.sum(p < 0.05) <= 30
    assert np.sum(p < 0.01) <= 10


def test_torques_at_random_times_are_bursts_and_shown_when_they_come() -> None:
    extra = events(2, 0.5)
    found = judged(noise(1) + extra)
    assert found.p_value < 1e-6
    assert found.share > MATERIAL
    loud = found.t[np.argmax(found.amplitude / found.noise)]
    assert extra[round(loud / DT) - 12 : round(loud / DT) + 12].max() > 0.5 * extra.max()
    assert np.any(found.amplitude > found.noise)


@pytest.mark.parametrize("seed", range(5))
def test_noise_that_grows_with_the_speed_is_no_burst(seed: int) -> None:
    assert judged(noise(seed) * (0.3 + 2.0 * SPEED)).p_value > 1e-3


def test_a_stretch_that_is_noisier_than_the_other_is_no_burst() -> None:
    assert judged(noise(1), 4.0 * noise(2)).p_value > 0.01


def test_tails_lighter_than_those_of_noise_are_no_bursts() -> None:
    assert judged(np.clip(noise(1), -0.8, 0.8)).p_value > 0.99


def test_a_joint_that_stands_still_has_none_for_that() -> None:
    assert judged(noise(3), speed=np.zeros(LENGTH)).p_value > 0.01
    assert judged(np.zeros(LENGTH)).p_value > 0.99


def test_too_little_is_not_judged() -> None:
    assert bursts_of([noise(1, 300)], [SPEED[:300]], [T[:300]], DT, BANDWIDTH) is None
    assert bursts_of([noise(1, 20)], [SPEED[:20]], [T[:20]], DT, BANDWIDTH) is None
