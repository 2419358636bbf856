"""Limits of a moving arm beyond which the guard stops its drives."""

from dataclasses import dataclass

import numpy as np

from armident.arrays import Array
from armident.configs import RobotConfig

FOLLOWING_S = 0.1
"""Largest following error, as the time of motion at the velocity limit, s."""

VELOCITY_S = 0.01
"""Time over which positions are differentiated, s; long enough that a lost frame is no excess velocity."""

TORQUE_S, TORQUE_SAMPLES = 0.01, 20
"""Torque is averaged over this time (s) and at least this number of samples, to suppress ripple of the current."""

TORQUE_PEAK = 2.0
"""Multiple of the torque limit that no single sample may exceed."""

HEARTBEATS_MISSED = 3
HEARTBEAT_MARGIN_S = 0.1
"""A heartbeat or SYNC is lost after this number of heartbeat periods plus a margin for the delay of the host, s."""


@dataclass(frozen=True)
class MotionLimits:
    """Limits of the joints, (n,), SI units; ``following``: largest distance between demand and position."""

    low: Array
    high: Array
    velocity: Array
    torque: Array
    following: Array


def motion_limits_of(robot: RobotConfig, following_s: float = FOLLOWING_S) -> MotionLimits:
    """Return the limits of a robot; ``following_s``: following error as time of motion at the velocity limit, s."""
    robot.check_movable()
    limits = [joint.limits for joint in robot.joints]
    velocity = np.array([limit.velocity for limit in limits])
    return MotionLimits(
        low=np.array([limit.position[0] for limit in limits]),
        high=np.array([limit.position[1] for limit in limits]),
        velocity=velocity,
        torque=np.array([limit.torque for limit in limits]),
        following=velocity * following_s,
    )
