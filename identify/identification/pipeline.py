"""Identification pipeline in the steps of the thesis, for `armident identify` and the worker."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from armident.arrays import Array
from armident.configs import DataError, RobotConfig
from armident.identify.effects.recording_corrections import corrected_experiments
from armident.identify.effects.terms import arm_model
from armident.identify.estimators.diagnostics import diagnose_estimate
from armident.identify.estimators.essential import essential_parameters
from armident.identify.estimators.idim_ls import idim_ls
from armident.identify.estimators.methods import estimator
from armident.identify.estimators.reason import Reason
from armident.identify.identification.auxiliary_loop import ClosedLoop, closed_loop, velocity_error
from armident.identify.identification.checks.interval import doubts_of_least_squares, interval_reason
from armident.identify.identification.checks.judged import Judged
from armident.identify.identification.equations import (
    Prepared,
    aligned_torque,
    equations,
    least_rows,
    published_equations,
    tested,
)
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.identification.identification_result import (
    IdentificationResult,
    LeastSquares,
    MethodResult,
    Statistics,
    make_result,
)
from armident.identify.identification.judgement import Notes, judgement, refusing_singular, require_finite
from armident.identify.identification.moving_joints import MOVE, moving_joints, require_motion
from armident.identify.identification.noise_decimation import decimation_from_noise
from armident.identify.identification.options import CONTROLLERS, Options
from armident.identify.identification.residual_statistics import residual_statistics
from armident.identify.identification.sign_smoothing import (
    Transition,
    law_error,
    recorded_speeds,
    unsaturated_joints,
    with_estimated_smoothing,
    with_sign_smoothing,
)
from armident.identify.identification.solvers import IdentificationProblem, Solution, decimation_of, solve
from armident.identify.identification.support import examine_support
from armident.identify.identification.verdict import judge
from armident.identify.regression.equations import Estimate, ExperimentEquations, residuals_of
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.consistent import nearest_consistent
from armident.identify.setup.result import SetupCheck, with_torque_shift
from armident.identify.signals.bandwidth import motion_bandwidth
from armident.identify.signals.decimate import Decimation
from armident.identify.signals.differentiate import Derivatives, differentiate, encoder_resolution
from armident.identify.signals.experiments import Experiment, check_one_rate
from armident.identify.signals.streamed import kept, mapped

TORQUE_PREDICTIONS = 2
"""Largest number of predictions of the torques on which terms depend."""

TORQUE_SHARE_PREDICTIONS = 6
"""Largest number of predictions where terms are shares of these torques."""

PREDICTED = 1e-3
"""Relative change of the predicted torques that ends the predictions."""

Progress = Callable[[str, float], None]


def identify_experiment(
    experiments: Sequence[Experiment] | Experiment,
    robot: RobotConfig,
    options: Options | None = None,
    progress: Progress | None = None,
    setup: SetupCheck | None = None,
) -> IdentificationResult:
    """Identify the base parameters of a robot, and judge the result.

    Derivatives (5.1), IDIM-LS (2.3.2), which starts the iterations, controller (5.2), closed loop, and IDIM-IV (2.3.3)
    or IDIM-PIV (6.2.2). Raises ConfigError or DataError if it is impossible.
    """
    if isinstance(experiments, Experiment):
        experiments = [experiments]
    _check(experiments, robot)
    clock = _Clock(progress or (lambda stage, share: None))
    try:
        # The matrices are tall and narrow: threads gain little, delay each other on a busy machine, round differently.
        with threadpool_limits(1):
            return _identify(experiments, robot, options or Options(), clock, setup)
    except DataError as error:
        known = judge([], setup).reasons
        if not known:
            raise
        cause = f"{known[0].message}. Next: {known[0].next_step}"
        raise DataError(f"{str(error).rstrip('.')}. Set-up: {cause}") from error


def _identify(
    experiments: Sequence[Experiment],
    robot: RobotConfig,
    options: Options,
    clock: "_Clock",
    setup: SetupCheck | None,
) -> IdentificationResult:
    """Carry out the steps of the thesis in their order."""
    notes = Notes()
    criteria = IdentificationCriteria()

    clock.enter("model", 0.0)
    moving = moving_joints(experiments, robot, criteria)
    require_motion(experiments, robot, moving)
    experiments = shifted_experiments(corrected_experiments(experiments, robot), robot, options, setup, notes)
    bandwidth = (
        options.bandwidth_hz
        or robot.bandwidth_hz
        or motion_bandwidth(mapped(lambda e: e.q, experiments), experiments[0].dt)
    )
    speeds = recorded_speeds(experiments, bandwidth)
    given, robot = robot, with_sign_smoothing(robot, speeds)

    clock.enter("derivatives", 0.05)
    signals = smoothed_derivatives(experiments, robot, options, bandwidth)

    clock.enter("idim-ls", 0.2)
    prepared, transitions = _prepared(robot, experiments, signals, bandwidth), dict[str, Transition]()
    if given.friction.sign_smoothing is None and not has_published_filters(robot, options):
        first = _least_squares(prepared, options, bandwidth, moving, criteria, Notes())
        robot, transitions = with_estimated_smoothing(given, prepared, first.decimation, speeds, criteria)
        if transitions:
            prepared = _prepared(robot, experiments, signals, bandwidth)
    model = prepared.model
    notes.reasons += [interval_reason(line) for line in unsaturated_joints(given, robot, speeds)]
    ls = _least_squares(prepared, options, bandwidth, moving, criteria, notes)
    support = examine_support(prepared, ls.blocks, ls.decimation, moving, criteria, ls.estimate.noise)

    with refusing_singular(options.method, model, support, criteria):
        doubts: tuple[str, ...] = ()
        if estimator(options.method).solve is None:
            solution, found = None, MethodResult(ls.estimate, ls.blocks, {"kind": "none"})
            doubts = doubts_of_least_squares(prepared, options, ls, bandwidth)
        else:
            clock.enter("controller", 0.35)
            solution, found = _solve_in_closed_loop(prepared, options, ls, bandwidth, clock, notes)
        require_finite(found.estimate)
        clock.enter("statistics", 0.85)
        shift = law_error(prepared, ls.decimation, transitions)
        if shift is not None:
            covariance = found.estimate.covariance + np.outer(shift, shift)
            found = replace(found, estimate=replace(found.estimate, covariance=covariance))
            joints = ", ".join(name for name, one in transitions.items() if one.saturating is not None)
            notes.warnings.append(
                f"The law by which dry friction of {joints} reverses is not known: standard deviations contain the "
                "difference between two laws (atan and tanh)."
            )
        statistics = _statistics(prepared, found, solution)
        statistics = replace(statistics, interval_warnings=(*statistics.interval_warnings, *doubts))
        numbers = tested(found.blocks)
        blocks = [found.blocks[k] for k in numbers]
        residuals, changes = residual_statistics(prepared.part(numbers), blocks, found.estimate)
        if len(numbers) < len(found.blocks):
            text = f"Tests use {len(numbers)} of the {len(found.blocks)} stretches; the estimate uses all."
            notes.warnings.append(text)
        statistics = replace(statistics, residuals=residuals, changes=changes)
        if options.physical:
            clock.enter("physical", 0.95)
            physical = nearest_consistent(model, found.estimate.theta, found.estimate.covariance)
            statistics = replace(statistics, physical=physical)

    clock.enter("verdict", 0.97)
    sign_given = given.friction.sign_smoothing is not None
    reasons = judgement(Judged(prepared, options, ls, found, solution, statistics, support, sign_given), criteria)
    verdict = judge([*notes.reasons, *reasons], setup)
    if verdict.of_kind("excitation"):
        statistics = replace(statistics, essential=statistics.essential & support.supported)
    clock.done()
    statistics = replace(statistics, transitions=transitions)
    return make_result(options, prepared, found, ls, statistics, (verdict, criteria), notes.warnings, clock.spent)


def _prepared(
    robot: RobotConfig, experiments: Sequence[Experiment], signals: Sequence[Derivatives], bandwidth: float
) -> Prepared:
    """Recordings with the model of a configuration; terms that depend on torques get predicted ones."""
    model = arm_model(robot)
    if any(term.depends_on_torque for term in model.terms):
        model = _with_predicted_torques(model, experiments, signals, bandwidth)
    return Prepared(model, experiments, signals)


def _least_squares(
    prepared: Prepared,
    options: Options,
    bandwidth: float,
    moving: NDArray[np.bool_],
    criteria: IdentificationCriteria,
    notes: Notes,
) -> LeastSquares:
    """IDIM-LS (2.3.2); its equations are decimated by the bandwidth, the user's factor, or the noise (6.2.3)."""
    model, experiments = prepared.model, prepared.experiments
    lengths = [e.q.shape[0] for e in experiments]

    def decimation(factor: int | None) -> Decimation:
        dt, rows = experiments[0].dt, least_rows(model)
        return decimation_of(
            "idim-ls",
            dt,
            bandwidth,
            factor,
            samples=lengths,
            rows=rows,
            warnings=notes.warnings,
            reasons=notes.reasons,
        )

    def estimate(blocks: Sequence[ExperimentEquations]) -> Estimate:
        try:
            return idim_ls(blocks, model.base.names, weighted=options.weighted)
        except DataError as error:
            support = examine_support(prepared, blocks, plain, moving, criteria)
            raise DataError(f"{error}; {support.sentence(model, criteria)}. Next: {MOVE}") from error

    # A factor chosen by the user is that of the method; a method with a noise model keeps its own for the comparison.
    factor = options.decimation if isinstance(options.decimation, int) else None
    plain = decimation(None if estimator(options.method).prefiltered else factor)
    published = model.robot.preprocessing
    as_published = has_published_filters(model.robot, options)
    if as_published and published is not None:
        blocks = published_equations(model, experiments, published)
    else:
        blocks = prepared.equations(plain)
    ls = estimate(blocks)
    if options.decimation == "noise":
        factor = _memory_of_noise(prepared, ls.theta, notes.reasons)
        if not estimator(options.method).prefiltered:
            plain = decimation(factor)
            blocks = prepared.equations(plain)
            ls = estimate(blocks)
    return LeastSquares(ls, blocks, plain, factor, as_published)


