"""Changes of parameters that every model has: visible against a baseline only."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from armident.identify.effects.effect import TORQUE, VISCOUS, Effect, Linear, Place, Shapes
from armident.identify.robot.motion import Motion

Array = NDArray[np.float64]


class ParameterChange(Effect):
    """Effect that only changes parameters of the same model."""

    @abstractmethod
    def parameters(self, place: Place, n: int) -> list[str]:
        """Return the names of the standard parameters that the linear ones change, (k,)."""

    def change(self, motion: Motion, place: Place) -> Array:
        """Return the Jacobian (b, k) of the base parameters with respect to the linear ones."""
        model = motion.model
        chosen = [model.names.index(name) for name in self.parameters(place, motion.n)]
        change: Array = model.base.regroup[:, chosen]
        return change

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the columns of the rigid model's parameters."""
        regressor = motion.model.rigid_regressor(motion.q, motion.qd, motion.qdd, sharp_sign=motion.sharp)
        # The terms of the model, last among its base parameters, do not change.
        columns: Array = regressor @ self.change(motion, place)[: regressor.shape[2]]
        return columns

    def may_be_added(self, motion: Motion, place: Place, present: Sequence[Shapes]) -> bool:
        """Return False: every model has these parameters."""
        return False


class FrictionChange(ParameterChange):
    """Other viscous and Coulomb friction."""

    name = "friction_change"
    title = "a change of friction"
    description = "viscous or Coulomb friction of a joint differs from the baseline: cold or aged grease, a worn gear"
    reference = "Bittencourt, Gunnarsson 2012, J. Dyn. Sys. Meas. Control 134(5)"
    required_motion = "a baseline identified before the change"
    linear = (
        Linear("fvx", VISCOUS, "Change of the viscous friction since the baseline."),
        Linear("fcx", TORQUE, "Change of the Coulomb friction since the baseline."),
    )

    def parameters(self, place: Place, n: int) -> list[str]:
        """Return those of the joint."""
        return [f"fv{place.joint + 1}", f"fc{place.joint + 1}"]


EFFECTS = (FrictionChange,)
