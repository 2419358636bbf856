"""Sensitivity of torque and position to the parameters, by finite differences (thesis section 4.1.2)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.estimators.auxiliary_model import AuxiliaryModel, Response
from armident.identify.regression.ar_noise import ArModel, ar_models
from armident.identify.regression.least_squares import column_norms
from armident.identify.regression.whitening import whitened

Arrays = Sequence[Array]

DIFFERENCE = 0.01
"""Finite-difference step in standard deviations that a parameter would have if all others were known.

Forward differences are then accurate to 1e-4 of the norm of a column (TX40), far better than an iteration needs.
"""

LEAST_TORQUE = 1e-3
"""Least torque error of the standard deviations, as a share of a joint's torque, for noise-free data."""


def sensitivities(auxiliary: AuxiliaryModel, theta: Array, response: Response, steps: Array) -> list[Response]:
    """Derivatives of the response with respect to each parameter, by forward differences: b simulations at once.

    ``response``: of the loop at ``theta`` (b,); ``steps`` (b,): perturbations. If the loop diverges at one, the
    opposite one is tried, then smaller ones. If it diverges at all, the derivative is zero and the loop gets a warning.
    """
    columns: list[Response | None] = [None] * theta.size
    for factor in (1.0, -1.0, 0.1, -0.1):
        missing = [i for i, column in enumerate(columns) if column is None]
        perturbed = [theta + factor * steps[i] * np.eye(theta.size)[i] for i in missing]
        for i, moved in zip(missing, auxiliary.respond_many(perturbed), strict=True):
            if moved is not None:
                columns[i] = _quotient(moved, response, factor * steps[i])
    lost = [auxiliary.model.base.names[i] for i, column in enumerate(columns) if column is None]
    if lost:
        auxiliary.warn(f"The closed loop diverges at the smallest change of {', '.join(lost)}: not estimated.")
    return [_quotient(response, response, 1.0) if column is None else column for column in columns]


def difference_steps(zeta: Arrays, torques: Arrays, errors: Arrays, keep: Sequence[NDArray[np.bool_]]) -> Array:
    """Finite-difference steps (b,) on the scale of each parameter's standard deviation, by instruments (M, n, b)."""
    noise = [
        ArModel(np.empty(0), max(e.variance, LEAST_TORQUE**2 * y.variance), 0.0)
        for e, y in zip(ar_models(errors, 0, keep=keep), ar_models(torques, 0, keep=keep), strict=True)
    ]
    return DIFFERENCE / column_norms(whitened(zeta, noise, keep))


def weighted_columns(columns: Sequence[Arrays], keep: Sequence[NDArray[np.bool_]], noise: Sequence[ArModel]) -> Array:
    """Jacobian (rows, b) of 4.2 and 4.4, whitened; ``columns``: derivatives (M, n) by parameter and experiment."""
    return np.stack([whitened(column, noise, keep) for column in columns], axis=1)


def _quotient(moved: Response, response: Response, step: float) -> Response:
    return Response(
        tuple((a - b) / step for a, b in zip(moved.torque, response.torque, strict=True)),
        tuple((a - b) / step for a, b in zip(moved.position, response.position, strict=True)),
    )
