"""Servo drives: encoder, interpolated demand, cascade controller and current, by control period."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armident.arrays import Array
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

    ``kp``, ``kv`` (n,): 1/s and units of the signal per rad/s or m/s. With feedback ``signal = kv (kp e - qd)``, ``e =
    demand - position``; without, ``kv (kp e + de/dt)``, as in cyclic synchronous position mode. Velocity is averaged
    over ``velocity_samples`` periods, low-pass ``filter_hz``.
    """

    period: float
    kp: Array
    kv: Array
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
    """Compute one control period of all drives (`Servo`), motor side; state and outputs (n,) change in place.

    ``q``: measured, joint side. ``ratio`` (n, n): transmission. ``origin``, ``target``, ``age``, ``steps``: previous
    and present target, counts, passed and total periods of the interpolation. ``held``: drives not enabled, without
    current, their demand follows the position. ``smooth``: weight of the velocity filter; ``past`` (n, samples) its
    inputs, newest first, ``rate`` the change per period. ``permille``: reported numbers per unit of the signal.
    ``torque`` (n, n): joint torque per unit of the signal. ``tau``: joint torques until the next period, with
    ``disturbance``.
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
    """Control period of the robot's drives, s; a SYNC period, s, has a whole number of them."""
    if robot.name in OWN_PERIODS or sync_period is None:
        return OWN_PERIODS.get(robot.name, CONTROL_PERIOD)
    return sync_period / math.ceil(sync_period / CONTROL_PERIOD - 1e-6)


def tuned_drives(
    robot: RobotConfig,
    mass: Array,
    velocity_feedback: bool | None = None,
    *,
    period: float | None = None,
    bandwidth_hz: Sequence[float] = BANDWIDTH_HZ,
    known: Controller | None = None,
) -> Servo:
    """Design the drives of a virtual arm: a ``known`` controller (with velocity feedback), else tuned gains.

    ``mass`` (n, n): at the posture of tuning, joint side, with rotors. The last of ``bandwidth_hz`` counts for all
    further joints. Raises ConfigError if ``velocity_feedback`` contradicts a known controller.
    """
    period = control_period(robot) if period is None else period
    known = robot.controller if known is None else known
    if known is None:
        return Servo(period, *cascade_gains(robot, mass, bandwidth_hz), bool(velocity_feedback), 1, VELOCITY_FILTER_HZ)
    if velocity_feedback is False:
        raise ConfigError(f"robot {robot.name!r}: its controller (kp, kv) feeds back the velocity, and cannot without")
    return Servo(period, np.array(known.kp), np.array(known.kv), True, known.velocity_samples, math.inf)


def cascade_gains(robot: RobotConfig, mass: Array, bandwidth_hz: Sequence[float] = BANDWIDTH_HZ) -> tuple[Array, Array]:
    """Gains ``kp`` (1/s) and ``kv`` (A s/rad), (n,) each, motor side, for two equal poles at the given bandwidths.

    ``mass`` (n, n): at the posture of tuning, joint side, with rotors. The last bandwidth counts for further joints.
    """
    inverse = np.linalg.inv(robot.transmission_matrix)
    inertia = np.diag(inverse.T @ mass @ inverse)
    bandwidth = np.array([bandwidth_hz[min(j, len(bandwidth_hz) - 1)] for j in range(robot.n)])
    pole = 2 * np.pi * bandwidth / SHARE_OF_POLE
    drive_gain = np.array([joint.drive.gain for joint in robot.joints])
    return 0.5 * pole, 2.0 * pole * inertia / drive_gain
