"""Additional torque terms of an arm model, beside its rigid dynamics and friction."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from armident.identify.robot.motion import Motion


class ModelTerm(Protocol):
    """A torque that is linear in ``k`` parameters; `armident.identify.effects.terms.Term` is one."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the linear parameters, (k,)."""

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the linear parameters, (k,)."""

    @property
    def values(self) -> NDArray[np.float64]:
        """Values of the linear parameters in the configuration, (k,)."""

    @property
    def depends_on_torque(self) -> bool:
        """True if the columns need torques that the model predicts."""

    @property
    def scales_torque(self) -> bool:
        """True if the term is a share of the torque that the model predicts."""

    def columns(self, motion: Motion) -> NDArray[np.float64]:
        """Return the torques of all joints per unit of the linear parameters, (N, n, k)."""
