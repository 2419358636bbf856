"""Servo drives: encoder, interpolated demand, cascade controller and current, by control period."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.compiled import PLAIN, compiled
from armident.configs import ConfigError, RobotConfig
from armident.configs.schema.robot import Controller

CONTROL_PERIOD = 200e-6
"""Longest control period of position, velocity and current command, s; that of the TX40."""

OWN_PERIODS = {"tx40": CONTROL_PERIOD, "emps": 1e-3}
"""Control periods of arms that have their own, s; EMPS: that of its recordings."""

BANDWIDTH_HZ = (5.0, 5.0, 6.0, 8.0, 8.0, 10.0)
"""Closed-loop bandwidth of each position loop, Hz; thesis appendix B.2: at most 10 Hz, reached by joint 6."""

VELOCITY_FILTER_HZ = 400.0
"""Corner of the first-order filter on the velocity from encoder differences, Hz."""

SHARE_OF_POLE = 0.6436
"""Bandwidth (-3 dB) of two equal poles relative to the poles' frequency: sqrt(sqrt(2) - 1)."""


@dataclass(frozen=True)
class Servo:
    """Cascade controllers of all drives, motor side (thesis figure B.1): a velocity loop inside a position loop.

    Parameters
    ----------
    kp, kv
        Gains, 1/s and units of the drives' signal per rad/s or m/s, shape (n,).
    velocity_feedback
        ``True``: ``signal = kv (kp e - qd)`` with ``e = demand - position``. ``False``: ``signal = kv (kp e + de/dt)``,
        with the velocity of the demand, as in cyclic synchronous position mode.
    velocity_samples
        Number of periods over which the velocity is averaged.
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
        """Weight of a new velocity in the discrete first-order low-pass."""
        return 1.0 - math.exp(-2 * math.pi * self.filter_hz * self.period)


@compiled(
    "f8, b1, f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[::1], i8[::1], i8[::1], b1[::1], f8[::1], f8[::1], f8, "
    "f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], i4[::1], i2[::1], i4[::1], f8[:, ::1], f8[::1], "
    "f8[::1]",
    **PLAIN,
)
def control(  # type: ignore[no-untyped-def]
    period, feedback, q, ratio, counts_per_rad, origin, target, age, steps, held, kp, kv, smooth, limit, noise,
    permille, past, rate, current, position, reported, demand, torque, disturbance, tau,
):  # fmt: skip
    """Compute one control period of all drives (`Servo`), motor side; state and outputs are changed in place.

    Parameters
    ----------
    period, feedback, kp, kv, smooth
        Control period, velocity feedback, gains, and weight of the velocity filter, as in `Servo`.
    q
        Measured joint positions, rad or m, shape (n,).
    ratio
        Transmission matrix, shape (n, n).
    counts_per_rad
        Encoder counts per rad or m, shape (n,).
    origin, target, age, steps
        Previous and present target (counts), and passed and total periods of the interpolation, shape (n,).
    held
        ``True`` for drives that are not enabled: no current, and their demand follows the position, shape (n,).
    limit
        Saturation of the signal, shape (n,).
    noise
        Noise of the measured signal, shape (n,).
    permille
        Reported numbers per unit of the signal, shape (n,).
    past, rate
        Input of the velocity loop in the last periods, newest first, shape (n, velocity samples), and its filtered
        change per period, shape (n,).
    current, position, reported, demand
        Signal, position (counts), reported signal (per mille of rated) and demand (counts), shape (n,).
    torque
        Joint torque per unit of the signal, N m or N, shape (n, n).
    disturbance
        Disturbance torques, joint side, shape (n,).
    tau
        Joint torques until the next period, shape (n,).
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


def control_period(robot: RobotConfig, sync_period: float | None = None) -> float:
    """Control period of the robot's drives, s; a SYNC period has a whole number of them.

    ``sync_period``: SYNC period, s; ``None``: any.
    """
    if robot.name in OWN_PERIODS or sync_period is None:
        return OWN_PERIODS.get(robot.name, CONTROL_PERIOD)
    return sync_period / math.ceil(sync_period / CONTROL_PERIOD - 1e-6)


def design(
    robot: RobotConfig,
    mass: NDArray[np.float64],
    velocity_feedback: bool | None = None,
    *,
    period: float | None = None,
    bandwidth_hz: Sequence[float] = BANDWIDTH_HZ,
    known: Controller | None = None,
) -> Servo:
    """Design the drives of a virtual arm: a known controller, else tuned gains.

    Raises ConfigError if ``velocity_feedback`` is ``False`` with a known controller.

    Parameters
    ----------
    robot
        Transmission and drive gains.
    mass
        Mass matrix at the posture for which the gains are tuned, joint side, rotors included, shape (n, n).
    velocity_feedback
        As for ``Servo``; ``None``: ``True`` with a known controller, else ``False``.
    period
        Control period, s; ``None``: that of `control_period`.
    bandwidth_hz
        Bandwidths of the position loops for tuned gains, Hz; the last one counts for all further joints.
    known
        Known controller, which has velocity feedback; ``None``: that of the robot's configuration, if it has one.
    """
    period = control_period(robot) if period is None else period
    known = robot.controller if known is None else known
    if known is None:
        return Servo(period, *gains(robot, mass, bandwidth_hz), bool(velocity_feedback), 1, VELOCITY_FILTER_HZ)
    if velocity_feedback is False:
        raise ConfigError(f"robot {robot.name!r}: its controller (kp, kv) feeds back the velocity, and cannot without")
    return Servo(period, np.array(known.kp), np.array(known.kv), True, known.velocity_samples, math.inf)


def gains(
    robot: RobotConfig, mass: NDArray[np.float64], bandwidth_hz: Sequence[float] = BANDWIDTH_HZ
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gains ``kp`` (1/s) and ``kv`` (A s/rad), motor side, for two equal poles at the given bandwidths.

    ``robot``: transmission and drive gains. ``mass``: mass matrix at the posture for which the gains are tuned, joint
    side, rotors included, shape (n, n). ``bandwidth_hz``: bandwidths of the position loops, Hz; the last one counts for
    all further joints. Returns ``kp``, ``kv``: gains, shape (n,) each.
    """
    inverse = np.linalg.inv(robot.transmission_matrix)
    inertia = np.diag(inverse.T @ mass @ inverse)
    bandwidth = np.array([bandwidth_hz[min(j, len(bandwidth_hz) - 1)] for j in range(robot.n)])
    pole = 2 * np.pi * bandwidth / SHARE_OF_POLE
    drive_gain = np.array([joint.drive.gain for joint in robot.joints])
    return 0.5 * pole, 2.0 * pole * inertia / drive_gain
