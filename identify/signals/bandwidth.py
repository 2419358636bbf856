"""Bandwidth of a recorded motion, for the choice of filters if none is configured."""

from collections.abc import Sequence

import numpy as np

from armident.arrays import Array
from armident.configs import DataError

POWER_SHARE = 0.95
"""Fraction of the power of the velocity that lies below the bandwidth of the motion."""

MARGIN = 5.0
"""Ratio of the closed-loop bandwidth assumed for the filters to the bandwidth of the motion: inertia torques have the
bandwidth of the acceleration, friction about reversals several harmonics more."""

SIGNIFICANT = 10.0
"""Power relative to the noise floor above which a frequency counts as motion; white noise exceeds it once in 20000."""

PERIODS = 50.0
"""Minimum bandwidth in periods per shortest experiment: 200 samples after the decimation of IDIM-LS."""


def motion_bandwidth(q: Sequence[Array], dt: float) -> float:
    """Bandwidth (Hz) for the choice of filters: `MARGIN` times that of the fastest joint's velocity.

    The encoder's noise floor is that of the upper half of the spectrum. At least `PERIODS` per shortest experiment:
    decimation would otherwise leave too few equations.
    """
    highest = max((_velocity_bandwidth(positions, dt) for positions in q), default=0.0)
    if highest == 0:
        raise DataError("nothing moves in this recording")
    shortest = min(positions.shape[0] for positions in q) * dt
    return float(min(max(MARGIN * highest, PERIODS / shortest), MARGIN * _highest(dt)))


def _highest(dt: float) -> float:
    """Highest frequency (Hz) that can count as motion."""
    return 0.04 / dt


def _velocity_bandwidth(q: Array, dt: float) -> float:
    """Frequency (Hz) below which ``POWER_SHARE`` of the fastest joint's velocity power lies; 0 if no joint moves."""
    frequency, power, position = velocity_spectra(q, dt)
    floor = _noise_floor(frequency, position, dt)
    moving = (position > SIGNIFICANT * floor) & (frequency <= _highest(dt))[:, None]
    cumulative = np.cumsum(np.where(moving, power, 0.0), axis=0)
    highest = 0.0
    for j in np.flatnonzero(cumulative[-1] > 0):
        reached = np.searchsorted(cumulative[:, j], POWER_SHARE * cumulative[-1, j])
        highest = max(highest, float(frequency[reached]))
    return highest


def position_noise(q: Array, dt: float) -> Array:
    """Standard deviation (n,) of the white noise of measured positions (N, n), rad or m."""
    frequency, _, position = velocity_spectra(q, dt)
    noise: Array = np.sqrt(_noise_floor(frequency, position, dt) * 0.5 * dt)
    return noise


def velocity_spectra(q: Array, dt: float) -> tuple[Array, Array, Array]:
    """Frequencies (F,), Hz, above 0, and spectral densities (F, n) of differences and positions over ``dt``."""
    velocity = np.diff(q, axis=0) / dt
    window = np.hanning(velocity.shape[0] + 1)[:-1, None]
    frequency = np.arange(1, velocity.shape[0] // 2 + 1) / (velocity.shape[0] * dt)
    spectrum = np.fft.rfft((velocity - velocity.mean(axis=0)) * window, axis=0)[1:]
    power: Array = np.abs(spectrum) ** 2 * (2.0 * dt / np.sum(window**2))
    return frequency, power, power / (2 - 2 * np.cos(2 * np.pi * frequency * dt))[:, None]


def _noise_floor(frequency: Array, position: Array, dt: float) -> Array:
    """White noise density (n,) over ``dt`` from the spectrum's upper half, whose median is log(2) of its mean."""
    floor: Array = np.median(position[frequency >= 0.25 / dt], axis=0) / np.log(2)
    return floor
