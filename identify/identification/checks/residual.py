"""Checks of the residuals, which must be noise, and of the instruments."""

import numpy as np

from armident.identify.estimators.methods import estimator
from armident.identify.estimators.reason import Reason
from armident.identify.identification.checks.judged import Judged
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.identification.identification_result import relative_torque_errors
from armident.identify.identification.motion_dependence import motion_dependence
from armident.identify.identification.verdict import enumerated

DIAGNOSE = "look for a missing effect: armident diagnose RECORDING"


def residual(judged: Judged, criteria: IdentificationCriteria) -> list[Reason]:
    """Return one reason for the residuals that are not noise, and one for standard deviations that are too small.

    A variance that depends on speed or torque biases nothing and is no defect. Joints at rest are not judged. An
    autoregressive model may absorb what depends on the motion; finer equations show it.
    """
    if judged.unusable:
        return []
    method, diagnostics = judged.options.method, judged.statistics.diagnostics
    names = [joint.joint for joint, moves in zip(diagnostics.joints, judged.support.moving, strict=True) if moves]
    known = () if judged.solution is None else judged.solution.reasons
    used = estimator(method)
    finest = judged.found.blocks if used.measured and used.prefiltered else judged.ls.blocks
    dependences = motion_dependence(judged.prepared, finest, judged.found.estimate.theta)
    errors = relative_torque_errors(judged.ls.blocks, judged.found.estimate.theta)[1]
    coloured = [j for j in diagnostics.joints if j.joint in names and not j.white]
    parts, step = [], DIAGNOSE
    if coloured:
        parts.append(f"serially correlated at {enumerated([j.joint for j in coloured])}")
    dependent = [
        d
        for d in dependences
        if diagnostics.joints[d.joint].joint in names
        and d.share > criteria.max_motion_share
        and d.deviation >= criteria.min_motion_deviation
        and errors[d.joint] * np.sqrt(d.share) >= criteria.material_pct
    ]
    if dependent:
        shares = [f"{d.variable} of {diagnostics.joints[d.joint].joint} ({100 * d.share:.0f} %)" for d in dependent]
        friction = any(d.variable == "velocity" for d in dependent)
        cause = "friction or an effect is not as modelled" if friction else "the model misses an effect"
        parts.append(f"they depend on {enumerated(shares)}, so {cause} there")
        step = f"leave friction.sign_smoothing out, or {DIAGNOSE}" if friction and judged.sign_given else DIAGNOSE
    parts += [reason.message for reason in known if reason.kind == "residual"]
    reasons = []
    if parts:
        joints = {j.joint for j in coloured} | {diagnostics.joints[d.joint].joint for d in dependent}
        message = f"The residuals are not noise: {'; '.join(parts)}. Standard deviations may be too small"
        reasons.append(Reason("doubtful", message, step, joints.pop() if len(joints) == 1 else None, "residual"))
    if estimator(method).white_covariance and diagnostics.serial_std_ratio > criteria.max_std_ratio:
        message = (
            f"Standard deviations are up to {diagnostics.serial_std_ratio:.1f} times too small: {method} takes the "
            "residuals for uncorrelated, which they are not"
        )
        reasons.append(Reason("doubtful", message, "use --method idim-piv", kind="uncertainty"))
    return reasons


def instruments(judged: Judged, criteria: IdentificationCriteria) -> list[Reason]:
    """Return a reason if instruments are weak."""
    if judged.unusable:
        return []
    parameters, diagnostics = judged.found.estimate.theta.size, judged.statistics.diagnostics
    weak = diagnostics.weak_instruments
    if not weak:
        return []
    of = f"all {parameters} parameters" if len(weak) == parameters else enumerated(weak, criteria.max_listed)
    message = f"The instruments of {of} are weak: the estimate may be biased like least squares"
    return [Reason("doubtful", message, "record the reference if it is missing, or move faster", kind="instruments")]
