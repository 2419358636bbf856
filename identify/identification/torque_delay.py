"""Delay between torque and position, estimated with the inverse dynamic model (thesis 2.33).

A torque held from sample to sample is reported half a sample early; filters and buses delay it. If ``tau(k)`` belongs
to the instant ``k + delta``, ``tau = phi theta + delta d(phi theta)/dk + e`` to first order. In a closed loop a
disturbance moves the arm before the torque, so that least squares finds a delay in the noise itself. Instruments of
IDIM-IV, along the reference or a simulated motion, are independent of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.regression.ar_noise import WHITE, ArModel
from armident.identify.regression.equations import (
    ExperimentEquations,
    filtered_regressor,
    joint_variances,
    noise_models,
)
from armident.identify.regression.iv import factored, serial_covariance
from armident.identify.regression.whitening import whitened
from armident.identify.robot.arm import ArmModel
from armident.identify.signals.decimate import Decimation
from armident.identify.signals.differentiate import Derivatives, differentiate
from armident.identify.signals.experiments import Experiment

HELD = 0.5
"""Delay in samples of a drive that reports the torque it holds until the next sample."""

DELAY_AR_ORDER = 10
"""Highest order of the noise models, for the standard deviations. The equations have a rate of four closed-loop
bandwidths (`LS_CUTOFF`): ten coefficients reach over two and a half periods, and the residuals keep little beyond."""

REWEIGHTINGS = 2
"""Weighted fits after the first, unweighted one: the delay is linear in the last theta, which hardly changes."""

_CHUNK_SAMPLES = 32768


@dataclass(frozen=True)
class TorqueDelay:
    """Number of samples by which the recorded torques lead the positions, and its standard deviation, (n,) each.

    Torque k belongs to the instant ``k + samples``. Least squares, without instruments, is biased by disturbances.
    """

    samples: Array
    std: Array
    instrumented: bool

    def contradicts(self) -> NDArray[np.bool_]:
        """Mask (n,) of the joints whose delay differs from a held torque by more than three standard deviations."""
        contradiction: NDArray[np.bool_] = np.abs(self.samples - HELD) > 3.0 * self.std
        return contradiction


def torque_delay(
    model: ArmModel,
    experiments: Sequence[Experiment],
    signals: Sequence[Derivatives],
    decimation: Decimation,
    instruments: Sequence[Derivatives] | None = None,
    regressors: tuple[Sequence[Array], Sequence[Array]] = ((), ()),
) -> TorqueDelay:
    """Delay between torque and position of every joint, in fractions of samples, beside all base parameters.

    Instruments are by default the references, else the measured motion (least squares). Coupled motors give a mixture.
    ``regressors`` (M, n, b) are filtered; standard deviations allow for serial correlation.
    """
    references = [e.q_ref for e in experiments if e.q_ref is not None]
    instrumented = instruments is not None or len(references) == len(experiments)
    if instruments is None:
        instruments = [differentiate(q, experiments[0].dt) for q in references] if instrumented else signals
    n, b = model.n, len(model.base.names)
    joints = np.arange(n)

    def augmented(motions: Sequence[Derivatives], known: Sequence[Array]) -> list[Array]:
        found = known or [filtered_regressor(model, s, decimation) for s in motions]
        # An empty column for the delay of every joint.
        return [np.concatenate([value, np.zeros((*value.shape[:2], n))], axis=2) for value in found]

    x = augmented(signals, regressors[0])
    z = augmented(instruments, regressors[1]) if instrumented else x
    y = [decimation(e.tau) for e in experiments]
    keep = [np.ones(value.shape, dtype=np.bool_) for value in y]

    def solve(
        zeta: Sequence[Array], phi: Sequence[Array], noise: Sequence[ArModel]
    ) -> tuple[Array, list[ExperimentEquations]]:
        theta = factored(*(whitened(values, noise, keep) for values in (zeta, phi, y))).theta
        return theta, [
            ExperimentEquations(*parts, np.zeros(parts[0].shape[0])) for parts in zip(y, phi, keep, strict=True)
        ]

    without = [value[:, :, :b] for value in z], [value[:, :, :b] for value in x]
    theta, blocks = solve(*without, [WHITE] * n)
    theta, blocks = solve(*without, joint_variances(blocks, theta))
    noise: Sequence[ArModel] = joint_variances(blocks, theta)
    for _ in range(REWEIGHTINGS):
        for values, motions in ((x, signals), (z, instruments)) if instrumented else ((x, signals),):
            for value, motion in zip(values, motions, strict=True):
                value[:, joints, b + joints] = _rate(model, motion, theta[:b], decimation)
        theta, blocks = solve(z, x, noise)
        noise = joint_variances(blocks, theta)
    covariance = serial_covariance(z, x, keep, noise, noise)
    coloured = noise_models(blocks, theta, covariance, DELAY_AR_ORDER)
    covariance = serial_covariance(z, x, keep, noise, coloured)
    return TorqueDelay(theta[b:], np.sqrt(np.diag(covariance)[b:]), instrumented)


def _rate(model: ArmModel, s: Derivatives, theta: Array, decimation: Decimation) -> Array:
    """Filtered change per sample of the torque that the rigid model needs for a motion, (M, n), piece by piece."""
    samples, count = s.q.shape[0], decimation.count(s.q.shape[0])
    rows = max(1, _CHUNK_SAMPLES // decimation.factor)
    filtered = np.empty((count, model.n))
    for first in range(0, count, rows):
        last = min(first + rows, count)
        begin, end = first * decimation.factor, (last - 1) * decimation.factor + decimation.taps.size
        # One more sample at each end, where there is one: the change is taken between both neighbours.
        before, after = max(begin - 1, 0), min(end + 1, samples)
        torque = model.inverse_dynamics(theta, s.q[before:after], s.qd[before:after], s.qdd[before:after])
        filtered[first:last] = decimation(np.gradient(torque, axis=0)[begin - before : end - before])
    return filtered
