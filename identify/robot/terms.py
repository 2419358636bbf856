"""Protocol of the torque terms that an arm model can have besides its rigid dynamics and friction."""

from typing import Protocol

from armident.arrays import Array
from armident.identify.robot.motion import Motion


class ModelTerm(Protocol):
    """Torque that is linear in ``k`` parameters; `armident.identify.effects.terms.Term` implements it."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the linear parameters, (k,)."""

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the linear parameters as text, (k,)."""

    @property
    def values(self) -> Array:
        """Values of the linear parameters in the configuration, (k,), each in its unit."""

    @property
    def depends_on_torque(self) -> bool:
        """True if the columns depend on torques that the model predicts."""

    @property
    def scales_torque(self) -> bool:
        """True if the term is a fraction of the torque that the model predicts."""

    def columns(self, motion: Motion) -> Array:
        """Return the torques (N m or N) of all n joints per unit of each linear parameter, (N, n, k)."""

    def add_torque(self, motion: Motion, values: Array, torque: Array) -> None:
        """Add the torque of the term, with its linear parameters (k,), to that of all joints (N, n) in place."""
