"""Scenarios for the tests of what can be hidden in the virtual arms."""

from armident.configs.schema.scenario import HiddenEffect, Scenario


def hide(effect: str, joint: str, other: str | None = None, **parameters: float) -> Scenario:
    """A scenario of one effect."""
    hidden = HiddenEffect(effect=effect, joint=joint, other=other, parameters=parameters)
    return Scenario(schema="armident/scenario/1", effects=(hidden,))
