"""Check of the torque errors of the joints."""

import numpy as np

from armident.daq.recording.faults.updates import resolution
from armident.identify.estimators.reason import Level, Reason
from armident.identify.identification.checks.judged import Judged
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.identification.identification_result import relative_torque_errors
from armident.identify.identification.moving_joints import MOVE
from armident.identify.identification.verdict import enumerated
from armident.identify.regression.ar_noise import whiteness
from armident.identify.regression.equations import residuals

CHECK = "check the set-up first: armident check RECORDING; then look for a missing effect: armident diagnose RECORDING"


def error(judged: Judged, criteria: IdentificationCriteria) -> list[Reason]:
    """Return a reason if the model leaves more than a third of the torque of a joint.

    It is unusable, unless least squares leaves as much and the rest is white, or more of it is rounding than not: then
    most of the joint's torque is noise. The power of rounding to steps d is d^2 / 12.
    """
    joints, blocks, theta = judged.prepared.model.robot.joints, judged.ls.blocks, judged.found.estimate.theta
    errors, ls_errors = (relative_torque_errors(blocks, at)[1] for at in (theta, judged.ls.estimate.theta))
    step = MOVE if judged.unusable else CHECK
    rest = residuals(blocks, theta)
    limits = np.where(judged.support.moving, criteria.max_joint_error_pct, criteria.max_rest_error_pct)
    longest = max((e.tau for e in judged.prepared.experiments), key=len)
    wrong: list[int] = []
    noisy: list[int] = []
    rounded: list[int] = []
    for j in np.flatnonzero(errors > limits).tolist():
        left = [e[b.keep[:, j], j] for e, b in zip(rest, blocks, strict=True)]
        white = whiteness(left).fraction_outside <= criteria.white_fraction and ls_errors[j] > limits[j]
        coarse = np.mean(np.concatenate(left) ** 2) < 2.0 * resolution(longest[:, j]) ** 2 / 12.0
        (noisy if white else rounded if coarse else wrong).append(j)

    def reason(level: Level, at: list[int], more: str, step: str = step) -> Reason:
        shares = enumerated([f"{joints[j].name} ({errors[j]:.3g} %)" for j in at])
        message = f"The model leaves more than {limits[at].min():.0f} % of the torque of {shares}{more}"
        return Reason(level, message, step, joints[at[0]].name if len(at) == 1 else None, "error")

    reasons = []
    if wrong and step == CHECK and (ls_errors[wrong] <= limits[wrong]).all():
        better = f"; idim-ls leaves {ls_errors[wrong].max():.3g} % at most"
        reference = "" if all(e.q_ref is not None for e in judged.prepared.experiments) else ", or record the reference"
        reasons.append(reason("unusable", wrong, better, f"use --method idim-ls{reference}"))
    elif wrong:
        reasons.append(reason("unusable", wrong, ""))
    if noisy:
        longer = "move with more torque at this joint, or record longer"
        reasons.append(reason("doubtful", noisy, "; the rest is white noise", longer))
    if rounded:
        finer = "move with more torque at this joint, or record its torque in finer steps"
        reasons.append(reason("doubtful", rounded, "; most of the rest is rounding of the recorded torque", finer))
    return reasons
