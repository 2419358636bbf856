"""Schema of a scenario: effects that are hidden in a virtual arm, and oddities of its drives."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from armident.configs.schema.base import FrozenModel
from armident.configs.schema.robot import JointName, Name


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


class Scenario(FrozenModel):
    """Hidden effects of one virtual arm, and oddities of its drives.

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
    """

    schema_: Literal["armident/scenario/1"] = Field(alias="schema")
    description: str = ""
    effects: tuple[HiddenEffect, ...] = ()
    drives: dict[Name, OddDrive] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _not_empty(self) -> Self:
        if not self.effects and not self.drives:
            raise ValueError("effects: expected at least one effect, or drives with oddities")
        return self
