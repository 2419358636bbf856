"""IDIM-IV: instrumental variables from the simulated closed loop (thesis section 2.3.3)."""

from collections.abc import Sequence

from armident.arrays import Array
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.problem import Estimator, Problem, Solved
from armident.identify.regression.equations import (
    COVARIANCE_PASSES,
    Estimate,
    ExperimentEquations,
    instrumented,
    joint_variances,
    noise_models,
    residual_norm,
    whitened_residuals,
)
from armident.identify.regression.iterations import iterate
from armident.identify.regression.iv import IvProducts, factored_parts, instrumented_parts, serial_covariance
from armident.identify.signals.streamed import mapped


def idim_iv(
    blocks: Sequence[ExperimentEquations], auxiliary: AuxiliaryModel, start: Array, *, serial_order: int = 0
) -> Estimate:
    """Iterate 2.33 with weights 2.24 to 2.26 on the instruments, the regressor and the torques alike.

    Parameters
    ----------
    blocks
        Filtered and decimated equations at measured signals.
    auxiliary
        The simulated closed loop; its instruments pass the same filter.
    start
        First theta of the auxiliary model, shape (b,).
    serial_order
        Highest order of an AR model of each joint's residuals, used for the covariance alone; 0: the residuals
        count as white (2.34).

    Raises
    ------
    DataError
        If no auxiliary model runs, not even the first.
    """
    auxiliary = auxiliary.fresh()
    scale = noise = joint_variances(blocks, start)

    def products(zeta: Sequence[Array]) -> IvProducts:
        return factored_parts(instrumented_parts(instrumented(blocks, zeta), noise), start.size)

    def step(previous: Array, _: int) -> tuple[Array, float]:
        nonlocal noise
        estimate = products(auxiliary.instruments(previous)).theta  # 2.33
        noise = joint_variances(blocks, estimate)
        return estimate, residual_norm(blocks, estimate, scale)

    theta, done, converged, reason = iterate(step, start)
    noise = joint_variances(blocks, theta)
    zeta = auxiliary.instruments(theta)
    covariance = products(zeta).covariance
    if serial_order:
        weights, keep = noise, [b.keep for b in blocks]
        x = mapped(lambda b: b.x, blocks)
        for _ in range(COVARIANCE_PASSES):
            noise = noise_models(blocks, theta, covariance, serial_order)
            covariance = serial_covariance(zeta, x, keep, weights, noise)
    residuals = whitened_residuals(blocks, theta, noise)
    return Estimate(theta, covariance, tuple(noise), residuals, done, converged, reason, auxiliary.warnings)


def _solve(problem: Problem) -> Solved:
    return Solved(idim_iv(problem.blocks, problem.auxiliary, problem.start, serial_order=problem.max_ar_order))


ESTIMATOR = Estimator(
    "idim-iv",
    _solve,
    "Instrumental variables: the regressor of a simulation serves as instrument, so that noise in the "
    "measured positions causes no bias.",
    "2.3.3 (2.33, 2.34), 4.34",
    measured=True,
    white_covariance=True,
)
