"""Singular values of the Jacobians of CLIE, CLOE and DIDIM (thesis section 4.1.2)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.sensitivity import difference_steps, sensitivities, weighted_columns
from armident.identify.regression.ar_noise import WHITE
from armident.identify.regression.qr import triangularize
from armident.identify.regression.whitening import whitened

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sensitivity:
    """Singular values of the unweighted Jacobians, in descending order (tables 4.2 and 4.5).

    ``clie``: of the simulated torque (4.4); ``cloe``: of the simulated position (4.2); ``didim``: of the simulated
    regressor, the pseudo-linear approximation of ``clie`` (4.22).
    """

    clie: Array
    cloe: Array
    didim: Array


def sensitivity(auxiliary: AuxiliaryModel, theta: Array, parameters: Sequence[int] | None = None) -> Sensitivity:
    """Singular values of the Jacobians of CLIE, CLOE and DIDIM at ``theta`` (b,); DataError if it cannot be simulated.

    ``parameters``: columns to consider, such as the essential parameters of the thesis; ``None``: all. A decimation
    factor of 1 is no filter (table 4.2).
    """
    auxiliary = auxiliary.fresh()
    response = auxiliary.respond(theta)
    if response is None:
        raise DataError("sensitivity: the auxiliary closed loop diverges with these parameters")
    chosen = np.arange(theta.size) if parameters is None else np.asarray(parameters)
    zeta = auxiliary.regressors(auxiliary.motions(theta))
    keep = [np.ones(torque.shape, dtype=np.bool_) for torque in response.torque]
    none = [np.zeros_like(torque) for torque in response.torque]
    steps = difference_steps(zeta, response.torque, none, keep)
    columns = sensitivities(auxiliary, theta, response, steps)
    plain = [WHITE] * auxiliary.model.n

    def singular_values(jacobian: Array) -> Array:
        factor = triangularize(jacobian[:, chosen], columns=chosen.size)
        return np.asarray(np.linalg.svd(factor, compute_uv=False), dtype=np.float64)

    return Sensitivity(
        clie=singular_values(weighted_columns([column.torque for column in columns], keep, plain)),
        cloe=singular_values(weighted_columns([column.position for column in columns], keep, plain)),
        didim=singular_values(whitened(zeta, plain, keep)),
    )