def has_published_filters(robot: RobotConfig, options: Options) -> bool:
    """True if IDIM-LS uses the filters of a published fit, which takes the torque as recorded."""
    return options.derivatives is None and options.decimation is None and robot.preprocessing is not None


def shifted_experiments(
    experiments: Sequence[Experiment], robot: RobotConfig, options: Options, setup: SetupCheck | None, notes: Notes
) -> Sequence[Experiment]:
    """Experiments with the common shift of the torques that the check of the set-up found; ``notes`` takes a remark."""
    shift = None if setup is None else setup.torque_shift
    if shift is None or not shift.applied or (options.method == "idim-ls" and has_published_filters(robot, options)):
        return experiments
    notes.warnings.append(shift.remark)
    return with_torque_shift(experiments, shift)


def _solve_in_closed_loop(
    prepared: Prepared,
    options: Options,
    ls: LeastSquares,
    bandwidth: float,
    clock: "_Clock",
    notes: Notes,
) -> tuple[Solution, MethodResult]:
    """Controller (5.2), auxiliary closed loop, and the method; a second time if the controller proves unsuitable."""
    experiments, rows = prepared.experiments, least_rows(prepared.model)
    decimation = decimation_of(
        options.method,
        experiments[0].dt,
        bandwidth,
        ls.factor,
        samples=[e.q.shape[0] for e in experiments],
        rows=rows,
        warnings=notes.warnings,
        reasons=notes.reasons,
    )

    def in_loop(loop: ClosedLoop) -> Solution:
        return solve(IdentificationProblem(prepared, loop.auxiliary, loop.start, ls.decimation, options))

    loop = closed_loop(prepared, options, ls.estimate.theta, decimation, bandwidth)
    clock.enter(options.method, 0.5)
    solution = in_loop(loop)
    kind = loop.controller["kind"]
    if estimator(options.method).measured and kind in CONTROLLERS:
        defect = _defect_of_loop(solution, prepared.signals)
        if defect:
            other = closed_loop(prepared, options, ls.estimate.theta, decimation, bandwidth, excluded=kind)
            second = in_loop(other)
            if not _defect_of_loop(second, prepared.signals):
                solution = second
                loop = other._replace(controller=other.controller | {"reason": defect}, warnings=(defect,))
    notes.warnings += [*loop.warnings, *_iterates(solution.estimate.warnings)]
    notes.reasons += [reason for reason in solution.reasons if reason.kind != "residual"]
    return solution, MethodResult(solution.estimate, solution.problem.blocks, loop.controller, solution.noise_of)


