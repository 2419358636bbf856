"""Schema of a scenario: effects that are hidden in a virtual arm and unknown to identification and diagnosis."""

from typing import Annotated, Literal

from pydantic import Field

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


class Scenario(FrozenModel):
    """Hidden effects of one virtual arm.

    Parameters
    ----------
    schema_
        Key ``schema``: version of the file format.
    description
        Free text.
    effects
        The hidden effects.
    """

    schema_: Literal["armident/scenario/1"] = Field(alias="schema")
    description: str = ""
    effects: Annotated[tuple[HiddenEffect, ...], Field(min_length=1)]
