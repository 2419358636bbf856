"""Errors of the simulated closed loop, with the model as configured and with the findings."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from armident.arrays import Array
from armident.identify.diagnosis.model_state import ModelState
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.identification.equations import aligned_torque


@dataclass(frozen=True)
class SimulatedErrors:
    """Errors of simulated signals, percent of the measured held-out ones, (n,); NaN where a loop diverges."""

    joints: tuple[str, ...]
    velocity_before: Array
    velocity_after: Array
    torque_before: Array
    torque_after: Array

    def document(self) -> dict[str, Any] | None:
        """Return the entry ``simulated`` of ``diagnosis.json``."""
        names = ("velocity_before", "velocity_after", "torque_before", "torque_after")
        finite = {name: getattr(self, name) for name in names if np.isfinite(getattr(self, name)).all()}
        return {
            name: dict(zip(self.joints, map(float, values), strict=True)) for name, values in finite.items()
        } or None


def simulated_errors(first: ModelState, final: ModelState) -> SimulatedErrors:
    """Errors of the closed loops of the models as configured and with the findings, simulated along the references."""
    before, after = _errors(first), _errors(final)
    if before is None or after is None:
        unknown = np.full(first.study.robot.n, np.nan)
        before = after = unknown, unknown
    return SimulatedErrors(tuple(first.study.joints), before[0], after[0], before[1], after[1])


def _errors(state: ModelState) -> tuple[Array, Array] | None:
    study = state.study
    auxiliary: AuxiliaryModel = replace(
        study.auxiliary.fresh(), model=study.model.anchored(state.fit.theta), anchor=None
    )
    runs = auxiliary.simulate(state.fit.theta)
    if runs is None:
        return None
    totals = np.zeros((4, study.robot.n))
    for stretch in study.held:
        run = runs[stretch.experiment]
        qd = run.qd[stretch.rows]
        y = study.decimation(study.thinning(aligned_torque(run.tau))[stretch.span])
        totals[0] += np.sum((qd - stretch.measured.qd) ** 2, axis=0)
        totals[1] += np.sum(stretch.measured.qd**2, axis=0)
        totals[2] += np.sum((y - stretch.y) ** 2, axis=0)
        totals[3] += np.sum(stretch.y**2, axis=0)
    if not np.isfinite(totals).all():
        return None
    velocity, torque = (100 * np.sqrt(totals[k] / np.maximum(totals[k + 1], 1e-300)) for k in (0, 2))
    return velocity, torque
