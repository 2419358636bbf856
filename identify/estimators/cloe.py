"""CLOE: closed-loop output error, measured against simulated positions (thesis section 4.1.1)."""

from collections.abc import Sequence

from armident.arrays import Array
from armident.configs import DataError
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.output_error import output_error
from armident.identify.estimators.problem import Estimator, Problem, Solved
from armident.identify.regression.equations import Estimate, ExperimentEquations


def cloe(
    blocks: Sequence[ExperimentEquations], positions: Sequence[Array], auxiliary: AuxiliaryModel, start: Array
) -> Estimate:
    """Minimise the output error ``q_m - q_s`` (4.1, 4.2).

    Parameters
    ----------
    blocks
        Filtered and decimated equations: which samples to keep, and torques that scale the perturbations.
    positions
        Measured joint positions after the same filter, one (M, n) array per experiment, rad or m.
    auxiliary
        The simulated closed loop with the true controller; its positions pass the same filter.
    start
        First theta, shape (b,).

    Returns
    -------
    Estimate
        ``noise`` and ``residuals`` belong to the positions; the covariance is that of the Jacobian under
        serially uncorrelated residuals.

    Raises
    ------
    DataError
        If the positions do not match the blocks, or the closed loop cannot be simulated with ``start``.
    """
    shapes, expected = [p.shape for p in positions], [b.y.shape for b in blocks]
    if shapes != expected:
        raise DataError(f"positions of shapes {shapes} do not belong to equations of shapes {expected}")
    return output_error(lambda r: r.position, positions, blocks, auxiliary.fresh(), start)


def _solve(problem: Problem) -> Solved:
    estimate = cloe(problem.blocks, problem.positions, problem.auxiliary, problem.start)
    return Solved(estimate, noise_of="joint position")


ESTIMATOR = Estimator(
    "cloe",
    _solve,
    "Least error between measured and simulated positions of the closed loop (closed-loop output error).",
    "4.1 (4.1 to 4.4)",
)
