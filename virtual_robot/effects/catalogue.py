"""The effects that can be hidden in the virtual arm: what they are called, and which parameters they take."""

import math
from dataclasses import dataclass, field
from typing import Literal

AUTO = math.nan
"""Default of a parameter that follows from the robot."""

Place = Literal["force", "bristle", "gear", "body", "drive", "report"]
"""What an effect changes: torques of the plant, its bristles, its gears, its bodies, the drives, what they report."""


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect, joint side.

    Parameters
    ----------
    unit
        Unit at a revolute joint; at a prismatic one N for N m, m for rad.
    meaning
        What it is.
    default
        ``None``: must be given; ``AUTO``: follows from the robot, as ``meaning`` says.
    low, high
        Range; ``low`` itself is outside where ``above`` is set.
    only
        The one type of joint that has it.
    """

    unit: str
    meaning: str
    default: float | None = None
    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    only: Literal["revolute", "prismatic"] | None = None


@dataclass(frozen=True)
class Effect:
    """An effect: where it acts, what it is, its parameters, and whether it has a second joint."""

    place: Place
    meaning: str
    parameters: dict[str, Parameter]
    other: Literal["none", "optional", "required"] = "none"
    first_joint: bool = field(default=False)


def _positive(unit: str, meaning: str, default: float | None = None, high: float = math.inf) -> Parameter:
    return Parameter(unit, meaning, default, 0.0, high, above=True)


def _flag(meaning: str, default: float) -> Parameter:
    return Parameter("-", meaning, default, 0.0, 1.0)


_PHASE = Parameter("rad", "phase", 0.0)
_PER_TURN = _positive(
    "-", "waves per turn; per metre at a prismatic joint, there two over its range unless given", AUTO
)
_PITCH = Parameter("m", "travel of a prismatic joint per turn of its motor", 0.02, 0.0, above=True, only="prismatic")

CATALOGUE: dict[str, Effect] = {
    "asymmetric_viscous_friction": Effect(
        "force",
        "viscous friction larger one way than the other",
        {"ratio": Parameter("-", "Fv (1 + ratio) forwards, Fv (1 - ratio) backwards", None, -1.0, 1.0)},
    ),
    "asymmetric_coulomb_friction": Effect(
        "force",
        "Coulomb friction larger one way than the other, once the joint moves",
        {
            "ratio": Parameter("-", "Fc (1 + ratio) forwards, Fc (1 - ratio) backwards", None, -1.0, 1.0),
            "velocity": _positive(
                "rad/s", "speed at which three quarters of it act; 1 % of the joint's limit unless given", AUTO
            ),
        },
    ),
    "stribeck_friction": Effect(
        "bristle",
        "LuGre bristle in place of Coulomb friction, with more friction at low speed",
        {
            "extra": _positive("N m", "break-away friction above Coulomb friction"),
            "velocity": _positive("rad/s", "Stribeck velocity; 2 % of the joint's limit unless given", AUTO),
            "exponent": _positive("-", "shape of the fall", 2.0, 4.0),
            "deflection": _positive(
                "rad", "bristle deflection when sliding; 4 us at the joint's limit unless given", AUTO
            ),
            "damping": Parameter("-", "damping of the stuck joint, of critical", 0.02, 0.0, 1.0),
        },
    ),
    "nonlinear_viscous_friction": Effect(
        "force",
        "lubricant that thins with speed (Cross): viscosity 1 / (1 + abs(qd / v)^exponent)",
        {
            "thinning": _positive("-", "share of the viscous torque lost at ``velocity``", None, 0.95),
            "velocity": _positive("rad/s", "speed of that loss; half of the joint's limit unless given", AUTO),
            "exponent": _positive("-", "exponent", 1.0, 1.0),
        },
    ),
    "load_dependent_friction": Effect(
        "force",
        "Coulomb friction that grows with the torque the gear passes on to the links",
        {"coefficient": _positive("-", "friction torque per torque passed on", None, 0.9)},
    ),
    "presliding_friction": Effect(
        "bristle",
        "Dahl bristle in place of Coulomb friction: elastic before it slides",
        {
            "deflection": _positive("rad", "bristle deflection when sliding"),
            "damping": Parameter("-", "damping of the stuck joint, of critical", 0.0, 0.0, 1.0),
        },
    ),
    "position_dependent_friction": Effect(
        "force",
        "Coulomb friction that varies along the joint: a wave, or one tight spot",
        {
            "ratio": Parameter("-", "amplitude over Fc", None, -1.0, 10.0),
            "per_turn": _PER_TURN,
            "phase": _PHASE,
            "width": Parameter("rad", "0: wave; else half width of a tight spot", 0.0, 0.0),
            "position": Parameter("rad", "middle of the tight spot", 0.0),
        },
    ),
    "friction_drift": Effect(
        "force",
        "viscous and Coulomb friction that change with time, as an arm warms up",
        {
            "change": Parameter("-", "relative change in the end", None, -1.0, 10.0),
            "time_constant": _positive("s", "time constant of the change", 10.0),
            "linear": _flag("1: ``change`` per ``time_constant``, for ever", 0.0),
        },
    ),
    "coupling_friction": Effect(
        "force",
        "friction of a shaft that turns with the sum of two joints",
        {
            "coulomb": Parameter("N m", "Coulomb friction of the shaft", None, 0.0),
            "viscous": Parameter("N m s/rad", "viscous friction; 0.3 s/rad times Coulomb unless given", AUTO, 0.0),
        },
        other="required",
    ),
    "cogging_torque": Effect(
        "force",
        "torque periodic in the motor angle; one entry per harmonic",
        {
            "amplitude": Parameter("N m", "amplitude"),
            "harmonic": _positive("-", "waves per motor turn", 1.0),
            "phase": _PHASE,
            "pitch": _PITCH,
        },
    ),
    "joint_spring": Effect(
        "force",
        "spring on the joint: gravity compensator, cable harness",
        {"stiffness": Parameter("N m/rad", "stiffness"), "rest": Parameter("rad", "where it is slack", 0.0)},
    ),
    "joint_elasticity": Effect(
        "gear",
        "two masses: the motor, with encoder and friction, drives the link through a spring",
        {
            "stiffness": _positive("N m/rad", "stiffness between motor and link"),
            "damping": Parameter("-", "damping of motor against link, of critical", 0.05, 0.0, 2.0),
            "motor_inertia": _positive(
                "kg m^2", "of the motor, joint side; the robot's own, or 0.3 of all where it has none", AUTO
            ),
        },
    ),
    "backlash": Effect(
        "gear",
        "two masses: the motor drives the link through a gap",
        {
            "gap": _positive("rad", "total play"),
            "stiffness": _positive("N m/rad", "of the contact; motor against link at 100 Hz unless given", AUTO),
            "damping": Parameter("-", "damping in contact, of critical", 0.1, 0.0, 2.0),
            "motor_inertia": _positive("kg m^2", "as for joint_elasticity", AUTO),
        },
    ),
    "payload": Effect(
        "body",
        "mass fixed to the joint's link, in that link's frame",
        {
            "mass": _positive("kg", "mass"),
            "x": Parameter("m", "centre of mass", 0.0),
            "y": Parameter("m", "centre of mass", 0.0),
            "z": Parameter("m", "centre of mass", 0.1),
            "radius": _positive("m", "radius of gyration about every axis through the centre of mass", 0.05),
        },
    ),
    "rotor_inertia": Effect(
        "body",
        "inertia of a rotor that the links do not have; between two joints with ``other``",
        {"inertia": Parameter("kg m^2", "joint side")},
        other="optional",
    ),
    "gravity_direction": Effect(
        "body",
        "base mounted out of level",
        {
            "tilt": Parameter("rad", "angle", None, -math.pi, math.pi),
            "azimuth": Parameter("rad", "horizontal axis of the tilt, from the base's x axis", 0.0),
        },
        first_joint=True,
    ),
    "drive_gain_error": Effect(
        "drive",
        "true torque per unit of the drive's signal differs from the configured one",
        {"error": Parameter("-", "true gain over configured gain, less 1", None, -0.9, 5.0)},
    ),
    "drive_gain_saturation": Effect(
        "drive",
        "torque falls behind the signal as the iron saturates: i / sqrt(1 + (i / i_s)^2)",
        {
            "drop": _positive("-", "share of the torque lost at ``torque``", None, 0.9),
            "torque": _positive("N m", "torque of that loss; half of the joint's limit unless given", AUTO),
        },
    ),
    "sign_error": Effect(
        "report",
        "a signal of the drive is recorded with the wrong sign",
        {"torque": _flag("1: the torque signal", 1.0), "position": _flag("1: the position and the demand", 0.0)},
    ),
    "joint_order": Effect(
        "report",
        "signals of two drives are recorded under each other's names",
        {"torque": _flag("1: the torque signals", 1.0), "position": _flag("1: the positions and the demands", 1.0)},
        other="required",
    ),
    "time_delay": Effect(
        "report",
        "the torque signal is reported late",
        {"delay": Parameter("s", "delay, whole samples or not", None, 0.0, 1.0)},
    ),
    "encoder_eccentricity": Effect(
        "report",
        "position measured wrong once or more per turn; the drive follows it",
        {
            "amplitude": Parameter("rad", "amplitude, joint side"),
            "per_turn": _PER_TURN,
            "phase": _PHASE,
            "motor": _flag("1: turns of the motor; 0: of the joint, metres of a prismatic one", 0.0),
            "pitch": _PITCH,
        },
    ),
    "actuator_bandwidth": Effect(
        "drive",
        "first-order lag between the torque reported and the torque applied",
        {"time_constant": _positive("s", "time constant", None, 1.0)},
    ),
    "torque_offset": Effect(
        "force",
        "constant torque against the joint",
        {"torque": Parameter("N m", "torque")},
    ),
}
"""What ``armident diagnose`` should find by name."""

OUTSIDE: dict[str, Effect] = {
    "torque_bump": Effect(
        "force",
        "torque against the joint near one angle",
        {
            "torque": Parameter("N m", "height"),
            "position": Parameter("rad", "middle", 0.0),
            "width": _positive("rad", "standard deviation; 2 % of the joint's range unless given", AUTO),
        },
    ),
    "mains_ripple": Effect(
        "report",
        "mains frequency picked up by the torque signal",
        {
            "amplitude": Parameter("N m", "amplitude, joint side"),
            "frequency": _positive("Hz", "frequency", 50.0),
            "phase": _PHASE,
        },
    ),
    "slosh_payload": Effect(
        "body",
        "vessel on the joint's link in which a mass swings as a pendulum about the link's x axis",
        {
            "mass": _positive("kg", "mass that swings"),
            "length": _positive("m", "of the pendulum", 0.1),
            "z": Parameter("m", "of its hinge in the link's frame", 0.05),
            "damping": _positive("-", "of critical", 0.05, 2.0),
        },
    ),
    "current_crosstalk": Effect(
        "report",
        "the torque signal contains a share of another drive's",
        {"share": Parameter("-", "joint torque read per joint torque of the other", None, -1.0, 1.0)},
        other="required",
    ),
    "stick_events": Effect(
        "force",
        "dirt: Coulomb friction for moments, once in every interval at a random time",
        {
            "torque": _positive("N m", "friction at its peak"),
            "every": _positive("s", "interval", 1.0),
            "duration": _positive("s", "of one event; shorter than the interval", 0.1),
            "seed": Parameter("-", "of the times", 0.0, 0.0, 1e6),
        },
    ),
    "quadratic_coupling": Effect(
        "force",
        "hose flung outwards by another joint pulls on this one: torque proportional to that velocity squared",
        {"coefficient": Parameter("N m s^2/rad^2", "torque per velocity squared of the other")},
        other="required",
    ),
    "base_vibration": Effect(
        "body",
        "floor that shakes horizontally",
        {
            "amplitude": Parameter("m/s^2", "acceleration"),
            "frequency": _positive("Hz", "frequency", 4.0),
            "azimuth": Parameter("rad", "direction, from the base's y axis", 0.0),
        },
        first_joint=True,
    ),
}
"""Outside the catalogue: ``armident diagnose`` has no name for these, and must not give them one of its own."""

STALE: dict[str, Effect] = {
    "friction_scale": Effect(
        "force",
        "all friction of a joint times a factor: cold grease; numbers change, structure does not",
        {"factor": Parameter("-", "factor", None, 0.0, 10.0)},
    ),
}
"""Wrong numbers in a right structure: identified afresh, nothing is missing."""

EFFECTS: dict[str, Effect] = CATALOGUE | OUTSIDE | STALE


def describe_effects() -> str:
    """Text table of all effects with their parameters, units, defaults and ranges."""
    lines = []
    for title, effects in (("Catalogue", CATALOGUE), ("Outside the catalogue", OUTSIDE), ("Stale numbers", STALE)):
        lines += [title, ""]
        for name, effect in effects.items():
            second = {"none": "", "optional": " [other: joint]", "required": " other: joint"}[effect.other]
            lines.append(f"  {name}{second}: {effect.meaning}")
            lines += [f"      {key} ({p.unit}): {p.meaning}{_limits(p)}" for key, p in effect.parameters.items()]
        lines.append("")
    lines.append("Joint side, SI; at a prismatic joint N for N m and m for rad.")
    return "\n".join(lines)


def _limits(p: Parameter) -> str:
    default = "required" if p.default is None else "from the robot" if math.isnan(p.default) else f"{p.default:g}"
    low = "" if math.isinf(p.low) else f"{'above' if p.above else 'from'} {p.low:g}"
    high = "" if math.isinf(p.high) else f"to {p.high:g}"
    bounds = " ".join(part for part in (low, high) if part)
    return f" [{'; '.join(part for part in (default, bounds, p.only and f'{p.only} only') if part)}]"
