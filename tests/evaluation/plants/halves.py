"""Parameter ranges of the sets of random arms: the same families, other seeds; validation and reserve draw wider."""

from dataclasses import dataclass, replace
from typing import Literal

Half = Literal["development", "validation", "reserve"]
Range = tuple[float, float]


@dataclass(frozen=True)
class Ranges:
    """Ranges from which the arms, controllers, motions and noise of a half are drawn.

    Parameters
    ----------
    entropy
        First word of every seed.
    joints
        Smallest and largest number of joints.
    prismatic
        Probability that a joint is prismatic.
    right_angles
        Probability that ``alpha`` is 0 or +-pi/2.
    mass
        Mass of the first link, kg.
    decay
        Mass of a link over that of the link before.
    length
        Lengths ``d`` and ``r`` other than zero, m.
    ratio
        Gear ratio of revolute joints.
    pitch
        Metres per turn of the motor of prismatic joints.
    rotor
        Rotor inertia, joint side, over the inertia of the links at the joint.
    sharp
        Probability that the dry friction of an arm has a sharp sign, so that its joints stick.
    smoothing
        Velocity scale of a smooth sign over the largest speed of the joint.
    dry, viscous
        Dry and viscous friction at full speed, over the torque scale of the joint.
    resolution
        Encoder resolution, joint side, rad; a tenth in metres.
    noise
        Torque noise over the rms torque of the joint.
    noise_time
        Time constant of coloured torque noise, s.
    speed
        Largest speed of the motion, rad/s.
    bandwidth
        Bandwidth of the position loop, Hz.
    duration
        Length of a recording, s.
    rates
        Sampling rates, Hz.
    wider
        Factor by which the ranges of the hidden laws are extended at both ends.
    visibility
        Visibility aimed at.
    """

    entropy: int
    joints: tuple[int, int]
    prismatic: float
    right_angles: float
    mass: Range
    decay: Range
    length: Range
    ratio: Range
    pitch: Range
    rotor: Range
    sharp: float
    smoothing: Range
    dry: Range
    viscous: Range
    resolution: Range
    noise: Range
    noise_time: Range
    speed: Range
    bandwidth: Range
    duration: Range
    rates: tuple[int, ...]
    wider: float
    visibility: Range


DEVELOPMENT = Ranges(
    entropy=20261,
    joints=(2, 7),
    prismatic=0.12,
    right_angles=0.9,
    mass=(2.0, 20.0),
    decay=(0.5, 0.8),
    length=(0.08, 0.45),
    ratio=(30.0, 130.0),
    pitch=(0.005, 0.03),
    rotor=(0.15, 1.5),
    sharp=0.25,
    smoothing=(0.004, 0.015),
    dry=(0.05, 0.6),
    viscous=(0.05, 0.8),
    resolution=(2e-6, 3e-4),
    noise=(0.008, 0.05),
    noise_time=(5e-4, 2e-2),
    speed=(0.8, 3.0),
    bandwidth=(4.0, 10.0),
    duration=(8.0, 14.0),
    rates=(200, 250, 400, 500, 1000, 1000, 2000, 2000, 4000, 5000),
    wider=1.0,
    visibility=(1.0, 10.0),
)

VALIDATION = Ranges(
    entropy=70517,
    joints=(2, 7),
    prismatic=0.18,
    right_angles=0.8,
    mass=(1.0, 40.0),
    decay=(0.45, 0.85),
    length=(0.05, 0.6),
    ratio=(20.0, 170.0),
    pitch=(0.003, 0.05),
    rotor=(0.1, 2.5),
    sharp=0.25,
    smoothing=(0.003, 0.02),
    dry=(0.03, 0.8),
    viscous=(0.03, 1.0),
    resolution=(1e-6, 5e-4),
    noise=(0.005, 0.06),
    noise_time=(3e-4, 3e-2),
    speed=(0.6, 3.5),
    bandwidth=(3.5, 12.0),
    duration=(8.0, 15.0),
    rates=(200, 300, 500, 800, 1000, 1250, 2000, 2500, 4000, 5000),
    wider=1.3,
    visibility=(1.0, 10.0),
)

RESERVE = replace(VALIDATION, entropy=40961)
"""Other seeds: `VALIDATION` was the reserve of the first four measurements, whose totals were looked at."""

HALVES: dict[Half, Ranges] = {"development": DEVELOPMENT, "validation": VALIDATION, "reserve": RESERVE}
