"""From experiments to filtered equations: derivatives, alignment of the torque, parallel filter, decimation."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from configs.robot import Preprocessing
from identify.estimators.regression import Block, filtered_regressor
from identify.experiment import Experiment
from identify.model.arm import ArmModel
from identify.signals.bandpass import butterworth, central_difference
from identify.signals.classical import chebyshev_decimate, kept_samples
from identify.signals.decimate import Decimation
from identify.signals.differentiate import Derivatives

LS_CUTOFF = 2.0
"""Cut-off of the least-squares decimation in closed-loop bandwidths (thesis 2.3.1: ``w_Fp >= 2 w_dyn``)."""

PIV_CUTOFF = 5.0
"""Cut-off of the rough decimation before IDIM-PIV, in closed-loop bandwidths (thesis section 7.2)."""


def aligned_torque(tau: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of the torques held before and after each position sample, shape (N, n).

    Sample k is held over ``[k, k + 1)``, so the torque as recorded belongs half a period after the position.
    """
    aligned = tau.copy()
    aligned[1:] = (tau[1:] + tau[:-1]) / 2
    return aligned


def equations(
    model: ArmModel, experiments: Sequence[Experiment], signals: Sequence[Derivatives], decimation: Decimation
) -> list[Block]:
    """Filtered and decimated equations of every experiment.

    The sign of the velocity is the smoothed one of the robot's configuration, so all samples can stay, which a linear
    filter needs; where the configuration gives ``velocity_threshold``, slower rows are left out.
    """
    threshold = model.robot.friction.velocity_threshold
    blocks = []
    for experiment, s in zip(experiments, signals, strict=True):
        kept = decimation.instants(s.q.shape[0])
        y = decimation(aligned_torque(experiment.tau))
        keep = np.ones(y.shape, dtype=np.bool_)
        if threshold is not None:
            keep = np.abs(s.qd[kept]) >= np.asarray(threshold)
        t = np.asarray(kept * experiment.dt, dtype=np.float64)
        blocks.append(Block(y, filtered_regressor(model, s, decimation), keep, t))
    return blocks


def published_equations(
    model: ArmModel, experiments: Sequence[Experiment], preprocessing: Preprocessing
) -> list[Block]:
    """Equations by the filters of a published fit: sharp ``sign``, torque as recorded, all rows."""
    p = preprocessing
    blocks = []
    for experiment in experiments:
        q = butterworth(experiment.q, experiment.dt, p.cutoff_hz, p.order, p.padlen)
        qd = central_difference(q, experiment.dt)
        qdd = central_difference(qd, experiment.dt)
        x = model.base_regressor(q, qd, qdd, sharp_sign=True)[p.drop :]
        filters = (p.decimation, p.decimation_order, p.decimation_ripple_db, p.decimation_padlen)
        y = chebyshev_decimate(experiment.tau[p.drop :], *filters)
        t = np.asarray((p.drop + kept_samples(x.shape[0], p.decimation)) * experiment.dt, dtype=np.float64)
        blocks.append(Block(y, chebyshev_decimate(x, *filters), np.ones(y.shape, dtype=np.bool_), t))
    return blocks