def _iterates(warnings: Sequence[str]) -> list[str]:
    """Warnings of an estimator, those of its iterates in one line."""
    if len(warnings) < 2:
        return list(warnings)
    return [f"{len(warnings)} iterates needed correction; the first: {warnings[0]}"]


def _statistics(prepared: Prepared, found: MethodResult, solution: Solution | None) -> Statistics:
    """Essential parameters, tests of the estimate, and the delay of the torques where a reference was recorded."""
    model, estimate = prepared.model, found.estimate
    used = sum(r.size for series in estimate.residuals for r in series)
    essential = essential_parameters(estimate.theta, estimate.covariance, used)
    if solution is None:
        joints = [joint.name for joint in model.robot.joints]
        numbers = tested(found.blocks)
        blocks, part = [found.blocks[k] for k in numbers], residuals_of(estimate, numbers)
        return Statistics(essential, diagnose_estimate(model.base.names, joints, blocks, part, essential=essential))
    diagnostics = solution.diagnostics(essential)
    if found.controller["kind"] not in CONTROLLERS:
        return Statistics(essential, diagnostics, interval_warnings=solution.interval_warnings, bias=solution.bias)
    delay = solution.delay()
    return Statistics(essential, diagnostics, delay, interval_warnings=solution.interval_warnings, bias=solution.bias)


