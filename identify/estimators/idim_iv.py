"""IDIM-IV: instrumental variables from the simulated closed loop (thesis section 2.3.3)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from identify.estimators.auxiliary import AuxiliaryModel
from identify.estimators.regression import (
    Block,
    Estimate,
    instrumental_variable,
    iterate,
    iv_covariance,
    joint_variances,
    noise_models,
    serial_covariance,
    weighted_rows,
    whitened_residuals,
)

ITERATIONS = 20
TOLERANCE = 1e-4
"""Relative change of theta and of the residual norm that ends the iterations; far below one standard deviation."""

COVARIANCE_PASSES = 3
"""Noise model and covariance need each other; the third pass changes standard deviations by less than 1 %."""


def idim_iv(
    blocks: Sequence[Block],
    auxiliary: AuxiliaryModel,
    start: NDArray[np.float64],
    iterations: int = ITERATIONS,
    *,
    serial_order: int = 0,
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
    iterations
        Most iterations.
    serial_order
        Highest order of an AR model of each joint's residuals, used for the covariance alone; 0: the residuals
        count as white (2.34).

    Raises
    ------
    DataError
        If no auxiliary model runs, not even the first.
    """
    keep = [b.keep for b in blocks]
    noise = joint_variances(blocks, start)
    theta = start

    def step(previous: NDArray[np.float64], _: int) -> tuple[NDArray[np.float64], float]:
        nonlocal noise
        zeta = auxiliary.instruments(previous)
        z = weighted_rows(zeta, keep, noise)
        x = weighted_rows([b.x for b in blocks], keep, noise)
        y = weighted_rows([b.y for b in blocks], keep, noise)
        estimate = instrumental_variable(z, x, y)  # 2.33
        norm = float(np.linalg.norm(y - x @ estimate))
        noise = joint_variances(blocks, estimate)
        return estimate, norm

    theta, done, converged, reason = iterate(step, start, iterations, TOLERANCE)
    zeta, x = auxiliary.instruments(theta), [b.x for b in blocks]
    covariance = iv_covariance(weighted_rows(zeta, keep, noise), weighted_rows(x, keep, noise))
    if serial_order:
        weights = noise
        for _ in range(COVARIANCE_PASSES):
            noise = noise_models(blocks, theta, covariance, serial_order)
            covariance = serial_covariance(zeta, x, keep, weights, noise)
    return Estimate(
        theta,
        covariance,
        tuple(noise),
        whitened_residuals(blocks, theta, noise),
        done,
        converged,
        reason,
        tuple(auxiliary.warnings),
    )
