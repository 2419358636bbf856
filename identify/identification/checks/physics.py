"""Check of physical possibility: signs of friction and inertia, mass matrix, and the nearest possible arm."""

import numpy as np
from scipy.special import chdtri

from armident.arrays import Array
from armident.configs import ArmidentError
from armident.identify.documents.rounding import plus_minus
from armident.identify.estimators.reason import Reason
from armident.identify.identification.checks.excitation import motion_postures, workspace_postures
from armident.identify.identification.checks.judged import Judged
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.identification.identification_result import relative_torque_errors, units
from armident.identify.identification.support import NON_NEGATIVE
from armident.identify.identification.verdict import enumerated
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.consistent import nearest_base

CHECK_SIGNALS = "check signs, units, sides and order of the recorded signals: armident check RECORDING"
USE_NEAREST = (
    "take the nearest possible parameters (--physical), or look for a missing effect: armident diagnose RECORDING"
)


def physics(judged: Judged, criteria: IdentificationCriteria) -> list[Reason]:
    """Return a reason if no physical arm has these parameters within their uncertainty.

    The result is doubtful if a possible arm explains the torques nearly as well. It is unusable if that arm leaves more
    than a third of a joint's torque, which the estimate explains: then signals are wrong.
    """
    model, experiments, blocks = judged.prepared.model, judged.prepared.experiments, judged.ls.blocks
    theta, covariance = judged.found.estimate.theta, judged.found.estimate.covariance
    consistent = judged.statistics.physical
    if not (np.isfinite(theta).all() and np.isfinite(covariance).all()):
        return []
    seen = motion_postures(experiments)
    postures = np.concatenate([seen, workspace_postures(model.robot, seen)])
    faults = impossible_values(model, postures, theta, covariance, criteria)
    try:
        nearest = nearest_base(model, theta, covariance)
    except ArmidentError:
        nearest = None
    far = nearest is not None and nearest.distance**2 > float(chdtri(theta.size, criteria.false_alarm_rate))
    if consistent is not None:
        far = consistent.p_value < criteria.false_alarm_rate
    if far and nearest is not None:
        worst = int(np.argmax(np.abs(nearest.shifts)))
        faults.append(
            f"the nearest possible parameters are {nearest.distance:.3g} standard deviations away "
            f"({model.base.names[worst]} by {nearest.shifts[worst]:+.2g})"
        )
    if not faults:
        return []
    message = f"The parameters are physically impossible: {'; '.join(faults)}"
    if nearest is None:
        return [Reason("doubtful", message, CHECK_SIGNALS, kind="physics")]
    names = [joint.name for joint in model.robot.joints]
    own, errors = relative_torque_errors(blocks, theta), relative_torque_errors(blocks, nearest.theta)
    wrong = (errors[1] > criteria.max_joint_error_pct) & (own[1] <= criteria.max_joint_error_pct)
    if wrong.any():
        left = [f"{errors[1][j]:.0f} % at {names[j]}" for j in np.flatnonzero(wrong)]
        message += f". No possible arm explains the torques: the nearest one leaves {enumerated(left)}"
        return [Reason("unusable", message, CHECK_SIGNALS, kind="physics")]
    message += f". The nearest possible arm leaves {errors[0]:.3g} % of the torques, the estimate {own[0]:.3g} %"
    return [Reason("doubtful", message, USE_NEAREST, kind="physics")]


def impossible_values(
    model: ArmModel, q: Array, theta: Array, covariance: Array, criteria: IdentificationCriteria
) -> list[str]:
    """Parts of a sentence on significant impossible values: friction, rotor inertia or mass matrix."""
    return [*_negative(model, theta, covariance, criteria), *_indefinite(model, q, theta, covariance, criteria)]


def _negative(model: ArmModel, theta: Array, covariance: Array, criteria: IdentificationCriteria) -> list[str]:
    """Friction and rotor inertias that are significantly negative, as one part of a sentence."""
    std, unit = np.sqrt(np.maximum(np.diag(covariance), 0.0)), units(model)
    rigid = model.base.names[: model.base.b - model.e]
    found = [
        k
        for k, name in enumerate(rigid)
        if name.startswith(NON_NEGATIVE)
        and "-" not in model.base.formulas.get(name, name)
        and theta[k] < -criteria.sign_tolerance_std * std[k]
    ]
    found.sort(key=lambda k: theta[k] / std[k])
    values = [f"{rigid[k]} = {plus_minus(theta[k], std[k])} {unit[k]}" for k in found]
    return [f"negative {enumerated(values, 3)}"] if values else []


def _indefinite(
    model: ArmModel, q: Array, theta: Array, covariance: Array, criteria: IdentificationCriteria
) -> list[str]:
    """Mass matrix that is significantly not positive definite at one of some postures.

    With its smallest eigenvector v, ``v' M v`` is linear in theta, so the covariance gives its standard deviation.
    """
    rigid = model.base.b - model.e
    arm, c, still = model.without_terms(), covariance[:rigid, :rigid], np.zeros_like(q)
    values, vectors = np.linalg.eigh(arm.mass_matrix(theta[:rigid], q))
    direction = np.ascontiguousarray(vectors[:, :, 0])
    change = arm.rigid_regressor(q, still, direction) - arm.rigid_regressor(q, still, still)
    row = np.einsum("kj,kjb->kb", direction, change)
    std = np.sqrt(np.maximum(np.einsum("kb,bc,kc->k", row, c, row), 1e-300))
    worst = int(np.argmin(values[:, 0] / std))
    if values[worst, 0] >= -criteria.sign_tolerance_std * std[worst]:
        return []
    negative = 100 * float(np.mean(values[:, 0] < 0))
    return [
        f"the mass matrix is not positive definite (smallest eigenvalue {plus_minus(values[worst, 0], std[worst])}, "
        f"negative at {negative:.0f} % of the postures)"
    ]
