"""Effects of links, springs, payload and mounting."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from armident.identify.effects.effect import TORQUE, Effect, Linear, Place, TorqueDependent
from armident.identify.effects.free_shapes import OverPosition, table, values
from armident.identify.effects.parameter_change import ParameterChange
from armident.identify.robot.chain import INERTIAL
from armident.identify.robot.motion import Motion

Array = NDArray[np.float64]


class JointSpring(Effect):
    """Linear spring."""

    name = "joint_spring"
    title = "a spring at the joint"
    description = (
        "a torque proportional to the joint's position: a spring, a gravity compensator, a stiff cable harness"
    )
    reference = "Khalil, Dombre 2002, Modeling, Identification and Control of Robots, chapter 9"
    required_motion = "a wide range of joint positions"
    excitation = ("range",)
    linear: tuple[Linear, ...] = (Linear("ks", ("N m/rad", "N/m"), "Stiffness: torque per joint position."),)
    rigid_part = "springs"

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the position."""
        return motion.q[:, place.joint, None]


class JointSpringCubic(JointSpring):
    """Spring that stiffens with its deflection."""

    law = "cubic"
    description = "a torque that grows faster than the joint's position: a stiffening spring, a bumper, a cable harness"
    linear = (
        *JointSpring.linear,
        Linear("ks2", ("N m/rad^2", "N/m^2"), "Change of the stiffness: torque per square of the position."),
        Linear("ks3", ("N m/rad^3", "N/m^3"), "Stiffening: torque per cube of the position."),
    )

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the first three powers of the position."""
        q = motion.q[:, place.joint]
        return np.stack([q, q**2, q**3], axis=1)


class JointSpringTable(OverPosition, JointSpring):
    """Spring of any shape."""

    description = (
        "a torque that depends on the joint's position: a spring, a gravity compensator, a stiff cable harness"
    )
    linear = values("kst", TORQUE, "torque of the spring over the position")

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the functions of the table."""
        return table(motion.q[:, place.joint], shapes["low"], shapes["high"])


class Payload(ParameterChange):
    """Other inertial parameters of the last link."""

    name = "payload"
    title = "a payload on the flange"
    description = "the last link is heavier than in the baseline: a gripper or a workpiece is mounted"
    reference = "Gaz, De Luca 2017, IROS, Payload estimation based on identified coefficients of robot dynamics"
    required_motion = "a baseline identified without it"
    excitation = ("load", "range")
    scope = "arm"
    linear = tuple(
        Linear(
            f"{kind}p",
            ("kg" if kind == "m" else "kg m" if len(kind) == 2 and kind[0] == "m" else "kg m^2",) * 2,
            f"Additional `{kind}` of the last link, in its frame, compared with the baseline.",
        )
        for kind in INERTIAL
    )

    def parameters(self, place: Place, n: int) -> list[str]:
        """Return those of the last link."""
        return [f"{kind}{n}" for kind in INERTIAL]

    def change_in_words(self, joint: str, values: Mapping[str, float], std: Mapping[str, float]) -> str:
        """Return mass and centre of mass, if they are estimable."""
        if "mp" not in values:
            return super().change_in_words(joint, values, std)
        mass = values["mp"]
        words = f"{abs(mass):.3g} kg (standard deviation {std['mp']:.2g} kg) {'more' if mass > 0 else 'less'}"
        words += " on the flange than in the baseline"
        moments = [values.get(f"m{axis}p") for axis in "xyz"]
        if mass > 3 * std["mp"] and None not in moments:
            at = ", ".join(f"{moment / mass:.3f}" for moment in moments if moment is not None)
            words += f", centre of mass at ({at}) m in the frame of the last link"
        return words


class RotorInertia(Effect):
    """Inertia that turns with the motor."""

    name = "rotor_inertia"
    title = "an unmodelled rotor inertia"
    description = (
        "a motor has more inertia than the links explain: a rotor, a brake or a coupling is missing in the model"
    )
    reference = "Brunot 2017, equation 2.13"
    required_motion = "strong accelerations"
    excitation = ("accelerations",)
    scope = "motor"
    linear = (Linear("iax", ("kg m^2", "kg"), "Motor inertia on the joint side beyond that of the model.", sign=1),)
    change_title = "motor inertia changed since the baseline"
    rigid_part = "rotor inertia"

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the acceleration of the motor."""
        ratios = motion.model.robot.transmission_matrix[place.joint]
        # The motor's inertia, referred to its own joint: divided by that joint's ratio squared.
        own = ratios[int(np.argmax(np.abs(ratios)))]
        return motion.of_motor(place.joint, motion.qdd @ ratios / own**2)


class GravityDirection(TorqueDependent):
    """Tilt of the base about two axes."""

    name = "gravity_direction"
    title = "a tilted base"
    description = "the direction of gravity differs from the configuration: the base is tilted or hangs"
    reference = "Khalil, Dombre 2002, Modeling, Identification and Control of Robots, chapter 12"
    required_motion = "postures all over the workspace"
    excitation = ("range", "load")
    scope = "arm"
    linear = (
        Linear(
            "tilt_x",
            ("rad", "rad"),
            "Tilt of gravity along the first axis across it, a small angle (x axis of an upright arm).",
        ),
        Linear("tilt_y", ("rad", "rad"), "Tilt of gravity along the second axis across it (y axis of an upright arm)."),
    )
    change_title = "gravity direction changed since the baseline"
    rigid_part = "gravity"

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return those of gravity along `across`, in which the torque is linear; zeros without gravity."""
        model, size = motion.model, float(np.linalg.norm(motion.model.chain.gravity))
        if size == 0.0:
            return np.zeros((motion.samples, motion.n, len(self.linear)))
        still = np.zeros_like(motion.q)
        theta = motion.standard
        without = model.with_gravity(np.zeros(3)).inverse_dynamics(theta, motion.q, still, still)
        columns = [
            model.with_gravity(size * axis).inverse_dynamics(theta, motion.q, still, still) - without
            for axis in across(model.chain.gravity)
        ]
        return np.stack(columns, axis=2)

    def invisible(self, motion: Motion, place: Place) -> str | None:
        """Return a reason if there is no gravity."""
        return None if np.any(motion.model.chain.gravity) else "the configuration has no gravity"


def across(gravity: Array) -> Array:
    """Return two orthonormal vectors perpendicular to gravity, shape (2, 3): the x and y axes of an upright arm."""
    down = gravity / np.linalg.norm(gravity)
    start = np.eye(3)[int(np.argmin(np.abs(down)))]
    first = start - (start @ down) * down
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(first, down)])


class TorqueOffset(ParameterChange):
    """Other constant offset."""

    name = "torque_offset"
    title = "a torque offset"
    description = "a constant torque that the baseline does not have: a drifting current sensor, a dragging brake"
    reference = "Brunot 2017, equation 2.12"
    required_motion = "a baseline identified without it"
    linear = (Linear("offx", TORQUE, "Constant torque compared with the baseline."),)

    def parameters(self, place: Place, n: int) -> list[str]:
        """Return that of the joint."""
        return [f"off{place.joint + 1}"]


EFFECTS = (JointSpring, JointSpringCubic, JointSpringTable, Payload, RotorInertia, GravityDirection, TorqueOffset)
