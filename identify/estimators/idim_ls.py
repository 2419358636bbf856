"""IDIM-LS: least squares on the inverse dynamic identification model (thesis section 2.3.2)."""

from collections.abc import Sequence

from armident.identify.estimators.problem import Estimator
from armident.identify.regression.ar_noise import WHITE
from armident.identify.regression.equations import (
    COVARIANCE_PASSES,
    Estimate,
    ExperimentEquations,
    joint_variances,
    noise_models,
    stacked_parts,
    whitened_residuals,
)
from armident.identify.regression.iv import serial_covariance
from armident.identify.regression.least_squares import Triangle, require_excitation
from armident.identify.signals.streamed import mapped


def idim_ls(
    blocks: Sequence[ExperimentEquations], names: Sequence[str], *, weighted: bool = True, serial_order: int = 0
) -> Estimate:
    """Ordinary, then weighted least squares.

    Parameters
    ----------
    blocks
        Filtered and decimated equations.
    names
        Base parameters, shape (b,), for messages.
    weighted
        Weight each joint by its residual variance (2.23); otherwise the ordinary solution (2.22) is the result, its
        covariance still that under residual variances which differ between joints.
    serial_order
        Highest order of an AR model of each joint's residuals, used for the covariance alone; 0: the residuals
        count as white (2.27).

    Raises
    ------
    DataError
        If the motion leaves parameters undetermined.
    """
    plain = [WHITE] * blocks[0].y.shape[1]
    rows = Triangle.of(stacked_parts(blocks, plain))
    require_excitation(rows, names)
    theta = rows.theta  # 2.22
    noise = joint_variances(blocks, theta)  # 2.24 to 2.26
    if weighted:
        rows = Triangle.of(stacked_parts(blocks, noise))
        theta = rows.theta  # 2.23
        covariance = rows.inverse_gram  # 2.27
    else:
        regressors = mapped(lambda b: b.x, blocks)
        covariance = serial_covariance(regressors, regressors, [b.keep for b in blocks], plain, noise)
    if serial_order:
        weights = noise if weighted else plain
        regressors = mapped(lambda b: b.x, blocks)
        for _ in range(COVARIANCE_PASSES):
            noise = noise_models(blocks, theta, covariance, serial_order)
            covariance = serial_covariance(regressors, regressors, [b.keep for b in blocks], weights, noise)
    return Estimate(theta, covariance, tuple(noise), whitened_residuals(blocks, theta, noise))


ESTIMATOR = Estimator(
    "idim-ls",
    None,
    "Least squares on the inverse dynamic model, the reference method.",
    "2.3.2 (2.22 to 2.27)",
    measured=True,
    white_covariance=True,
)
