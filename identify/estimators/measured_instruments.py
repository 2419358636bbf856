"""Instruments without a simulation: an arm that follows the smoothed motion exactly."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from armident.arrays import Array
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.simulation import Simulation
from armident.identify.signals.bandpass import central_difference
from armident.identify.signals.decimate import Decimation
from armident.identify.signals.streamed import kept


@dataclass
class MotionInstruments(AuxiliaryModel):
    """Instruments at the smoothed motion: the limit of an infinitely stiff controller, whatever the parameters.

    For recordings whose arm cannot be simulated: there is no reference, and the estimated inertias are so far from
    physical that no controller can be chosen by them. Torque sensors behind the gears give such estimates where a wrist
    weighs less than its friction. Instruments from measured positions are independent of the noise of the torques.
    Where the references are smoothed by another filter than the regressor, they are also independent of most of the
    noise of the positions.
    """

    @classmethod
    def of(cls, model: ArmModel, motion: Sequence[Array], dt: float, decimation: Decimation) -> Self:
        """Instruments from smoothed joint positions, one (N, n) array per experiment, rad or m."""
        # Neither controller nor initial state has a part in it.
        controller = DiscreteController.fir(np.zeros((model.n, 1)), dt)
        at_rest = [(q[0].copy(), np.zeros(model.n)) for q in motion]
        return cls(model, controller, motion, at_rest, dt, decimation, np.full(model.n, np.inf), feedback=False)

    def simulate(self, theta: Array, disturbances: Sequence[Array] | None = None) -> Sequence[Simulation] | None:
        """The motion, which is given, with the torques that theta (b,) needs; ``disturbances`` have no effect."""
        if not np.isfinite(theta).all():
            return None

        def run(k: int, q: Array) -> Simulation:
            qd = central_difference(q, self.dt)
            qdd = central_difference(qd, self.dt)
            tau = self.model.inverse_dynamics(theta, q, qd, qdd)
            if self.model.terms:
                motion = self.model.motion(q, qd, qdd, self.dt, self._start(k))
                tau = tau + self.model.term_regressor(motion) @ theta[theta.size - self.model.e :]
            return Simulation(q, qd, qdd, tau, None)

        return kept((run(k, q) for k, q in enumerate(self.references)), like=self.references)
