"""Essential parameters: those that the data need (backward elimination with an F statistic)."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri

from armident.arrays import Array

CONFIDENCE = 0.99
"""A parameter is essential if leaving it out raises the weighted error beyond this quantile of F."""


def essential_parameters(
    theta: Array, covariance: Array, equations: int, confidence: float = CONFIDENCE
) -> NDArray[np.bool_]:
    """Mask (b,) of the essential parameters, by backward elimination with an F statistic (thesis B.2).

    The least significant parameter is dropped and the rest refitted until all that are left are significant, at the
    quantile ``confidence`` of F. The refit is exact for Gaussian estimates with this covariance: fixing parameter i at
    zero moves the others by ``-C[:, i] theta_i / C_ii``, and ``theta_i^2 / C_ii`` is the F statistic (1 and ``equations
    - b`` degrees). Reported values stay those of the full model: a fit after selection has too small standard
    deviations.
    """
    theta, covariance = theta.copy(), covariance.copy()
    essential = np.ones(theta.size, dtype=np.bool_)
    limit = float(fdtri(1, max(equations - theta.size, 1), confidence))
    while essential.any():
        left = np.flatnonzero(essential)
        f = theta[left] ** 2 / np.diag(covariance)[left]
        weakest = left[int(np.argmin(f))]
        if f.min() > limit:
            break
        row = covariance[:, weakest] / covariance[weakest, weakest]
        theta -= row * theta[weakest]
        covariance -= np.outer(row, covariance[weakest])
        essential[weakest] = False
    return essential
