"""Friction effects beyond viscous and Coulomb friction, ``fv qd + fc sign(qd)``."""

from collections.abc import Mapping, Sequence

import numpy as np

from armident.arrays import Array
from armident.compiled import ARITHMETIC, compiled
from armident.identify.effects.effect import (
    POSITION,
    TORQUE,
    UNITLESS,
    VELOCITY,
    VISCOUS,
    Effect,
    Linear,
    Periodic,
    Place,
    Shape,
    Shapes,
    TorqueDependent,
    Trials,
)
from armident.identify.effects.free_shapes import TOP_SPEED, FreeShape, OverPosition, hats, table, values
from armident.identify.effects.rotor import ROTOR, rotors
from armident.identify.robot.motion import Motion

SLOWEST = 0.03
"""Least characteristic speed of a friction law over the joint's top speed: below it laws look like the reversal."""


def speeds(motion: Motion, place: Place) -> Sequence[float]:
    """Return characteristic speeds from those of the reversal to a third of the joint's top speed, rad/s or m/s."""
    return [float(v) for v in float(motion.top_speed[place.joint]) * np.geomspace(SLOWEST, 0.35, 7)]


LARGEST = 2.0
"""Largest transition of dry friction at a reversal over the dry friction of the joint. Dry friction breaks away at up
to twice the level of slow motion (Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Automatica 30(7)), and a joint that
sticks looks like that."""

TRANSITION = "coulomb_transition"
"""Name of the transition of dry friction at a reversal: a part of the friction model, and no cause of a gap."""


class CoulombTransition(Effect):
    """Gradual reversal of dry friction, in place of the smoothed sign of the model."""

    name = TRANSITION
    title = "gradual reversal of dry friction"
    description = (
        "dry friction changes its sign over a range of velocities about standstill; a part of the friction model"
    )
    reference = "Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Automatica 30(7)"
    required_motion = "reversals"
    excitation = ("reversals",)
    at_reversals = True
    linear = (
        Linear("fct", TORQUE, "Coulomb friction that reverses as `fct tanh((qd + lead qdd) / velocity)`.", sign=1),
    )
    shapes = (
        Shape("velocity", VELOCITY, "Velocity over which the dry friction reverses."),
        Shape("lead", ("s", "s"), "Time by which it reverses before the differentiated velocity.", default=0.0),
    )

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return ``tanh((qd + lead qdd) / velocity) - sign(qd)``.

        A joint stops suddenly and leaves standstill slowly: a smoothed velocity is late under the rising torque.
        """
        j = place.joint
        reversal = motion.qd[:, j] + shapes["lead"] * motion.qdd[:, j]
        return (np.tanh(reversal / shapes["velocity"]) - motion.sign[:, j])[:, None]

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return velocities from 0.06 to 3 % of the joint's top speed, and leads from hardly any to four samples."""
        velocities = float(motion.top_speed[place.joint]) * np.geomspace(0.0006, SLOWEST, 7)
        return velocities, motion.dt * np.array([0.01, 0.25, 0.5, 1.0, 2.0, 4.0])

    def positive_friction(self, shapes: Mapping[str, float]) -> tuple[str, Array]:
        """Return Coulomb friction less that of the largest transition: beyond it, friction falls with the speed."""
        return "fc", np.array([-1.0 / LARGEST])

    def is_convention(self, values: Array, uncertain: float) -> bool:
        """Return True: every model of dry friction has some transition, so that it is no missing effect."""
        return True


