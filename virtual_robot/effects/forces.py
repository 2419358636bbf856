"""Hidden torques without state: one entry of `EFFECTS` and one branch of `effect_torque` each."""

import math
from collections.abc import Sequence

import numpy as np

from armident.arrays import Array
from armident.compiled import PLAIN, compiled
from armident.configs import ConfigError, Joint, RobotConfig
from armident.virtual_robot.effects.spec import (
    AUTO,
    PER_TURN,
    PHASE,
    PITCH,
    EffectSpec,
    Hidden,
    ParameterSpec,
    flag,
    positive,
)

PARAMETERS = 6
"""Number of parameters of a row, after code, joint and other joint."""


@compiled(**PLAIN)
def _random(seed, cell):  # type: ignore[no-untyped-def]
    """Uniform random number in [0, 1) of a seed and the number of an interval (splitmix64, Steele et al. 2014)."""
    x = np.uint64(seed) * np.uint64(0xD1342543DE82EF95) + np.uint64(cell + 1) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    x = x ^ (x >> np.uint64(31))
    return (x >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@compiled(**PLAIN)
def effect_torque(code, p, q, qd, motor, other, load, t, smoothing):  # type: ignore[no-untyped-def]
    """Torque against the joint (N m) and its slope over ``qd`` (N m s/rad).

    ``code`` is in ``CODES``; ``p``: parameters of its row in `force_table`. ``motor``: angle, rad. ``other``: velocity
    of the other joint. ``load``: of the gear on the links, N m. ``smoothing``: ``g``, s/rad or s/m.
    """
    side = 2.0 / math.pi * math.atan(smoothing * qd)
    side_slope = 2.0 / math.pi * smoothing / (1.0 + (smoothing * qd) ** 2)
    if code == 0:  # fva |qd|
        return p[0] * abs(qd), p[0] * math.copysign(1.0, qd)
    if code == 1:  # fca, which builds up with speed
        film = math.tanh(qd / p[1])
        return p[0] * film * film, p[0] * 2.0 * film * (1.0 - film * film) / p[1]
    if code == 2:  # fv qd (1 / (1 + |qd / v0|^exponent) - 1)
        thin = abs(qd / p[1]) ** p[2]
        return -p[0] * qd * thin / (1.0 + thin), p[0] * ((1.0 + thin - p[2] * thin) / (1.0 + thin) ** 2 - 1.0)
    if code == 3:  # fcl |load|
        return p[0] * abs(load) * side, p[0] * abs(load) * side_slope
    if code == 4:  # wave or tight spot
        level = p[0] * (math.exp(-0.5 * ((q - p[4]) / p[3]) ** 2) if p[3] > 0.0 else math.cos(p[1] * q + p[2]))
        return level * side, level * side_slope
    if code == 5:  # change of fv and fc with time
        part = t / p[2] if p[3] > 0.5 else 1.0 - math.exp(-t / p[2])
        return part * (p[0] * qd + p[1] * side), part * (p[0] + p[1] * side_slope)
    if code == 6:  # harmonic of the motor's turns
        return p[0] * math.sin(p[1] * motor + p[2]), 0.0
    if code == 7:  # spring
        return p[0] * (q - p[1]), 0.0
    if code == 8:  # constant
        return p[0], 0.0
    if code == 9:  # scaled viscous and Coulomb friction
        return p[0] * qd + p[1] * side, p[0] + p[1] * side_slope
    if code == 10:  # bump at one angle
        return p[0] * math.exp(-0.5 * ((q - p[1]) / p[2]) ** 2), 0.0
    if code == 11:  # one event in every interval
        cell = math.floor(t / p[1])
        since = t - cell * p[1] - _random(p[3], cell) * (p[1] - p[2])
        if since <= 0.0 or since >= p[2]:
            return 0.0, 0.0
        level = p[0] * math.sin(math.pi * since / p[2]) ** 2
        return level * side, level * side_slope
    # velocity of the other joint squared
    return p[0] * other * other, 0.0


def waves(h: Hidden, joint: Joint) -> float:
    """Angular wave number (1/rad or 1/m) of an effect that is periodic in the joint position."""
    if joint.type == "revolute":
        return h.value_or("per_turn", 1.0)
    low, high = joint.limits.position
    return 2.0 * math.pi * h.value_or("per_turn", 2.0 / (high - low))


def _turn(h: Hidden, robot: RobotConfig) -> float:
    """Return the angle of the motor of a joint over its number of turns: 1 where positions are angles."""
    if robot.joints[h.joint].type == "revolute":
        return 1.0
    return 2.0 * math.pi / h["pitch"] / float(robot.transmission_matrix[h.joint, h.joint])


def _at_most(h: Hidden, name: str, friction: float) -> float:
    """Return a difference between the directions, which the friction of the joint bounds."""
    if abs(h[name]) > friction:
        raise ConfigError(f"{h.where}.parameters.{name}: expected at most the friction {friction:g}, found {h[name]:g}")
    return h[name]


EFFECTS: dict[str, EffectSpec] = {
    "asymmetric_viscous_friction": EffectSpec(
        "force",
        "viscous friction that depends on the direction of motion",
        {"fva": ParameterSpec("N m s/rad", "Fv + fva forwards, Fv - fva backwards; at most Fv")},
        row=lambda h, robot, fv, fc: (_at_most(h, "fva", fv),),
    ),
    "asymmetric_coulomb_friction": EffectSpec(
        "force",
        "Coulomb friction that depends on the direction of motion, once the joint moves",
        {
            "fca": ParameterSpec("N m", "Fc + fca forwards, Fc - fca backwards; at most Fc"),
            "velocity": positive(
                "rad/s", "speed at which it reaches 75 %; 1 % of the joint's limit unless given", AUTO
            ),
        },
        row=lambda h, robot, fv, fc: (
            # tanh^2 reaches three quarters at 1.317.
            _at_most(h, "fca", fc),
            h.value_or("velocity", 0.01 * robot.joints[h.joint].limits.velocity) / math.atanh(math.sqrt(0.75)),
        ),
    ),
    "nonlinear_viscous_friction": EffectSpec(
        "force",
        "lubricant that thins with speed (Cross): viscosity 1 / (1 + abs(qd / v)^exponent)",
        {
            "thinning": positive("-", "share of the viscous torque lost at ``velocity``", None, 0.95),
            "velocity": positive("rad/s", "speed of that loss; half of the joint's limit unless given", AUTO),
            "exponent": positive("-", "exponent", 1.0, 1.0),
        },
        row=lambda h, robot, fv, fc: (
            fv,
            h.value_or("velocity", 0.5 * robot.joints[h.joint].limits.velocity)
            * (1.0 / h["thinning"] - 1.0) ** (1.0 / h["exponent"]),
            h["exponent"],
        ),
    ),
    "load_dependent_friction": EffectSpec(
        "force",
        "Coulomb friction that increases with the torque transmitted by the gear",
        {"fcl": positive("-", "friction torque per transmitted torque", None, 0.9)},
        row=lambda h, robot, fv, fc: (h["fcl"],),
    ),
    "position_dependent_friction": EffectSpec(
        "force",
        "Coulomb friction that varies along the joint: a wave, or one tight spot",
        {
            "ratio": ParameterSpec("-", "amplitude over Fc", None, -1.0, 10.0),
            "per_turn": PER_TURN,
            "phase": PHASE,
            "width": ParameterSpec("rad", "0: wave; else half width of a tight spot", 0.0, 0.0),
            "position": ParameterSpec("rad", "middle of the tight spot", 0.0),
        },
        repeatable=True,
        row=lambda h, robot, fv, fc: (
            h["ratio"] * fc,
            waves(h, robot.joints[h.joint]),
            h["phase"],
            h["width"],
            h["position"],
        ),
    ),
    "friction_drift": EffectSpec(
        "force",
        "viscous and Coulomb friction that change with time, as an arm warms up",
        {
            "change": ParameterSpec("-", "relative change in the end", None, -1.0, 10.0),
            "time_constant": positive("s", "time constant of the change", 10.0),
            "linear": flag("1: ``change`` per ``time_constant``, without limit", 0.0),
        },
        row=lambda h, robot, fv, fc: (h["change"] * fv, h["change"] * fc, h["time_constant"], h["linear"]),
    ),
    "cogging_torque": EffectSpec(
        "force",
        "torque periodic in the motor angle; one entry per harmonic",
        {
            "amplitude": ParameterSpec("N m", "amplitude"),
            "harmonic": positive("-", "waves per motor turn", 1.0),
            "phase": PHASE,
            "pitch": PITCH,
        },
        repeatable=True,
        row=lambda h, robot, fv, fc: (h["amplitude"], h["harmonic"] * _turn(h, robot), h["phase"]),
    ),
    "joint_spring": EffectSpec(
        "force",
        "spring on the joint: gravity compensator, cable harness",
        {
            "stiffness": ParameterSpec("N m/rad", "stiffness"),
            "rest": ParameterSpec("rad", "position without force", 0.0),
        },
        row=lambda h, robot, fv, fc: (h["stiffness"], h["rest"]),
    ),
    "torque_offset": EffectSpec(
        "force",
        "constant torque against the joint",
        {"torque": ParameterSpec("N m", "torque")},
        row=lambda h, robot, fv, fc: (h["torque"],),
    ),
    "friction_scale": EffectSpec(
        "force",
        "all friction of a joint times a factor (cold grease): changed parameters in the same model structure",
        {"factor": ParameterSpec("-", "factor", None, 0.0, 10.0)},
        group="parameters",
        row=lambda h, robot, fv, fc: ((h["factor"] - 1.0) * fv, (h["factor"] - 1.0) * fc),
    ),
    "torque_bump": EffectSpec(
        "force",
        "torque against the joint near one angle",
        {
            "torque": ParameterSpec("N m", "height"),
            "position": ParameterSpec("rad", "middle", 0.0),
            "width": positive("rad", "standard deviation; 2 % of the joint's range unless given", AUTO),
        },
        group="outside",
        repeatable=True,
        row=lambda h, robot, fv, fc: (
            h["torque"],
            h["position"],
            h.value_or("width", 0.02 * float(np.ptp(robot.joints[h.joint].limits.position))),
        ),
    ),
    "stick_events": EffectSpec(
        "force",
        "short events of additional Coulomb friction (dirt), one per interval at a random time",
        {
            "torque": positive("N m", "friction at its peak"),
            "every": positive("s", "interval", 1.0),
            "duration": positive("s", "duration of one event; shorter than the interval", 0.1),
            "seed": ParameterSpec("-", "seed of the random times", 0.0, 0.0, 1e6),
        },
        group="outside",
        row=lambda h, robot, fv, fc: (h["torque"], h["every"], h["duration"], h["seed"]),
    ),
    "quadratic_coupling": EffectSpec(
        "force",
        "torque proportional to the squared velocity of another joint (centrifugal force of a hose)",
        {"coefficient": ParameterSpec("N m s^2/rad^2", "torque per velocity squared of the other")},
        other="required",
        group="outside",
        row=lambda h, robot, fv, fc: (h["coefficient"],),
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
}
"""Effects whose torque is computed here, those of `effect_torque` in the order of its branches."""

CODES = tuple(name for name, effect in EFFECTS.items() if effect.row is not None)
"""Effects in the order of the branches of `effect_torque`."""

LOAD_CODE = CODES.index("load_dependent_friction")
"""Effect that needs the transmitted torque."""


def force_table(hidden: Sequence[Hidden], robot: RobotConfig, friction: Array) -> Array:
    """Code, joint, other joint (-1: none) and parameters of each torque of `effect_torque`, (E, 3 + PARAMETERS).

    ``friction`` (n, 3 or more): fv, fc and offset of the healthy arm.
    """
    mine = [h for h in hidden if h.effect in CODES]
    table = np.zeros((len(mine), 3 + PARAMETERS))
    for row, h in zip(table, mine, strict=True):
        assert h.spec.row is not None
        values = h.spec.row(h, robot, float(friction[h.joint, 0]), float(friction[h.joint, 1]))
        row[:3] = CODES.index(h.effect), h.joint, h.other
        row[3 : 3 + len(values)] = values
    return table
