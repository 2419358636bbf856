"""Effects of links, springs and mounting."""

import numpy as np
from numpy.typing import NDArray

from armident.identify.effects.effect import Effect, Linear, Place
from armident.identify.robot.chain import INERTIAL
from armident.identify.robot.motion import Motion

Array = NDArray[np.float64]


def _spring(motion: Motion, place: Place) -> Array:
    return motion.q[:, place.joint, None]


def across(gravity: Array) -> Array:
    """Two unit vectors at right angles to gravity and to each other, shape (2, 3): x, then y, of an upright arm."""
    down = gravity / np.linalg.norm(gravity)
    start = np.eye(3)[int(np.argmin(np.abs(down)))]
    first = start - (start @ down) * down
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(first, down)])


def _gravity(motion: Motion, place: Place) -> Array:
    """The torque is linear in gravity, so a tilt adds the torque of a gravity along the axes across it."""
    model, size = motion.model, float(np.linalg.norm(motion.model.chain.gravity))
    still = np.zeros_like(motion.q)
    theta = motion.standard
    without = model.with_gravity(np.zeros(3)).inverse_dynamics(theta, motion.q, still, still)
    columns = [
        model.with_gravity(size * axis).inverse_dynamics(theta, motion.q, still, still) - without
        for axis in across(model.chain.gravity)
    ]
    return np.stack(columns, axis=2)


def _no_gravity(motion: Motion, place: Place) -> str | None:
    if not np.any(motion.model.chain.gravity):
        return "the configuration has no gravity"
    return None


def _payload_numbers(motion: Motion, place: Place) -> Array:
    base, n = motion.model.base, motion.n
    chosen = [motion.model.names.index(f"{kind}{n}") for kind in INERTIAL]
    change: Array = base.regroup[:, chosen]
    return change


def _rotor(motion: Motion, place: Place) -> Array:
    ratios = motion.model.robot.transmission_matrix[place.joint]
    # Of the motor, but given at its own joint: the ratio of that joint taken out twice.
    own = ratios[int(np.argmax(np.abs(ratios)))]
    return motion.of_motor(place.joint, motion.qdd @ ratios / own**2)


def _offset_numbers(motion: Motion, place: Place) -> Array:
    model = motion.model
    change: Array = model.base.regroup[:, [model.names.index(f"off{place.joint + 1}")]]
    return change


def by_numbers(motion: Motion, change: Array) -> Array:
    """Columns (N, n, k) of a change (b, k) of the base parameters."""
    columns: Array = motion.model.rigid_regressor(motion.q, motion.qd, motion.qdd, sharp_sign=motion.sharp) @ change
    return columns


EFFECTS = (
    Effect(
        name="joint_spring",
        title="a spring on the joint",
        says="a torque in proportion to the joint's position: a spring, a gravity compensator, a stiff cable harness",
        reference="Khalil, Dombre 2002, Modeling, Identification and Control of Robots, chapter 9",
        linear=(Linear("ks", ("N m/rad", "N/m")),),
        columns=_spring,
        needs="a wide range of joint positions",
        excitation=("range",),
    ),
    Effect(
        name="payload",
        title="something mounted on the flange",
        says="the last link is heavier than in the baseline: a gripper or a workpiece is mounted",
        reference="Gaz, De Luca 2017, IROS, Payload estimation based on identified coefficients of robot dynamics",
        linear=tuple(
            Linear(
                f"{kind}p", ("kg" if kind == "m" else "kg m" if len(kind) == 2 and kind[0] == "m" else "kg m^2",) * 2
            )
            for kind in INERTIAL
        ),
        columns=lambda motion, place: by_numbers(motion, _payload_numbers(motion, place)),
        numbers=_payload_numbers,
        needs="a baseline identified without it",
        scope="arm",
        excitation=("load", "range"),
    ),
    Effect(
        name="rotor_inertia",
        title="a rotor that the model does not know",
        says="a motor has more inertia than the links explain: a rotor, a brake or a coupling left out of the model",
        reference="Brunot 2017, equation 2.13",
        linear=(Linear("iax", ("kg m^2", "kg"), sign=1),),
        columns=_rotor,
        needs="strong accelerations",
        scope="motor",
        excitation=("accelerations",),
    ),
    Effect(
        name="gravity_direction",
        title="the base stands askew",
        says="the arm feels gravity from another direction than its configuration says: the base is tilted, or hangs",
        reference="Khalil, Dombre 2002, Modeling, Identification and Control of Robots, chapter 12",
        linear=(Linear("tilt_x", ("rad", "rad")), Linear("tilt_y", ("rad", "rad"))),
        columns=_gravity,
        visible=_no_gravity,
        predicts=True,
        needs="postures all over the workspace",
        scope="arm",
        excitation=("range", "load"),
    ),
    Effect(
        name="torque_offset",
        title="a constant torque",
        says="a constant torque that the baseline did not have: a drifting current sensor, a brake that drags",
        reference="Brunot 2017, equation 2.12",
        linear=(Linear("offx", ("N m", "N")),),
        columns=lambda motion, place: by_numbers(motion, _offset_numbers(motion, place)),
        numbers=_offset_numbers,
        needs="a baseline identified without it",
    ),
)
