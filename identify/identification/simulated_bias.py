"""Bias of an estimate by derivatives, encoder noise and sampling, found by identifying simulated recordings.

The covariance holds none of it, the closed loop with the last estimate all. The estimate on its recordings, less the
true values, is the bias (indirect inference: Gourieroux, Monfort, Renault, J. Applied Econometrics 8, 1993).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from armident.arrays import Array
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.identification.equations import Prepared, aligned_torque
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.equations import (
    Estimate,
    ExperimentEquations,
    filtered_regressor,
    instrumented,
    joint_variances,
    stacked_parts,
    whitened_residuals,
)
from armident.identify.regression.iv import iv_products
from armident.identify.regression.least_squares import Triangle
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.simulation import Simulation
from armident.identify.signals.bandpass import central_difference
from armident.identify.signals.bandwidth import position_noise
from armident.identify.signals.choices import DerivativesName
from armident.identify.signals.decimate import Decimation
from armident.identify.signals.differentiate import Derivatives, differentiate
from armident.identify.signals.experiments import Experiment
from armident.identify.signals.recursive import recursive_filter
from armident.identify.signals.streamed import kept, mapped

SIMULATION_ERROR = 0.15
"""Standard deviation of the part of the bias that the simulation misses, over the bias.

On one axis of 0.02 to 0.15 m/s at 1 kHz, encoder noise of 0 to 20 um, 0.88 to 1.13 of the bias was measured.
"""

DOMINANT = 1.0 / SIMULATION_ERROR
"""Bias in standard deviations above which intervals are doubtful although it was subtracted: what is left of it is
then as large as everything else."""

SIGNIFICANCE = 0.05
"""Probability that the scatter of simulated recordings counts as wider than the standard deviations by chance."""

FEW, MANY = 2, 12
"""Simulated recordings to see that the bias is irrelevant, and to measure a relevant one."""


@dataclass(frozen=True)
class SimulatedBias:
    """Mean bias (b,) of simulated recordings, and scatter (b,) by encoder noise, SI; ``share``: of the experiments."""

    bias: Array
    scatter: Array
    runs: int
    share: float = 1.0

    def largest(self, estimate: Estimate) -> tuple[int, float]:
        """Parameter with the largest bias, and the bias in its standard deviations."""
        share = np.abs(self.bias) / estimate.std
        k = int(np.argmax(share))
        return k, float(share[k])


def simulated_bias(
    prepared: Prepared,
    auxiliary: AuxiliaryModel,
    blocks: Sequence[ExperimentEquations],
    estimate: Estimate,
    weights: Sequence[ArModel],
    derivatives: DerivativesName,
    *,
    runs: int | None = None,
    share: float = 1.0,
) -> SimulatedBias | None:
    """Bias of an instrumental-variable estimate; ``None`` if its loop fails; ``share``: of experiments simulated."""
    auxiliary, theta = auxiliary.fresh(), estimate.theta
    clean = auxiliary.simulate(theta)
    if clean is None:
        return None
    starts = [e.start for e in prepared.experiments]
    motions = mapped(lambda run, at: Derivatives(run.q, run.qd, run.qdd, None, auxiliary.dt, at), clean, starts)
    instruments = auxiliary.regressors(motions, thinned=True)
    rng = np.random.default_rng(0)
    errors: list[Array] = []
    while len(errors) < (runs or MANY):
        recorded = _recorded(prepared, auxiliary, theta, rng, derivatives)
        if recorded is None:
            return None
        rows = mapped(lambda new, block: replace(new, keep=block.keep, t=block.t), recorded, blocks)
        try:
            found = iv_products(instrumented(rows, instruments), weights).theta
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(found).all():
            return None
        errors.append(found - theta)
        relevant = np.abs(np.mean(errors, axis=0)) > IdentificationCriteria.max_bias_std * estimate.std
        if runs is None and len(errors) == FEW and not relevant.any():
            break
    return SimulatedBias(np.mean(errors, axis=0), np.std(errors, axis=0, ddof=1), len(errors), share)


def corrected(estimate: Estimate, found: SimulatedBias, blocks: Sequence[ExperimentEquations]) -> Estimate:
    """Return the estimate without its bias; the covariance contains that of the bias and `SIMULATION_ERROR`.

    It is widened where encoder noise alone scatters a parameter by more than its standard deviation.
    """
    theta = estimate.theta - found.bias
    ratio = np.sqrt(found.share) * found.scatter / estimate.std
    least = np.sqrt(chdtri(found.runs - 1, SIGNIFICANCE) / (found.runs - 1))
    wider = np.where(ratio > least, ratio, 1.0)
    covariance = estimate.covariance * np.outer(wider, wider) + np.diag(
        found.scatter**2 / found.runs + (SIMULATION_ERROR * found.bias) ** 2
    )
    residuals = whitened_residuals(blocks, theta, estimate.noise)
    return replace(estimate, theta=theta, covariance=covariance, residuals=residuals)


def _recorded(
    prepared: Prepared,
    auxiliary: AuxiliaryModel,
    theta: Array,
    rng: np.random.Generator,
    derivatives: DerivativesName,
) -> Sequence[ExperimentEquations] | None:
    """Equations of one simulated recording per experiment; ``None`` if a simulation diverges."""
    experiments = prepared.experiments
    noise = kept((position_noise(e.q, e.dt) * rng.normal(size=e.q.shape) for e in experiments), like=experiments)
    pushes = None
    if auxiliary.feedback:
        ratios = auxiliary.model.robot.transmission_matrix
        pushes = mapped(lambda n: _torque_of_noise(auxiliary.controller, n @ ratios.T), noise)
    runs = auxiliary.simulate(theta, pushes)
    if runs is None:
        return None
    parts = zip(runs, noise, prepared.signals, experiments, strict=True)
    return kept((_equations(prepared, auxiliary, *part, derivatives) for part in parts), like=experiments)


def _equations(
    prepared: Prepared,
    auxiliary: AuxiliaryModel,
    run: Simulation,
    noise: Array,
    signals: Derivatives,
    experiment: Experiment,
    derivatives: DerivativesName,
) -> ExperimentEquations:
    """Equations of a simulated recording by the smoother of the real one."""
    nvr = None if signals.nvr is None else signals.nvr[:, 0]
    smooth: Callable[[Array], Derivatives] = auxiliary_smoother(auxiliary, derivatives, nvr)
    motion = replace(smooth(run.q + noise), start=experiment.start)
    y = auxiliary.decimation(aligned_torque(run.tau))
    x = filtered_regressor(prepared.model, motion, auxiliary.decimation)
    return ExperimentEquations(y, x, np.ones(y.shape, dtype=np.bool_), np.zeros(y.shape[0]))


def auxiliary_smoother(
    auxiliary: AuxiliaryModel, derivatives: DerivativesName, nvr: Array | None
) -> Callable[[Array], Derivatives]:
    """Smoother of measured positions, for simulated ones; ``nvr``: noise-variance ratios (n,), ``None``: bandpass."""
    if nvr is None:
        measured = auxiliary.measured
        assert measured is not None
        return lambda q: measured(q, 0)
    return lambda q: differentiate(q, auxiliary.dt, derivatives, nvr)


def _torque_of_noise(controller: DiscreteController, noise: Array) -> Array:
    """Motor torques (N, n), N m or N, that the controller makes of the noise (N, n) of the motor positions."""
    torque = np.empty_like(noise)
    length = max(controller.error_taps.shape[1], controller.position_taps.shape[1])
    for i in range(noise.shape[1]):
        taps = np.zeros(length)
        taps[: controller.error_taps.shape[1]] -= controller.error_taps[i]
        taps[: controller.position_taps.shape[1]] += controller.position_taps[i]
        torque[:, i] = recursive_filter(taps, np.append(1.0, -controller.output_taps[i]), noise[:, i])
    return torque


def least_squares_bias(
    prepared: Prepared,
    decimation: Decimation,
    blocks: Sequence[ExperimentEquations],
    estimate: Estimate,
    smooth: Callable[[Array, int], Derivatives],
) -> SimulatedBias:
    """Return the bias of IDIM-LS, which knows no closed loop: the smoothed motion counts as the true one.

    Encoder noise is added open-loop. ``smooth(positions, k)``: derivatives of positions (N, n) of experiment k.
    """
    model, theta = prepared.model, estimate.theta
    weights = joint_variances(blocks, theta)
    truths = []
    for e, s in zip(prepared.experiments, prepared.signals, strict=True):
        qd = central_difference(s.q, e.dt)
        motion = Derivatives(s.q, qd, central_difference(qd, e.dt), None, e.dt, e.start)
        truths.append(filtered_regressor(model, motion, decimation) @ theta)
    rng, errors = np.random.default_rng(0), list[Array]()
    for _ in range(FEW):

        def of(k: int, e: Experiment, s: Derivatives) -> ExperimentEquations:
            noise = position_noise(e.q, e.dt) * rng.normal(size=e.q.shape)
            x = filtered_regressor(model, replace(smooth(s.q + noise, k), start=e.start), decimation)
            return replace(blocks[k], y=truths[k], x=x)

        pairs = enumerate(zip(prepared.experiments, prepared.signals, strict=True))
        rows = (of(k, *pair) for k, pair in pairs)
        errors.append(Triangle.of(stacked_parts(rows, weights)).theta - theta)
    return SimulatedBias(np.mean(errors, axis=0), np.std(errors, axis=0, ddof=1), FEW)
