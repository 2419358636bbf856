"""Reasons of the verdict of an identification, collected from all checks."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from scipy import linalg

from armident.configs import DataError
from armident.identify.identification.auxiliary_loop import velocity_error
from armident.identify.identification.criteria import IdentificationCriteria
from armident.identify.identification.equations import Prepared
from armident.identify.identification.excitation_check import Support, excitation_reasons
from armident.identify.identification.motion_dependence import motion_dependence
from armident.identify.identification.moving_joints import MOVE
from armident.identify.identification.options import Method, Options
from armident.identify.identification.physics_check import physics_reasons
from armident.identify.identification.result import LeastSquares, MethodResult, Statistics, relative_errors
from armident.identify.identification.result_check import (
    CHECK,
    convergence_reasons,
    delay_reasons,
    error_reasons,
    instrument_reasons,
    loop_reasons,
    residual_reasons,
)
from armident.identify.identification.solvers import Solution, is_singular
from armident.identify.identification.verdict import Reason
from armident.identify.regression.equations import Estimate
from armident.identify.robot.arm import ArmModel


@dataclass
class Notes:
    """Lines for the user, and defects for the verdict, as the steps of an identification find them."""

    warnings: list[str] = field(default_factory=list)
    reasons: list[Reason] = field(default_factory=list)


@dataclass(frozen=True)
class Judged:
    """Parts of an identification that its verdict depends on.

    Parameters
    ----------
    prepared
        Arm, experiments and derivatives.
    ls, found
        IDIM-LS, in whose equations errors are measured, and the estimate of the method.
    solution
        Solution in the closed loop; ``None`` for IDIM-LS.
    statistics
        Tests of the estimate, and delay of the torques.
    support
        Joints that move, and parameters that the motion supports.
    """

    prepared: Prepared
    options: Options
    ls: LeastSquares
    found: MethodResult
    solution: Solution | None
    statistics: Statistics
    support: Support


def require_finite(estimate: Estimate) -> None:
    """Raise if an estimate or its covariance is not finite, or a variance is negative.

    ``estimate``: estimate of any method. Raises LinAlgError if so.
    """
    finite = np.isfinite(estimate.theta).all() and np.isfinite(estimate.covariance).all()
    if not finite or (np.diag(estimate.covariance) < 0.0).any():
        raise np.linalg.LinAlgError("the estimate or its covariance is not finite")


@contextmanager
def refusing_singular(
    method: Method, model: ArmModel, support: Support, criteria: IdentificationCriteria
) -> Iterator[None]:
    """Turn equations without a finite solution into a `DataError` that lists what the motion supports.

    Floating-point warnings of such equations are suppressed: the verdict states the defect.

    ``method``: name of the method; ``support``: parameters that the motion supports. Raises DataError if numpy finds a
    singular matrix, or scipy a number that is not finite (which it reports as ``ValueError``).
    """
    try:
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore", linalg.LinAlgWarning)
            yield
    except (np.linalg.LinAlgError, ValueError) as error:
        if not is_singular(error):
            raise
        raise DataError(
            f"the equations of {method} have no finite solution. Of the motion: "
            f"{support.sentence(model, criteria)}. Next: {MOVE}"
        ) from error


def judgement(judged: Judged, criteria: IdentificationCriteria) -> list[Reason]:
    """Return the defects of an identification.

    Tests of residuals and instruments have no meaning for an unusable result; they are left out.

    ``judged``: parts of the identification.
    """
    prepared, estimate = judged.prepared, judged.found.estimate
    model, experiments, method = prepared.model, prepared.experiments, judged.options.method
    theta, covariance, blocks = estimate.theta, estimate.covariance, judged.ls.blocks
    moving, diagnostics = judged.support.moving, judged.statistics.diagnostics
    errors, ls_errors = (relative_errors(blocks, at)[1] for at in (theta, judged.ls.estimate.theta))
    excitation = excitation_reasons(model, experiments, judged.support, theta, covariance, criteria)
    step = MOVE if any(reason.level == "unusable" for reason in excitation) else CHECK
    reasons = [
        *excitation,
        *error_reasons(model.robot, blocks, theta, errors, moving, criteria, step, ls_errors),
        *physics_reasons(model, experiments, blocks, theta, covariance, criteria, judged.statistics.physical),
        *convergence_reasons(method, estimate),
    ]
    if judged.solution is not None:
        reasons += _loop(judged, judged.solution, criteria)
    if not any(reason.level == "unusable" for reason in reasons):
        known = () if judged.solution is None else judged.solution.reasons
        names = [joint.name for joint, moves in zip(model.robot.joints, moving, strict=True) if moves]
        finest = judged.found.blocks if method == "idim-piv" else blocks
        dependences = motion_dependence(prepared, finest, theta)
        reasons += residual_reasons(method, diagnostics, names, criteria, known, dependences)
        reasons += instrument_reasons(diagnostics, theta.size, criteria)
        reasons += delay_reasons(judged.statistics.delay, model.robot, criteria)
    return reasons


def _loop(judged: Judged, solution: Solution, criteria: IdentificationCriteria) -> list[Reason]:
    kind, runs = judged.found.controller["kind"], solution.runs
    diverges = kind == "followed" or runs is None
    error = None if diverges or runs is None else velocity_error(runs, judged.prepared.signals)
    return loop_reasons(judged.options.method, diverges=diverges, velocity_error=error, criteria=criteria)
