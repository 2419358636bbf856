"""Effects of drives and encoders: reported signals differ from the true ones."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.configs.schema.robot import Effect as Entry
from armident.identify.effects.effect import UNITLESS, Linear, Periodic, Place, Shape, TorqueDependent, Trials
from armident.identify.robot.motion import Motion
from armident.identify.signals.experiments import Experiment
from armident.identify.signals.recursive import recursive_filter

LEAST = 0.1
"""Least squared ratio of a recorded torque to the true one in the correction of a saturated report."""


NOMINAL_TORQUE = 100.0
"""Torque limit of a joint (N m, or N) whose configuration has none; it only scales the parameter of a saturation."""


def motor_limit(robot: RobotConfig, motor: int) -> float:
    """Return the largest torque of a motor at its shaft, N m or N; that of `NOMINAL_TORQUE` if no limit is known."""
    limit = robot.joints[motor].limits.torque
    torque = limit if math.isfinite(limit) else NOMINAL_TORQUE
    return float(torque / np.abs(robot.transmission_matrix[motor]).max())


class Correction(TorqueDependent):
    """Effect with one linear parameter, for whose value the recorded torque of a motor can be corrected.

    The columns, its first-order expansion, have noise larger than the effect; a corrected recording adds none.
    """

    scope = "motor"

    @abstractmethod
    def shaft_column(self, torque: Array, motion: Motion, motor: int) -> Array:
        """Return the torque (N,) at a motor's shaft per unit of the parameter; ``torque`` (N,): predicted."""

    @abstractmethod
    def true_torque(self, recorded: Array, value: float, dt: float, limit: float) -> Array:
        """Return the true torque (N,) of a motor whose largest torque is ``limit``, N m or N."""

    @abstractmethod
    def values_to_test(self, recorded: Array, dt: float, limit: float) -> Array:
        """Return the values at which a diagnosis tests the correction, increasing in size for each sign."""

    def relative_slope(self, value: float) -> float:
        """Return the change of the true torque by a change of the value, over that by a further small correction."""
        return 1.0

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the torques of the joints that the motor drives."""
        return motion.of_motor(place.joint, self.shaft_column(motion.motor_torque[:, place.joint], motion, place.joint))

    def corrects(self, entry: Entry) -> bool:
        """Return True if the entry gives the value; otherwise it is estimated with the other parameters."""
        return bool(entry.parameters.get(self.linear[0].name))

    def corrected(self, experiment: Experiment, robot: RobotConfig, entry: Entry) -> Experiment:
        """Return an experiment with corrected torques. ``entry``: entry of this effect with the value."""
        motor = [joint.name for joint in robot.joints].index(entry.joint)
        at_motors = experiment.tau @ np.linalg.inv(robot.transmission_matrix)
        value, limit = entry.parameters[self.linear[0].name], motor_limit(robot, motor)
        at_motors[:, motor] = self.true_torque(at_motors[:, motor], value, experiment.dt, limit)
        return replace(experiment, tau=np.ascontiguousarray(at_motors @ robot.transmission_matrix))


class DriveGainError(Correction):
    """Torque per ampere that differs from the configuration."""

    name = "drive_gain_error"
    title = "a wrong torque constant"
    description = (
        "the torque per ampere of a drive differs from its configuration: wrong data, weak magnets, a new drive"
    )
    reference = "Gautier, Briot 2014, IEEE Trans. Automatic Control 59(10), Global identification of drive gains"
    required_motion = "several joints that carry the same link; for a single axis a baseline"
    direct_evidence = "a known payload, or a torque sensor behind the gear"
    excitation = ("load", "accelerations")
    linear = (
        Linear("gain_error", UNITLESS, "Relative error of the reported torque: 0.1: 10 % more.", bounds=(-0.6, 1.5)),
    )
    scales_torque = True
    change_title = "torque constant changed since the baseline"
    compared = True

    def shaft_column(self, torque: Array, motion: Motion, motor: int) -> Array:
        """Return the torque."""
        return torque

    def invisible(self, motion: Motion, place: Place) -> str | None:
        """Return a reason for a single axis."""
        if motion.n == 1:
            return "the parameters of a single axis grow and shrink with the gain of its only drive"
        return None

    def true_torque(self, recorded: Array, value: float, dt: float, limit: float) -> Array:
        """Return the torque over one plus the gain error."""
        true: Array = recorded / (1.0 + value)
        return true

    def relative_slope(self, value: float) -> float:
        """Return ``1 / (1 + gain_error)``: gains multiply."""
        return 1.0 / (1.0 + value)

    def values_to_test(self, recorded: Array, dt: float, limit: float) -> Array:
        """Return errors from 4 to 60 % to either side, and 120 %."""
        sizes = np.geomspace(0.04, 0.6, 5)
        return np.concatenate([-sizes, sizes, [1.2]])


class DriveGainSaturation(Correction):
    """Odd torque curve: the share lost grows with the square of the torque."""

    name = "drive_gain_saturation"
    title = "a torque that is not proportional to the current"
    description = (
        "the motor gives less torque per ampere at high current because its iron saturates (gain_loss positive), or "
        "the reported current saturates (negative); gain_loss is the share at the torque limit of the joint, and grows "
        "with the square of the torque"
    )
    reference = "Leonhard 2001, Control of Electrical Drives, chapter 5"
    required_motion = "small and large torques"
    direct_evidence = "a torque sensor behind the gear"
    excitation = ("load", "accelerations")
    linear = (Linear("gain_loss", UNITLESS, "Share of the torque lost at the torque limit of the joint."),)

    def shaft_column(self, torque: Array, motion: Motion, motor: int) -> Array:
        """Return the cubic term of the curve."""
        # Normalised by the torque limit, so that the parameter does not depend on the motion.
        loss: Array = torque * (torque / motor_limit(motion.model.robot, motor)) ** 2
        return loss

    def true_torque(self, recorded: Array, value: float, dt: float, limit: float) -> Array:
        """Return ``i / sqrt(1 + 2 loss (i / limit)^2)``, sample by sample."""
        given: Array = recorded / np.sqrt(np.maximum(1.0 + 2.0 * value * (recorded / limit) ** 2, LEAST))
        return given

    def values_to_test(self, recorded: Array, dt: float, limit: float) -> Array:
        """Return losses of 2 to 60 % at the largest recorded torque, to either side."""
        sizes = np.geomspace(0.02, 0.6, 5) * (limit / max(float(np.abs(recorded).max()), 1e-300)) ** 2
        return np.concatenate([-sizes, sizes])


class TimeDelay(Correction):
    """Torque that is reported late."""

    name = "time_delay"
    title = "a delay of the recorded torque"
    description = (
        "the reported torque belongs to a position that was reported earlier: a filter or a queue in the drive"
    )
    reference = "Brunot 2017, section 2.3.1"
    required_motion = "quick changes of the torque"
    direct_evidence = "the demanded torque, recorded with the actual one"
    excitation = ("accelerations",)
    linear: tuple[Linear, ...] = (Linear("delay", ("s", "s"), "Time by which the reported torque is late.", sign=1),)

    def shaft_column(self, torque: Array, motion: Motion, motor: int) -> Array:
        """Return minus the rate of the torque."""
        return -motion.rate(torque)

    def true_torque(self, recorded: Array, value: float, dt: float, limit: float) -> Array:
        """Return the torque at the instants at which it acted."""
        t = dt * np.arange(recorded.size)
        early: Array = np.interp(t + value, t, recorded)
        return early

    def values_to_test(self, recorded: Array, dt: float, limit: float) -> Array:
        """Return times from a quarter of a sample to 64 samples."""
        return np.asarray(dt * np.geomspace(0.25, 64.0, 9))

    def is_convention(self, values: Array, uncertain: float) -> bool:
        """Return True below the time by which the instant of all torques is uncertain: drives latch signals then."""
        return bool(np.all(np.abs(values) < uncertain))


class ActuatorBandwidth(TimeDelay):
    """Torque that follows the reported command with a first-order lag."""

    name = "actuator_bandwidth"
    title = "a slow current loop"
    description = (
        "the reported torque is a command that the motor follows with a first-order lag: a slow current loop; a "
        "delay of the reported position has the same effect"
    )
    reference = "Leonhard 2001, Control of Electrical Drives, chapter 7"
    linear = (Linear("lag", ("s", "s"), "Time constant of the lag of the torque behind the report.", sign=1),)

    def shaft_column(self, torque: Array, motion: Motion, motor: int) -> Array:
        """Return the rate of the torque."""
        return motion.rate(torque)

    def true_torque(self, recorded: Array, value: float, dt: float, limit: float) -> Array:
        """Return the torque after ``1 / (1 + lag s)``, from rest (Tustin)."""
        if value <= 0.0:
            return recorded
        ratio = 2.0 * value / dt
        b, a = np.array([1.0, 1.0]) / (1.0 + ratio), np.array([1.0, (1.0 - ratio) / (1.0 + ratio)])
        return np.asarray(recursive_filter(b, a, recorded - recorded[0]) + recorded[0])


class EncoderEccentricity(Periodic, TorqueDependent):
    """Error of the measured position that is periodic in the angle."""

    name = "encoder_eccentricity"
    title = "an eccentric encoder"
    description = "the measured position has an error that is periodic in the angle: an encoder disc mounted off centre"
    reference = "Armstrong 1998, Mechanism and Machine Theory; de Silva 2007, Sensors and Actuators, chapter 5"
    required_motion = "fast motion over a wide range"
    direct_evidence = "an encoder on the joint side"
    excitation = ("speeds", "range")
    linear = (
        Linear("ecc", ("rad", "m"), "Amplitude of the cosine component of the position error."),
        Linear("ecs", ("rad", "m"), "Amplitude of the sine component of the position error."),
    )
    shapes = (
        Shape(
            "harmonic",
            ("per rad of the joint", "rad/m"),
            "Periods of the error per turn of the joint; for a prismatic axis a wave number.",
            continuous=(False, True),
        ),
    )

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return columns for measured positions ``q + c cos(h q) + s sin(h q)``, linearised in ``c`` and ``s``."""
        j, harmonic = place.joint, shapes["harmonic"]
        angle, w, a = harmonic * motion.q[:, j], harmonic * motion.qd[:, j], harmonic * motion.qdd[:, j]
        c, s = np.cos(angle), np.sin(angle)
        ways = ((c, -s * w, -s * a - c * w**2), (s, c * w, c * a - s * w**2))
        return -np.stack([motion.response(j, *way) for way in ways], axis=2)

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return one and two per turn of joint and motor; of a prismatic axis wave numbers, rad/m."""
        if motion.model.robot.joints[place.joint].type == "prismatic":
            resolution = np.pi / float(motion.span[place.joint])
            return ([resolution * k for k in (*np.arange(2.0, 16.0, 0.5), *range(16, 81))],)
        ratio = float(np.max(np.abs(motion.model.robot.transmission_matrix[place.joint])))
        return (sorted({1.0, 2.0, ratio, 2 * ratio}),)
