"""CLIE: closed-loop input error, measured against simulated torques (thesis section 4.1.1)."""

from collections.abc import Sequence

from armident.arrays import Array
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.output_error import output_error
from armident.identify.estimators.problem import Estimator, Solved
from armident.identify.regression.equations import Estimate, ExperimentEquations


def clie(blocks: Sequence[ExperimentEquations], auxiliary: AuxiliaryModel, start: Array) -> Estimate:
    """Minimise the input error ``tau - tau_s`` (4.3, 4.4).

    Parameters
    ----------
    blocks
        Filtered and decimated equations; of them only the torques are used, and which equations to keep.
    auxiliary
        The simulated closed loop with the true controller; its torques pass the same filter.
    start
        First theta, shape (b,).

    Returns
    -------
    Estimate
        Its covariance is that of the Jacobian under serially uncorrelated residuals.

    Raises
    ------
    DataError
        If the closed loop cannot be simulated with ``start``.
    """
    return output_error(lambda r: r.torque, [b.y for b in blocks], blocks, auxiliary.fresh(), start)


ESTIMATOR = Estimator(
    "clie",
    lambda problem: Solved(clie(problem.blocks, problem.auxiliary, problem.start)),
    "Least error between measured torques and those of the simulated closed loop (closed-loop input error).",
    "4.1 (4.1 to 4.4)",
)
