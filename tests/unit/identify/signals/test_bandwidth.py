"""The bandwidth of a motion that nobody described: the same whatever the encoder and the sampling rate."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import DataError
from armident.identify.signals.bandwidth import MARGIN, PERIODS, motion_bandwidth

SECONDS = 30.0


def sines(dt: float, fastest: float = 3.0) -> NDArray[np.float64]:
    t = np.arange(round(SECONDS / dt))[:, None] * dt
    slow = 0.3 * np.sin(2 * np.pi * 0.2 * t) * [1.0, 0.5]
    # Half of the velocity's power, on the second joint only.
    quick = 0.3 * 0.5 * 0.2 / fastest * np.sin(2 * np.pi * fastest * t) * [0.0, 1.0]
    motion: NDArray[np.float64] = slow + quick
    return motion


@pytest.mark.parametrize("dt", [2e-4, 1e-3, 5e-3])
@pytest.mark.parametrize("resolution", [1e-8, 1e-6, 1e-5])
def test_fastest_joint_decides_whatever_the_rate_and_the_encoder(dt: float, resolution: float) -> None:
    q = np.round(sines(dt) / resolution) * resolution
    assert motion_bandwidth([q], dt) == pytest.approx(MARGIN * 3.0, rel=0.03)


def test_noise_of_more_power_than_the_motion_is_not_taken_for_motion() -> None:
    dt = 2e-4
    q = sines(dt)
    noise = 1e-3 * np.random.default_rng(0).standard_normal(q.shape)
    assert np.mean(np.diff(noise, axis=0) ** 2) > 100 * np.mean(np.diff(q, axis=0) ** 2)
    assert motion_bandwidth([q + noise], dt) == pytest.approx(MARGIN * 3.0, rel=0.05)


def test_slow_motion_leaves_enough_equations() -> None:
    dt = 5e-3
    t = np.arange(round(SECONDS / dt))[:, None] * dt
    slow = np.sin(2 * np.pi * 0.12 * t)
    assert motion_bandwidth([slow], dt) == pytest.approx(PERIODS / SECONDS)
    # The shortest experiment has to have enough.
    assert motion_bandwidth([slow, slow[:3000]], dt) == pytest.approx(2 * PERIODS / SECONDS)


def test_a_short_recording_is_not_asked_for_more_than_its_rate_gives() -> None:
    dt = 1e-2
    t = np.arange(300)[:, None] * dt
    assert motion_bandwidth([np.sin(2 * np.pi * 0.5 * t)], dt) <= 0.2 / dt


def test_standstill_is_refused() -> None:
    with pytest.raises(DataError, match="nothing moves"):
        motion_bandwidth([np.ones((1000, 3))], 1e-3)


def test_coarse_encoder_of_the_measured_panda_is_not_its_motion(shared_data: Path) -> None:
    file = shared_data / "panda" / "exciting_traj_positions.txt"
    if not file.is_file():
        pytest.skip(f"no {file.name} in the measured data")
    q = np.loadtxt(file).reshape(-1, 7)
    # 95 % of the power of its smoothed velocity lies below 0.45 Hz; the rounding to 1e-4 rad reaches to 500 Hz.
    assert motion_bandwidth([q], 1e-3) < 5.0
