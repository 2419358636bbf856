"""Effects of links, springs, payload and mounting."""

import numpy as np
from numpy.typing import NDArray

from armident.identify.effects.effect import Effect, Linear, Place
from armident.identify.effects.tables import RANGE, table, values
from armident.identify.robot.chain import INERTIAL
from armident.identify.robot.motion import Motion

Array = NDArray[np.float64]


def _spring(motion: Motion, place: Place) -> Array:
    return motion.q[:, place.joint, None]


def _stiffening_spring(motion: Motion, place: Place) -> Array:
    q = motion.q[:, place.joint]
    return np.stack([q, q**2, q**3], axis=1)


def _spring_table(motion: Motion, place: Place, *, low: float, high: float) -> Array:
    return table(motion.q[:, place.joint], low, high)


def across(gravity: Array) -> Array:
    """Return two orthonormal vectors perpendicular to gravity, shape (2, 3): the x and y axes of an upright arm."""
    down = gravity / np.linalg.norm(gravity)
    start = np.eye(3)[int(np.argmin(np.abs(down)))]
    first = start - (start @ down) * down
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(first, down)])


def _gravity(motion: Motion, place: Place) -> Array:
    """Return columns of a tilt: the torque is linear in gravity, so they are those of gravity along `across`."""
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
    # The motor's inertia, referred to its own joint: divided by that joint's ratio squared.
    own = ratios[int(np.argmax(np.abs(ratios)))]
    return motion.of_motor(place.joint, motion.qdd @ ratios / own**2)


def _offset_numbers(motion: Motion, place: Place) -> Array:
    model = motion.model
    change: Array = model.base.regroup[:, [model.names.index(f"off{place.joint + 1}")]]
    return change


def by_numbers(motion: Motion, change: Array) -> Array:
    """Return the columns (N, n, k), N m or N per unit of a parameter, of a change of the base parameters.

    Parameters
    ----------
    motion
        Motion of the arm, N samples.
    change
        Jacobian (b, k) of the base parameters.
    """
    columns: Array = motion.model.rigid_regressor(motion.q, motion.qd, motion.qdd, sharp_sign=motion.sharp) @ change
    return columns


EFFECTS = (
    Effect(
        name="joint_spring",
        title="a spring at the joint",
        says="a torque proportional to the joint's position: a spring, a gravity compensator, a stiff cable harness",
        reference="Khalil, Dombre 2002, Modeling, Identification and Control of Robots, chapter 9",
        linear=(Linear("ks", ("N m/rad", "N/m")),),
        columns=_spring,
        needs="a wide range of joint positions",
        excitation=("range",),
    ),
    Effect(
        name="joint_spring",
        law="cubic",
        title="a spring at the joint",
        says="a torque that grows faster than the joint's position: a stiffening spring, a bumper, a cable harness",
        reference="Khalil, Dombre 2002, Modeling, Identification and Control of Robots, chapter 9",
        linear=(
            Linear("ks", ("N m/rad", "N/m")),
            Linear("ks2", ("N m/rad^2", "N/m^2")),
            Linear("ks3", ("N m/rad^3", "N/m^3")),
        ),
        columns=_stiffening_spring,
        needs="a wide range of joint positions",
        excitation=("range",),
    ),
    Effect(
        name="joint_spring",
        law="table",
        title="a spring at the joint",
        says="a torque that depends on the joint's position: a spring, a gravity compensator, a stiff cable harness",
        reference="Khalil, Dombre 2002, Modeling, Identification and Control of Robots, chapter 9",
        linear=values("kst", ("N m", "N")),
        shapes=RANGE,
        columns=_spring_table,
        needs="a wide range of joint positions",
        excitation=("range",),
    ),
    Effect(
        name="payload",
        title="a payload on the flange",
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
        title="an unmodelled rotor inertia",
        says="a motor has more inertia than the links explain: a rotor, a brake or a coupling is missing in the model",
        reference="Brunot 2017, equation 2.13",
        linear=(Linear("iax", ("kg m^2", "kg"), sign=1),),
        columns=_rotor,
        needs="strong accelerations",
        scope="motor",
        excitation=("accelerations",),
    ),
    Effect(
        name="gravity_direction",
        title="a tilted base",
        says="the direction of gravity differs from the configuration: the base is tilted or hangs",
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
        title="a torque offset",
        says="a constant torque that the baseline does not have: a drifting current sensor, a dragging brake",
        reference="Brunot 2017, equation 2.12",
        linear=(Linear("offx", ("N m", "N")),),
        columns=lambda motion, place: by_numbers(motion, _offset_numbers(motion, place)),
        numbers=_offset_numbers,
        needs="a baseline identified without it",
    ),
)
