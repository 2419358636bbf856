"""Effects that can be hidden in the virtual arm, with their parameters."""

import math
from dataclasses import dataclass, field
from typing import Literal

AUTO = math.nan
"""Default of a parameter that is derived from the robot."""

Target = Literal["force", "bristle", "gear", "body", "drive", "report"]
"""Target of an effect: torques, bristles, gears or bodies of the plant, the drives, or their reported signals."""


@dataclass(frozen=True)
class ParameterSpec:
    """Parameter of an effect, joint side.

    ``unit``: unit at a revolute joint; at a prismatic joint N for N m, and m for rad. ``default``: ``None``: required;
    ``AUTO``: derived from the robot as described in ``meaning``. ``above``: ``True`` if ``low`` itself is excluded.
    ``only``: type of joint that has the parameter; ``None``: both.
    """

    unit: str
    meaning: str
    default: float | None = None
    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    only: Literal["revolute", "prismatic"] | None = None


@dataclass(frozen=True)
class EffectSpec:
    """Effect that can be hidden in the virtual arm.

    ``other``: ``required``, ``optional`` or ``none``: second joint of the effect; ``first_joint``: ``True`` if the
    effect concerns the base and is given at the first joint.
    """

    target: Target
    meaning: str
    parameters: dict[str, ParameterSpec]
    other: Literal["none", "optional", "required"] = "none"
    first_joint: bool = field(default=False)


def _positive(unit: str, meaning: str, default: float | None = None, high: float = math.inf) -> ParameterSpec:
    return ParameterSpec(unit, meaning, default, 0.0, high, above=True)


def _flag(meaning: str, default: float) -> ParameterSpec:
    return ParameterSpec("-", meaning, default, 0.0, 1.0)


_PHASE = ParameterSpec("rad", "phase", 0.0)
_PER_TURN = _positive(
    "-", "waves per turn; per metre at a prismatic joint, there two over its range unless given", AUTO
)
_PITCH = ParameterSpec(
    "m", "travel of a prismatic joint per turn of its motor", 0.02, 0.0, above=True, only="prismatic"
)

