"""IDIM-PIV: prefiltered instrumental variables (thesis section 6.2.2), after a rough decimation (section 7.2)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from identify.estimators.auxiliary import AuxiliaryModel
from identify.estimators.idim_iv import ITERATIONS, TOLERANCE
from identify.estimators.noise import ArModel
from identify.estimators.regression import (
    Block,
    Estimate,
    instrumental_variable,
    iterate,
    iv_covariance,
    joint_variances,
    noise_models,
    residuals,
    weighted_rows,
    whitened_residuals,
)

MAX_AR_ORDER = 60

NOISE_UPDATES = 6
"""Iterations after which the noise models are held: an order that flips between two equal AICs never settles."""


def idim_piv(
    blocks: Sequence[Block],
    auxiliary: AuxiliaryModel,
    start: NDArray[np.float64],
    iterations: int = ITERATIONS,
    max_order: int = MAX_AR_ORDER,
) -> Estimate:
    """Alternate the IV estimate of the parameters and an AR model of the noise of each joint.

    Parameters
    ----------
    blocks
        Roughly decimated equations at measured signals; all rows, since a whitening filter needs a gapless record.
    auxiliary
        The simulated closed loop; its instruments pass the same rough decimation.
    start
        First theta of the auxiliary model, shape (b,).
    iterations
        Most iterations.
    max_order
        Highest AR order tried.

    Notes
    -----
    The noise model is fitted to ``tau - phi(q, qd, qdd) theta``: it is the error that the IV equations 6.30 weigh, and
    whitening it makes their covariance minimal.

    Raises
    ------
    DataError
        If no auxiliary model runs, not even the first.
    """
    keep = [b.keep for b in blocks]
    scale = joint_variances(blocks, start)
    noise: list[ArModel] = scale  # step 1: H = 1, lambda from the start

    def step(previous: NDArray[np.float64], k: int) -> tuple[NDArray[np.float64], float]:
        nonlocal noise
        zeta = auxiliary.instruments(previous)  # step 2a
        z = weighted_rows(zeta, keep, noise)
        x = weighted_rows([b.x for b in blocks], keep, noise)
        y = weighted_rows([b.y for b in blocks], keep, noise)
        estimate = instrumental_variable(z, x, y)  # step 2b, 6.30
        if k <= NOISE_UPDATES:
            noise = noise_models(blocks, estimate, iv_covariance(z, x), max_order)  # step 2c
        return estimate, float(np.linalg.norm(weighted_rows(residuals(blocks, estimate), keep, scale)))

    theta, done, converged, reason = iterate(step, start, iterations, TOLERANCE)
    z = weighted_rows(auxiliary.instruments(theta), keep, noise)
    x = weighted_rows([b.x for b in blocks], keep, noise)
    return Estimate(
        theta,
        iv_covariance(z, x),
        tuple(noise),
        whitened_residuals(blocks, theta, noise),
        done,
        converged,
        reason,
        tuple(auxiliary.warnings),
    )
