"""Hidden effects of the virtual arm, from the scenario file to the torques of the plant and the drives' signals."""

from armident.virtual_robot.effects.catalogue import CATALOGUE, EFFECTS, OUTSIDE, describe_effects
from armident.virtual_robot.effects.hidden import hidden_effects
from armident.virtual_robot.effects.spec import Hidden

__all__ = ["CATALOGUE", "EFFECTS", "OUTSIDE", "Hidden", "describe_effects", "hidden_effects"]
