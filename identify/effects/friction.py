"""Friction effects beyond viscous and Coulomb friction, ``fv qd + fc sign(qd)``."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from armident.identify.effects.effect import Effect, Linear, Place, Shape
from armident.identify.effects.rotor import ROTOR
from armident.identify.effects.tables import RANGE, hats, table, values
from armident.identify.robot.compiled import compiled
from armident.identify.robot.motion import Motion

Array = NDArray[np.float64]

TORQUE = ("N m", "N")
LATE = 0.3
"""Lowest speed, over the largest one tried, at which nonlinear viscous friction may be negative (shear thickening).

The largest one tried is a third of the joint's top speed.
"""
SLOWEST = 0.03
"""Least characteristic speed of a friction law over the joint's top speed: below it laws look like the reversal."""
VISCOUS = ("N m s/rad", "N s/m")


def speeds(motion: Motion, joint: int) -> Sequence[float]:
    """Return characteristic speeds from those of the reversal to a third of the joint's top speed, rad/s or m/s.

    Parameters
    ----------
    motion
        Motion of the arm.
    joint
        Index of the joint, from 0.
    """
    top = float(motion.top_speed[joint])
    return [float(v) for v in top * np.geomspace(SLOWEST, 0.35, 7)]


def _asymmetric_viscous(motion: Motion, place: Place) -> Array:
    return (motion.qd * motion.sign)[:, place.joint, None]


def _asymmetric_coulomb(motion: Motion, place: Place, *, velocity: float = 0.0) -> Array:
    if velocity == 0.0:
        return motion.sign[:, place.joint, None] ** 2
    built: Array = (2 / np.pi * np.arctan(motion.qd[:, place.joint, None] / velocity)) ** 2
    return built


def films(motion: Motion, joint: int) -> Sequence[float]:
    """Return speeds from that of the joint's smoothed sign to a twentieth of the joint's top speed, rad/s or m/s.

    Parameters
    ----------
    motion
        Motion of the arm.
    joint
        Index of the joint, from 0.
    """
    least, most = 1 / float(motion.model.smoothing[joint]), 0.05 * float(motion.top_speed[joint])
    return [float(v) for v in np.geomspace(least, most, 5)] if most > least else [least]


TRANSITION = "coulomb_transition"
"""Name of the transition of dry friction at a reversal: a part of the friction model, and no cause of a gap."""


def transitions(motion: Motion, joint: int) -> Sequence[float]:
    """Return velocities of the transition of dry friction, from 0.06 to 3 % of the joint's top speed, rad/s or m/s.

    Parameters
    ----------
    motion
        Motion of the arm.
    joint
        Index of the joint, from 0.
    """
    return [float(v) for v in float(motion.top_speed[joint]) * np.geomspace(0.0006, SLOWEST, 7)]


def _transition(motion: Motion, place: Place, *, velocity: float) -> Array:
    j = place.joint
    return (np.tanh(motion.qd[:, j] / velocity) - motion.sign[:, j])[:, None]


def _stribeck(motion: Motion, place: Place, *, velocity: float, displacement: float = 0.0) -> Array:
    j = place.joint
    # At speeds where the smoothed sign has not saturated yet, the bristle already has.
    side = dahl(motion.q[:, j], displacement) if displacement > 0.0 else motion.sign[:, j]
    # The second column moves the model's Coulomb friction from the smoothed sign to the bristle.
    return np.stack([np.exp(-((motion.qd[:, j] / velocity) ** 2)) * side, side - motion.sign[:, j]], axis=1)


def _stribeck_exponential(motion: Motion, place: Place, *, velocity: float) -> Array:
    j = place.joint
    return (np.exp(-np.abs(motion.qd[:, j]) / velocity) * motion.sign[:, j])[:, None]


SPEEDS = (0.0, 0.05, 0.12, 0.25, 0.5, 1.0)
"""Knots of the friction curve at low speed, over its highest speed: close to standstill, where friction is curved."""


def _friction_curve(motion: Motion, place: Place, *, top: float) -> Array:
    """Return piecewise linear functions of the speed; those at the last two knots are Coulomb and viscous friction."""
    j = place.joint
    speed = hats(np.abs(motion.qd[:, j]), top * np.array(SPEEDS))
    return speed[:, : len(SPEEDS) - 2] * motion.sign[:, j, None]


def tops(motion: Motion, joint: int) -> Sequence[float]:
    """Return the top speed of a joint, rad/s or m/s.

    Parameters
    ----------
    motion
        Motion of the arm.
    joint
        Index of the joint, from 0.
    """
    return [float(motion.top_speed[joint])]