def _defect_of_loop(solution: Solution, signals: Sequence[Derivatives]) -> str:
    """Reason why the instruments of an estimate are unsuitable, as at the edge of stability; empty if suitable."""
    runs = solution.runs
    if runs is None:
        defect = "diverges with"
    elif (error := velocity_error(runs, signals)) >= IdentificationCriteria.max_velocity_error:
        defect = f"misses the measured velocities by {100 * error:.0f} % with"
    elif solution.estimate.converged:
        return ""
    else:
        defect = "does not converge to"
    return f"The loop of the identified controller {defect} the estimated parameters. A stiff PD controller is used."


def _with_predicted_torques(
    model: ArmModel, experiments: Sequence[Experiment], signals: Sequence[Derivatives], bandwidth: float
) -> ArmModel:
    """The model with terms at predicted torques: first by the rigid arm, then by the arm with its terms."""
    rigid = model.without_terms()
    lengths = [e.q.shape[0] for e in experiments]
    decimation = decimation_of("idim-ls", experiments[0].dt, bandwidth, None, samples=lengths, rows=least_rows(model))
    theta = idim_ls(equations(rigid, experiments, signals, decimation), rigid.base.names).theta
    shared = any(term.scales_torque for term in model.terms)
    for _ in range(TORQUE_SHARE_PREDICTIONS if shared else TORQUE_PREDICTIONS):
        model = model.anchored(np.concatenate([theta[: rigid.base.b], np.zeros(model.e)]))
        before, rows = theta[: rigid.base.b], equations(model, experiments, signals, decimation)
        theta = idim_ls(rows, model.base.names).theta
        change = [block.x[..., : rigid.base.b] @ (theta[: rigid.base.b] - before) for block in rows]
        whole = [block.x[..., : rigid.base.b] @ before for block in rows]
        if sum(float(np.sum(c**2)) for c in change) <= PREDICTED**2 * sum(float(np.sum(w**2)) for w in whole):
            break
    return model


