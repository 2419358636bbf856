"""The effects that a robot configuration names, as terms of its model."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from configs import ConfigError, RobotConfig
from configs.robot import Effect as Stanza
from identify.catalogue.effect import Effect, Place
from identify.catalogue.motion import Motion
from identify.catalogue.registry import known

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Term:
    """One stanza of a robot's ``effects``.

    Parameters
    ----------
    effect, place, shapes
        The entry of the catalogue, where it sits, and its nonlinear parameters.
    names, units
        Of its linear parameters, as they stand in results.
    values
        Of its linear parameters in the configuration, zero where it gives none, (k,).
    """

    effect: Effect
    place: Place
    shapes: dict[str, float]
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array

    def columns(self, motion: Motion) -> Array:
        """Torques of all joints per unit of the linear parameters, (N, n, k)."""
        return self.effect.torque(motion, self.place, self.shapes)


def terms_of(robot: RobotConfig) -> tuple[Term, ...]:
    """Terms of a robot's effects, in their order; exchanges of signals are none.

    Raises
    ------
    ConfigError
        If an effect is unknown, lacks a parameter or has one too many, or stands at a joint where it cannot be.
    """
    terms: list[Term] = []
    taken: dict[str, int] = {}
    for k, stanza in enumerate(robot.effects):
        effect = known(stanza.effect)
        if effect.rewires:
            continue
        where = f"effects[{k}]: {stanza.effect} of {stanza.joint}"
        place = place_of(stanza, effect, robot, where)
        shapes = _shapes(stanza, effect, where)
        kind = int(robot.joints[place.joint].type == "prismatic")
        number = f"{place.joint + 1}" if place.other is None else f"{place.joint + 1}{place.other + 1}"
        names = []
        for linear in effect.linear:
            name = f"{linear.name}{number}"
            taken[name] = taken.get(name, 0) + 1
            names.append(name if taken[name] == 1 else f"{name}_{taken[name]}")
        terms.append(
            Term(
                effect,
                place,
                shapes,
                tuple(names),
                tuple(linear.unit[kind] for linear in effect.linear),
                np.array([stanza.parameters.get(linear.name, 0.0) for linear in effect.linear]),
            )
        )
    return tuple(terms)


def place_of(stanza: Stanza, effect: Effect, robot: RobotConfig, where: str) -> Place:
    """Where a stanza puts its effect.

    Raises
    ------
    ConfigError
        If a pair lacks its second joint, or another effect has one.
    """
    names = [joint.name for joint in robot.joints]
    joint = names.index(stanza.joint)
    if effect.scope != "pair":
        if stanza.other is not None:
            raise ConfigError(f"{where}: other: only an effect between two joints has one")
        return Place(joint)
    if stanza.other is None or stanza.other == stanza.joint:
        raise ConfigError(f"{where}: other: expected the second joint")
    return Place(joint, names.index(stanza.other))


def stanza_of(effect: Effect, place: Place, robot: RobotConfig, parameters: dict[str, float]) -> Stanza:
    """The stanza of an effect at a place."""
    other = None if place.other is None else robot.joints[place.other].name
    return Stanza(effect=effect.name, joint=robot.joints[place.joint].name, other=other, parameters=parameters)


def _shapes(stanza: Stanza, effect: Effect, where: str) -> dict[str, float]:
    shapes = [shape.name for shape in effect.shapes]
    linear = [parameter.name for parameter in effect.linear]
    given = {shape.name: shape.default for shape in effect.shapes if shape.default is not None} | stanza.parameters
    missing = [name for name in shapes if name not in given]
    if missing:
        raise ConfigError(f"{where} needs {', '.join(missing)}")
    unknown = [name for name in stanza.parameters if name not in (*shapes, *linear)]
    if unknown:
        raise ConfigError(f"{where}: parameters.{unknown[0]}: unknown (takes {', '.join((*shapes, *linear))})")
    return {name: given[name] for name in shapes}