def _higher_at_rest(values: Array, shapes: Mapping[str, float], largest: Mapping[str, float]) -> bool:
    """Return True if friction falls with the speed.

    The value at rest is not judged alone: there the curve also contains the transition of dry friction at reversals.
    """
    return bool(values[1] > 0.0 and values[1] >= values[-1] and values[0] + values[1] > 0.0)


def bristles(motion: Motion, joint: int) -> Sequence[float]:
    """Return displacements from three millionths of the joint's range of motion to a hundred times that, rad or m.

    Parameters
    ----------
    motion
        Motion of the arm.
    joint
        Index of the joint, from 0.
    """
    return [float(d) for d in motion.span[joint] * np.geomspace(3e-6, 3e-4, 4)]


def _nonlinear_viscous(motion: Motion, place: Place, *, velocity: float) -> Array:
    """Return Eyring's law, ``asinh(qd / velocity)``; linear up to ``velocity``, logarithmic above."""
    curved: Array = np.arcsinh(motion.qd[:, place.joint] / velocity)
    return curved[:, None]


def _rises_from_rest(values: Array, shapes: Mapping[str, float], largest: Mapping[str, float]) -> bool:
    """Return False for a negative value with a low speed: that shape is additional friction at low speed (Stribeck)."""
    return bool(shapes["velocity"] >= LATE * largest["velocity"] or values[0] >= 0.0)


def _load_dependent(motion: Motion, place: Place, *, rotor: float = 0.0) -> Array:
    j = place.joint
    return (np.abs(motion.handed_on(j, rotor)) * motion.sign[:, j])[:, None]


def _presliding(motion: Motion, place: Place, *, displacement: float) -> Array:
    j = place.joint
    return (motion.sign[:, j] - dahl(motion.q[:, j], displacement))[:, None]


def _part_of_the_model(values: Array, sample: float) -> bool:
    """Return True: every model of dry friction has some transition, so that it is no missing effect."""
    return True


@compiled
def dahl(q: Array, displacement: float) -> Array:
    """Return Dahl's friction over its level, shape (N,), integrated exactly between samples.

    ``dz/dq = (1 - z sign(qd)) / displacement``: after a reversal it approaches its level exponentially in the distance.

    Parameters
    ----------
    q
        Positions, rad or m, shape (N,).
    displacement
        Constant of the exponential, in the unit of ``q``.
    """
    z = np.empty(q.size)
    state = 0.0
    z[0] = state
    for k in range(1, q.size):
        way = q[k] - q[k - 1]
        side = 1.0 if way > 0 else -1.0
        state = side + (state - side) * np.exp(-abs(way) / displacement)
        z[k] = state
    return z


def _position_dependent(motion: Motion, place: Place, *, period: float) -> Array:
    j = place.joint
    angle, side = 2 * np.pi * motion.q[:, j] / period, motion.sign[:, j]
    return np.stack([side * np.cos(angle), side * np.sin(angle)], axis=1)


def _position_table(motion: Motion, place: Place, *, low: float, high: float) -> Array:
    j = place.joint
    return table(motion.q[:, j], low, high) * motion.sign[:, j, None]


def turns(motion: Motion, joint: int) -> Sequence[float]:
    """Return periods in the joint's position, rad or m: fractions of a turn, or of the travel of a prismatic axis.

    The fractions are 1, 1/2, 1/3 and 1/4. The travel is that of the motion.

    Parameters
    ----------
    motion
        Motion of the arm.
    joint
        Index of the joint, from 0.
    """
    if motion.model.robot.joints[joint].type == "revolute":
        return [2 * np.pi / k for k in (4, 3, 2, 1)]
    return [float(motion.span[joint]) / k for k in (4, 3, 2, 1)]


def _drift(motion: Motion, place: Place, *, time_constant: float) -> Array:
    """Return columns of an exponential change of friction, from half the change below to half of it above the mean."""
    j, whole = place.joint, max(motion.duration, motion.dt * motion.samples)
    progress = np.expm1(-motion.t / time_constant) / np.expm1(-whole / time_constant) - 0.5
    return np.stack([motion.sign[:, j] * progress, motion.qd[:, j] * progress], axis=1)


def _drift_with_work(motion: Motion, place: Place, *, decay: float) -> Array:
    """Return columns of a change of friction with the work that viscous friction has dissipated."""
    j = place.joint
    work = motion.dt * np.cumsum(motion.qd[:, j] ** 2)
    progress = -np.expm1(-decay * work)
    return np.stack([motion.sign[:, j] * progress, motion.qd[:, j] * progress], axis=1)


