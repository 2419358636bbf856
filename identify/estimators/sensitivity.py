"""What torque and position tell about the parameters: singular values of the Jacobians (thesis section 4.1.2)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from configs import DataError
from identify.estimators.auxiliary import AuxiliaryModel
from identify.estimators.output_error import difference_steps, sensitivities, weighted_columns
from identify.estimators.regression import unweighted, weighted_rows
from identify.estimators.triangular import triangularize


@dataclass(frozen=True)
class Sensitivity:
    """Singular values of the unweighted Jacobians, in descending order (tables 4.2 and 4.5).

    Parameters
    ----------
    clie
        Of the simulated torque with respect to the parameters, ``Psi_CLIE`` (4.4).
    cloe
        Of the simulated position, ``Psi_CLOE`` (4.2).
    didim
        Of the simulated regressor, the pseudo-linear stand-in for ``Psi_CLIE`` (4.22).
    """

    clie: NDArray[np.float64]
    cloe: NDArray[np.float64]
    didim: NDArray[np.float64]


def sensitivity(
    auxiliary: AuxiliaryModel, theta: NDArray[np.float64], parameters: Sequence[int] | None = None
) -> Sensitivity:
    """Singular values of the Jacobians of CLIE, CLOE and DIDIM at ``theta``.

    Parameters
    ----------
    auxiliary
        The simulated closed loop and its parallel filter; a decimation factor of 1 is no filter (table 4.2).
    theta
        Base parameters, shape (b,).
    parameters
        Columns to consider, such as the essential parameters of the thesis; ``None``: all.

    Raises
    ------
    DataError
        If the loop cannot be simulated with ``theta``.
    """
    auxiliary = auxiliary.fresh()
    response = auxiliary.respond(theta)
    if response is None:
        raise DataError("sensitivity: the auxiliary closed loop diverges with these parameters")
    chosen = np.arange(theta.size) if parameters is None else np.asarray(parameters)
    zeta = auxiliary.instruments(theta)
    keep = [np.ones(torque.shape, dtype=np.bool_) for torque in response.torque]
    none = [np.zeros_like(torque) for torque in response.torque]
    steps = difference_steps(zeta, response.torque, none, keep)
    columns = sensitivities(auxiliary, theta, response, steps)
    plain = unweighted(auxiliary.model.n)

    def singular_values(jacobian: NDArray[np.float64]) -> NDArray[np.float64]:
        factor = triangularize(jacobian[:, chosen], columns=chosen.size)
        return np.asarray(np.linalg.svd(factor, compute_uv=False), dtype=np.float64)

    return Sensitivity(
        clie=singular_values(weighted_columns([column.torque for column in columns], keep, plain)),
        cloe=singular_values(weighted_columns([column.position for column in columns], keep, plain)),
        didim=singular_values(weighted_rows(zeta, keep, plain)),
    )
