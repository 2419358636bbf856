"""Controllers that are not identified: that of the configuration, and a stiff nominal PD that follows any motion."""

import numpy as np

from armident.arrays import Array
from armident.configs import ConfigError, DataError, RobotConfig
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.controller import DiscreteController

STIFFNESS = 8.0
"""Natural frequency of the nominal controller, over the closed-loop bandwidth of the robot: at that bandwidth the
continuous loop leaves an error of ``1 / (1 + 8^2)``, 1.5 %."""

HIGHEST = 0.3
"""Largest natural frequency times sampling period (rad); above it the sampled loop is poorly damped."""


def saturation(robot: RobotConfig) -> Array:
    """Largest motor torque of each drive (n,), N m or N; infinite where the configuration gives none."""
    return np.array(
        [np.inf if j.drive.saturation is None else abs(j.drive.gain) * j.drive.saturation for j in robot.joints]
    )


def known_controller(robot: RobotConfig, dt: float) -> DiscreteController:
    """Cascade controller with the configured gains; ConfigError without them."""
    if robot.controller is None:
        raise ConfigError(f"controller known: the configuration of {robot.name} has no controller (kp, kv)")
    gain = np.array([joint.drive.gain for joint in robot.joints])
    known = robot.controller
    return DiscreteController.cascade(
        np.array(known.kp),
        np.array(known.kv),
        gain,
        dt,
        saturation=saturation(robot),
        velocity_samples=known.velocity_samples,
    )


def nominal_controller(model: ArmModel, theta: Array, q: Array, dt: float, bandwidth_hz: float) -> DiscreteController:
    """Critically damped PD for the mean inertia at each motor over the postures ``q`` (N, n).

    Its derivative acts on the error, not on the velocity, so that it follows a moving reference without lag.
    """
    ratios = model.robot.transmission_matrix
    mass = model.mass_matrix(theta, q).mean(axis=0)
    inverse = np.linalg.inv(ratios)
    inertia = np.diag(inverse.T @ mass @ inverse)
    if not (inertia > 0).all():
        weak = model.robot.joints[int(np.argmin(inertia))].name
        raise DataError(f"the estimated inertia seen by the motor of {weak} is not positive")
    omega = min(2 * np.pi * STIFFNESS * bandwidth_hz, HIGHEST / dt)
    stiffness, damping = inertia * omega**2, 2 * inertia * omega
    return DiscreteController.fir(np.stack([stiffness + damping / dt, -damping / dt], axis=1), dt)
