"""Effects between motor and joint: elasticity, backlash, cogging."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from armident.arrays import Array
from armident.compiled import ARITHMETIC, compiled
from armident.identify.effects.effect import (
    POSITION,
    TORQUE,
    UNITLESS,
    Linear,
    Periodic,
    Place,
    Shape,
    TorqueDependent,
    Trials,
)
from armident.identify.effects.rotor import ROTOR, rotors
from armident.identify.robot.motion import Motion

DAMPINGS = (0.1, 0.7)
"""Damping ratios of an elastic joint: by its own damping, and with damping by the controlled motor."""

LEAST_INERTIA = 0.04
"""Lower bound of the link inertia, over its maximum along the motion: a fit may make it negative. It is the least of
640 joints in random postures (arms with random bodies on the shipped kinematics)."""


class Gear(NamedTuple):
    """Equation of the motion ``x`` of a link relative to its motor.

    ``inertia x'' + damping x' + stiffness x = share (rotor qdd - load)``, within ``limit`` where there is no stiffness.
    ``load``: torque of the links, N m or N; ``inertia``: that of the link less ``rotor``, at least ``least``, kg m^2 or
    kg; ``x`` and ``limit``, rad or m.
    """

    joint: int
    rotor: float
    least: float
    share: float
    damping: float
    stiffness: float
    limit: float

    @property
    def of_bodies(self) -> "Gear":
        """Equation of two bodies with the same compliance or gap: the whole load moves the link."""
        share = self.share
        return self._replace(
            share=1.0, damping=self.damping / share, stiffness=self.stiffness / share, limit=self.limit / share
        )


class MotorOrder(Periodic):
    """Effect whose one nonlinear parameter is an order of the motor angle."""


class CoggingTorque(MotorOrder):
    """Torque ripple of a motor."""

    name = "cogging_torque"
    title = "a torque ripple of the motor"
    description = "a torque ripple that is periodic in the motor angle: magnets of the motor, or an eccentric gear"
    reference = "Petrovic et al. 2000, IEEE Trans. Power Electronics 15(6); Gandhi et al. 2002, ICRA"
    required_motion = "slow motion over several motor turns"
    excitation = ("slow", "range")
    scope = "motor"
    linear = (
        Linear("cgc", TORQUE, "Amplitude of the cosine component of the ripple, on the joint side."),
        Linear("cgs", TORQUE, "Amplitude of the sine component of the ripple, on the joint side."),
    )
    shapes = (
        Shape(
            "harmonic",
            ("per rad of the motor", "rad/m"),
            "Periods of the ripple per turn of the motor; for a prismatic axis a wave number.",
            continuous=(False, False),
        ),
    )

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return cosine and sine of ``harmonic`` times the motor angle."""
        angle = shapes["harmonic"] * motion.motor[:, place.joint]
        ripple = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        ratios = motion.model.robot.transmission_matrix[place.joint]
        # Referred to the motor's own joint; a coupled transmission passes the rest on in proportion.
        share: Array = ratios / ratios[int(np.argmax(np.abs(ratios)))]
        columns: Array = ripple[:, None, :] * share[:, None]
        return columns

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return harmonics of a motor turn; of a prismatic axis, whose pitch is unknown, wave numbers by its travel."""
        if motion.model.robot.joints[place.joint].type == "revolute":
            return ((1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 18.0, 24.0),)
        resolution = np.pi / float(motion.span[place.joint])
        return ([resolution * k for k in range(4, 161)],)


class JointElasticity(TorqueDependent):
    """Elastic joint: the link lags by compliance times load, with second-order dynamics."""

    name = "joint_elasticity"
    title = "an elastic joint"
    description = "the link oscillates relative to its motor: an elastic gear, belt or coupling, or a bending link"
    reference = "Spong 1987, J. Dyn. Sys. Meas. Control 109(4)"
    required_motion = "quick accelerations near the resonance, under load"
    direct_evidence = "an encoder on the joint side"
    excitation = ("accelerations",)
    linear = (Linear("compliance", ("rad/(N m)", "m/N"), "Compliance: deflection per transmitted torque.", sign=1),)
    shapes = (
        Shape("frequency", ("Hz", "Hz"), "Natural frequency of the link at its mean inertia along the motion."),
        Shape("damping", UNITLESS, "Damping ratio of that oscillation.", default=DAMPINGS[-1]),
        ROTOR,
    )

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the torques by `swinging` of the link."""
        j, rotor = place.joint, shapes["rotor"]
        inertia, share = inertias(motion, j, rotor), np.ones(motion.samples)
        if inertia.max() > 0.0:
            share = inertia / max(self._usual(motion, j, rotor), LEAST_INERTIA * float(inertia.max()))
        w = 2 * np.pi * shapes["frequency"]
        moves = swinging(-motion.handed_on(j, rotor), share, w, shapes["damping"], motion.dt)
        return motion.response(j, *moves, links=True, rotor=rotor)[:, :, None]

    def least(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> float:
        """Return half the compliance of the resonance of the link's mean inertia; 0 where that is not determined."""
        inertia = self._usual(motion, place.joint, shapes["rotor"])
        return 0.5 / (inertia * (2 * np.pi * shapes["frequency"]) ** 2) if inertia > 0.0 else 0.0

    def _usual(self, motion: Motion, joint: int, rotor: float) -> float:
        return float(_at_postures(motion, joint, rotor).mean())

    def gear(self, motion: Motion, place: Place, shapes: Mapping[str, float], compliance: float) -> Gear:
        """Return the equation that `swinging` solves."""
        j, rotor, w = place.joint, shapes["rotor"], 2 * np.pi * shapes["frequency"]
        least = LEAST_INERTIA * float(_at_postures(motion, j, rotor).max())
        usual = max(self._usual(motion, j, rotor), least)
        stiffness = usual * w * w
        return Gear(j, rotor, least, stiffness * compliance, 2 * shapes["damping"] * w * usual, stiffness, 0.0)

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return resonance frequencies up to a fifth of the sampling rate, `DAMPINGS` and `rotors`."""
        return np.geomspace(4.0, min(80.0, 0.2 / motion.dt), 7), DAMPINGS, rotors(motion, place.joint)


@compiled("f8[::1], f8[::1], f8, f8, f8", **ARITHMETIC)
def swinging(pull: Array, share: Array, w: float, damping: float, dt: float) -> tuple[Array, Array, Array]:
    """Position, velocity, acceleration (N,) of ``share x'' + 2 damping w x' + w^2 x = w^2 pull``, from rest.

    Trapezoidal rule (Newmark 1959), stable at any frequency. For a gear, ``x`` is minus the transmitted torque: the
    position per unit of compliance. ``share`` (N,): inertia over its mean; ``w``: resonance at mean inertia, rad/s.
    """
    way, rate, acceleration = np.empty(pull.size), np.zeros(pull.size), np.zeros(pull.size)
    way[0] = pull[0]
    half, drag, spring = 0.5 * dt, 2.0 * damping * w, w * w
    for k in range(pull.size - 1):
        v = rate[k] + half * acceleration[k]
        x = way[k] + dt * rate[k] + half * half * acceleration[k]
        a = (spring * (pull[k + 1] - x) - drag * v) / (share[k + 1] + drag * half + spring * half * half)
        way[k + 1], rate[k + 1], acceleration[k + 1] = x + half * half * a, v + half * a, a
    return way, rate, acceleration


class Backlash(TorqueDependent):
    """Gap of the gear, in which the link moves freely until the teeth are in contact again.

    A simulation does not reproduce its jumps to the sample: columns at measured signals are their own instruments.
    """

    name = "backlash"
    title = "backlash of the gear"
    description = (
        "after a sign change of the load the motor crosses a gap before the link follows: worn teeth, a loose key"
    )
    reference = "Nordin, Gutman 2002, Automatica 38(10)"
    required_motion = "many changes of the load's direction"
    direct_evidence = "an encoder on the joint side"
    excitation = ("reversals", "accelerations")
    at_reversals = True
    linear = (Linear("behind", UNITLESS, "Torque pulses over those of plastic impacts.", sign=1, bounds=(0.1, 1.5)),)
    shapes = (Shape("gap", POSITION, "Width of the gap at the joint, from side to side."), ROTOR)
    regressor_signals = "measured"
    instrument_signals = "measured"

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the torques by `crossing` of the gap."""
        j, rotor = place.joint, shapes["rotor"]
        moves = crossing(falls(motion, j, rotor), shapes["gap"], motion.dt)
        return motion.response(j, *moves, links=True, rotor=rotor)[:, :, None]

    def gear(self, motion: Motion, place: Place, shapes: Mapping[str, float], behind: float) -> Gear:
        """Return the equation that `crossing` solves."""
        least = LEAST_INERTIA * float(_at_postures(motion, place.joint, shapes["rotor"]).max())
        return Gear(place.joint, shapes["rotor"], least, behind, 0.0, 0.0, 0.5 * abs(behind) * shapes["gap"])

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return gaps that the link crosses in 5 to 100 ms under the usual load, and `rotors`."""
        usual = max(float(np.std(falls(motion, place.joint))), 1e-9)
        gaps = [0.5 * usual * float(time) ** 2 for time in np.geomspace(0.005, 0.1, 25)]
        return gaps, rotors(motion, place.joint)


def falls(motion: Motion, joint: int, rotor: float = 0.0) -> Array:
    """Return the free acceleration (N,) of a link relative to its motor, rad/s^2 or m/s^2; ``rotor``: in the link."""
    inertia = inertias(motion, joint, rotor)
    if inertia.max() <= 0.0:
        return np.zeros(motion.samples)
    away: Array = -motion.handed_on(joint, rotor) / inertia
    return away


@compiled("f8[::1], f8, f8", **ARITHMETIC)
def crossing(pull: Array, gap: float, dt: float) -> tuple[Array, Array, Array]:
    """Return position, velocity and acceleration (N,) of a link relative to its motor, in the gap of the gear.

    Leapfrog with plastic impacts at half a gap; central differences have no delay. ``pull``: free acceleration.
    """
    way, rate, acceleration = np.zeros(pull.size), np.zeros(pull.size), np.zeros(pull.size)
    way[0] = 0.5 * gap if pull[0] > 0.0 else -0.5 * gap
    v = 0.0
    for k in range(pull.size - 1):
        before = v
        v += dt * pull[k]
        if way[k] + dt * v > 0.5 * gap:
            v = (0.5 * gap - way[k]) / dt
        elif way[k] + dt * v < -0.5 * gap:
            v = (-0.5 * gap - way[k]) / dt
        way[k + 1] = way[k] + dt * v
        rate[k] = 0.5 * (before + v)
        acceleration[k] = (v - before) / dt
    return way, rate, acceleration


def inertias(motion: Motion, joint: int, rotor: float) -> Array:
    """Return the inertia (N,) of the link that a gear drives, kg m^2 or kg; at least `LEAST_INERTIA`."""
    inertia = motion.slopes(joint, links=True)[2][:, joint] - rotor
    believed: Array = np.maximum(inertia, LEAST_INERTIA * inertia.max())
    return believed


def _at_postures(motion: Motion, joint: int, rotor: float) -> Array:
    """Return that inertia (P,) at `Motion.postures`, without a lower bound."""
    inertia: Array = motion.model.mass_matrix(motion.links, motion.postures)[:, joint, joint] - rotor
    return inertia
