"""Effects of drives and encoders: reported signals differ from the true ones."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from armident.identify.effects.effect import Effect, Linear, Place, Recorded, Shape, motor_limit
from armident.identify.robot.motion import Motion

Array = NDArray[np.float64]


LEAST = 0.1
"""Least squared ratio of a recorded torque to the true one in the correction of a saturated report."""


def _gain(motion: Motion, place: Place) -> Array:
    return motion.of_motor(place.joint, motion.motor_torque[:, place.joint])


def _alone(motion: Motion, place: Place) -> str | None:
    if motion.n == 1:
        return "the parameters of a single axis grow and shrink with the gain of its only drive"
    return None


def _rescaled(recorded: Array, at: Recorded, gain_error: float) -> Array:
    """Return the true torques (N,) of recorded ones."""
    true: Array = recorded / (1.0 + gain_error)
    return true


def _saturation(motion: Motion, place: Place) -> Array:
    """Return the cubic term of an odd torque curve: the share lost grows with the square of the torque."""
    torque = motion.motor_torque[:, place.joint]
    # Normalised by the torque limit, so that the parameter does not depend on the motion.
    loss = torque * (torque / motor_limit(motion.model.robot, place.joint)) ** 2
    return motion.of_motor(place.joint, loss)


def _unsaturated(recorded: Array, at: Recorded, loss: float) -> Array:
    """Return the true torques (N,) of recorded ones: ``i / sqrt(1 + 2 loss (i / limit)^2)``.

    Sample by sample: the saturation acts on the noise that the controller adds, too.
    """
    given: Array = recorded / np.sqrt(np.maximum(1.0 + 2.0 * loss * (recorded / at.limit) ** 2, LEAST))
    return given


def _delay(motion: Motion, place: Place) -> Array:
    return motion.of_motor(place.joint, -motion.rate(motion.motor_torque[:, place.joint]))


def _bandwidth(motion: Motion, place: Place) -> Array:
    return motion.of_motor(place.joint, motion.rate(motion.motor_torque[:, place.joint]))


def _earlier(recorded: Array, at: Recorded, delay: float) -> Array:
    """Return the recorded torques (N,) shifted to the instants at which they acted."""
    t = at.dt * np.arange(recorded.size)
    early: Array = np.interp(t + delay, t, recorded)
    return early


def _lagging(recorded: Array, at: Recorded, lag: float) -> Array:
    """Return the torques (N,) of recorded commands after a first-order lag ``1 / (1 + lag s)``, from rest (Tustin)."""
    if lag <= 0.0:
        return recorded
    ratio = 2.0 * lag / at.dt
    b, a = np.array([1.0, 1.0]) / (1.0 + ratio), np.array([1.0, (1.0 - ratio) / (1.0 + ratio)])
    late: Array = signal.lfilter(b, a, recorded, zi=recorded[:1] * (1.0 - b[0]))[0]
    return late


def _within_a_sample(values: Array, dt: float) -> bool:
    """Return True for delays below a sampling period: drives differ in the instant at which they latch signals."""
    return bool(np.all(np.abs(values) < dt))


def _eccentricity(motion: Motion, place: Place, *, harmonic: float) -> Array:
    """Return columns for measured positions ``q + c cos(h q) + s sin(h q)``, linearised in ``c`` and ``s``."""
    j = place.joint
    angle, w, a = harmonic * motion.q[:, j], harmonic * motion.qd[:, j], harmonic * motion.qdd[:, j]
    c, s = np.cos(angle), np.sin(angle)
    ways = ((c, -s * w, -s * a - c * w**2), (s, c * w, c * a - s * w**2))
    return -np.stack([motion.response(j, *way) for way in ways], axis=2)


def rounds(motion: Motion, joint: int) -> Sequence[float]:
    """Return harmonics: one and two per turn of joint and motor; for a prismatic axis wave numbers, rad/m.

    Parameters
    ----------
    motion
        Motion of the arm.
    joint
        Index of the joint, from 0.
    """
    if motion.model.robot.joints[joint].type == "prismatic":
        resolution = np.pi / float(motion.span[joint])
        return [float(resolution * k) for k in (*np.arange(2.0, 16.0, 0.5), *range(16, 81))]
    ratio = float(np.max(np.abs(motion.model.robot.transmission_matrix[joint])))
    return sorted({1.0, 2.0, ratio, 2 * ratio})


EFFECTS = (
    Effect(
        name="drive_gain_error",
        title="a wrong torque constant",
        says="the torque per ampere of a drive differs from its configuration: wrong data, weak magnets, a new drive",
        reference="Gautier, Briot 2014, IEEE Trans. Automatic Control 59(10), Global identification of drive gains",
        linear=(Linear("gain_error", ("", ""), bounds=(-0.6, 1.5)),),
        columns=_gain,
        visible=_alone,
        predicts=True,
        share=True,
        undo=_rescaled,
        needs="several joints that carry the same link; for a single axis a baseline",
        scope="motor",
        excitation=("load", "accelerations"),
    ),
    Effect(
        name="drive_gain_saturation",
        title="a torque that is not proportional to the current",
        says="the motor gives less torque per ampere at high current because its iron saturates (gain_loss "
        "positive), or the reported current saturates (negative); "
        "gain_loss is the share at the torque limit of the joint, and "
        "grows with the square of the torque",
        reference="Leonhard 2001, Control of Electrical Drives, chapter 5",
        linear=(Linear("gain_loss", ("", "")),),
        columns=_saturation,
        predicts=True,
        undo=_unsaturated,
        needs="small and large torques",
        scope="motor",
        excitation=("load", "accelerations"),
    ),
    Effect(
        name="time_delay",
        title="a delay of the recorded torque",
        says="the reported torque belongs to a position that was reported earlier: a filter or a queue in the drive",
        reference="Brunot 2017, section 2.3.1",
        linear=(Linear("delay", ("s", "s"), sign=1),),
        columns=_delay,
        predicts=True,
        undo=_earlier,
        negligible=_within_a_sample,
        needs="quick changes of the torque",
        scope="motor",
        excitation=("accelerations",),
    ),
    Effect(
        name="actuator_bandwidth",
        title="a slow current loop",
        says="the reported torque is a command that the motor follows with a first-order lag: a slow current loop; a "
        "delay of the reported position has the same effect",
        reference="Leonhard 2001, Control of Electrical Drives, chapter 7",
        linear=(Linear("lag", ("s", "s"), sign=1),),
        columns=_bandwidth,
        predicts=True,
        undo=_lagging,
        negligible=_within_a_sample,
        needs="quick changes of the torque",
        scope="motor",
        excitation=("accelerations",),
    ),
    Effect(
        name="encoder_eccentricity",
        title="an eccentric encoder",
        says="the measured position has an error that is periodic in the angle: an encoder disc mounted off centre",
        reference="Armstrong 1998, Mechanism and Machine Theory; de Silva 2007, Sensors and Actuators, chapter 5",
        linear=(Linear("ecc", ("rad", "m")), Linear("ecs", ("rad", "m"))),
        shapes=(Shape("harmonic", ("per rad of the joint", "rad/m"), rounds, continuous=(False, True)),),
        columns=_eccentricity,
        predicts=True,
        needs="fast motion over a wide range",
        together=True,
        excitation=("speeds", "range"),
    ),
)