class AsymmetricViscousFriction(Effect):
    """Viscous friction that depends on the direction."""

    name = "asymmetric_viscous_friction"
    title = "direction-dependent viscous friction"
    description = "viscous friction is higher in one direction than in the other: a worn or one-sidedly loaded gear"
    reference = "Janot, Gautier, Brunot 2019, Data set and reference models of EMPS"
    required_motion = "both directions of motion at several speeds"
    linear = (Linear("fva", VISCOUS, "Half the difference of the viscous friction between both directions."),)
    compared = True

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return ``qd sign(qd)``."""
        return (motion.qd * motion.sign)[:, place.joint, None]


class AsymmetricCoulombFriction(Effect):
    """Coulomb friction that depends on the direction."""

    name = "asymmetric_coulomb_friction"
    title = "direction-dependent Coulomb friction"
    description = (
        "Coulomb friction differs between the two directions of motion; the difference vanishes at standstill, "
        "unlike a constant offset"
    )
    reference = "Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Automatica 30(7)"
    required_motion = "both directions of motion, and standstill: while moving it looks like a constant offset"
    excitation = ("reversals", "standstill")
    linear = (Linear("fca", TORQUE, "Half the difference of the Coulomb friction between both directions."),)
    shapes = (Shape("velocity", VELOCITY, "Velocity over which the difference builds up; 0: at once.", default=0.0),)

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return ``sign(qd)^2``, with the smoothing of the model if the velocity is zero."""
        j, velocity = place.joint, shapes["velocity"]
        if velocity == 0.0:
            return motion.sign[:, j, None] ** 2
        built: Array = (2 / np.pi * np.arctan(motion.qd[:, j, None] / velocity)) ** 2
        return built

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return speeds from that of the joint's smoothed sign to a twentieth of the joint's top speed."""
        least = 1 / float(motion.model.smoothing[place.joint])
        most = 0.05 * float(motion.top_speed[place.joint])
        return (np.geomspace(least, most, 5) if most > least else [least],)


class StribeckBell(Effect):
    """Stribeck friction beside the model's own Coulomb friction."""

    name = "stribeck_friction"
    title = "Stribeck friction"
    description = "additional friction at low speed that decreases with the speed: poor or squeezed-out lubricant"
    reference = "Bittencourt, Gunnarsson 2012, J. Dyn. Sys. Meas. Control 134(5)"
    required_motion = "slow motion in both directions"
    excitation = ("slow", "reversals")
    linear: tuple[Linear, ...] = (
        Linear("fst", TORQUE, "Additional friction at low speed: `fst exp(-(qd / velocity)^2) sign(qd)`.", sign=1),
    )
    shapes: tuple[Shape, ...] = (
        Shape("velocity", VELOCITY, "Stribeck velocity, at which the additional friction has decreased to 37 %."),
        Shape("displacement", POSITION, "Displacement of the bristle (Dahl); 0: no bristle.", default=0.0),
    )

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return ``exp(-(qd / velocity)^2)`` in the direction of the bristle."""
        bell = np.exp(-((motion.qd[:, place.joint] / shapes["velocity"]) ** 2))
        return (bell * self._side(motion, place, shapes["displacement"]))[:, None]

    def positive_friction(self, shapes: Mapping[str, float]) -> tuple[str, Array]:
        """Return Coulomb friction, to which the friction falls: below zero it is curved viscous friction."""
        return "fc", np.zeros(len(self.linear))

    def _side(self, motion: Motion, place: Place, displacement: float) -> Array:
        """Return the direction of the friction (N,): the sign of the velocity, or that of a bristle, rad or m."""
        j = place.joint
        # At speeds where the smoothed sign has not saturated yet, the bristle already has.
        return dahl(motion.q[:, j], displacement) if displacement > 0.0 else motion.sign[:, j]

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return `speeds`, and displacements: none, and three millionths of the joint's range to 100 times that."""
        return speeds(motion, place), [0.0, *motion.span[place.joint] * np.geomspace(3e-6, 3e-4, 4)]


class StribeckFriction(StribeckBell):
    """Stribeck friction with the model's Coulomb friction on the same bristle."""

    linear = (
        *StribeckBell.linear,
        Linear("fsb", TORQUE, "Coulomb friction on the bristle.", requires="displacement", absorbs="fc"),
    )

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the bell, and the way of the model's Coulomb friction from the smoothed sign to the bristle."""
        moved = self._side(motion, place, shapes["displacement"]) - motion.sign[:, place.joint]
        return np.column_stack([super().columns(motion, place, shapes), moved])

    @property
    def minimal(self) -> Effect:
        """The bell alone."""
        return StribeckBell()


