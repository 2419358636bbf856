"""Check of the delay of the recorded torques."""

import numpy as np

from armident.identify.documents.rounding import plus_minus
from armident.identify.estimators.reason import Reason
from armident.identify.identification.checks.judged import Judged
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.identification.torque_delay import HELD
from armident.identify.identification.verdict import enumerated


def delay(judged: Judged, criteria: IdentificationCriteria) -> list[Reason]:
    """Return a reason if torques are recorded more than a sample away from their expected position."""
    found, robot = judged.statistics.delay, judged.prepared.model.robot
    if found is None or judged.unusable:
        return []
    off = found.contradicts() & (np.abs(found.samples - HELD) > criteria.max_delay_samples)
    late = [
        f"{joint.name} {plus_minus(samples, std)}"
        for joint, samples, std, wrong in zip(robot.joints, found.samples, found.std, off, strict=True)
        if wrong
    ]
    if not late:
        return []
    names = [joint.name for joint, wrong in zip(robot.joints, off, strict=True) if wrong]
    message = f"The torque belongs to the position some samples later ({enumerated(late)}; expected is {HELD})"
    step = "check the clocks of drives and capture; time_delay is an effect that the configuration can contain"
    return [Reason("doubtful", message, step, names[0] if len(names) == 1 else None, "delay")]
