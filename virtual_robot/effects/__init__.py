"""Hidden effects of the virtual arm, from the scenario file to the torques of the plant and the drives' signals."""

from armident.virtual_robot.effects.catalogue import CATALOGUE, EFFECTS, OUTSIDE, PARAMETER_CHANGES, describe_effects
from armident.virtual_robot.effects.hidden import Hidden, hidden_effects

__all__ = ["CATALOGUE", "EFFECTS", "OUTSIDE", "PARAMETER_CHANGES", "Hidden", "describe_effects", "hidden_effects"]