CATALOGUE: dict[str, EffectSpec] = {
    "asymmetric_viscous_friction": EffectSpec(
        "force",
        "viscous friction that depends on the direction of motion",
        {"ratio": ParameterSpec("-", "Fv (1 + ratio) forwards, Fv (1 - ratio) backwards", None, -1.0, 1.0)},
    ),
    "asymmetric_coulomb_friction": EffectSpec(
        "force",
        "Coulomb friction that depends on the direction of motion, once the joint moves",
        {
            "ratio": ParameterSpec("-", "Fc (1 + ratio) forwards, Fc (1 - ratio) backwards", None, -1.0, 1.0),
            "velocity": _positive(
                "rad/s", "speed at which it reaches 75 %; 1 % of the joint's limit unless given", AUTO
            ),
        },
    ),
    "stribeck_friction": EffectSpec(
        "bristle",
        "LuGre bristle in place of Coulomb friction, with more friction at low speed",
        {
            "extra": _positive("N m", "break-away friction above Coulomb friction"),
            "velocity": _positive("rad/s", "Stribeck velocity; 2 % of the joint's limit unless given", AUTO),
            "exponent": _positive("-", "exponent of the decrease", 2.0, 4.0),
            "deflection": _positive(
                "rad", "bristle deflection when sliding; 4 us times the velocity limit unless given", AUTO
            ),
            "damping": ParameterSpec("-", "damping of the stuck joint, of critical", 0.02, 0.0, 1.0),
        },
    ),
    "nonlinear_viscous_friction": EffectSpec(
        "force",
        "lubricant that thins with speed (Cross): viscosity 1 / (1 + abs(qd / v)^exponent)",
        {
            "thinning": _positive("-", "share of the viscous torque lost at ``velocity``", None, 0.95),
            "velocity": _positive("rad/s", "speed of that loss; half of the joint's limit unless given", AUTO),
            "exponent": _positive("-", "exponent", 1.0, 1.0),
        },
    ),
    "load_dependent_friction": EffectSpec(
        "force",
        "Coulomb friction that increases with the torque transmitted by the gear",
        {"coefficient": _positive("-", "friction torque per transmitted torque", None, 0.9)},
    ),
    "presliding_friction": EffectSpec(
        "bristle",
        "Dahl bristle in place of Coulomb friction: elastic before it slides",
        {
            "deflection": _positive("rad", "bristle deflection when sliding"),
            "damping": ParameterSpec("-", "damping of the stuck joint, of critical", 0.0, 0.0, 1.0),
        },
    ),
    "position_dependent_friction": EffectSpec(
        "force",
        "Coulomb friction that varies along the joint: a wave, or one tight spot",
        {
            "ratio": ParameterSpec("-", "amplitude over Fc", None, -1.0, 10.0),
            "per_turn": _PER_TURN,
            "phase": _PHASE,
            "width": ParameterSpec("rad", "0: wave; else half width of a tight spot", 0.0, 0.0),
            "position": ParameterSpec("rad", "middle of the tight spot", 0.0),
        },
    ),
    "friction_drift": EffectSpec(
        "force",
        "viscous and Coulomb friction that change with time, as an arm warms up",
        {
            "change": ParameterSpec("-", "relative change in the end", None, -1.0, 10.0),
            "time_constant": _positive("s", "time constant of the change", 10.0),
            "linear": _flag("1: ``change`` per ``time_constant``, without limit", 0.0),
        },
    ),
    "coupling_friction": EffectSpec(
        "force",
        "friction of a shaft that turns with the sum of two joints",
        {
            "coulomb": ParameterSpec("N m", "Coulomb friction of the shaft", None, 0.0),
            "viscous": ParameterSpec("N m s/rad", "viscous friction; 0.3 s/rad times Coulomb unless given", AUTO, 0.0),
        },
        other="required",
    ),
    "cogging_torque": EffectSpec(
        "force",
        "torque periodic in the motor angle; one entry per harmonic",
        {
            "amplitude": ParameterSpec("N m", "amplitude"),
            "harmonic": _positive("-", "waves per motor turn", 1.0),
            "phase": _PHASE,
            "pitch": _PITCH,
        },
    ),
    "joint_spring": EffectSpec(
        "force",
        "spring on the joint: gravity compensator, cable harness",
        {
            "stiffness": ParameterSpec("N m/rad", "stiffness"),
            "rest": ParameterSpec("rad", "position without force", 0.0),
        },
    ),
    "joint_elasticity": EffectSpec(
        "gear",
        "two masses: the motor, with encoder and friction, drives the link through a spring",
        {
            "stiffness": _positive("N m/rad", "stiffness between motor and link"),
            "damping": ParameterSpec("-", "damping of motor against link, of critical", 0.05, 0.0, 2.0),
            "motor_inertia": _positive(
                "kg m^2", "inertia of the motor, joint side; the robot's own, or 0.3 of the total if it has none", AUTO
            ),
        },
    ),
    "backlash": EffectSpec(
        "gear",
        "two masses: the motor drives the link through a gap",
        {
            "gap": _positive("rad", "total play"),
            "stiffness": _positive(
                "N m/rad", "stiffness of the contact; motor against link at 100 Hz unless given", AUTO
            ),
            "damping": ParameterSpec("-", "damping in contact, of critical", 0.1, 0.0, 2.0),
            "motor_inertia": _positive("kg m^2", "as for joint_elasticity", AUTO),
        },
    ),
    "payload": EffectSpec(
        "body",
        "mass fixed to the joint's link, in that link's frame",
        {
            "mass": _positive("kg", "mass"),
            "x": ParameterSpec("m", "centre of mass", 0.0),
            "y": ParameterSpec("m", "centre of mass", 0.0),
            "z": ParameterSpec("m", "centre of mass", 0.1),
            "radius": _positive("m", "radius of gyration about every axis through the centre of mass", 0.05),
        },
    ),
    "rotor_inertia": EffectSpec(
        "body",
        "additional rotor inertia; between two joints with ``other``",
        {"inertia": ParameterSpec("kg m^2", "joint side")},
        other="optional",
    ),
    "gravity_direction": EffectSpec(
        "body",
        "base mounted out of level",
        {
            "tilt": ParameterSpec("rad", "angle", None, -math.pi, math.pi),
            "azimuth": ParameterSpec("rad", "horizontal axis of the tilt, from the base's x axis", 0.0),
        },
        first_joint=True,
    ),
    "drive_gain_error": EffectSpec(
        "drive",
        "true torque per unit of the drive's signal differs from the configured one",
        {"error": ParameterSpec("-", "true gain over configured gain, minus 1", None, -0.9, 5.0)},
    ),
    "drive_gain_saturation": EffectSpec(
        "drive",
        "torque less than proportional to the signal by magnetic saturation: i / sqrt(1 + (i / i_s)^2)",
        {
            "drop": _positive("-", "share of the torque lost at ``torque``", None, 0.9),
            "torque": _positive("N m", "torque of that loss; half of the joint's limit unless given", AUTO),
        },
    ),
    "sign_error": EffectSpec(
        "report",
        "a signal of the drive is recorded with the wrong sign",
        {"torque": _flag("1: the torque signal", 1.0), "position": _flag("1: the position and the demand", 0.0)},
    ),
    "joint_order": EffectSpec(
        "report",
        "signals of two drives are exchanged in the recording",
        {"torque": _flag("1: the torque signals", 1.0), "position": _flag("1: the positions and the demands", 1.0)},
        other="required",
    ),
    "time_delay": EffectSpec(
        "report",
        "the torque signal is reported late",
        {"delay": ParameterSpec("s", "delay, whole samples or not", None, 0.0, 1.0)},
    ),
    "encoder_eccentricity": EffectSpec(
        "report",
        "periodic error of the measured position, which the drive follows",
        {
            "amplitude": ParameterSpec("rad", "amplitude, joint side"),
            "per_turn": _PER_TURN,
            "phase": _PHASE,
            "motor": _flag("1: turns of the motor; 0: of the joint, metres of a prismatic one", 0.0),
            "pitch": _PITCH,
        },
    ),
    "actuator_bandwidth": EffectSpec(
        "drive",
        "first-order lag between the torque reported and the torque applied",
        {"time_constant": _positive("s", "time constant", None, 1.0)},
    ),
    "torque_offset": EffectSpec(
        "force",
        "constant torque against the joint",
        {"torque": ParameterSpec("N m", "torque")},
    ),
}
"""Effects that ``armident diagnose`` can find by name."""

