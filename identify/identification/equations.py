"""Filtered equations of experiments: alignment of the torque, parallel filter, decimation (thesis 2.3.1)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from armident.arrays import Array
from armident.configs.schema.robot import Preprocessing
from armident.identify.regression.equations import ExperimentEquations, filtered_regressor
from armident.identify.robot.arm import ArmModel
from armident.identify.signals.bandpass import butterworth, central_difference
from armident.identify.signals.decimate import Decimation, design
from armident.identify.signals.differentiate import Derivatives
from armident.identify.signals.experiments import Experiment
from armident.identify.signals.published_filters import chebyshev_decimate, kept_samples
from armident.identify.signals.streamed import Streamed, chosen, kept

LS_CUTOFF = 2.0
"""Cut-off of the least-squares decimation in closed-loop bandwidths (thesis 2.3.1: ``w_Fp >= 2 w_dyn``)."""

PIV_CUTOFF = 5.0
"""Cut-off of the rough decimation before IDIM-PIV, in closed-loop bandwidths (thesis section 7.2)."""

TESTED_ROWS = 30_000
"""Number of decimated instants of a long recording that the tests of an estimate use."""

EQUATIONS_PER_PARAMETER = 10.0
"""Least number of equations per base parameter, of all joints and experiments: the rest determines the noise."""


def least_rows(model: ArmModel) -> int:
    """Least number of decimated instants of all experiments: ``EQUATIONS_PER_PARAMETER b / n``, rounded up."""
    return math.ceil(EQUATIONS_PER_PARAMETER * model.base.b / model.n)


def decimated_rows(decimation: Decimation, samples: Sequence[int]) -> int:
    """Number of instants that a decimation leaves, of all experiments together."""
    return sum(decimation.count(count) for count in samples)


def sufficient(decimation: Decimation, dt: float, samples: Sequence[int], rows: int) -> Decimation:
    """Return the decimation or, where it leaves fewer than ``rows`` instants, the strongest one that leaves enough."""
    if decimated_rows(decimation, samples) >= rows:
        return decimation
    low, high = 1, decimation.factor
    found = design(dt, 0.5 / dt, 1)
    while high - low > 1:
        factor = (low + high) // 2
        tried = design(dt, 0.5 / (dt * factor), factor)
        if decimated_rows(tried, samples) >= rows:
            low, found = factor, tried
        else:
            high = factor
    return found


def aligned_torque(tau: Array, late: float = 0.0) -> Array:
    """Mean of the torques (N, n) held before and after each position sample; ``late`` ones, samples, are interpolated.

    Sample k is held over ``[k, k + 1)``, so the torque as recorded belongs half a period after the position.
    """
    if late:
        k = np.arange(tau.shape[0], dtype=np.float64)
        return np.stack([np.interp(k + late - 0.5, k, column) for column in tau.T], axis=1)
    aligned = tau.copy()
    aligned[1:] = (tau[1:] + tau[:-1]) / 2
    return aligned


def equations(
    model: ArmModel, experiments: Sequence[Experiment], signals: Sequence[Derivatives], decimation: Decimation
) -> Sequence[ExperimentEquations]:
    """Filtered and decimated equations of every experiment, without rows slower than a ``velocity_threshold``."""
    threshold = model.robot.friction.velocity_threshold

    def of(experiment: Experiment, s: Derivatives) -> ExperimentEquations:
        instants = decimation.instants(s.q.shape[0])
        y = decimation(aligned_torque(experiment.tau, experiment.torque_shift))
        keep = np.ones(y.shape, dtype=np.bool_)
        if threshold is not None:
            keep = np.abs(s.qd[instants]) >= np.asarray(threshold)
        t = np.asarray(instants * experiment.dt, dtype=np.float64)
        return ExperimentEquations(y, filtered_regressor(model, s, decimation), keep, t)

    return kept((of(e, s) for e, s in zip(experiments, signals, strict=True)), like=experiments)


@dataclass(frozen=True, eq=False)
class Prepared:
    """Recordings of one rate with the derivatives of their positions, and equations computed once per decimation."""

    model: ArmModel
    experiments: Sequence[Experiment]
    signals: Sequence[Derivatives]
    _made: dict[Decimation, Sequence[ExperimentEquations]] = field(default_factory=dict, repr=False)

    def equations(self, decimation: Decimation) -> Sequence[ExperimentEquations]:
        """:func:`equations` after a decimation; repeated calls return the same arrays."""
        if decimation not in self._made:
            self._made[decimation] = equations(self.model, self.experiments, self.signals, decimation)
        return self._made[decimation]

    def part(self, numbers: Sequence[int]) -> "Prepared":
        """Some of the experiments. ``numbers``: their numbers, from 0."""
        return Prepared(self.model, chosen(self.experiments, numbers), chosen(self.signals, numbers))


def tested(blocks: Sequence[ExperimentEquations]) -> list[int]:
    """Experiments that tests of an estimate use: all, or evenly spaced stretches of a long recording (memory)."""
    if not isinstance(blocks, Streamed):
        return list(range(len(blocks)))
    rows = sum(block.y.shape[0] for block in blocks)
    count = min(max(1, round(TESTED_ROWS * len(blocks) / max(rows, 1))), len(blocks))
    return [int(k) for k in np.linspace(0, len(blocks) - 1, count).round()]


def published_equations(
    model: ArmModel, experiments: Sequence[Experiment], preprocessing: Preprocessing
) -> Sequence[ExperimentEquations]:
    """Equations by the filters of a published fit: sharp ``sign``, torque as recorded, all rows."""
    p = preprocessing

    def of(experiment: Experiment) -> ExperimentEquations:
        q = butterworth(experiment.q, experiment.dt, p.cutoff_hz, p.order, p.padlen)
        qd = central_difference(q, experiment.dt)
        qdd = central_difference(qd, experiment.dt)
        x = model.base_regressor(q, qd, qdd, sharp_sign=True, dt=experiment.dt, start=experiment.start)[p.drop :]
        filters = (p.decimation, p.decimation_order, p.decimation_ripple_db, p.decimation_padlen)
        y = chebyshev_decimate(experiment.tau[p.drop :], *filters)
        t = np.asarray((p.drop + kept_samples(x.shape[0], p.decimation)) * experiment.dt, dtype=np.float64)
        return ExperimentEquations(y, chebyshev_decimate(x, *filters), np.ones(y.shape, dtype=np.bool_), t)

    return kept((of(e) for e in experiments), like=experiments)
