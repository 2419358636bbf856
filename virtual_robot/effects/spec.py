"""Specification of an effect of the virtual arm, and one of a scenario."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from armident.configs import RobotConfig

AUTO = math.nan
"""Default of a parameter that is derived from the robot."""

Group = Literal["catalogue", "outside", "parameters"]
Row: TypeAlias = "Callable[[Hidden, RobotConfig, float, float], tuple[float, ...]]"
Target = Literal["force", "bristle", "gear", "body", "drive", "report"]
"""Target of an effect: torques, bristles, gears or bodies of the plant, the drives, or their reported signals."""


@dataclass(frozen=True)
class ParameterSpec:
    """Parameter of an effect, joint side.

    Parameters
    ----------
    unit
        Unit at a revolute joint; at a prismatic joint N for N m, and m for rad.
    meaning
        Description.
    default
        ``None``: required; ``AUTO``: derived from the robot as described in ``meaning``.
    low, high
        Range of values.
    above
        ``True`` if ``low`` itself is excluded.
    only
        Type of joint that has the parameter; ``None``: both.
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

    Parameters
    ----------
    target
        Target of the effect.
    meaning
        Description.
    parameters
        Parameters by name.
    other
        ``required``, ``optional`` or ``none``: second joint of the effect.
    first_joint
        ``True`` if the effect concerns the base and is given at the first joint.
    group
        ``catalogue``: ``armident diagnose`` can find it by name; ``outside``: it must report it as unexplained;
        ``parameters``: it changes parameters and not the structure, so that a new identification leaves no error.
    repeatable
        ``True`` if one joint may have it several times, such as harmonics.
    row
        Of a force: its parameters for `effect_torque` from the effect, the robot, and fv and fc of the joint.
    """

    target: Target
    meaning: str
    parameters: dict[str, ParameterSpec]
    other: Literal["none", "optional", "required"] = "none"
    first_joint: bool = False
    group: Group = "catalogue"
    repeatable: bool = False
    row: "Row | None" = None


def positive(unit: str, meaning: str, default: float | None = None, high: float = math.inf) -> ParameterSpec:
    """Return a parameter above zero."""
    return ParameterSpec(unit, meaning, default, 0.0, high, above=True)


def flag(meaning: str, default: float) -> ParameterSpec:
    """Return a parameter from 0 to 1."""
    return ParameterSpec("-", meaning, default, 0.0, 1.0)


PHASE = ParameterSpec("rad", "phase", 0.0)
PER_TURN = positive("-", "waves per turn; per metre at a prismatic joint, there two over its range unless given", AUTO)
PITCH = ParameterSpec("m", "travel of a prismatic joint per turn of its motor", 0.02, 0.0, above=True, only="prismatic")


@dataclass(frozen=True)
class Hidden:
    """Validated hidden effect.

    Parameters
    ----------
    effect
        Name of the effect.
    joint, other
        Numbers of its joints; ``other`` is -1 if there is none.
    values
        Parameters including defaults; ``AUTO`` (NaN): derived from the robot.
    where
        Name of the entry in messages.
    spec
        Its specification.
    """

    effect: str
    joint: int
    other: int
    values: dict[str, float]
    where: str
    spec: EffectSpec

    @property
    def target(self) -> Target:
        """Target of the effect."""
        return self.spec.target

    def __getitem__(self, name: str) -> float:
        return self.values[name]

    def value_or(self, name: str, otherwise: float) -> float:
        """Value of a parameter, or a default derived from the robot.

        Parameters
        ----------
        name
            Name of the parameter.
        otherwise
            Value if the parameter is ``AUTO``.
        """
        value = self.values[name]
        return otherwise if math.isnan(value) else value
