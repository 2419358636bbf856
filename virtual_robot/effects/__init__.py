"""What can be hidden in the virtual arm, from a scenario file to the torques of the plant and the drives' signals."""

from armident.virtual_robot.effects.catalogue import CATALOGUE, EFFECTS, OUTSIDE, STALE, describe_effects
from armident.virtual_robot.effects.hidden import Hidden, hidden_effects

__all__ = ["CATALOGUE", "EFFECTS", "OUTSIDE", "STALE", "Hidden", "describe_effects", "hidden_effects"]
