"""Motion for a virtual arm without a trajectory: a Fourier series within the limits of all joints."""

import numpy as np

from armident.configs import RobotConfig, Trajectory
from armident.configs.schema.trajectory import Fourier

FREQUENCY_HZ = 0.1
"""First harmonic, Hz."""
HARMONICS = 5
"""Number of harmonics."""
REACH = 0.6
"""Largest share of the position range that is used."""
SHARE = 0.7
"""Largest share of the limits of velocity and acceleration that is used."""
SAMPLES = 2000
"""Samples of a period at which the limits are checked."""


def plausible_trajectory(robot: RobotConfig, seed: int = 0) -> Trajectory:
    """Draw a periodic motion that uses the limits of the joints; begins and ends at rest."""
    rng, n = np.random.default_rng([seed, 4]), robot.n
    order = np.arange(1.0, HARMONICS + 1)
    sine, cosine = rng.normal(size=(2, HARMONICS, n)) / order[:, None]
    # A series begins at rest if the sums of l sine and of l^2 cosine are zero.
    sine -= np.outer(order, order @ sine) / (order @ order)
    cosine -= np.outer(order**2, order**2 @ cosine) / (order**2 @ order**2)
    t = np.arange(SAMPLES) / SAMPLES / FREQUENCY_HZ
    rate = 2.0 * np.pi * FREQUENCY_HZ * order
    angle = t[:, None] * rate
    away = np.sin(angle) @ sine + (np.cos(angle) - 1.0) @ cosine
    velocity = (np.cos(angle) * rate) @ sine - (np.sin(angle) * rate) @ cosine
    acceleration = -(np.sin(angle) * rate**2) @ sine - (np.cos(angle) * rate**2) @ cosine
    low, high = np.array([joint.limits.position for joint in robot.joints]).T
    factor = np.min(
        [
            REACH * (high - low) / np.ptp(away, axis=0),
            SHARE * np.array([joint.limits.velocity for joint in robot.joints]) / np.abs(velocity).max(axis=0),
            SHARE * np.array([joint.limits.acceleration for joint in robot.joints]) / np.abs(acceleration).max(axis=0),
        ],
        axis=0,
    )
    middle = 0.5 * (low + high) - factor * 0.5 * (away.max(axis=0) + away.min(axis=0))
    series = Fourier(
        frequency=FREQUENCY_HZ,
        sine=tuple(map(tuple, (factor * sine).tolist())),
        cosine=tuple(map(tuple, (factor * cosine).tolist())),
    )
    return Trajectory(schema="armident/trajectory/1", start=tuple(middle.tolist()), fourier=series)
