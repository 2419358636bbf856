"""IDIM-PIV: prefiltered instrumental variables (thesis section 6.2.2), after a rough decimation (section 7.2)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.grey_box import InverseController
from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.equations import (
    MAX_AR_ORDER,
    Estimate,
    ExperimentEquations,
    instrumented,
    joint_variances,
    noise_models,
    residual_norm,
    whitened_residuals,
)
from armident.identify.regression.iterations import ITERATIONS, iterate
from armident.identify.regression.iv import IvProducts, iv_products
from armident.identify.signals.streamed import mapped

NOISE_UPDATES = 6
"""Iterations after which the noise models are held: an order that flips between two equal AICs never settles."""


def idim_piv(
    blocks: Sequence[ExperimentEquations],
    auxiliary: AuxiliaryModel,
    start: NDArray[np.float64],
    iterations: int = ITERATIONS,
    max_order: int = MAX_AR_ORDER,
    *,
    grey_box: bool = False,
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
    grey_box
        Take the noise for position noise that the controller has turned into torque (6.28). ``noise`` and
        ``residuals`` of the result then belong to the motors' positions (rad or m).

    Notes
    -----
    The noise model is fitted to ``tau - phi(q, qd, qdd) theta``: it is the error that the IV equations 6.30 weigh, and
    whitening it makes their covariance minimal.

    Raises
    ------
    DataError
        If no auxiliary model runs, not even the first.
    """
    auxiliary = auxiliary.fresh()
    controller = InverseController.of(auxiliary, max_order) if grey_box else None

    def seen(equations: Sequence[ExperimentEquations]) -> Sequence[ExperimentEquations]:
        return equations if controller is None else controller(equations)

    measured = seen(blocks)
    scale = joint_variances(measured, start)
    noise: list[ArModel] = scale  # step 1: H = 1, lambda from the start

    def solved(at: NDArray[np.float64]) -> IvProducts:
        instruments = mapped(lambda block: block.x, seen(auxiliary.equations(blocks, at)))
        return iv_products(instrumented(measured, instruments), noise)  # 6.30

    def step(previous: NDArray[np.float64], k: int) -> tuple[NDArray[np.float64], float]:
        nonlocal noise
        products = solved(previous)  # steps 2a and 2b
        estimate = products.theta
        if k <= NOISE_UPDATES:
            noise = noise_models(measured, estimate, products.covariance, max_order)  # step 2c
        return estimate, residual_norm(measured, estimate, scale)

    theta, done, converged, reason = iterate(step, start, iterations)
    covariance = solved(theta).covariance
    residuals = whitened_residuals(measured, theta, noise)
    return Estimate(theta, covariance, tuple(noise), residuals, done, converged, reason, auxiliary.warnings)
