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

    ``unit``: prismatic joints have N for N m, m for rad. ``default``: ``None`` if required, ``AUTO`` if derived from
    the robot. ``above``: ``low`` is excluded. ``only``: type of joint.
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

    ``first_joint``: it concerns the base. ``group``: ``armident diagnose`` must name a member of the catalogue and
    report one outside as unexplained; after a new identification a change of parameters leaves no error. ``row``:
    parameters of a force for `effect_torque`.
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
    """Validated hidden effect of a joint, and of another one if ``other`` is not -1; ``AUTO`` (NaN): from the robot."""

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
        """Return the value of a parameter; if it is ``AUTO``, ``otherwise``."""
        value = self.values[name]
        return otherwise if math.isnan(value) else value