class StribeckFrictionExponential(StribeckBell):
    """Stribeck friction that decreases exponentially."""

    law = "exponential"
    reference = "Bo, Pavelescu 1982, Wear 82(3), with exponent 1"
    linear = (Linear("fst", TORQUE, "Additional friction: `fst exp(-|qd| / velocity) sign(qd)`.", sign=1),)
    shapes = (Shape("velocity", VELOCITY, "Velocity at which the additional friction has decreased to 37 %."),)

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return ``exp(-|qd| / velocity) sign(qd)``."""
        j = place.joint
        return (np.exp(-np.abs(motion.qd[:, j]) / shapes["velocity"]) * motion.sign[:, j])[:, None]

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return `speeds`."""
        return (speeds(motion, place),)


class StribeckFrictionTable(FreeShape, StribeckBell):
    """Friction curve of any shape at low speed."""

    KNOTS = (0.0, 0.05, 0.12, 0.25, 0.5, 1.0)
    """Knots over the highest speed: close to standstill, where friction is curved."""

    reference = "Bittencourt, Gunnarsson 2012, J. Dyn. Sys. Meas. Control 134(5), measured curves"
    linear = tuple(
        Linear(f"fst{k}", TORQUE, f"Additional friction at {share:.0%} of the speed `top`; linear in between.")
        for k, share in enumerate(KNOTS[:-2])
    )
    shapes = TOP_SPEED

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return functions of the speed; those at the last two knots are Coulomb and viscous friction."""
        j = place.joint
        speed = hats(np.abs(motion.qd[:, j]), shapes["top"] * np.array(self.KNOTS))
        return speed[:, : len(self.linear)] * motion.sign[:, j, None]

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return the joint's top speed."""
        return ([motion.top_speed[place.joint]],)

    def possible(self, values: Array, shapes: Mapping[str, float]) -> bool:
        """Return True if friction falls with the speed."""
        return bool(values[1] > 0.0 and values[1] >= values[-1] and values[0] + values[1] > 0.0)


class NonlinearViscousFriction(Effect):
    """Eyring's law: linear up to a velocity, logarithmic above."""

    name = "nonlinear_viscous_friction"
    title = "nonlinear viscous friction"
    description = "friction is not proportional to speed: shear thinning or churning of the lubricant"
    reference = "Ree, Ree, Eyring 1958, Ind. Eng. Chem. 50(7)"
    required_motion = "slow and fast motion"
    excitation = ("speeds",)
    linear = (Linear("fvn", TORQUE, "Nonlinear part of the viscous friction: `fvn asinh(qd / velocity)` (Eyring)."),)
    shapes = (Shape("velocity", VELOCITY, "Velocity at which the curve bends: linear below, logarithmic above."),)

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return ``asinh(qd / velocity)``."""
        curved: Array = np.arcsinh(motion.qd[:, place.joint] / shapes["velocity"])
        return curved[:, None]

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return `speeds`."""
        return (speeds(motion, place),)

    def positive_friction(self, shapes: Mapping[str, float]) -> tuple[str, Array]:
        """Return viscous friction and the slope at rest: friction that falls with the speed is Stribeck friction."""
        return "fv", np.array([1.0 / shapes["velocity"]])


class LoadDependentFriction(TorqueDependent):
    """Coulomb friction in proportion to the transmitted torque."""

    name = "load_dependent_friction"
    title = "load-dependent friction"
    description = "Coulomb friction grows with the torque that the gear transmits"
    reference = "Hamon, Gautier, Garrec 2010, IROS, Dynamic identification with load-dependent dry friction"
    required_motion = "motion in both directions under small and under large load"
    direct_evidence = "the same motion with a known payload"
    excitation = ("reversals", "load")
    linear = (Linear("fcl", UNITLESS, "Coulomb friction per transmitted torque.", sign=1),)
    shapes = (ROTOR,)

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return ``|transmitted torque| sign(qd)``."""
        j = place.joint
        return (np.abs(motion.handed_on(j, shapes["rotor"])) * motion.sign[:, j])[:, None]

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return `rotors`."""
        return (rotors(motion, place.joint),)


