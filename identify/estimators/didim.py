"""DIDIM: direct and inverse dynamic identification models, torques alone (thesis section 2.3.4)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from identify.estimators.auxiliary import AuxiliaryModel
from identify.estimators.regression import (
    ITERATIONS,
    Block,
    Estimate,
    Iterations,
    inverse_gram,
    iterate,
    joint_variances,
    least_squares,
    residual_norm,
    stacked,
    whitened_residuals,
)


def didim(
    blocks: Sequence[Block],
    auxiliary: AuxiliaryModel,
    start: NDArray[np.float64],
    iterations: int = ITERATIONS,
) -> Estimate:
    """Iterate least squares of the measured torque on the simulated regressor (2.36).

    Parameters
    ----------
    blocks
        Filtered and decimated equations; of them only the torques are used, and which equations to keep.
    auxiliary
        The simulated closed loop with the true controller; its regressor passes the same filter.
    start
        First theta of the auxiliary model, shape (b,).
    iterations
        Most iterations.

    Raises
    ------
    DataError
        If no auxiliary model runs, not even the first.
    """
    auxiliary = auxiliary.fresh()
    (theta, done, converged, reason), simulated = solve_didim(blocks, auxiliary, start, iterations)
    noise = joint_variances(simulated, theta)
    covariance = inverse_gram(stacked(simulated, noise)[0])  # 2.37
    residuals = whitened_residuals(simulated, theta, noise)
    return Estimate(theta, covariance, tuple(noise), residuals, done, converged, reason, auxiliary.said())


def solve_didim(
    blocks: Sequence[Block], auxiliary: AuxiliaryModel, start: NDArray[np.float64], iterations: int
) -> tuple[Iterations, list[Block]]:
    """The iterations of DIDIM, and the simulated equations at their end."""
    scale = noise = joint_variances(blocks, np.zeros_like(start))

    def step(previous: NDArray[np.float64], _: int) -> tuple[NDArray[np.float64], float]:
        nonlocal noise
        simulated = auxiliary.equations(blocks, previous)
        estimate = least_squares(*stacked(simulated, noise))  # 2.36
        noise = joint_variances(simulated, estimate)
        return estimate, residual_norm(simulated, estimate, scale)

    end = iterate(step, start, iterations)
    return end, auxiliary.equations(blocks, end.theta)
