"""DIDIM: direct and inverse dynamic identification models, torques alone (thesis section 2.3.4)."""

from collections.abc import Sequence

import numpy as np

from armident.arrays import Array
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.problem import Estimator, Solved
from armident.identify.regression.equations import (
    Estimate,
    ExperimentEquations,
    joint_variances,
    residual_norm,
    stacked_parts,
    whitened_residuals,
)
from armident.identify.regression.iterations import Iterations, iterate
from armident.identify.regression.least_squares import Triangle


def didim(blocks: Sequence[ExperimentEquations], auxiliary: AuxiliaryModel, start: Array) -> Estimate:
    """Iterate least squares of the measured torque on the simulated regressor (2.36).

    Parameters
    ----------
    blocks
        Filtered and decimated equations; of them only the torques are used, and which equations to keep.
    auxiliary
        The simulated closed loop with the true controller; its regressor passes the same filter.
    start
        First theta of the auxiliary model, shape (b,).

    Notes
    -----
    2.36 solves ``Z' W (y - tau_s) = 0``, so the estimate scatters by ``(Z' W Psi)^-1 Z' W Z (Psi' W Z)^-1`` with the
    Jacobian ``Psi`` of ``tau_s``. 2.37 takes Z for ``Psi`` (4.22) and is too small where the loop follows its
    reference loosely.

    Raises
    ------
    DataError
        If no auxiliary model runs, not even the first.
    """
    auxiliary = auxiliary.fresh()
    (theta, done, converged, reason), simulated = solve_didim(blocks, auxiliary, start)
    noise = joint_variances(simulated, theta)
    covariance = Triangle.of(stacked_parts(simulated, noise)).inverse_gram  # 2.37
    residuals = whitened_residuals(simulated, theta, noise)
    return Estimate(theta, covariance, tuple(noise), residuals, done, converged, reason, auxiliary.warnings)


def solve_didim(
    blocks: Sequence[ExperimentEquations], auxiliary: AuxiliaryModel, start: Array
) -> tuple[Iterations, Sequence[ExperimentEquations]]:
    """Iterations of DIDIM (2.36), and the equations simulated at their last theta; DataError if no loop runs."""
    scale = noise = joint_variances(blocks, np.zeros_like(start))

    def step(previous: Array, _: int) -> tuple[Array, float]:
        nonlocal noise
        simulated = auxiliary.equations(blocks, previous)
        estimate = Triangle.of(stacked_parts(simulated, noise)).theta  # 2.36
        noise = joint_variances(simulated, estimate)
        return estimate, residual_norm(simulated, estimate, scale)

    end = iterate(step, start)
    return end, auxiliary.equations(blocks, end.theta)


ESTIMATOR = Estimator(
    "didim",
    lambda problem: Solved(didim(problem.blocks, problem.auxiliary, problem.start)),
    "Least error between measured and simulated torques, by a regression on the simulated motion.",
    "2.3.4 (2.36, 2.37)",
    white_covariance=True,
)
