"""SEP-PEM: the dynamic model by DIDIM, then the noise of each joint, then the covariance (thesis section 6.2.1)."""

from collections.abc import Sequence

from armident.arrays import Array
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.didim import solve_didim
from armident.identify.estimators.problem import Estimator, Problem, Solved
from armident.identify.regression.equations import (
    COVARIANCE_PASSES,
    Estimate,
    ExperimentEquations,
    joint_variances,
    noise_models,
    stacked_parts,
    whitened_residuals,
)
from armident.identify.regression.least_squares import Triangle
from armident.identify.regression.orders import MAX_AR_ORDER


def sep_pem(
    blocks: Sequence[ExperimentEquations], auxiliary: AuxiliaryModel, start: Array, max_order: int = MAX_AR_ORDER
) -> Estimate:
    """DIDIM on equations with little or no decimation, whose residuals an AR model per joint whitens (6.26, 6.27).

    Parameters
    ----------
    blocks
        Equations at the recorded rate or roughly decimated; all rows, since a whitening filter needs a gapless record.
    auxiliary
        The simulated closed loop with the true controller, same filter.
    start
        First theta of the auxiliary model, shape (b,).
    max_order
        Highest AR order tried; the thesis finds 141 on average at 5 kHz.

    Notes
    -----
    The covariance 6.29 is that of an estimate which the noise models had weighted. DIDIM has not used them, so its own
    scatter may be somewhat larger.

    Raises
    ------
    DataError
        If no auxiliary model runs, not even the first.
    """
    auxiliary = auxiliary.fresh()
    (theta, done, converged, reason), simulated = solve_didim(blocks, auxiliary, start)  # step 1
    noise = joint_variances(simulated, theta)
    covariance = Triangle.of(stacked_parts(simulated, noise)).inverse_gram
    for _ in range(COVARIANCE_PASSES):
        noise = noise_models(simulated, theta, covariance, max_order)  # step 2, 6.27
        covariance = Triangle.of(stacked_parts(simulated, noise)).inverse_gram  # step 3, 6.29
    residuals = whitened_residuals(simulated, theta, noise)
    return Estimate(theta, covariance, tuple(noise), residuals, done, converged, reason, auxiliary.warnings)


def _solve(problem: Problem) -> Solved:
    return Solved(sep_pem(problem.blocks, problem.auxiliary, problem.start, max_order=problem.max_ar_order))


ESTIMATOR = Estimator(
    "sep-pem",
    _solve,
    "Least prediction error of the torque, with a noise model that is estimated separately.",
    "6.2.1 (6.26, 6.27, 6.29)",
    prefiltered=True,
)
