"""Changes of parameters that every model has: visible against a baseline only."""

import numpy as np
from numpy.typing import NDArray

from armident.identify.effects.effect import Effect, Linear, Place
from armident.identify.effects.friction import TORQUE, VISCOUS
from armident.identify.effects.link import by_numbers
from armident.identify.robot.motion import Motion

Array = NDArray[np.float64]


def _friction(motion: Motion, place: Place) -> Array:
    names, number = motion.model.names, place.joint + 1
    change: Array = motion.model.base.regroup[:, [names.index(f"fv{number}"), names.index(f"fc{number}")]]
    return change


EFFECTS = (
    Effect(
        name="friction_change",
        title="a change of friction",
        says="viscous or Coulomb friction of a joint differs from the baseline: cold or aged grease, a worn gear",
        reference="Bittencourt, Gunnarsson 2012, J. Dyn. Sys. Meas. Control 134(5)",
        linear=(Linear("fvx", VISCOUS), Linear("fcx", TORQUE)),
        columns=lambda motion, place: by_numbers(motion, _friction(motion, place)),
        numbers=_friction,
        needs="a baseline identified before the change",
    ),
)
