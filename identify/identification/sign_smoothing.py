"""Smoothing of the sign of each joint's velocity, chosen from the recorded motion (thesis appendix B.2).

The width ``1/g`` of ``(2/pi) atan(g qd)`` is a velocity: 150 s/rad saturates on a wrist, but not on a slow lift.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.signals.bandpass import butterworth, central_difference
from armident.identify.signals.bandwidth import position_noise
from armident.identify.signals.experiments import Experiment
from armident.identify.signals.streamed import Streamed

SATURATION = 450.0
"""``g`` times the top speed of the joint.

Source: 150 s/rad suffices for all joints of the TX40 (appendix B.2), so for the slowest one, of 3.1 rad/s (joint 5 of
`tx40_4.yaml`, 99 % quantile; all: 3.1 to 9.3 rad/s). The smoothed sign reaches 0.99 at 14 % of the top speed.
"""

TOP_QUANTILE = 0.99
"""Quantile of the absolute velocity that counts as the top speed."""

SPEEDS_PER_PERIOD = 8
"""Velocities per period of the low-pass from which the top speed of a long recording is taken: all of them would take
as much memory as the recording."""

LARGEST_CUTOFF = 0.45
"""Highest cut-off of the velocity filter, over the sampling rate."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Speeds:
    """Top (99 % quantile) and rms velocity of each joint, and its noise by the encoder, (n,) each, rad/s or m/s."""

    top: Array
    rms: Array
    noise: Array


def recorded_speeds(experiments: Sequence[Experiment], bandwidth_hz: float) -> Speeds:
    """Velocities of each joint, after a zero-phase low-pass at the closed-loop bandwidth."""
    speeds, noise, power, samples = [], [], np.zeros(experiments[0].q.shape[1]), 0
    for e in experiments:
        cutoff = min(bandwidth_hz, LARGEST_CUTOFF / e.dt)
        speed = np.abs(central_difference(butterworth(e.q, e.dt, cutoff), e.dt))
        power += np.sum(speed**2, axis=0)
        samples += speed.shape[0]
        every = max(1, int(1 / (SPEEDS_PER_PERIOD * cutoff * e.dt))) if isinstance(experiments, Streamed) else 1
        speeds.append(speed[::every].copy())
        # White noise has the density 2 var dt per Hz; differentiated up to the cut-off, its variance is this integral.
        noise.append(position_noise(e.q, e.dt) * np.sqrt(8 / 3 * e.dt * np.pi**2 * cutoff**3))
    top = [np.quantile(np.concatenate([s[:, j] for s in speeds]), TOP_QUANTILE) for j in range(speeds[0].shape[1])]
    return Speeds(np.array(top), np.sqrt(power / samples), np.max(noise, axis=0))


def with_sign_smoothing(robot: RobotConfig, experiments: Sequence[Experiment], bandwidth_hz: float) -> RobotConfig:
    """Return the configuration with a number for each joint's ``friction.sign_smoothing``, where it gives none.

    The width ``1/g`` is ``1 / SATURATION`` of the top speed, but not below the noise of the velocity.
    """
    if robot.friction.sign_smoothing is not None:
        return robot
    speeds = recorded_speeds(experiments, bandwidth_hz)
    width = np.maximum(speeds.top / SATURATION, speeds.noise)
    # Four digits: the choice is one of scale, and the document shows the number that was used.
    chosen = [
        float(f"{1 / w:.4g}") if w > 0 else float(nominal)
        for w, nominal in zip(width, robot.sign_smoothing, strict=True)
    ]
    return with_numbers(robot, chosen)


def with_numbers(robot: RobotConfig, smoothing: Sequence[float] | Array) -> RobotConfig:
    """Configuration with numbers ``g`` (n,), s/rad or s/m, for ``friction.sign_smoothing`` where it gives none."""
    if robot.friction.sign_smoothing is not None:
        return robot
    numbers = tuple(float(g) for g in smoothing)
    return robot.model_copy(update={"friction": robot.friction.model_copy(update={"sign_smoothing": numbers})})


def unsaturated_joints(
    given: RobotConfig, robot: RobotConfig, experiments: Sequence[Experiment], bandwidth_hz: float
) -> list[str]:
    """Warnings for joints so slow that the smoothing of the sign biases their friction; ``given``: by the user."""
    speeds = recorded_speeds(experiments, bandwidth_hz)
    reached = 2 / np.pi * np.arctan(robot.sign_smoothing * speeds.rms)
    warnings = []
    for j, joint in enumerate(robot.joints):
        if reached[j] >= IdentificationCriteria.min_smoothed_sign or speeds.rms[j] == 0.0:
            continue
        unit = "s/rad" if joint.type == "revolute" else "s/m"
        wanted = SATURATION / max(float(speeds.top[j]), 1e-300)
        change = given.friction.sign_smoothing is not None and speeds.top[j] / SATURATION > speeds.noise[j]
        remedy = (
            f"leave friction.sign_smoothing out, or set {wanted:.3g} {unit} for this joint"
            if change
            else "record faster motion of this joint"
        )
        warnings.append(
            f"{joint.name}: the smoothed sign (g = {robot.sign_smoothing[j]:.4g} {unit}) reaches only "
            f"{100 * reached[j]:.0f} % at the joint's rms velocity: Coulomb and viscous friction are biased. "
            f"Next: {remedy}."
        )
    return warnings
