"""Correlation analysis finds controllers it is shown, in a loop that it does not see."""

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import DataError
from armident.identify.controller.crc import identify_crc

DT = 1e-3
STEPS = 20000


def closed_loop(
    error_taps: NDArray[np.float64], velocity_gain: float, noise: float = 0.0, seed: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Position, reference and torque of a unit mass with friction under FIR and velocity feedback, encoder of 1e-6."""
    rng = np.random.default_rng(seed)
    t = np.arange(STEPS) * DT
    reference = 0.3 * np.sin(2 * np.pi * 0.7 * t) + 0.1 * np.sin(2 * np.pi * 2.3 * t + 1)
    q, qd = reference[0], 0.0
    measured, torque = np.zeros(STEPS), np.zeros(STEPS)
    errors = np.zeros(error_taps.size)
    for k in range(STEPS):
        measured[k] = np.round(q / 1e-6) * 1e-6
        errors = np.concatenate([[reference[k] - measured[k]], errors[:-1]])
        speed = (measured[k] - measured[max(k - 1, 0)]) / DT
        torque[k] = error_taps @ errors - velocity_gain * speed
        acceleration = torque[k] - 2.0 * qd
        q, qd = q + DT * qd + DT**2 / 2 * acceleration, qd + DT * acceleration
    return measured[:, None], reference[:, None], torque[:, None] + noise * rng.standard_normal((STEPS, 1))


@pytest.mark.slow
def test_a_pd_on_the_error_is_recovered_from_noisy_torque() -> None:
    stiffness, damping = 900.0, 60.0
    taps = np.array([stiffness + damping / DT, -damping / DT])
    q, r, tau = closed_loop(taps, 0.0, noise=0.02)
    found = identify_crc([q], [r], [tau], DT).responses[0]
    assert found.position_taps.size == 0
    assert found.error_taps.sum() == pytest.approx(stiffness, rel=0.02)
    assert -found.error_taps[1:] @ np.arange(1, found.error_taps.size) * DT == pytest.approx(damping, rel=0.02)
    assert found.fit_pct > 99.0


def test_a_velocity_loop_by_differencing_is_found() -> None:
    q, r, tau = closed_loop(np.array([4000.0]), 60.0)
    found = identify_crc([q], [r], [tau], DT).responses[0]
    assert found.fit_pct > 99.99
    assert found.error_taps[0] == pytest.approx(4000.0, rel=1e-3)
    np.testing.assert_allclose(found.position_taps[:2], [-60.0 / DT, 60.0 / DT], rtol=1e-3)
    assert found.position_taps.sum() == pytest.approx(0.0, abs=1e-6)


def test_length_and_structure_can_be_given() -> None:
    q, r, tau = closed_loop(np.array([4000.0]), 60.0)
    found = identify_crc([q], [r], [tau], DT, length=7, velocity_loop=False)
    assert found.responses[0].error_taps.size == 7
    assert found.responses[0].position_taps.size == 0
    assert found.controller.error_taps.shape == (1, 7)


def test_two_experiments_count_as_one_longer_one() -> None:
    taps = np.array([900.0 + 60.0 / DT, -60.0 / DT])
    q, r, tau = closed_loop(taps, 0.0)
    half = STEPS // 2
    found = identify_crc([q[:half], q[half:]], [r[:half], r[half:]], [tau[:half], tau[half:]], DT).responses[0]
    assert found.error_taps.sum() == pytest.approx(900.0, rel=0.02)


def test_a_motor_that_never_deviates_is_named() -> None:
    still = np.zeros((1000, 1))
    with pytest.raises(DataError, match="motor 1"):
        identify_crc([still], [still], [still], DT)