def decays(motion: Motion, joint: int) -> Sequence[float]:
    """Return rates of change with work: the work of the recording is a third of, once and three times the constant.

    The unit is that of the inverse of the integral of the squared velocity, s/rad^2 or s/m^2.

    Parameters
    ----------
    motion
        Motion of the arm.
    joint
        Index of the joint, from 0.
    """
    whole = max(float(motion.dt * np.sum(motion.qd[:, joint] ** 2)), 1e-12)
    return [share / whole for share in (0.3, 1.0, 3.0, 10.0)]


def warming(motion: Motion, joint: int) -> Sequence[float]:
    """Return time constants from a tenth of the recorded time to three times it, s; longer ones are linear in time.

    Parameters
    ----------
    motion
        Motion of the arm.
    joint
        Index of the joint, from 0; not used.
    """
    whole = max(motion.duration, motion.dt * motion.samples)
    return [whole * share for share in (0.1, 0.3, 1.0, 3.0)]


def _coupling(motion: Motion, place: Place) -> Array:
    first, second = place.joint, place.other
    assert second is not None
    columns = np.zeros((motion.samples, motion.n, 3))
    for one, two in ((first, second), (second, first)):
        columns[:, one, 0] = motion.qdd[:, two]
        columns[:, one, 1] = motion.qd[:, two]
        both = motion.qd[:, one] + motion.qd[:, two]
        columns[:, one, 2] = np.sign(both) if motion.sharp else motion.model.smooth_sign(both, (one, two))
    return columns


