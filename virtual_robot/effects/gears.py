"""Elastic gears: motor and link are two masses with a spring, and optionally backlash, between them."""

import math
from collections.abc import Sequence

import numpy as np

from armident.arrays import Array
from armident.compiled import PLAIN, compiled
from armident.configs import ConfigError, RobotConfig
from armident.virtual_robot.effects.spec import AUTO, EffectSpec, Hidden, ParameterSpec, positive

COLUMNS = 6
"""Columns of a gear: coordinates of motor and link (-1: the base), stiffness, damping, gap, rounding of the gap."""
CONTACT_HZ = 100.0
"""Natural frequency of motor against link in contact, Hz, unless the scenario gives the stiffness."""
MOTOR_SHARE = 0.3
"""Motor's fraction of the inertia that moves with a joint, if the robot has no separate rotor inertia."""
ROUNDING = 0.004
"""Distance over which a contact closes on either side of its edge, relative to the gap."""

EFFECTS: dict[str, EffectSpec] = {
    "joint_elasticity": EffectSpec(
        "gear",
        "two masses: the motor, with encoder and friction, drives the link through a spring",
        {
            "stiffness": positive("N m/rad", "stiffness between motor and link"),
            "damping": ParameterSpec("-", "damping of motor against link, of critical", 0.05, 0.0, 2.0),
            "motor_inertia": positive(
                "kg m^2", "inertia of the motor, joint side; the robot's own, or 0.3 of the total if it has none", AUTO
            ),
        },
    ),
    "backlash": EffectSpec(
        "gear",
        "two masses: the motor drives the link through a gap",
        {
            "gap": positive("rad", "total play"),
            "stiffness": positive(
                "N m/rad", "stiffness of the contact; motor against link at 100 Hz unless given", AUTO
            ),
            "damping": ParameterSpec("-", "damping in contact, of critical", 0.1, 0.0, 2.0),
            "motor_inertia": positive("kg m^2", "as for joint_elasticity", AUTO),
        },
    ),
}
"""Effects of this module."""


@compiled(**PLAIN)
def _press(way, rounding):  # type: ignore[no-untyped-def]
    """Compression of a contact that has closed by ``way`` (negative: open), and its slope."""
    if way <= -rounding:
        return 0.0, 0.0
    if way >= rounding:
        return way, 1.0
    return (way + rounding) ** 2 / (4.0 * rounding), (way + rounding) / (2.0 * rounding)


@compiled("f8[::1], f8, f8", **PLAIN)
def gear_torque(row, twist, rate):  # type: ignore[no-untyped-def]
    """Torque between motor and link (N m) by a row of `gear_rows`, and its slopes over twist and rate of the motor."""
    if row[4] == 0.0:
        return row[2] * twist + row[3] * rate, row[2], row[3]
    one, share = _press(twist - 0.5 * row[4], row[5])
    two, other = _press(-twist - 0.5 * row[4], row[5])
    contact = share + other
    return row[2] * (one - two) + row[3] * contact * rate, row[2] * contact, row[3] * contact


def twist_under(row: Array, torque: float) -> float:
    """Twist (rad or m) of a gear at rest under a torque, N m or N."""
    end = torque / float(row[2]) + math.copysign(float(row[4]), torque)
    low, high = min(0.0, end), max(0.0, end)
    for _ in range(80):
        middle = 0.5 * (low + high)
        if float(gear_torque(row, middle, 0.0)[0]) < torque:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def gear_rows(
    hidden: Sequence[Hidden], robot: RobotConfig, rotor: Array, mass: Array, least: Array
) -> tuple[Array, Array]:
    """Rows (G, COLUMNS) of the elastic gears, and the inertia (G,) of the links that is assigned to each motor.

    The link of gear e has coordinate n + e. ``mass`` (n, n): of the links alone at the start; ``least`` (n,): least
    inertia if all other joints are free. Raises ConfigError if a motor has more inertia than motor and link.
    """
    rows, moved = [], []
    mine = [h for h in hidden if h.target == "gear"]
    for e, j in enumerate(sorted({h.joint for h in mine})):
        entries = {h.effect: h for h in mine if h.joint == j}
        first = next(iter(entries.values()))
        own, total = float(rotor[j, j]), float(rotor[j, j] + mass[j, j])
        motor = first.value_or("motor_inertia", own if own > 0.0 else MOTOR_SHARE * float(least[j]))
        if motor >= total:
            raise ConfigError(
                f"{first.where}.parameters.motor_inertia: expected less than the {total:.4g} of "
                f"{robot.joints[j].name} in all, found {motor:g}"
            )
        reduced = motor * (total - motor) / total
        elastic, gap = entries.get("joint_elasticity"), entries.get("backlash")
        if elastic is not None:
            stiffness = elastic["stiffness"]
        else:
            stiffness = first.value_or("stiffness", reduced * (2.0 * math.pi * CONTACT_HZ) ** 2)
        damping = first["damping"] * 2.0 * math.sqrt(stiffness * reduced)
        play = 0.0 if gap is None else gap["gap"]
        rows.append([j, robot.n + e, stiffness, damping, play, ROUNDING * play])
        moved.append(motor - own)
    return np.array(rows, np.float64).reshape(-1, COLUMNS), np.array(moved)
