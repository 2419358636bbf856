"""Judgement of a result by its errors, iterations, closed loop, residuals, instruments and torque delay."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig
from armident.identify.estimators.diagnostics import Diagnostics
from armident.identify.identification.criteria import IdentificationCriteria
from armident.identify.identification.motion_dependence import Dependence
from armident.identify.identification.options import Method
from armident.identify.identification.torque_delay import HELD, TorqueDelay
from armident.identify.identification.verdict import Level, Reason, listed
from armident.identify.regression.ar_noise import whiteness
from armident.identify.regression.equations import Estimate, ExperimentEquations, residuals

Array = NDArray[np.float64]

DIAGNOSE = "look for a missing effect: armident diagnose RECORDING"
CHECK = "check the set-up first: armident check RECORDING; then look for a missing effect: armident diagnose RECORDING"

WHITE_COVARIANCE: tuple[Method, ...] = ("idim-ls", "idim-iv", "didim")
"""Methods whose standard deviations assume white residuals of the torques."""

SIMULATED: tuple[Method, ...] = ("didim", "clie", "cloe", "sep-pem")
"""Methods whose regressor or output is simulated: without a loop that runs, their estimate has no meaning."""


def error_reasons(
    robot: RobotConfig,
    blocks: Sequence[ExperimentEquations],
    theta: Array,
    errors: Array,
    moving: NDArray[np.bool_],
    criteria: IdentificationCriteria,
    step: str,
    ls_errors: Array,
) -> list[Reason]:
    """Return a reason if the model leaves more than a third of the torque of a joint.

    It is unusable, unless least squares leaves as much and the rest is white noise: then the torque of the joint itself
    is mostly noise.

    Parameters
    ----------
    blocks
        Equations to which the errors belong.
    theta
        Base parameters (b,), SI.
    errors
        Relative error of each joint (n,), percent.
    moving
        Joints that move (n,).
    step
        Next step where the rest is not noise and least squares does no better.
    ls_errors
        Relative error of each joint (n,) with the estimate of IDIM-LS, percent.
    """
    rest = residuals(blocks, theta)
    limits = np.where(moving, criteria.max_joint_error_pct, criteria.max_rest_error_pct)
    wrong: list[int] = []
    noisy: list[int] = []
    for j in np.flatnonzero(errors > limits).tolist():
        test = whiteness([e[b.keep[:, j], j] for e, b in zip(rest, blocks, strict=True)])
        white = test.fraction_outside <= criteria.white_fraction and ls_errors[j] > limits[j]
        (noisy if white else wrong).append(j)

    def reason(level: Level, joints: list[int], more: str, step: str = step) -> Reason:
        shares = listed([f"{robot.joints[j].name} ({errors[j]:.3g} %)" for j in joints])
        message = f"The model leaves more than {limits[joints].min():.0f} % of the torque of {shares}{more}"
        return Reason(level, message, step, robot.joints[joints[0]].name if len(joints) == 1 else None, "error")

    reasons = []
    if wrong and step == CHECK and (ls_errors[wrong] <= limits[wrong]).all():
        better = f"; idim-ls leaves {ls_errors[wrong].max():.3g} % at most"
        reasons.append(reason("unusable", wrong, better, "use --method idim-ls, or record the reference"))
    elif wrong:
        reasons.append(reason("unusable", wrong, ""))
    if noisy:
        longer = "move with more torque at this joint, or record longer"
        reasons.append(reason("doubtful", noisy, "; the rest is white noise", longer))
    return reasons


def convergence_reasons(method: Method, estimate: Estimate) -> list[Reason]:
    """Return a reason if the iterations did not converge. ``method``: name of the method."""
    if estimate.converged:
        return []
    message = f"{method} did not converge: {estimate.stop_reason}"
    return [
        Reason("doubtful", message, "use another method (--method idim-ls), or record more motion", kind="convergence")
    ]


def loop_reasons(
    method: Method, *, diverges: bool, velocity_error: float | None, criteria: IdentificationCriteria
) -> list[Reason]:
    """Return a reason if the closed loop, simulated with the estimate, diverges or does not move like the robot.

    ``method``: name of the method. ``diverges``: True if no closed loop runs with the estimate. ``velocity_error``:
    relative error of the simulated velocities; ``None`` without a simulation.
    """
    level: Level = "unusable" if method in SIMULATED else "doubtful"
    if diverges:
        message = "The closed loop, simulated with these parameters, diverges"
        if method not in SIMULATED:
            message += "; the instruments come from the smoothed measured motion or an earlier iterate"
    elif velocity_error is not None and velocity_error > criteria.max_velocity_error:
        message = f"The simulated closed loop misses the measured velocities by {100 * velocity_error:.0f} %"
    else:
        return []
    step = "record the reference if it is missing, or give the controller in the configuration (--controller known)"
    return [Reason(level, message, step, kind="loop")]


def residual_reasons(
    method: Method,
    diagnostics: Diagnostics,
    judged: Sequence[str],
    criteria: IdentificationCriteria,
    known: Sequence[Reason] = (),
    dependences: Sequence[Dependence] = (),
) -> list[Reason]:
    """Return one reason for the residuals that are not noise, and one for standard deviations that are too small.

    A variance that depends on speed or torque is reported by the tests, but is no defect: it biases nothing.

    ``method``: name of the method. ``diagnostics``: tests of the estimate. ``judged``: joints whose residuals are
    judged; those with a worse defect are not. ``known``: reasons of the estimator, which may already contain the
    statement. ``dependences``: dependence of the residuals on the motion.
    """
    coloured = [j for j in diagnostics.joints if j.joint in judged and not j.white]
    parts, step = [], DIAGNOSE
    if coloured:
        parts.append(f"serially correlated at {listed([j.joint for j in coloured])}")
    dependent = [
        d
        for d in dependences
        if diagnostics.joints[d.joint].joint in judged
        and d.share > criteria.max_motion_share
        and d.deviation >= criteria.min_motion_deviation
    ]
    if dependent:
        shares = [f"{d.variable} of {diagnostics.joints[d.joint].joint} ({100 * d.share:.0f} %)" for d in dependent]
        friction = any(d.variable == "velocity" for d in dependent)
        cause = (
            "friction, its smoothed sign or an effect is not as modelled" if friction else "the model misses an effect"
        )
        parts.append(f"they depend on {listed(shares)}, so {cause} there")
        step = f"adjust friction.sign_smoothing, or {DIAGNOSE}" if friction else DIAGNOSE
    parts += [reason.message for reason in known if reason.kind == "residual"]
    reasons = []
    if parts:
        joints = {j.joint for j in coloured} | {diagnostics.joints[d.joint].joint for d in dependent}
        message = f"The residuals are not noise: {'; '.join(parts)}. Standard deviations may be too small"
        reasons.append(Reason("doubtful", message, step, joints.pop() if len(joints) == 1 else None, "residual"))
    if method in WHITE_COVARIANCE and diagnostics.serial_std_ratio > criteria.max_std_ratio:
        message = (
            f"Standard deviations are up to {diagnostics.serial_std_ratio:.1f} times too small: {method} takes the "
            "residuals for uncorrelated, which they are not"
        )
        reasons.append(Reason("doubtful", message, "use --method idim-piv", kind="uncertainty"))
    return reasons


def instrument_reasons(diagnostics: Diagnostics, parameters: int, criteria: IdentificationCriteria) -> list[Reason]:
    """Return a reason if instruments are weak.

    ``diagnostics``: tests of the estimate; ``parameters``: number of base parameters.
    """
    weak = diagnostics.weak_instruments
    if not weak:
        return []
    of = f"all {parameters} parameters" if len(weak) == parameters else listed(weak, criteria.max_listed)
    message = f"The instruments of {of} are weak: the estimate may be biased like least squares"
    return [Reason("doubtful", message, "record the reference if it is missing, or move faster", kind="instruments")]


def delay_reasons(delay: TorqueDelay | None, robot: RobotConfig, criteria: IdentificationCriteria) -> list[Reason]:
    """Return a reason if torques are recorded more than a sample away from their expected position.

    ``delay``: estimated delays; ``None``: not estimated.
    """
    if delay is None:
        return []
    off = delay.contradicts() & (np.abs(delay.samples - HELD) > criteria.max_delay_samples)
    late = [
        f"{joint.name} {samples:.1f} +- {std:.1f}"
        for joint, samples, std, wrong in zip(robot.joints, delay.samples, delay.std, off, strict=True)
        if wrong
    ]
    if not late:
        return []
    names = [joint.name for joint, wrong in zip(robot.joints, off, strict=True) if wrong]
    message = f"The torque belongs to the position some samples later ({listed(late)}; expected is {HELD})"
    step = "check the clocks of drives and capture; time_delay is an effect that the configuration can contain"
    return [Reason("doubtful", message, step, names[0] if len(names) == 1 else None, "delay")]