class PreslidingFriction(Effect):
    """Coulomb friction that builds up over a displacement."""

    name = "presliding_friction"
    title = "presliding friction"
    description = "after a reversal Coulomb friction builds up over a small displacement: elastic contacts or seals"
    reference = "Dahl 1968, A solid friction model; Canudas de Wit et al. 1995, IEEE TAC 40(3)"
    required_motion = "many reversals"
    excitation = ("reversals", "slow")
    at_reversals = True
    linear = (Linear("fcd", TORQUE, "Coulomb friction that builds up after a reversal, times -1.", sign=-1),)
    shapes = (Shape("displacement", POSITION, "Characteristic displacement of Dahl's model."),)

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return what `dahl` lacks of ``sign(qd)``."""
        j = place.joint
        return (motion.sign[:, j] - dahl(motion.q[:, j], shapes["displacement"]))[:, None]

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return displacements from 0.02 to 10 % of the joint's range of motion."""
        return (float(motion.span[place.joint]) * np.geomspace(0.0002, 0.1, 12),)


def dahl(q: Array, displacement: float) -> Array:
    """Return Dahl's friction over its level, shape (N,), integrated exactly between samples ``q`` (N,).

    ``dz/dq = (1 - z sign(qd)) / displacement``: after a reversal it approaches its level exponentially.
    """
    if q.dtype == object:
        # Symbols in place of numbers: a formula is derived, see `armident.identify.model_export.formulas`.
        return np.array([symbol.bristle(displacement) for symbol in q])
    state: Array = _dahl(q, displacement)
    return state


@compiled("f8[:], f8", "f8[::1], f8", **ARITHMETIC)
def _dahl(q: Array, displacement: float) -> Array:
    z = np.empty(q.size)
    state = 0.0
    z[0] = state
    for k in range(1, q.size):
        way = q[k] - q[k - 1]
        side = 1.0 if way > 0 else -1.0
        state = side + (state - side) * np.exp(-abs(way) / displacement)
        z[k] = state
    return z


class PositionDependent(Effect):
    """Coulomb friction that depends on the position."""

    name = "position_dependent_friction"
    title = "position-dependent friction"
    description = "Coulomb friction varies with the position of the joint: a bent shaft, a tight spot, uneven wear"
    reference = "Simoni et al. 2015, IROS, Modelling the temperature in joint friction of industrial manipulators"
    required_motion = "a wide range of joint positions, passed in both directions"
    excitation = ("range", "reversals")


class PositionDependentFriction(Periodic, PositionDependent):
    """Coulomb friction that is periodic in the position."""

    linear = (
        Linear("fpc", TORQUE, "Amplitude of the cosine component of the Coulomb friction over the position."),
        Linear("fps", TORQUE, "Amplitude of the sine component of the Coulomb friction over the position."),
    )
    shapes = (Shape("period", POSITION, "Period of the friction in the joint position.", continuous=(False, True)),)

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return cosine and sine of ``2 pi q / period`` times ``sign(qd)``."""
        j = place.joint
        angle, side = 2 * np.pi * motion.q[:, j] / shapes["period"], motion.sign[:, j]
        return np.stack([side * np.cos(angle), side * np.sin(angle)], axis=1)

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return 1/4, 1/3, 1/2 and the whole of a turn, or of the travel of the motion of a prismatic axis."""
        revolute = motion.model.robot.joints[place.joint].type == "revolute"
        whole = 2 * np.pi if revolute else float(motion.span[place.joint])
        return ([whole / k for k in (4, 3, 2, 1)],)


