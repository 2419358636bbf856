"""The auxiliary model: the closed loop simulated with the last estimate, source of the instruments."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from configs import DataError
from identify.estimators.regression import filtered_regressor
from identify.model.arm import ArmModel
from identify.model.controller import DiscreteController
from identify.model.simulation import Simulation, simulate
from identify.signals.decimate import Decimation
from identify.signals.differentiate import Derivatives

HALVINGS = 8
"""Step halvings towards the last estimate that could be simulated."""


@dataclass
class AuxiliaryModel:
    """Simulates every experiment's reference through controller and arm, and filters the regressor.

    An estimate that cannot be simulated is moved half-way, and half-way again, towards the last one that could
    (``warnings`` says so); the estimate itself is left alone, only the instruments use the damped one.

    Parameters
    ----------
    references
        One (N, n) array of joint references per experiment, rad or m.
    initial
        Position and velocity (n,) each at the start of every experiment.
    max_velocity
        Joint speeds (n,) beyond which a simulation counts as diverged.
    """

    model: ArmModel
    controller: DiscreteController
    references: Sequence[NDArray[np.float64]]
    initial: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]]
    dt: float
    decimation: Decimation
    max_velocity: NDArray[np.float64]
    warnings: list[str] = field(default_factory=list)
    _last: NDArray[np.float64] | None = None

    def simulate(self, theta: NDArray[np.float64]) -> list[Simulation] | None:
        """All experiments with these base parameters, or ``None`` if one diverges or theta is not finite."""
        if not np.isfinite(theta).all():
            return None
        runs = []
        for q_ref, (q0, qd0) in zip(self.references, self.initial, strict=True):
            run = simulate(
                self.model, theta, self.controller, q_ref, self.dt, q0=q0, qd0=qd0, max_velocity=self.max_velocity
            )
            if run.diverged_at is not None:
                return None
            runs.append(run)
        return runs

    def instruments(self, theta: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Filtered regressor at simulated signals, one (M, n, b) per experiment.

        Raises
        ------
        DataError
            If neither theta nor any point between it and the last good estimate can be simulated.
        """
        target = theta
        for halving in range(HALVINGS + 1):
            runs = self.simulate(target)
            if runs is not None:
                if halving:
                    self.warnings.append(
                        f"an iterate was not physical: its simulation diverged; instruments from a point "
                        f"{100 * 0.5**halving:.1f} % of the way to it"
                    )
                self._last = target
                return [
                    filtered_regressor(self.model, Derivatives(r.q, r.qd, r.qdd, None), self.decimation) for r in runs
                ]
            if self._last is None:
                break
            target = self._last + (theta - self._last) * 0.5 ** (halving + 1)
        raise DataError("the auxiliary closed loop cannot be simulated: it diverges with the first estimate")
