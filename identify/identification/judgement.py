"""Checks of an identification in their order, and refusal of equations without a solution."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from scipy import linalg

from armident.configs import DataError
from armident.identify.estimators.methods import Method
from armident.identify.estimators.reason import Reason
from armident.identify.identification.checks.convergence import convergence, loop
from armident.identify.identification.checks.delay import delay
from armident.identify.identification.checks.error import error
from armident.identify.identification.checks.excitation import excitation
from armident.identify.identification.checks.interval import interval
from armident.identify.identification.checks.judged import Judged
from armident.identify.identification.checks.physics import physics
from armident.identify.identification.checks.residual import instruments, residual
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.identification.moving_joints import MOVE
from armident.identify.identification.solvers import is_singular
from armident.identify.identification.support import Support
from armident.identify.regression.equations import Estimate
from armident.identify.robot.arm import ArmModel

CHECKS: tuple[Callable[[Judged, IdentificationCriteria], list[Reason]], ...] = (
    excitation, error, physics, convergence, loop, residual, instruments, delay, interval,
)  # fmt: skip
"""All checks in their order; a check sees the reasons of those before it."""


@dataclass
class Notes:
    """Lines for the user, and defects for the verdict, as the steps of an identification find them."""

    warnings: list[str] = field(default_factory=list)
    reasons: list[Reason] = field(default_factory=list)


def judgement(judged: Judged, criteria: IdentificationCriteria) -> list[Reason]:
    """Return the defects of an identification that the checks find."""
    for check in CHECKS:
        judged.reasons.extend(check(judged, criteria))
    return judged.reasons


def require_finite(estimate: Estimate) -> None:
    """Raise LinAlgError if an estimate or its covariance is not finite, or a variance is negative."""
    finite = np.isfinite(estimate.theta).all() and np.isfinite(estimate.covariance).all()
    if not finite or (np.diag(estimate.covariance) < 0.0).any():
        raise np.linalg.LinAlgError("the estimate or its covariance is not finite")


@contextmanager
def refusing_singular(
    method: Method, model: ArmModel, support: Support, criteria: IdentificationCriteria
) -> Iterator[None]:
    """Turn equations without a finite solution into a `DataError` that lists what the motion supports."""
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
