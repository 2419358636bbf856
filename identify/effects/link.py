"""Effects of links, springs, payload and mounting."""

from collections.abc import Mapping

import numpy as np

from armident.arrays import Array
from armident.identify.documents.rounding import plus_minus
from armident.identify.effects.effect import TORQUE, Effect, Linear, Place, TorqueDependent
from armident.identify.effects.free_shapes import OverPosition, table, values
from armident.identify.effects.parameter_change import ParameterChange
from armident.identify.robot.chain import INERTIAL
from armident.identify.robot.motion import Motion


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
    compared = True

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the position."""
        return motion.q[:, place.joint, None]


class JointSpringCubic(JointSpring):
    """Spring that stiffens with its deflection."""

    law = "cubic"
    compared = False
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
    compared = False

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the functions of the table."""
        return table(motion.q[:, place.joint], shapes["low"], shapes["high"])


class Payload(ParameterChange):
    """Other inertial parameters of a link."""

    name = "payload"
    title = "a payload"
    description = (
        "a link has another mass than in the baseline: a gripper, a workpiece or equipment is mounted, or was removed"
    )
    reference = "Gaz, De Luca 2017, IROS, Payload estimation based on identified coefficients of robot dynamics"
    required_motion = "a baseline identified without it"
    excitation = ("load", "range")
    linear = tuple(
        Linear(
            f"{kind}p",
            ("kg" if kind == "m" else "kg m" if len(kind) == 2 and kind[0] == "m" else "kg m^2",) * 2,
            f"Additional `{kind}` of the link, in its frame, compared with the baseline.",
        )
        for kind in INERTIAL
    )

    def parameters(self, place: Place, n: int) -> list[str]:
        """Return those of the link."""
        return [f"{kind}{place.joint + 1}" for kind in INERTIAL]

    def sizes(self, place: Place, standard: Mapping[str, float]) -> Array:
        """Return those of a mass at `PAYLOAD_REACH` from the origin of the link."""
        return np.array([1.0 if kind == "m" else PAYLOAD_REACH ** (1 if kind[0] == "m" else 2) for kind in INERTIAL])

    def consistent(self, values: Array, covariance: Array) -> bool:
        """Return True if a body with positive masses, added or removed, has these ten parameters.

        Its pseudo-inertia has no eigenvalue of the other sign by more than three standard deviations (Wensing, Kim,
        Slotine 2018, IEEE Robotics and Automation Letters 3(1)).
        """
        basis = [_pseudo_inertia(unit) for unit in np.eye(len(INERTIAL))]
        eigenvalues, vectors = np.linalg.eigh(sum(v * b for v, b in zip(values, basis, strict=True)))
        slopes = np.array([[v @ b @ v for b in basis] for v in vectors.T])
        deviations = eigenvalues / np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", slopes, covariance, slopes), 1e-300))
        return bool(deviations.min() > -3.0 or deviations.max() < 3.0)

    def change_in_words(self, joint: str, values: Mapping[str, float], std: Mapping[str, float]) -> str:
        """Return mass and centre of mass, or the moments of mass, as far as they are estimable."""
        mass, moments = values.get("mp", 0.0), {name: values[name] for name in ("mxp", "myp", "mzp") if name in values}
        if "mp" in values and abs(mass) > 3 * std["mp"]:
            words = f"{plus_minus(abs(mass), std['mp'])} kg {'more' if mass > 0 else 'less'}"
            words += f" on the link of {joint} than in the baseline"
            if len(moments) == 3:
                at = ", ".join(f"{moment / mass:.3f}" for moment in moments.values())
                words += f", centre of mass at ({at}) m in the frame of the link"
            return words
        words = f"another load on the link of {joint} than in the baseline"
        each = ", ".join(f"{n[:2]} {plus_minus(v, std[n])} kg m" for n, v in moments.items())
        return f"{words}: moment of mass {each}" if each else words


PAYLOAD_REACH = 0.2
"""Typical distance of a payload from the origin of its link, m: it relates mass, moments and inertias a priori."""


def _pseudo_inertia(values: Array) -> Array:
    """Return the pseudo-inertia (4, 4) of ten inertial parameters in the order of `INERTIAL`."""
    v = dict(zip(INERTIAL, values, strict=True))
    inertia = np.array([[v["xx"], v["xy"], v["xz"]], [v["xy"], v["yy"], v["yz"]], [v["xz"], v["yz"], v["zz"]]])
    moment = np.array([[v["mx"], v["my"], v["mz"]]])
    second = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    return np.block([[second, moment.T], [moment, np.array([[v["m"]]])]])


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
    compared = True
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
    direct_evidence = "an inclinometer at the base"
    excitation = ("range", "load")
    scope = "arm"
    linear: tuple[Linear, ...] = (
        Linear(
            "tilt_x",
            ("rad", "rad"),
            "Tilt of gravity along the first axis across it, a small angle (x axis of an upright arm).",
        ),
        Linear("tilt_y", ("rad", "rad"), "Tilt of gravity along the second axis across it (y axis of an upright arm)."),
    )
    change_title = "gravity direction changed since the baseline"
    compared = True
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


class GravityDirectionOfVerticalJoint(GravityDirection):
    """Tilt of the base of an arm whose first axis is vertical as configured."""

    law = "vertical_joint"
    change_title = ""
    compared = False
    rigid_part = ""
    linear = (
        *GravityDirection.linear,
        Linear("first_cos", TORQUE, "Torque of the tilt on the first joint, over the cosine of its position."),
        Linear("first_sin", TORQUE, "Torque of the tilt on the first joint, over the sine of its position."),
    )

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return those of the tilt, and both functions of the first joint."""
        first = np.zeros((motion.samples, motion.n, 2))
        first[:, 0] = np.column_stack([np.cos(motion.q[:, 0]), np.sin(motion.q[:, 0])])
        return np.concatenate([super().columns(motion, place, shapes), first], axis=2)

    def invisible(self, motion: Motion, place: Place) -> str | None:
        """Return a reason if there is no gravity, or the first axis is not along it."""
        chain = motion.model.chain
        axis = np.array([0.0, -chain.sin_alpha[0], chain.cos_alpha[0]])
        apart = float(np.linalg.norm(np.cross(axis, chain.gravity)))
        if chain.prismatic[0] or apart > PARALLEL * float(np.linalg.norm(chain.gravity)):
            return "the first joint does not turn about a vertical axis"
        return super().invisible(motion, place)

    def allows(self, values: Array, std: Array, shapes: Mapping[str, float]) -> bool:
        """Return True if joints beside the first show a tilt: that joint alone may as well have a spring."""
        return bool(np.any(np.abs(values[:2]) > SHOWN * std[:2]))


SHOWN = 3.0
"""Standard deviations from which a tilt is shown: noise exceeds them once in 370 times."""

PARALLEL = 1e-3
"""Sine of the angle under which an axis counts as vertical, as right angles of a file are rounded."""


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
