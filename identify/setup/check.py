"""Check of the set-up: wiring, units, transmission, gravity and clocks, before anything else."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from armident.arrays import Array
from armident.configs import DataError, RobotConfig
from armident.identify.effects.recording_corrections import corrected_experiments
from armident.identify.effects.wiring import PositionOffset
from armident.identify.setup import signals
from armident.identify.setup.bench import Bench, make_bench
from armident.identify.setup.calibration import NAMED
from armident.identify.setup.clipping import clipped_torques
from armident.identify.setup.describe import as_configured, effects_line
from armident.identify.setup.fit import Hypothesis, joint_errors
from armident.identify.setup.judge import NEXT_STEP, judged_search
from armident.identify.setup.prior import Mistake
from armident.identify.setup.result import SetupCheck, SetupFinding, TorqueShift
from armident.identify.setup.search import NOT_UNDERSTOOD, STRUCTURED, Search, Step
from armident.identify.setup.stationarity import ChangedStretch, change_finding, spans, stretch
from armident.identify.setup.torque_shift import LONGEST_SHIFT_S, common_shift, long_torque_shift
from armident.identify.setup.weight import weight_findings
from armident.identify.setup.zero_offset import zero_offset
from armident.identify.signals.experiments import Experiment, check_one_rate

TRIED = {
    "position_sign": "wrong sign of positions, or of positions and torques, of each joint and of all",
    "torque_sign": "wrong sign of torques of each joint and of all",
    "exchange": "exchange of any two joints: positions, torques, both",
    "assignment": "any other order of the torques",
    "order": "any other order of the joints",
    "position_unit": "positions in degrees or mm",
    "torque_unit": "torques in thousands, thousandths or per mille of their unit",
    "position_scale": "another encoder resolution of each joint",
    "torque_scale": "another torque constant of each joint",
    "torque_scales": "every torque in a unit of its own drive",
    "gear_ratio": "another gear ratio of each joint",
    "side": "motor side taken for joint side, and the reverse",
    "gravity_direction": "any direction of gravity",
    "gravity_missing": "torques without gravity",
    "position_offset": "another zero of each joint's position",
    "time_unit": "time in ms, us, ns",
    "time_shift": "all torques late or early by the same time",
}
"""Families of hypotheses in words."""


def check_setup(experiments: Sequence[Experiment], robot: RobotConfig) -> SetupCheck:
    """Compare the set-up as configured (SI, joint side, one rate) with its possible mistakes, each refitted."""
    _validate(experiments, robot)
    # The matrices are small: threads delay each other.
    with threadpool_limits(1):
        try:
            return _check(corrected_experiments(experiments, robot), robot)
        except np.linalg.LinAlgError as error:
            message = f"the set-up cannot be checked: the equations of the motion are singular ({error})"
            raise DataError(message) from error


def _check(experiments: Sequence[Experiment], robot: RobotConfig) -> SetupCheck:
    moving = signals.moving_joints(experiments, robot)
    findings = signals.rest_findings(moving, robot)
    if not moving.any():
        nothing = (100.0,) * robot.n
        return SetupCheck(tuple(findings), nothing, nothing, (), ("standstill",), None)
    findings += signals.clipped_findings(experiments, robot, moving)
    findings += signals.held_findings(experiments, robot)
    findings += signals.one_way_findings(experiments, robot, moving)
    damaged = signals.step_findings(experiments, robot) + signals.absolute_findings(experiments, robot, moving)
    if damaged:
        # No correction is right beside signals that are wrong.
        bench = make_bench(experiments, robot, moving)
        errors = _errors(bench, as_configured(robot))
        return SetupCheck((*damaged, *findings), errors, errors, (), (), None)
    rates = signals.rate_findings(experiments, robot)
    if _noise_alone(rates, experiments, robot, moving):
        errors = _errors(make_bench(experiments, robot, moving), as_configured(robot))
        names = tuple(joint.name for joint, moves in zip(robot.joints, moving, strict=True) if moves)
        return SetupCheck((*rates, *findings), errors, errors, names, (), None)
    numbers = _whole(experiments, robot, moving)
    experiments = [experiments[number] for number in numbers]
    bench, search, best = _searched(experiments, robot, moving)
    best, changed = _stretch(bench, best)
    if changed is not None:
        findings.append(change_finding(changed, bench, best.h))
    else:
        best = _unless_zero_explains(search, best)
    judged = judged_search(search, best, robot)
    tried, before = search.tried | {PositionOffset.name: bench.n}, _errors(bench, as_configured(robot))
    setup_findings = judged.findings
    of_clock = tuple(finding for finding in setup_findings if finding.kind == "time_unit")
    clock = best.h.clock if any(finding.probability >= NAMED for finding in of_clock) else 1.0
    if clock != 1.0:
        # Velocities enter friction and limits: everything else is judged with the right clock.
        experiments = [replace(e, dt=e.dt * clock) for e in experiments]
        rates = signals.rate_findings(experiments, robot)
        bench, search, best = _searched(experiments, robot, moving)
        judged = judged_search(search, _unless_zero_explains(search, best), robot)
        setup_findings = (*of_clock, *judged.findings)
        tried = tried | search.tried
    best, corrected, likely = judged.step, judged.robot, judged.likely
    findings += rates
    of_scale = [finding for finding in setup_findings if finding.kind in ("torque_unit", "side")]
    if not any(finding.decisive for finding in of_scale):
        findings += signals.small_torque_findings(experiments, robot)
    known = {name for finding in findings for name in finding.joints}
    findings += _clipped(bench, best, experiments, robot, known)
    doubtful = changed is not None or not all(finding.correction for finding in setup_findings)
    zero = None if doubtful else zero_offset(bench, best.h)
    if zero is not None:
        entry = zero.entry(robot)
        findings.append(zero.finding(robot, effects_line([entry]) if zero.certain else NEXT_STEP))
    if zero is not None and zero.certain:
        bench = zero.bench
        corrected, likely = (
            (one or robot).model_copy(update={"effects": (*(one or robot).effects, entry)})
            for one in (corrected, likely)
        )
    lost = _not_explained(bench, best)
    if not (lost or of_scale or changed is not None or any(finding.decisive for finding in findings)):
        findings += weight_findings(bench, best.h, robot)
    most = np.inf if changed is None else 100.0 * changed.left
    after, likely_after = (_errors(bench, step.h, most) for step in (best, judged.likely_step))
    if changed is not None:
        pairs = zip(robot.joints, changed.left, strict=True)
        lost = tuple(joint.name for joint, left in pairs if joint.name in lost and left > NOT_UNDERSTOOD)
    return SetupCheck(
        findings=(*setup_findings, *findings),
        relative_error_pct=before,
        corrected_error_pct=after,
        joints_not_understood=lost,
        tried=tuple(words for family, words in TRIED.items() if family in tried),
        corrected_robot=corrected,
        likely_robot=likely,
        likely_error_pct=likely_after,
        clock=clock,
        torque_shift=None if lost else _torque_shift(experiments, bench, best),
        stretch=()
        if changed is None
        else tuple(replace(s, experiment=numbers[s.experiment]) for s in spans(changed, bench)),
    )


def _whole(experiments: Sequence[Experiment], robot: RobotConfig, moving: NDArray[np.bool_]) -> list[int]:
    """Return the numbers of the experiments that move all joints that move in any; all if there are none.

    A joint at rest says nothing of its order, scale or clock, and its friction would pass for a mistake of them.
    """
    whole = [k for k, e in enumerate(experiments) if signals.moving_joints([e], robot)[moving].all()]
    return whole or list(range(len(experiments)))


def _noise_alone(
    rates: Sequence[SetupFinding], experiments: Sequence[Experiment], robot: RobotConfig, moving: NDArray[np.bool_]
) -> bool:
    """True if the steps of the positions are most of what every moving joint shows: no set-up can be judged by them."""
    coarse = {name for finding in rates if finding.kind == "position_resolution" for name in finding.joints}
    if not all(joint.name in coarse for joint, moves in zip(robot.joints, moving, strict=True) if moves):
        return False
    errors, _ = joint_errors(make_bench(experiments, robot, moving), as_configured(robot), free=True)
    return bool(np.all(errors[moving] > NOT_UNDERSTOOD))


def _torque_shift(experiments: Sequence[Experiment], bench: Bench, best: Step) -> TorqueShift | None:
    """Return the common shift of the torques; ``None`` with a longer one as a finding, or where none is determined."""
    if "time_shift" in best.families:
        return None
    try:
        return common_shift(experiments, bench, best.h)
    except (DataError, np.linalg.LinAlgError):
        return None


def _unless_zero_explains(search: Search, best: Step) -> Step:
    """Return the set-up without corrections where another zero of one joint explains the recordings better."""
    if not best.mistakes or best.h.clock != 1.0:
        return best
    configured = Step(best.start)
    zero = zero_offset(search.bench, configured.h)
    return configured if zero is not None and zero.gain > search.gain(configured, best)[0] else best


def _stretch(bench: Bench, best: Step) -> tuple[Step, ChangedStretch | None]:
    """Return the set-up, and the stretch of time in which the arm is another one.

    A change in time competes with the corrections: they go where it explains the torques as well without them.
    """
    found = stretch(bench, best.h)
    if best.mistakes and best.h.clock == 1.0:
        configured = Step(as_configured(bench.robot))
        alone = stretch(bench, configured.h)
        if found is not None and alone is not None and alone.certain:
            left = found.left if found.certain else found.error
            if np.log(alone.left / left).sum() <= 0.0:
                return configured, alone
    return best, found if found is not None and found.certain else None


def _searched(
    experiments: Sequence[Experiment], robot: RobotConfig, moving: NDArray[np.bool_]
) -> tuple[Bench, Search, Step]:
    bench = make_bench(experiments, robot, moving)
    search = Search(bench)
    best = search.within_limits(search.run(as_configured(robot)))
    if "time_shift" in best.families:
        best = _with_exact_shift(experiments, bench, best)
    elif moving.sum() > 1 and all(e.q_ref is not None for e in experiments):
        best = _with_instrumented_shift(experiments, bench, best)
    return bench, search, best


def _with_exact_shift(experiments: Sequence[Experiment], bench: Bench, best: Step) -> Step:
    """Replace a common shift that the search has found, if it can be estimated to a factor of 2.

    Prediction gives too short a shift where the closed loop follows disturbances, and where a joint stops suddenly.
    """
    common = float(np.median(best.h.shift[bench.moving]))
    found = long_torque_shift(experiments, bench, best.h, common, abs(common))
    if found is None or found.std > abs(found.samples) / 2.0:
        return best
    return _with_shift(best, bench, (found.samples * bench.period - common) * bench.moving, found)


def _with_instrumented_shift(experiments: Sequence[Experiment], bench: Bench, best: Step) -> Step:
    """Add a common shift that the recorded references show and the search has not found, if two joints confirm it.

    Disturbances in the closed loop may hide it from prediction, not from the instruments.
    """
    found = long_torque_shift(experiments, bench, best.h, 0.0, LONGEST_SHIFT_S)
    if found is None or not found.confirmed:
        return best
    own = np.eye(bench.n)
    named = replace(
        best,
        mistakes=(*best.mistakes, Mistake("time_shift", TRIED["time_shift"], own, own, np.zeros(bench.n))),
        shift_decisive=False,
    )
    return _with_shift(named, bench, found.samples * bench.period * bench.moving, found)


def _with_shift(step: Step, bench: Bench, more_s: NDArray[np.floating], found: TorqueShift) -> Step:
    last = max(k for k, family in enumerate(step.families) if family == "time_shift")
    mistakes = list(step.mistakes)
    mistakes[last] = replace(mistakes[last], shift=mistakes[last].shift + more_s)
    std = found.std * bench.period
    return replace(step, mistakes=tuple(mistakes), shift_std=std, shift_measured=found.instrumented or found.confirmed)


def _clipped(
    bench: Bench, best: Step, experiments: Sequence[Experiment], robot: RobotConfig, known: set[str]
) -> list[SetupFinding]:
    """Return the torques that are clipped behind noise, and were not found by equal values."""
    findings = []
    for clip in clipped_torques(bench, best.h):
        name = robot.joints[clip.joint].name
        if name in known or not signals.in_fine_steps([e.tau[:, clip.joint] for e in experiments]):
            continue
        unit = "N m" if robot.joints[clip.joint].type == "revolute" else "N"
        message = (
            f"the torque of {name} is clipped at {clip.level:.4g} {unit} in {100 * clip.share:.0f} % of the time: the "
            f"model needs {clip.needed:.2g} times as much there"
        )
        unusable = clip.share >= signals.CLIPPED_UNUSABLE
        findings.append(
            SetupFinding("torque_clipped", (name,), clip.probability, message, signals.CLIPPED_REMEDY, unusable)
        )
    return findings


def _errors(bench: Bench, h: Hypothesis, most: Array | float = np.inf) -> tuple[float, ...]:
    """Relative error of every joint's corrected torque, percent, (n,), at most ``most``; 100 at a joint at rest."""
    return tuple(map(float, np.minimum(100 * np.where(bench.moving, joint_errors(bench, h)[0], 1.0), most)))


def _not_explained(bench: Bench, best: Step) -> tuple[str, ...]:
    """Names of moving joints with a large residual that is not noise."""
    # A spring or another law of friction is no doubt about the set-up.
    errors, memory = joint_errors(bench, best.h, free=True)
    bad = bench.moving & (errors > NOT_UNDERSTOOD) & (memory > STRUCTURED)
    return tuple(bench.robot.joints[j].name for j in np.flatnonzero(bad))


def _validate(experiments: Sequence[Experiment], robot: RobotConfig) -> None:
    if not experiments:
        raise DataError("no recording to check")
    for e in experiments:
        if e.q.shape != e.tau.shape or e.q.ndim != 2 or e.q.shape[1] != robot.n:
            raise DataError(
                f"positions of shape {e.q.shape} and torques of shape {e.tau.shape}: {robot.name} has {robot.n} joints"
            )
        if not (np.isfinite(e.q).all() and np.isfinite(e.tau).all()):
            raise DataError("positions or torques are not finite")
    check_one_rate(experiments)
