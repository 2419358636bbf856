"""What a moving arm may do before its drives are stopped."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig

FOLLOWING_S = 0.1
"""A joint may lag behind its demand by what it covers in this time at its velocity limit, s."""

VELOCITY_S = 0.01
"""Velocity is a difference of positions over this time (s): a lost frame must not look like haste."""

TORQUE_S, TORQUE_SAMPLES = 0.01, 20
"""Torque is a mean over this time (s) and at least so many samples: measured currents chop, gears do not feel it."""

TORQUE_PEAK = 2.0
"""A single sample beyond this multiple of the limit is no chopping."""

HEARTBEATS_MISSED = 3
HEARTBEAT_MARGIN_S = 0.1
"""A drive is lost after so many of its heartbeat periods, and what a host may be late on top; so is SYNC."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """Limits of the joints, (n,) each: rad or m, per second, N m or N.

    ``following`` is the largest distance between demand and position.
    """

    low: Floats
    high: Floats
    velocity: Floats
    torque: Floats
    following: Floats


def limits_of(robot: RobotConfig, following_s: float = FOLLOWING_S) -> Limits:
    """Limits as the robot's configuration states them.

    Parameters
    ----------
    robot
        The robot.
    following_s
        See `FOLLOWING_S`.
    """
    limits = [joint.limits for joint in robot.joints]
    velocity = np.array([limit.velocity for limit in limits])
    return Limits(
        low=np.array([limit.position[0] for limit in limits]),
        high=np.array([limit.position[1] for limit in limits]),
        velocity=velocity,
        torque=np.array([limit.torque for limit in limits]),
        following=velocity * following_s,
    )