EFFECTS = (
    Effect(
        name=TRANSITION,
        title="gradual reversal of dry friction",
        says="dry friction changes its sign over a range of velocities about standstill; a part of the friction model",
        reference="Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Automatica 30(7)",
        linear=(Linear("fct", TORQUE, sign=1),),
        shapes=(Shape("velocity", ("rad/s", "m/s"), transitions),),
        columns=_transition,
        needs="reversals",
        excitation=("reversals",),
        negligible=_part_of_the_model,
    ),
    Effect(
        name="asymmetric_viscous_friction",
        title="direction-dependent viscous friction",
        says="viscous friction is higher in one direction than in the other: a worn or one-sidedly loaded gear",
        reference="Janot, Gautier, Brunot 2019, Data set and reference models of EMPS",
        linear=(Linear("fva", VISCOUS),),
        columns=_asymmetric_viscous,
        needs="both directions of motion at several speeds",
    ),
    Effect(
        name="asymmetric_coulomb_friction",
        title="direction-dependent Coulomb friction",
        says="Coulomb friction differs between the two directions of motion; the difference vanishes at standstill, "
        "unlike a constant offset",
        reference="Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Automatica 30(7)",
        linear=(Linear("fca", TORQUE),),
        shapes=(Shape("velocity", ("rad/s", "m/s"), films, default=0.0),),
        columns=_asymmetric_coulomb,
        needs="both directions of motion, and standstill: while moving it looks like a constant offset",
        excitation=("reversals", "standstill"),
    ),
    Effect(
        name="stribeck_friction",
        title="Stribeck friction",
        says="additional friction at low speed that decreases with the speed: poor or squeezed-out lubricant",
        reference="Bittencourt, Gunnarsson 2012, J. Dyn. Sys. Meas. Control 134(5)",
        linear=(Linear("fst", TORQUE, sign=1), Linear("fsb", TORQUE, through="displacement", replaces="fc")),
        shapes=(
            Shape("velocity", ("rad/s", "m/s"), speeds),
            Shape("displacement", ("rad", "m"), bristles, default=0.0),
        ),
        columns=_stribeck,
        needs="slow motion in both directions",
        excitation=("slow", "reversals"),
    ),
    Effect(
        name="stribeck_friction",
        law="exponential",
        title="Stribeck friction",
        says="additional friction at low speed that decreases with the speed: poor or squeezed-out lubricant",
        reference="Bo, Pavelescu 1982, Wear 82(3), with exponent 1",
        linear=(Linear("fst", TORQUE, sign=1),),
        shapes=(Shape("velocity", ("rad/s", "m/s"), speeds),),
        columns=_stribeck_exponential,
        needs="slow motion in both directions",
        excitation=("slow", "reversals"),
    ),
    Effect(
        name="stribeck_friction",
        law="table",
        title="Stribeck friction",
        says="additional friction at low speed that decreases with the speed: poor or squeezed-out lubricant",
        reference="Bittencourt, Gunnarsson 2012, J. Dyn. Sys. Meas. Control 134(5), measured curves",
        linear=tuple(Linear(f"fst{k}", TORQUE) for k in range(len(SPEEDS) - 2)),
        shapes=(Shape("top", ("rad/s", "m/s"), tops, continuous=(False, False)),),
        columns=_friction_curve,
        physical=_higher_at_rest,
        needs="slow motion in both directions",
        excitation=("slow", "reversals"),
    ),
    Effect(
        name="nonlinear_viscous_friction",
        title="nonlinear viscous friction",
        says="friction is not proportional to speed: shear thinning or churning of the lubricant",
        reference="Ree, Ree, Eyring 1958, Ind. Eng. Chem. 50(7)",
        linear=(Linear("fvn", TORQUE),),
        shapes=(Shape("velocity", ("rad/s", "m/s"), speeds),),
        columns=_nonlinear_viscous,
        physical=_rises_from_rest,
        needs="slow and fast motion",
        excitation=("speeds",),
    ),
    Effect(
        name="load_dependent_friction",
        title="load-dependent friction",
        says="Coulomb friction grows with the torque that the gear transmits",
        reference="Hamon, Gautier, Garrec 2010, IROS, Dynamic identification with load-dependent dry friction",
        linear=(Linear("fcl", ("", ""), sign=1),),
        shapes=(ROTOR,),
        columns=_load_dependent,
        predicts=True,
        needs="motion in both directions under small and under large load",
        excitation=("reversals", "load"),
    ),
    Effect(
        name="presliding_friction",
        title="presliding friction",
        says="after a reversal Coulomb friction builds up over a small displacement: elastic contacts or seals",
        reference="Dahl 1968, A solid friction model; Canudas de Wit et al. 1995, IEEE TAC 40(3)",
        linear=(Linear("fcd", TORQUE, sign=-1),),
        shapes=(
            Shape(
                "displacement",
                ("rad", "m"),
                lambda motion, joint: tuple(float(motion.span[joint]) * np.geomspace(0.0002, 0.1, 12)),
            ),
        ),
        columns=_presliding,
        needs="many reversals",
        excitation=("reversals", "slow"),
    ),
    Effect(
        name="position_dependent_friction",
        title="position-dependent friction",
        says="Coulomb friction varies with the position of the joint: a bent shaft, a tight spot, uneven wear",
        reference="Simoni et al. 2015, IROS, Modelling the temperature in joint friction of industrial manipulators",
        linear=(Linear("fpc", TORQUE), Linear("fps", TORQUE)),
        shapes=(Shape("period", ("rad", "m"), turns, continuous=(False, True)),),
        columns=_position_dependent,
        needs="a wide range of joint positions, passed in both directions",
        together=True,
        excitation=("range", "reversals"),
    ),
    Effect(
        name="position_dependent_friction",
        law="table",
        title="position-dependent friction",
        says="Coulomb friction varies with the position of the joint: a bent shaft, a tight spot, uneven wear",
        reference="Simoni et al. 2015, IROS, Modelling the temperature in joint friction of industrial manipulators",
        linear=values("fpt", TORQUE),
        shapes=RANGE,
        columns=_position_table,
        needs="a wide range of joint positions, passed in both directions",
        excitation=("range", "reversals"),
    ),
    Effect(
        name="friction_drift",
        title="friction drift",
        says="friction changes between the beginning and the end of the recording: the gear warms up",
        reference="Simoni et al. 2015, IROS, Modelling the temperature in joint friction of industrial manipulators",
        linear=(Linear("fcdr", TORQUE), Linear("fvdr", VISCOUS)),
        shapes=(Shape("time_constant", ("s", "s"), warming),),
        columns=_drift,
        needs="the same motion early and late in the recordings",
        excitation=("repeats",),
    ),
    Effect(
        name="friction_drift",
        law="work",
        title="friction drift",
        says="friction changes with the work that it has dissipated: the gear warms up",
        reference="Simoni et al. 2015, IROS, Modelling the temperature in joint friction of industrial manipulators",
        linear=(Linear("fcdr", TORQUE), Linear("fvdr", VISCOUS)),
        shapes=(Shape("decay", ("s/rad^2", "s/m^2"), decays),),
        columns=_drift_with_work,
        needs="the same motion early and late in the recordings",
        excitation=("repeats",),
    ),
    Effect(
        name="coupling_friction",
        title="coupling of two joints",
        says="two joints share a shaft or gear, whose friction and inertia act on both",
        reference="Brunot 2017, equation B.1",
        linear=(
            Linear("iac", ("kg m^2", "kg"), sign=1),
            Linear("fvc", VISCOUS, sign=1),
            Linear("fcc", TORQUE, sign=1),
        ),
        columns=_coupling,
        needs="motion of both joints, together and against each other",
        scope="pair",
        excitation=("independent",),
    ),
)
