"""Identification of an experiment from beginning to end: what `armident identify` and the worker both call."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from armident.configs import DataError, RobotConfig
from armident.identify.effects.recorded import put_right
from armident.identify.effects.terms import arm_model
from armident.identify.estimators.diagnostics import diagnose_estimate
from armident.identify.estimators.essential import essential_parameters
from armident.identify.estimators.idim_ls import idim_ls
from armident.identify.experiment import Experiment
from armident.identify.identification.auxiliary_loop import RELEVANT, closed_loop, velocity_error
from armident.identify.identification.equations import (
    Prepared,
    aligned_torque,
    equations,
    least_rows,
    published_equations,
)
from armident.identify.identification.noise_decimation import decimation_from_noise
from armident.identify.identification.options import CONTROLLERS, Options
from armident.identify.identification.result import Array, Identification, make_result
from armident.identify.identification.solvers import MEASURED, PREFILTERED, Problem, Solution, decimation_of, solve
from armident.identify.identification.torque_delay import HELD, TorqueDelay
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.consistent import nearest_consistent
from armident.identify.signals.bandwidth import motion_bandwidth
from armident.identify.signals.differentiate import Derivatives, differentiate, encoder_resolution

TOLERATED_DELAY = 1.0
"""Samples by which torque and position may be apart without a warning."""

ANCHORINGS = 2
"""Estimates of the arm with its terms before those that depend on its torques are left as they are."""

SHARED = 6
"""Most of them where terms are shares of these torques."""

ANCHORED = 1e-3
"""Change of the torques by which they are predicted, over their size, that ends them."""

Progress = Callable[[str, float], None]


def identify_experiment(
    experiments: Sequence[Experiment] | Experiment,
    robot: RobotConfig,
    options: Options | None = None,
    progress: Progress | None = None,
) -> Identification:
    """Identify the base parameters of a robot.

    The steps are the thesis's: derivatives (5.1), IDIM-LS (2.3.2), controller (5.2), auxiliary closed loop, IDIM-IV
    (2.3.3) or IDIM-PIV (6.2.2). IDIM-LS is always computed: it starts the iterations and stands beside their result.

    Parameters
    ----------
    experiments
        One or more recordings of the same robot at one sampling rate.
    robot
        Its configuration.
    options
        See :class:`Options`.
    progress
        Called with a stage and the share done, 0 to 1.

    Raises
    ------
    ConfigError
        If ``controller='known'`` and the configuration has none.
    DataError
        If the data cannot support the request: too short, not finite, motion that leaves parameters undetermined.
    """
    experiments = [experiments] if isinstance(experiments, Experiment) else list(experiments)
    _check(experiments, robot)
    # The matrices are tall and narrow: threads gain little, wait for each other on a busy machine, and round otherwise.
    with threadpool_limits(1):  # type: ignore[no-untyped-call]
        return _identify(experiments, robot, options or Options(), _Clock(progress or (lambda stage, share: None)))


def _identify(
    experiments: Sequence[Experiment], robot: RobotConfig, options: Options, clock: "_Clock"
) -> Identification:
    warnings: list[str] = []

    clock.enter("model", 0.0)
    experiments = put_right(experiments, robot)
    model = arm_model(robot)
    dt = experiments[0].dt
    bandwidth = options.bandwidth_hz or robot.bandwidth_hz or motion_bandwidth([e.q for e in experiments], dt)

    clock.enter("derivatives", 0.05)
    signals = _derivatives(experiments, robot, options, dt, bandwidth)

    clock.enter("idim-ls", 0.2)
    lengths = [e.q.shape[0] for e in experiments]
    if any(term.depends_on_torque for term in model.terms):
        model = _anchored(model, experiments, signals, bandwidth, lengths)
    decimate = partial(decimation_of, samples=lengths, rows=least_rows(model), warnings=warnings)
    # A factor given by hand is that of the method; a method with a noise model keeps its own for the comparison.
    factor = options.decimation if isinstance(options.decimation, int) else None
    plain = decimate("idim-ls", dt, bandwidth, None if options.method in PREFILTERED else factor)
    prepared = Prepared(model, experiments, signals)
    if options.derivatives is None and options.decimation is None and robot.preprocessing is not None:
        ls_blocks = published_equations(model, experiments, robot.preprocessing)
    else:
        ls_blocks = prepared.equations(plain)
    ls = idim_ls(ls_blocks, model.base.names, weighted=options.weighted)
    if options.decimation == "noise":
        factor = _memory_of_noise(model, experiments, signals, ls.theta, warnings)
        if options.method not in PREFILTERED:
            plain = decimate("idim-ls", dt, bandwidth, factor)
            ls_blocks = prepared.equations(plain)
            ls = idim_ls(ls_blocks, model.base.names, weighted=options.weighted)

    controller: dict[str, Any] = {"kind": "none"}
    if options.method == "idim-ls":
        estimate, blocks, solution = ls, ls_blocks, None
    else:
        clock.enter("controller", 0.35)
        decimation = decimate(options.method, dt, bandwidth, factor)
        loop = partial(closed_loop, model, experiments, signals, options, ls.theta, decimation, bandwidth)
        said: list[str] = []
        auxiliary, start, controller = loop(said)
        clock.enter(options.method, 0.5)
        solution = solve(Problem(prepared, auxiliary, start, plain, options))
        if options.method in MEASURED and controller["kind"] in CONTROLLERS:
            astray = _astray(solution, signals)
            if astray:
                again: list[str] = []
                auxiliary, start, stand_in = loop(again, without=controller["kind"])
                second = solve(Problem(prepared, auxiliary, start, plain, options))
                if not _astray(second, signals):
                    solution, controller, said = second, stand_in | {"reason": astray}, [astray]
        warnings += said
        estimate, blocks = solution.estimate, solution.problem.blocks
        warnings += [*solution.warnings, *estimate.warnings]
        if not estimate.converged:
            warnings.append(f"{options.method} did not converge: {estimate.stop_reason}")

    clock.enter("statistics", 0.85)
    delay: TorqueDelay | None = None
    used = sum(r.size for series in estimate.residuals for r in series)
    essential = essential_parameters(estimate.theta, estimate.covariance, used)
    if solution is None:
        joints = [joint.name for joint in robot.joints]
        diagnostics = diagnose_estimate(model.base.names, joints, blocks, estimate, essential=essential)
    else:
        diagnostics = solution.diagnostics(essential)
        if controller["kind"] in CONTROLLERS:
            delay = solution.delay()
            warnings += _late(delay, robot)
    physical = None
    if options.physical:
        clock.enter("physical", 0.95)
        physical = nearest_consistent(model, estimate.theta, estimate.covariance)
        if not physical.compatible:
            warnings.append(physical.verdict)
    clock.done()
    return make_result(
        options, model, estimate, essential, diagnostics, physical, delay, blocks, ls, ls_blocks, controller,
        "joint torque" if solution is None else solution.noise_of, warnings, clock.spent,
    )  # fmt: skip


def _astray(solution: Solution, signals: Sequence[Derivatives]) -> str:
    """Why the instruments of an estimate are not to be trusted, or nothing.

    A controller can move the arm with the first estimate and, at the edge of stability, not with a later one: the
    iterates then wander, or come to rest where the instruments have little to do with the motion.
    """
    runs = solution.problem.auxiliary.simulate(solution.estimate.theta)
    if runs is None:
        why = "diverges"
    elif (miss := velocity_error(runs, signals)) >= RELEVANT:
        why = f"misses the measured velocities by {100 * miss:.0f} %"
    elif solution.estimate.converged:
        return ""
    else:
        why = "leads to no convergence"
    return f"the loop of the identified controller {why} with the parameters it leads to: a stiff stand-in is used"


def _anchored(
    model: ArmModel,
    experiments: Sequence[Experiment],
    signals: Sequence[Derivatives],
    bandwidth: float,
    lengths: Sequence[int],
) -> ArmModel:
    """The model whose terms predict torques by an estimate: first of the rigid arm, then with the terms in it."""
    rigid = model.without_terms()
    decimation = decimation_of("idim-ls", experiments[0].dt, bandwidth, None, samples=lengths, rows=least_rows(model))
    theta = idim_ls(equations(rigid, experiments, signals, decimation), rigid.base.names).theta
    for _ in range(SHARED if any(term.scales_torque for term in model.terms) else ANCHORINGS):
        model = model.anchored(np.concatenate([theta[: rigid.base.b], np.zeros(model.e)]))
        before, rows = theta[: rigid.base.b], equations(model, experiments, signals, decimation)
        theta = idim_ls(rows, model.base.names).theta
        change = [block.x[..., : rigid.base.b] @ (theta[: rigid.base.b] - before) for block in rows]
        whole = [block.x[..., : rigid.base.b] @ before for block in rows]
        if sum(float(np.sum(c**2)) for c in change) <= ANCHORED**2 * sum(float(np.sum(w**2)) for w in whole):
            break
    return model


def _memory_of_noise(
    model: ArmModel,
    experiments: Sequence[Experiment],
    signals: Sequence[Derivatives],
    theta: Array,
    warnings: list[str],
) -> int:
    """The decimation after which the noise that IDIM-LS leaves at the full rate is hardly correlated."""
    left = [
        aligned_torque(e.tau)
        - model.inverse_dynamics(theta, s.q, s.qd, s.qdd)
        - model.term_regressor(model.motion(s.q, s.qd, s.qdd, e.dt, e.start)) @ theta[theta.size - model.e :]
        for e, s in zip(experiments, signals, strict=True)
    ]
    found = decimation_from_noise(left)
    if found.bounded:
        warnings.append(f"the noise may remember more than the {found.factor} samples that the decimation was set to")
    return found.factor


def _late(delay: TorqueDelay | None, robot: RobotConfig) -> list[str]:
    """A warning for every joint whose torque is recorded more than a sample off the position it belongs to."""
    if delay is None:
        return []
    off = delay.contradicts() & (np.abs(delay.samples - HELD) > TOLERATED_DELAY)
    return [
        f"{joint.name}: the torque belongs to the position {samples:.1f} +- {std:.1f} samples later, expected is {HELD}"
        for joint, samples, std, wrong in zip(robot.joints, delay.samples, delay.std, off, strict=True)
        if wrong
    ]


def _derivatives(
    experiments: Sequence[Experiment], robot: RobotConfig, options: Options, dt: float, bandwidth: float
) -> list[Derivatives]:
    resolution = encoder_resolution(robot) if options.nvr == "tracking-error" else None
    return [
        replace(
            differentiate(
                e.q, dt, options.derivatives or "irwsm", options.nvr, bandwidth, q_ref=e.q_ref, resolution=resolution
            ),
            start=e.start,
        )
        for e in experiments
    ]


@dataclass
class _Clock:
    """Reports stages and how long each took."""

    report: Progress
    spent: dict[str, float] = field(default_factory=dict)
    _stage: str = ""
    _since: float = 0.0
    _begin: float = field(default_factory=time.perf_counter)

    def enter(self, stage: str, share: float) -> None:
        self._close()
        self._stage, self._since = stage, time.perf_counter()
        self.report(stage, share)

    def done(self) -> None:
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
        if e.dt != experiments[0].dt:
            raise DataError("the experiments have different sampling rates")
