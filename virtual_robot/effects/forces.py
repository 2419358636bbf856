"""Hidden torques without state: one row of a table and one branch of the compiled function each."""

import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from armident.configs import Joint, RobotConfig
from armident.virtual_robot.effects.hidden import Hidden

CODES = (
    "asymmetric_viscous_friction", "asymmetric_coulomb_friction", "nonlinear_viscous_friction",
    "load_dependent_friction", "position_dependent_friction", "friction_drift", "cogging_torque", "joint_spring",
    "torque_offset", "friction_scale", "torque_bump", "stick_events", "quadratic_coupling",
)  # fmt: skip
"""Effects in the order of the branches of ``effect_torque``."""

PARAMETERS = 6
"""Number of parameters of a row, after code, joint and other joint."""


@njit(cache=True, error_model="numpy")
def _random(seed, cell):  # type: ignore[no-untyped-def]
    """Uniform random number in [0, 1) of a seed and the number of an interval (splitmix64, Steele et al. 2014)."""
    x = np.uint64(seed) * np.uint64(0xD1342543DE82EF95) + np.uint64(cell + 1) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    x = x ^ (x >> np.uint64(31))
    return (x >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@njit(cache=True, error_model="numpy")
def effect_torque(code, p, q, qd, motor, other, load, t, smoothing):  # type: ignore[no-untyped-def]
    """Torque against the joint (N m) and its slope over ``qd`` (N m s/rad).

    Parameters
    ----------
    code
        Index of the effect in ``CODES``.
    p
        Parameters of its row in `force_table`, shape (PARAMETERS,).
    q, qd
        Position and velocity of the joint, rad or m.
    motor
        Angle of its motor, rad.
    other
        Velocity of the other joint, rad/s or m/s.
    load
        Torque that the gear transmits to the links, N m.
    smoothing
        ``g`` in ``sign(qd) -> (2/pi) atan(g qd)``, s/rad or s/m.
    """
    side = 2.0 / math.pi * math.atan(smoothing * qd)
    side_slope = 2.0 / math.pi * smoothing / (1.0 + (smoothing * qd) ** 2)
    if code == 0:  # ratio fv |qd|
        return p[0] * abs(qd), p[0] * math.copysign(1.0, qd)
    if code == 1:  # ratio fc, which builds up with speed
        film = math.tanh(qd / p[1])
        return p[0] * film * film, p[0] * 2.0 * film * (1.0 - film * film) / p[1]
    if code == 2:  # fv qd (1 / (1 + |qd / v0|^exponent) - 1)
        thin = abs(qd / p[1]) ** p[2]
        return -p[0] * qd * thin / (1.0 + thin), p[0] * ((1.0 + thin - p[2] * thin) / (1.0 + thin) ** 2 - 1.0)
    if code == 3:  # coefficient |load|
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


def force_table(hidden: Sequence[Hidden], robot: RobotConfig, friction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Table of hidden torques for `effect_torque`.

    ``friction``: fv, fc and offset of the healthy arm (further columns are ignored), shape (n, 3 or more). Returns the
    code, joint, other joint (-1: none) and parameters of each torque, shape (E, 3 + PARAMETERS).
    """
    mine = [h for h in hidden if h.effect in CODES]
    table = np.zeros((len(mine), 3 + PARAMETERS))
    for row, h in zip(table, mine, strict=True):
        values = _row(h, robot, float(friction[h.joint, 0]), float(friction[h.joint, 1]))
        row[:3] = CODES.index(h.effect), h.joint, h.other
        row[3 : 3 + len(values)] = values
    return table


def _row(h: Hidden, robot: RobotConfig, fv: float, fc: float) -> tuple[float, ...]:
    joint, ratio = robot.joints[h.joint], robot.transmission_matrix[h.joint, h.joint]
    match h.effect:
        case "asymmetric_viscous_friction":
            return (h["ratio"] * fv,)
        case "asymmetric_coulomb_friction":
            # tanh^2 reaches three quarters at 1.317.
            return h["ratio"] * fc, h.value_or("velocity", 0.01 * joint.limits.velocity) / math.atanh(math.sqrt(0.75))
        case "nonlinear_viscous_friction":
            speed = h.value_or("velocity", 0.5 * joint.limits.velocity)
            return fv, speed * (1.0 / h["thinning"] - 1.0) ** (1.0 / h["exponent"]), h["exponent"]
        case "load_dependent_friction":
            return (h["coefficient"],)
        case "position_dependent_friction":
            return h["ratio"] * fc, waves(h, joint), h["phase"], h["width"], h["position"]
        case "friction_drift":
            return h["change"] * fv, h["change"] * fc, h["time_constant"], h["linear"]
        case "cogging_torque":
            turn = 1.0 if joint.type == "revolute" else 2.0 * math.pi / h["pitch"] / ratio
            return h["amplitude"], h["harmonic"] * turn, h["phase"]
        case "joint_spring":
            return h["stiffness"], h["rest"]
        case "torque_offset":
            return (h["torque"],)
        case "friction_scale":
            return (h["factor"] - 1.0) * fv, (h["factor"] - 1.0) * fc
        case "torque_bump":
            low, high = joint.limits.position
            return h["torque"], h["position"], h.value_or("width", 0.02 * (high - low))
        case "stick_events":
            return h["torque"], h["every"], h["duration"], h["seed"]
        case _:
            return (h["coefficient"],)


def waves(h: Hidden, joint: Joint) -> float:
    """Angular wave number (1/rad or 1/m) of an effect that is periodic in the joint position.

    ``h``: hidden effect with the parameter ``per_turn``.
    """
    if joint.type == "revolute":
        return h.value_or("per_turn", 1.0)
    low, high = joint.limits.position
    return 2.0 * math.pi * h.value_or("per_turn", 2.0 / (high - low))