OUTSIDE: dict[str, EffectSpec] = {
    "torque_bump": EffectSpec(
        "force",
        "torque against the joint near one angle",
        {
            "torque": ParameterSpec("N m", "height"),
            "position": ParameterSpec("rad", "middle", 0.0),
            "width": _positive("rad", "standard deviation; 2 % of the joint's range unless given", AUTO),
        },
    ),
    "mains_ripple": EffectSpec(
        "report",
        "interference of the mains frequency in the torque signal",
        {
            "amplitude": ParameterSpec("N m", "amplitude, joint side"),
            "frequency": _positive("Hz", "frequency", 50.0),
            "phase": _PHASE,
        },
    ),
    "slosh_payload": EffectSpec(
        "body",
        "liquid in a vessel on the joint's link, as a pendulum about the link's x axis",
        {
            "mass": _positive("kg", "mass that swings"),
            "length": _positive("m", "length of the pendulum", 0.1),
            "z": ParameterSpec("m", "position of its hinge in the link's frame", 0.05),
            "damping": _positive("-", "damping of the pendulum, of critical", 0.05, 2.0),
        },
    ),
    "current_crosstalk": EffectSpec(
        "report",
        "the torque signal contains a share of another drive's",
        {"share": ParameterSpec("-", "joint torque read per joint torque of the other", None, -1.0, 1.0)},
        other="required",
    ),
    "stick_events": EffectSpec(
        "force",
        "short events of additional Coulomb friction (dirt), one per interval at a random time",
        {
            "torque": _positive("N m", "friction at its peak"),
            "every": _positive("s", "interval", 1.0),
            "duration": _positive("s", "duration of one event; shorter than the interval", 0.1),
            "seed": ParameterSpec("-", "seed of the random times", 0.0, 0.0, 1e6),
        },
    ),
    "quadratic_coupling": EffectSpec(
        "force",
        "torque proportional to the squared velocity of another joint (centrifugal force of a hose)",
        {"coefficient": ParameterSpec("N m s^2/rad^2", "torque per velocity squared of the other")},
        other="required",
    ),
    "base_vibration": EffectSpec(
        "body",
        "horizontal vibration of the base",
        {
            "amplitude": ParameterSpec("m/s^2", "acceleration"),
            "frequency": _positive("Hz", "frequency", 4.0),
            "azimuth": ParameterSpec("rad", "direction, from the base's y axis", 0.0),
        },
        first_joint=True,
    ),
}
"""Effects outside the diagnosis catalogue: ``armident diagnose`` must report them as unexplained."""

PARAMETER_CHANGES: dict[str, EffectSpec] = {
    "friction_scale": EffectSpec(
        "force",
        "all friction of a joint times a factor (cold grease): changed parameters in the same model structure",
        {"factor": ParameterSpec("-", "factor", None, 0.0, 10.0)},
    ),
}
"""Effects that change parameters but not the model structure: a new identification leaves no error."""

EFFECTS: dict[str, EffectSpec] = CATALOGUE | OUTSIDE | PARAMETER_CHANGES
"""All effects by name."""


def describe_effects() -> str:
    """Text table of all effects with their parameters, units, defaults and ranges."""
    lines = []
    for title, effects in (
        ("Catalogue", CATALOGUE),
        ("Outside the catalogue", OUTSIDE),
        ("Changed parameters", PARAMETER_CHANGES),
    ):
        lines += [title, ""]
        for name, effect in effects.items():
            second = {"none": "", "optional": " [other: joint]", "required": " other: joint"}[effect.other]
            lines.append(f"  {name}{second}: {effect.meaning}")
            lines += [f"      {key} ({p.unit}): {p.meaning}{_limits(p)}" for key, p in effect.parameters.items()]
        lines.append("")
    lines.append("Joint side, SI; at a prismatic joint N for N m and m for rad.")
    return "\n".join(lines)


def _limits(p: ParameterSpec) -> str:
    default = "required" if p.default is None else "from the robot" if math.isnan(p.default) else f"{p.default:g}"
    low = "" if math.isinf(p.low) else f"{'above' if p.above else 'from'} {p.low:g}"
    high = "" if math.isinf(p.high) else f"to {p.high:g}"
    bounds = " ".join(part for part in (low, high) if part)
    return f" [{'; '.join(part for part in (default, bounds, p.only and f'{p.only} only') if part)}]"