def _memory_of_noise(prepared: Prepared, theta: Array, reasons: list[Reason]) -> int:
    """Decimation factor after which the residuals of IDIM-LS at the full rate are hardly correlated (6.2.3)."""
    model = prepared.model
    errors = [
        aligned_torque(e.tau, e.torque_shift)
        - model.inverse_dynamics(theta, s.q, s.qd, s.qdd)
        - model.term_regressor(model.motion(s.q, s.qd, s.qdd, e.dt, e.start)) @ theta[theta.size - model.e :]
        for e, s in zip(prepared.experiments, prepared.signals, strict=True)
    ]
    found = decimation_from_noise(errors)
    if found.bounded:
        message = (
            f"The noise is correlated over more than {found.factor} samples, the limit of the decimation: standard "
            "deviations may be too small"
        )
        reasons.append(Reason("doubtful", message, "use --method idim-piv", kind="uncertainty"))
    return found.factor


def smoothed_derivatives(
    experiments: Sequence[Experiment], robot: RobotConfig, options: Options, bandwidth: float
) -> Sequence[Derivatives]:
    """Smoothed positions of every experiment and their derivatives (5.1); ``bandwidth``: of the closed loop, Hz."""
    resolution = encoder_resolution(robot) if options.nvr == "tracking-error" else None

    def derived(e: Experiment) -> Derivatives:
        name = options.derivatives or "irwsm"
        found = differentiate(e.q, e.dt, name, options.nvr, bandwidth, q_ref=e.q_ref, resolution=resolution)
        return replace(found, start=e.start)

    return kept((derived(e) for e in experiments), like=experiments)


@dataclass
class _Clock:
    """Reports stages and measures their durations, s."""

    report: Progress
    spent: dict[str, float] = field(default_factory=dict)
    _stage: str = ""
    _since: float = 0.0
    _begin: float = field(default_factory=time.perf_counter)

    def enter(self, stage: str, share: float) -> None:
        """End the current stage and begin the next one. ``share``: share of the identification that is done, 0 to 1."""
        self._close()
        self._stage, self._since = stage, time.perf_counter()
        self.report(stage, share)

    def done(self) -> None:
        """End the last stage, and store the total duration."""
        self._close()
        self.spent["total"] = time.perf_counter() - self._begin
        self.report("done", 1.0)

    def _close(self) -> None:
        if self._stage:
            self.spent[self._stage] = time.perf_counter() - self._since


def _check(experiments: Sequence[Experiment], robot: RobotConfig) -> None:
    if not experiments:
        raise DataError("no experiment to identify from")
    for number, e in enumerate(experiments, start=1):
        for name, values in (("position", e.q), ("torque", e.tau), ("reference", e.q_ref)):
            if values is None:
                continue
            if values.ndim != 2 or values.shape != (e.q.shape[0], robot.n):
                raise DataError(
                    f"experiment {number}: {name} has shape {values.shape}, {robot.name} has {robot.n} joints"
                )
            bad = ~np.isfinite(values)
            if bad.any():
                k, j = np.argwhere(bad)[0]
                raise DataError(f"experiment {number}: {name} of {robot.joints[j].name} is not finite at sample {k}")
    check_one_rate(experiments)
