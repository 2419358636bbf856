"""Checks of the iterations and of the closed loop, simulated with their result."""

from armident.identify.estimators.methods import estimator
from armident.identify.estimators.reason import Level, Reason
from armident.identify.identification.auxiliary_loop import velocity_error
from armident.identify.identification.checks.judged import Judged
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.identification.options import CONTROLLERS


def convergence(judged: Judged, criteria: IdentificationCriteria) -> list[Reason]:
    """Return a reason if the iterations did not converge."""
    method, estimate = judged.options.method, judged.found.estimate
    if estimate.converged:
        return []
    message = f"{method} did not converge: {estimate.stop_reason}"
    return [
        Reason("doubtful", message, "use another method (--method idim-ls), or record more motion", kind="convergence")
    ]


def loop(judged: Judged, criteria: IdentificationCriteria) -> list[Reason]:
    """Return a reason if the closed loop, simulated with the estimate, diverges or does not move like the robot.

    With a measured regressor, only the loop of the robot's own controller judges the estimate: divergence of a stiff
    controller that this program chooses depends on the sampling rate, and only makes the instruments follow the motion.
    """
    if judged.solution is None:
        return []
    measured, runs = estimator(judged.options.method).measured, judged.solution.runs
    if measured and judged.found.controller["kind"] not in CONTROLLERS:
        return []
    missed = None if runs is None else velocity_error(runs, judged.prepared.signals)
    level: Level = "unusable" if not measured else "doubtful"
    if missed is None:
        message = "The closed loop, simulated with these parameters, diverges"
        if measured:
            message += "; the instruments come from the smoothed measured motion or an earlier iterate"
    elif missed > criteria.max_velocity_error:
        message = f"The simulated closed loop misses the measured velocities by {100 * missed:.0f} %"
    else:
        return []
    step = "record the reference if it is missing, or give the controller in the configuration (--controller known)"
    return [Reason(level, message, step, kind="loop")]
