"""What the drives compute every control period: encoder, interpolated demand, cascade, current."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from armident.configs import ConfigError, RobotConfig

CONTROL_PERIOD = 200e-6
"""Period of position, velocity and current command, s."""

OTHER_PERIODS = {"emps": 1e-3}
"""Control periods of virtual arms whose drives have another one, s; EMPS: that of its recordings."""

BANDWIDTH_HZ = (5.0, 5.0, 6.0, 8.0, 8.0, 10.0)
"""Closed-loop bandwidth of each position loop; thesis appendix B.2: at most 10 Hz, reached by joint 6."""

VELOCITY_FILTER_HZ = 400.0
"""Corner of the first-order filter on the velocity loop's difference of encoder counts."""

SHARE_OF_POLE = 0.6436
"""Bandwidth (-3 dB) of two equal poles, over the poles' frequency."""


@dataclass(frozen=True)
class Servo:
    """The cascade of all drives, motor side (thesis figure B.1): a velocity loop inside a position loop.

    Parameters
    ----------
    period
        Control period, s.
    kp, kv
        Gains (n,), 1/s and units of the drives' signal per rad/s or m/s.
    velocity_feedback
        ``signal = kv (kp e - qd)``, ``e = demand - position``; otherwise the velocity loop has the demand's velocity as
        well, ``signal = kv (kp e + de/dt)``, as drives in cyclic synchronous position mode do.
    velocity_samples
        Periods over which the velocity is the mean.
    filter_hz
        Corner of the first-order low-pass on the velocity, Hz; infinite: none.
    """

    period: float
    kp: NDArray[np.float64]
    kv: NDArray[np.float64]
    velocity_feedback: bool
    velocity_samples: int
    filter_hz: float

    @property
    def smooth(self) -> float:
        """Share of a new velocity that the low-pass lets through at once."""
        return 1.0 - math.exp(-2 * math.pi * self.filter_hz * self.period)


@njit(cache=True, error_model="numpy")
def control(  # type: ignore[no-untyped-def]
    period, feedback, q, ratio, counts_per_rad, origin, target, age, steps, held, kp, kv, smooth, limit, noise,
    permille, past, rate, current, position, reported, demand, torque, disturbance, tau,
):  # fmt: skip
    """One control period of all drives (arrays (n,), motor side); state and outputs change in place.

    Cascade of ``Servo``. ``past`` (n, velocity samples) holds what the velocity loop differentiates, newest first,
    ``rate`` its filtered change over a period. ``tau`` (n,) gets the joint torques until the next period, ``torque``
    (n, n) being N m per ampere (or N per volt, as the drives have it). ``held`` drives (not enabled) give no current
    and let their demand follow the position.
    """
    n, samples = past.shape
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
            past[j, :] = -counts / counts_per_rad[j] if feedback else 0.0
            rate[j] = 0.0
            current[j] = 0.0
        else:
            share = min(age[j] / steps[j], 1.0)
            wanted = origin[j] + (target[j] - origin[j]) * share
            demand[j] = np.int32(math.floor(wanted + 0.5))
            now = (wanted - counts) / counts_per_rad[j]
            newest = -counts / counts_per_rad[j] if feedback else now
            rate[j] += smooth * ((newest - past[j, samples - 1]) / samples - rate[j])
            for i in range(samples - 1, 0, -1):
                past[j, i] = past[j, i - 1]
            past[j, 0] = newest
            current[j] = min(max(kv[j] * (kp[j] * now + rate[j] / period), -limit[j]), limit[j])
        age[j] += 1
        measured = math.floor((current[j] + noise[j]) * permille[j] + 0.5)
        reported[j] = np.int16(min(max(measured, -32768.0), 32767.0))
    for i in range(n):
        tau[i] = disturbance[i]
        for j in range(n):
            tau[i] += torque[i, j] * current[j]


def control_period(robot: RobotConfig) -> float:
    """Control period of the robot's drives, s."""
    return OTHER_PERIODS.get(robot.name, CONTROL_PERIOD)


def design(robot: RobotConfig, mass: NDArray[np.float64], velocity_feedback: bool | None = None) -> Servo:
    """The drives of a virtual arm: with the controller that its configuration knows, else tuned.

    Parameters
    ----------
    robot
        Transmission, drive gains, and perhaps a known controller, which feeds back the velocity.
    mass
        Mass matrix (n, n) at the posture the gains are tuned for, joint side, rotors included.
    velocity_feedback
        As for ``Servo``; ``None``: as the controller of the configuration, without one not.

    Raises
    ------
    ConfigError
        If the known controller is wanted without its velocity feedback.
    """
    period, known = control_period(robot), robot.controller
    if known is None:
        return Servo(period, *gains(robot, mass), bool(velocity_feedback), 1, VELOCITY_FILTER_HZ)
    if velocity_feedback is False:
        raise ConfigError(f"robot {robot.name!r}: its controller (kp, kv) feeds back the velocity, and cannot without")
    return Servo(period, np.array(known.kp), np.array(known.kv), True, known.velocity_samples, math.inf)


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
