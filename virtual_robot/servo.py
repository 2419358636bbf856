"""What the drives compute every control period: encoder, interpolated demand, cascade, current."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from configs import RobotConfig

CONTROL_PERIOD = 200e-6
"""Period of position, velocity and current command, s."""

BANDWIDTH_HZ = (5.0, 5.0, 6.0, 8.0, 8.0, 10.0)
"""Closed-loop bandwidth of each position loop; thesis appendix B.2: at most 10 Hz, reached by joint 6."""

VELOCITY_FILTER_HZ = 400.0
"""Corner of the first-order filter on the velocity error, which is a difference of encoder counts."""

SHARE_OF_POLE = 0.6436
"""Bandwidth (-3 dB) of two equal poles, over the poles' frequency."""


@njit(cache=True, error_model="numpy")
def control(  # type: ignore[no-untyped-def]
    q, ratio, counts_per_rad, origin, target, age, steps, held, kp, kv, smooth, limit, noise, permille,
    error, error_rate, current, position, reported, demand, torque, disturbance, tau,
):  # fmt: skip
    """One control period of all drives (arrays (n,), motor side); state and outputs change in place.

    Velocity loop around position loop (thesis figure B.1), its reference completed by the demand's velocity, as
    drives in cyclic synchronous position mode do: ``current = kv (kp e + de/dt)``, ``e = demand - position``.
    ``tau`` (n,) gets the joint torques until the next period, ``torque`` (n, n) being N m per ampere.
    ``held`` drives (not enabled) give no current and let their demand follow the position.
    """
    n = q.size
    for j in range(n):
        angle = 0.0
        for i in range(n):
            angle += ratio[j, i] * q[i]
        counts = math.floor(angle * counts_per_rad[j] + 0.5)
        position[j] = np.int32(counts)
        if held[j]:
            origin[j] = counts
            target[j] = counts
            demand[j] = np.int32(counts)
            error[j] = 0.0
            error_rate[j] = 0.0
            current[j] = 0.0
        else:
            share = min(age[j] / steps[j], 1.0)
            wanted = origin[j] + (target[j] - origin[j]) * share
            demand[j] = np.int32(math.floor(wanted + 0.5))
            now = (wanted - counts) / counts_per_rad[j]
            error_rate[j] += smooth * (now - error[j] - error_rate[j])
            error[j] = now
            current[j] = min(max(kv[j] * (kp[j] * now + error_rate[j] / CONTROL_PERIOD), -limit[j]), limit[j])
        age[j] += 1
        measured = math.floor((current[j] + noise[j]) * permille[j] + 0.5)
        reported[j] = np.int16(min(max(measured, -32768.0), 32767.0))
    for i in range(n):
        tau[i] = disturbance[i]
        for j in range(n):
            tau[i] += torque[i, j] * current[j]


def gains(robot: RobotConfig, mass: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gains ``kp`` (1/s) and ``kv`` (A s/rad), motor side, for two equal poles at the bandwidths wanted.

    Parameters
    ----------
    robot
        Transmission and drive gains.
    mass
        Mass matrix (n, n) at the posture the gains are tuned for, joint side, rotors included.
    """
    inverse = np.linalg.inv(robot.transmission_matrix)
    inertia = np.diag(inverse.T @ mass @ inverse)
    bandwidth = np.array([BANDWIDTH_HZ[min(j, len(BANDWIDTH_HZ) - 1)] for j in range(robot.n)])
    pole = 2 * np.pi * bandwidth / SHARE_OF_POLE
    drive_gain = np.array([joint.drive.gain for joint in robot.joints])
    return 0.5 * pole, 2.0 * pole * inertia / drive_gain
