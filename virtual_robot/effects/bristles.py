"""LuGre bristles in place of Coulomb friction, one state per joint (Canudas de Wit et al. 1995)."""

import math
from collections.abc import Sequence

import numpy as np

from armident.arrays import Array
from armident.compiled import PLAIN, compiled
from armident.configs import ConfigError, RobotConfig
from armident.virtual_robot.effects.spec import AUTO, EffectSpec, Hidden, ParameterSpec, positive

COLUMNS = 7
"""Columns of a bristle: joint, Coulomb friction, extra at rest, Stribeck velocity, exponent, stiffness, damping."""

EFFECTS: dict[str, EffectSpec] = {
    "stribeck_friction": EffectSpec(
        "bristle",
        "LuGre bristle in place of Coulomb friction, with more friction at low speed",
        {
            "extra": positive("N m", "break-away friction above Coulomb friction"),
            "velocity": positive("rad/s", "Stribeck velocity; 2 % of the joint's limit unless given", AUTO),
            "exponent": positive("-", "exponent of the decrease", 2.0, 4.0),
            "deflection": positive(
                "rad", "bristle deflection when sliding; 4 us times the velocity limit unless given", AUTO
            ),
            "damping": ParameterSpec("-", "damping of the stuck joint, of critical", 0.02, 0.0, 1.0),
        },
    ),
    "presliding_friction": EffectSpec(
        "bristle",
        "Dahl bristle in place of Coulomb friction: elastic before it slides",
        {
            "deflection": positive("rad", "bristle deflection when sliding"),
            "damping": ParameterSpec("-", "damping of the stuck joint, of critical", 0.0, 0.0, 1.0),
        },
    ),
}
"""Effects of this module."""


@compiled("f8[::1], f8", **PLAIN)
def sliding_level(row, qd):  # type: ignore[no-untyped-def]
    """Friction (N m) of a row of `bristle_table` when sliding at a velocity, and its slope over ``abs(qd)``."""
    speed = abs(qd)
    ratio = (speed / row[3]) ** row[4]
    bump = row[2] * math.exp(-ratio)
    return row[1] + bump, -bump * row[4] * ratio / max(speed, 1e-12)


@compiled(**PLAIN)
def bristle_rate(row, z, qd):  # type: ignore[no-untyped-def]
    """Rate of a bristle's deflection, ``qd - abs(qd) z stiffness / g(qd)``, and its slopes over ``z`` and ``qd``."""
    level, fall = sliding_level(row, qd)
    pull = row[5] / level
    side = math.copysign(1.0, qd)
    return qd - abs(qd) * z * pull, -abs(qd) * pull, 1.0 - side * z * pull * (1.0 - abs(qd) * fall / level)


def bristle_table(hidden: Sequence[Hidden], robot: RobotConfig, friction: Array, inertia: Array) -> Array:
    """Rows (B, COLUMNS) of the bristles; Stribeck and presliding friction of one joint share a bristle.

    ``friction`` (n, 3 or more): fv, fc, offset of the healthy arm. ``inertia`` (n,): at the start, for critical
    damping. Raises ConfigError for a joint without Coulomb friction.
    """
    rows: list[Array] = []
    mine = [h for h in hidden if h.target == "bristle"]
    for j in sorted({h.joint for h in mine}):
        speed, coulomb = robot.joints[j].limits.velocity, float(friction[j, 1])
        extra, velocity, exponent, deflection, damping = 0.0, 0.02 * speed, 2.0, 4e-6 * speed, 0.0
        # Sorted by name: the deflection of presliding comes first and is replaced by one given for Stribeck friction.
        for h in sorted((h for h in mine if h.joint == j), key=lambda h: h.effect):
            if coulomb <= 0.0:
                raise ConfigError(f"{h.where}: {robot.joints[j].name} has no Coulomb friction to make a bristle of")
            deflection, damping = h.value_or("deflection", deflection), max(damping, h["damping"])
            if h.effect == "stribeck_friction":
                extra, velocity, exponent = h["extra"], h.value_or("velocity", velocity), h["exponent"]
        stiffness = coulomb / deflection
        critical = 2.0 * math.sqrt(stiffness * inertia[j])
        rows.append(np.array([j, coulomb, extra, velocity, exponent, stiffness, damping * critical]))
    return np.array(rows).reshape(-1, COLUMNS)
