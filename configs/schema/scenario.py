"""Schema of a scenario: effects that are hidden in a virtual arm, and oddities of its drives."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from armident.configs.schema.base import FrozenModel
from armident.configs.schema.robot import Controller, JointName, Name, Positive


class HiddenEffect(FrozenModel):
    """One effect at one joint; the virtual arm defines and checks its parameters.

    Parameters
    ----------
    effect
        Name of the effect (``armident robot --list-effects``).
    joint, other
        Joint of the effect; second joint of an effect between two joints.
    parameters
        Values by name, joint side, SI.
    """

    effect: Name
    joint: JointName
    other: JointName | None = None
    parameters: dict[Name, float] = Field(default_factory=dict)


class OddDrive(FrozenModel):
    """Drive that deviates from an ordinary one within CiA 301 and CiA 402; the virtual arm defines and checks how.

    Parameters
    ----------
    oddities
        Names of the deviations (``armident robot --list-oddities``).
    """

    oddities: Annotated[tuple[Name, ...], Field(min_length=1)]


class JointFriction(FrozenModel):
    """Friction of a joint of the virtual arm, joint side; what is left out stays as it is.

    Parameters
    ----------
    viscous, coulomb
        Coefficients, N m s/rad and N m, or N s/m and N.
    offset
        Constant torque against the joint, N m or N.
    """

    viscous: Annotated[float, Field(ge=0)] | None = None
    coulomb: Annotated[float, Field(ge=0)] | None = None
    offset: float | None = None


class JointNoise(FrozenModel):
    """Noise of the torque signal of a joint, joint side, N m or N.

    Parameters
    ----------
    std
        Standard deviation of the samples.
    std_below_20_hz
        That of the part below 20 Hz, which is a disturbance of the motion; 0: the noise is white.
    """

    std: Annotated[float, Field(ge=0)]
    std_below_20_hz: Annotated[float, Field(ge=0)] = 0.0

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.std_below_20_hz > self.std:
            raise ValueError("std_below_20_hz: a part of the noise cannot exceed the whole, std")
        return self


class ScenarioController(FrozenModel):
    """Gains of the virtual drives: by the bandwidth of their position loops, or given.

    Parameters
    ----------
    bandwidth_hz
        Closed-loop bandwidth, Hz: one for all joints, or one per joint.
    gains
        Gains as of a known controller, which feeds back the velocity; in place of ``bandwidth_hz``.
    """

    bandwidth_hz: Positive | tuple[Positive, ...] | None = None
    gains: Controller | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.bandwidth_hz is None) == (self.gains is None):
            raise ValueError("expected either bandwidth_hz or gains")
        return self


class Scenario(FrozenModel):
    """One virtual arm: effects hidden in it, oddities of its drives, and its controller, friction and noise.

    Parameters
    ----------
    schema_
        Key ``schema``: version of the file format.
    description
        Free text.
    effects
        The hidden effects, which are unknown to identification and diagnosis.
    drives
        Odd drives, by joint.
    controller
        Gains of the drives; ``None``: tuned for the arm.
    friction, noise
        Friction and noise by joint, in place of the arm's own.
    """

    schema_: Literal["armident/scenario/1"] = Field(alias="schema")
    description: str = ""
    effects: tuple[HiddenEffect, ...] = ()
    drives: dict[JointName, OddDrive] = Field(default_factory=dict)
    controller: ScenarioController | None = None
    friction: dict[JointName, JointFriction] = Field(default_factory=dict)
    noise: dict[JointName, JointNoise] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _not_empty(self) -> Self:
        if not (self.effects or self.drives or self.controller or self.friction or self.noise):
            raise ValueError("expected at least one of effects, drives, controller, friction and noise")
        return self
