"""Torques that no recorded motion explains: lines, slow signals and bursts beside noise."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal

from armident.identify.diagnosis.excess import bursts, spectral_excess

Array = NDArray[np.float64]

DT, ROWS = 0.02, 600
T: Array = DT * np.arange(ROWS, dtype=np.float64)
SPEED: Array = np.asarray(np.sin(2 * np.pi * 0.3 * T + 0.1), dtype=np.float64)


def noise(seed: int, constant_s: float = 0.0) -> Array:
    """White noise of unit variance, or noise of first order with a time constant."""
    white = np.random.default_rng(seed).normal(size=ROWS + 200)
    if constant_s == 0.0:
        return white[:ROWS]
    pole = np.exp(-DT / constant_s)
    return np.asarray(signal.lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], white)[200:])


@pytest.mark.parametrize("constant_s", [0.0, 0.01, 0.03])
def test_noise_of_drives_has_no_excess(constant_s: float) -> None:
    lowest = []
    for seed in range(60):
        one, other = noise(2 * seed, constant_s), noise(2 * seed + 1, constant_s)
        spectral, moments = spectral_excess([one], [other], DT), bursts([one], [T], [SPEED])
        lowest.append(min(part.p_value for part in (spectral, moments) if part is not None))
    # Of 120 p-values 1.2 are below 0.01; ten or more have a probability of 1e-6.
    assert np.sum(np.array(lowest) < 0.01) < 10
    assert min(lowest) > 1e-6


def test_a_vibration_has_its_frequency() -> None:
    one, other = (noise(k) + 2.0 * np.sin(2 * np.pi * 3.7 * T + k) for k in range(2))
    found = spectral_excess([one], [other], DT)
    assert found is not None
    assert found.kind == "frequency"
    assert found.where[0] == pytest.approx(3.7, abs=0.1)
    assert found.p_value < 1e-6
    assert found.p_held < 1e-3
    # Its rms is 1.41, that of the noise 1.
    assert found.size == pytest.approx(np.sqrt(2.0), rel=0.15)


def test_a_slow_signal_is_no_line() -> None:
    one, other = (noise(k) + 3.0 * noise(k + 9, 1.0) for k in range(2))
    found = spectral_excess([one], [other], DT)
    assert found is not None
    assert found.kind == "unrecorded signal"
    assert found.where[0] < 1.0
    assert found.p_value < 1e-3
    assert found.share > 0.4


def test_contact_is_bursts_at_their_times() -> None:
    touched = noise(0)
    for begin in (2.2, 7.4):
        touched[round(begin / DT) : round(begin / DT) + 15] += 12.0
    found = bursts([touched], [T], [SPEED])
    assert found is not None
    assert found.p_value < 1e-12
    assert found.share > 0.5
    assert all(min(abs(t - 2.2), abs(t - 7.4)) < 0.4 for t in found.where)


def test_errors_at_reversals_are_no_bursts() -> None:
    turns = np.flatnonzero(np.sign(SPEED[1:]) != np.sign(SPEED[:-1]))
    rough = noise(0)
    for turn in turns:
        rough[turn - 1 : turn + 3] += 12.0
    found = bursts([rough], [T], [SPEED])
    assert found is None or found.p_value > 1e-3


def test_a_joint_at_rest_has_none() -> None:
    rest = np.zeros(ROWS)
    assert spectral_excess([rest], [rest], DT) is None
    assert bursts([rest], [T], [SPEED]) is None