class PositionDependentFrictionTable(OverPosition, PositionDependent):
    """Coulomb friction of any dependence on the position."""

    linear = values("fpt", TORQUE, "Coulomb friction over the position")

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the functions of the table times ``sign(qd)``."""
        j = place.joint
        return table(motion.q[:, j], shapes["low"], shapes["high"]) * motion.sign[:, j, None]


class FrictionDrift(Effect):
    """Exponential change of friction with time."""

    name = "friction_drift"
    title = "friction drift"
    description = "friction changes between the beginning and the end of the recording: the gear warms up"
    reference = "Simoni et al. 2015, IROS, Modelling the temperature in joint friction of industrial manipulators"
    required_motion = "the same motion early and late in the recordings"
    direct_evidence = "the temperature of the drive, recorded with the motion"
    excitation = ("repeats",)
    linear: tuple[Linear, ...] = (
        Linear("fcdr", TORQUE, "Change of the Coulomb friction from the beginning to the end of the recordings."),
        Linear("fvdr", VISCOUS, "Change of the viscous friction from the beginning to the end of the recordings."),
    )
    shapes: tuple[Shape, ...] = (Shape("time_constant", ("s", "s"), "Time constant of the change."),)

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return Coulomb and viscous friction times the progress of the change."""
        j, progress = place.joint, self._progress(motion, place, shapes)
        return np.stack([motion.sign[:, j] * progress, motion.qd[:, j] * progress], axis=1)

    def _progress(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the progress (N,): exponential in time, from half the change below the mean to half of it above."""
        constant = shapes["time_constant"]
        progress: Array = np.expm1(-motion.t / constant) / np.expm1(-motion.whole_time / constant) - 0.5
        return progress

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return time constants from a tenth of the recorded time to three times it; longer ones are linear in time."""
        return ([motion.whole_time * share for share in (0.1, 0.3, 1.0, 3.0)],)


class FrictionDriftWithWork(FrictionDrift):
    """Change of friction with the work that viscous friction has dissipated."""

    law = "work"
    description = "friction changes with the work that it has dissipated: the gear warms up"
    linear = (
        Linear("fcdr", TORQUE, "Change of the Coulomb friction after much work."),
        Linear("fvdr", VISCOUS, "Change of the viscous friction after much work."),
    )
    shapes = (Shape("decay", ("s/rad^2", "s/m^2"), "Rate of the change per integral of the squared velocity (work)."),)

    def _progress(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the progress (N,): ``1 - exp(-decay work)``, the work that of a unit of viscous friction."""
        work = motion.dt * np.cumsum(motion.qd[:, place.joint] ** 2)
        return -np.expm1(-shapes["decay"] * work)

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return rates with which the work of the recording is 0.3 to 10 times the constant."""
        whole = max(float(motion.dt * np.sum(motion.qd[:, place.joint] ** 2)), 1e-12)
        return ([share / whole for share in (0.3, 1.0, 3.0, 10.0)],)


class CouplingFriction(Effect):
    """Inertia and friction of a shaft that turns with two joints."""

    name = "coupling_friction"
    title = "coupling of two joints"
    description = "two joints share a shaft or gear, whose friction and inertia act on both"
    reference = "Brunot 2017, equation B.1"
    required_motion = "motion of both joints, together and against each other"
    excitation = ("independent",)
    scope = "pair"
    linear = (
        Linear("iac", ("kg m^2", "kg"), "Inertia shared by the two joints.", sign=1),
        Linear("fvc", VISCOUS, "Viscous friction shared by the two joints.", sign=1),
        Linear("fcc", TORQUE, "Coulomb friction of the sum of the two velocities.", sign=1),
    )
    rigid_part = "couplings"

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return acceleration and velocity of the other joint, and the sign of the common velocity."""
        columns = np.zeros((motion.samples, motion.n, 3), dtype=motion.q.dtype)
        for one, two in ((place.joint, place.second), (place.second, place.joint)):
            columns[:, one, 0] = motion.qdd[:, two]
            columns[:, one, 1] = motion.qd[:, two]
            both = motion.qd[:, one] + motion.qd[:, two]
            columns[:, one, 2] = np.sign(both) if motion.sharp else motion.model.smooth_sign(both, (one, two))
        return columns

    def may_be_added(self, motion: Motion, place: Place, present: Sequence[Shapes]) -> bool:
        """Return True unless the model couples the two joints already."""
        robot = motion.model.robot
        pair = {robot.joints[j].name for j in (place.joint, place.second)}
        coupled = any(set(coupling.joints) == pair for coupling in robot.couplings)
        return not coupled and super().may_be_added(motion, place, present)
