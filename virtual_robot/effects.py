"""The hidden effects the virtual arm can have: one entry and one branch each, nothing elsewhere."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from configs import ConfigError, RobotConfig
from configs.scenario import HiddenEffect, Scenario

WIDTH = 4
"""Columns of the parameter table."""


@dataclass(frozen=True)
class Effect:
    """An effect's parameters, in the order of its branch, with defaults (``None``: must be given)."""

    parameters: dict[str, float | None]


EFFECTS: dict[str, Effect] = {
    "asymmetric_viscous_friction": Effect({"ratio": None}),
    "asymmetric_coulomb_friction": Effect({"ratio": None}),
    "stribeck_friction": Effect({"extra": None, "velocity": None, "exponent": 2.0}),
    "joint_spring": Effect({"stiffness": None, "rest": 0.0}),
    "cogging_torque": Effect({"amplitude": None, "harmonic": 1.0, "phase": 0.0}),
    "friction_scale": Effect({"factor": None}),
}


@njit(cache=True, error_model="numpy")
def effect_torque(  # type: ignore[no-untyped-def]
    code, p, fv, fc, q, qd, motor, smoothing
):
    """Torque resisting the motion (N m) and its slope over ``qd`` (N m s/rad).

    ``p`` are the parameters of entry ``code`` of ``EFFECTS``; ``fv``, ``fc`` the friction of the joint,
    ``q``, ``qd`` its position and velocity, ``motor`` the angle of its motor (rad).
    """
    side = 2.0 / math.pi * math.atan(smoothing * qd)
    side_slope = 2.0 / math.pi * smoothing / (1.0 + (smoothing * qd) ** 2)
    if code == 0:  # viscous friction fv (1 +- ratio)
        return p[0] * fv * abs(qd), p[0] * fv * math.copysign(1.0, qd)
    if code == 1:  # Coulomb friction fc (1 +- ratio)
        return p[0] * fc * abs(side), p[0] * fc * math.copysign(side_slope, qd)
    if code == 2:  # extra exp(-|qd/velocity|^exponent) sign(qd)
        ratio = abs(qd / p[1])
        bump = p[0] * math.exp(-(ratio ** p[2]))
        fall = bump * p[2] * ratio ** p[2] / max(abs(qd), 1e-12)
        return bump * side, bump * side_slope - fall * abs(side)
    if code == 3:  # stiffness (q - rest)
        return p[0] * (q - p[1]), 0.0
    if code == 4:  # amplitude sin(harmonic motor + phase)
        return p[0] * math.sin(p[1] * motor + p[2]), 0.0
    # friction times factor
    return (p[0] - 1.0) * (fv * qd + fc * side), (p[0] - 1.0) * (fv + fc * side_slope)


@dataclass(frozen=True)
class EffectTable:
    """Effects as the compiled loop reads them: code and joint (E,), parameters (E, WIDTH)."""

    code: NDArray[np.int64]
    joint: NDArray[np.int64]
    parameters: NDArray[np.float64]


def effect_table(scenario: Scenario | None, robot: RobotConfig, where: str = "scenario") -> EffectTable:
    """Check the effects of a scenario against the catalogue and the robot.

    Raises
    ------
    ConfigError
        Naming the entry and what was expected.
    """
    effects = () if scenario is None else scenario.effects
    table = EffectTable(
        np.zeros(len(effects), np.int64), np.zeros(len(effects), np.int64), np.zeros((len(effects), WIDTH))
    )
    names, joints = list(EFFECTS), [joint.name for joint in robot.joints]
    for k, hidden in enumerate(effects):
        at = f"{where}: effects[{k}]"
        if hidden.effect not in EFFECTS:
            raise ConfigError(
                f"{at}.effect: {hidden.effect!r} is not an effect of the virtual arm ({', '.join(names)})"
            )
        if hidden.joint not in joints:
            raise ConfigError(f"{at}.joint: {hidden.joint!r} is not a joint of {robot.name} ({', '.join(joints)})")
        table.code[k] = names.index(hidden.effect)
        table.joint[k] = joints.index(hidden.joint)
        values = _parameters(hidden, at)
        table.parameters[k, : len(values)] = values
    return table


def _parameters(hidden: HiddenEffect, at: str) -> list[float]:
    known = EFFECTS[hidden.effect].parameters
    for name in hidden.parameters:
        if name not in known:
            raise ConfigError(f"{at}.parameters.{name}: unknown ({hidden.effect} takes {', '.join(known)})")
    values = []
    for name, default in known.items():
        value = hidden.parameters.get(name, default)
        if value is None:
            raise ConfigError(f"{at}.parameters: {hidden.effect} needs {name}")
        if name == "velocity" and value <= 0:
            raise ConfigError(f"{at}.parameters.velocity: expected a number above 0, found {value}")
        values.append(value)
    return values
