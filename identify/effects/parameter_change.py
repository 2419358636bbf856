"""Changes of parameters that every model has: visible against a baseline only."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from armident.arrays import Array
from armident.identify.effects.effect import TORQUE, VISCOUS, Effect, Linear, Place, Shapes
from armident.identify.robot.motion import Motion

if TYPE_CHECKING:
    from armident.identify.robot.arm import ArmModel


class ParameterChange(Effect):
    """Effect that only changes parameters of the same model."""

    @abstractmethod
    def parameters(self, place: Place, n: int) -> list[str]:
        """Return the names of the standard parameters that the linear ones change, (k,)."""

    def sizes(self, place: Place, standard: Mapping[str, float]) -> Array:
        """Return the typical ratios (k,) of the linear parameters; ``standard``: parameters of the model by name."""
        return np.ones(len(self.linear))

    def consistent(self, values: Array, covariance: Array) -> bool:
        """Return True if the change (k,), with covariance (k, k), is physically possible."""
        return True

    def change(self, model: "ArmModel", place: Place) -> Array:
        """Return the Jacobian (b, k) of the base parameters with respect to the linear ones."""
        chosen = [model.names.index(name) for name in self.parameters(place, model.n)]
        change: Array = model.base.regroup[:, chosen]
        return change

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the columns of the rigid model's parameters."""
        regressor = motion.model.rigid_regressor(motion.q, motion.qd, motion.qdd, sharp_sign=motion.sharp)
        # The terms of the model, last among its base parameters, do not change.
        columns: Array = regressor @ self.change(motion.model, place)[: regressor.shape[2]]
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

    def sizes(self, place: Place, standard: Mapping[str, float]) -> Array:
        """Return the friction that the joint has."""
        return np.array([max(abs(standard[name]), 1e-3) for name in self.parameters(place, 0)])
