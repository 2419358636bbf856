"""Scenarios: effects hidden in the virtual arm that no identification code is told of."""

from typing import Annotated, Literal

from pydantic import Field

from armident.configs.schema.base import FrozenModel
from armident.configs.schema.robot import Name


class HiddenEffect(FrozenModel):
    """One effect on one joint; which parameters it takes is the virtual arm's business.

    ``other`` is the second joint of an effect between two.
    """

    effect: Name
    joint: Name
    other: Name | None = None
    parameters: dict[Name, float] = Field(default_factory=dict)


class Scenario(FrozenModel):
    """What is wrong with the arm."""

    schema_: Literal["armident/scenario/1"] = Field(alias="schema")
    description: str = ""
    effects: Annotated[tuple[HiddenEffect, ...], Field(min_length=1)]
