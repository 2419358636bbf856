"""Identification of an experiment from beginning to end: what `armident identify` and the worker both call."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from configs import ConfigError, DataError, RobotConfig
from identify.controller.crc import IdentifiedController, identify_crc
from identify.controller.nominal import known_controller, nominal_controller, saturation
from identify.estimators.auxiliary import AuxiliaryModel
from identify.estimators.essential import essential_parameters
from identify.estimators.idim_iv import idim_iv
from identify.estimators.idim_ls import idim_ls
from identify.estimators.idim_piv import MAX_AR_ORDER, idim_piv
from identify.estimators.noise import whiteness
from identify.estimators.regression import Block, Estimate, residuals
from identify.experiment import Experiment
from identify.model.arm import ArmModel
from identify.model.controller import DiscreteController
from identify.preparation import LS_CUTOFF, equations, published_equations
from identify.signals.bandpass import butterworth
from identify.signals.bandwidth import motion_bandwidth
from identify.signals.decimate import Decimation, design
from identify.signals.differentiate import Derivatives, differentiate

Method = Literal["idim-piv", "idim-iv", "idim-ls"]
METHODS: tuple[Method, ...] = ("idim-piv", "idim-iv", "idim-ls")
DERIVATIVES = ("irwsm", "irwsm2", "bandpass")
CONTROLLERS = ("crc", "known")

PIV_CUTOFF = 5.0
"""Cut-off of the rough decimation before IDIM-PIV, in closed-loop bandwidths (thesis section 7.2)."""

RUNAWAY = 3.0
"""A simulated joint that is this many times faster than the measured one ever was has diverged."""

RELEVANT = 0.3
"""Relative velocity error of the auxiliary model below which its instruments are relevant enough."""

CONTRADICTION = 5.0
"""Standard deviations by which IDIM-PIV may differ from IDIM-IV in any parameter before it is disbelieved."""

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Options:
    """What a user may choose; everything has a default that needs no knowledge.

    Parameters
    ----------
    method
        ``idim-piv``, ``idim-iv`` or ``idim-ls``.
    derivatives
        ``irwsm``, ``irwsm2`` or ``bandpass``; ``None``: IRWSM 1, except that IDIM-LS uses the filters of a published
        fit where the robot's configuration has them.
    controller
        ``crc`` identifies it by correlation analysis, ``known`` takes the gains of the configuration.
    decimation
        Keep one sample of so many; ``None``: from the bandwidth.
    nvr
        Noise-variance ratio of the smoother; ``None``: by likelihood.
    bandwidth_hz
        Closed-loop bandwidth; ``None``: from the configuration, else from the data.
    max_ar_order
        Highest order of the noise models of IDIM-PIV.
    """

    method: Method = "idim-piv"
    derivatives: Literal["irwsm", "irwsm2", "bandpass"] | None = None
    controller: Literal["crc", "known"] = "crc"
    decimation: int | None = None
    nvr: float | None = None
    bandwidth_hz: float | None = None
    max_ar_order: int = MAX_AR_ORDER

    def __post_init__(self) -> None:
        """Refuse what is not offered, naming what is."""
        for name, value, offered in (
            ("method", self.method, METHODS),
            ("derivatives", self.derivatives, (None, *DERIVATIVES)),
            ("controller", self.controller, CONTROLLERS),
        ):
            if value not in offered:
                raise ConfigError(f"{name}: {value!r} is not one of {', '.join(str(o) for o in offered if o)}")
        if self.decimation is not None and self.decimation < 1:
            raise ConfigError(f"decimation: expected a number of samples, got {self.decimation}")


@dataclass(frozen=True)
class JointWhiteness:
    """Residual autocorrelation of one joint: share of the lags outside the 2-sigma band (about 0.05 if white)."""

    joint: str
    lags: int
    fraction_outside_2sigma: float


@dataclass(frozen=True)
class Identification:
    """The result of an identification; SI, joint side.

    Parameters
    ----------
    names, units, theta, std, covariance, essential
        Base parameters (b,), their covariance (b, b), and which of them the data need.
    relative_error_pct, relative_error_pct_by_joint
        ``|y - X theta| / |y|`` on the torques decimated to twice the bandwidth, overall and (n,).
    whiteness, residual_autocorrelation, autocorrelation_bound
        Of the residuals that the estimator weighs: test, (n, lags), and 2 sigma (n,).
    idim_ls
        Theta and standard deviations of IDIM-LS on the same data, for comparison.
    t, tau_measured, tau_predicted
        Decimated instants (M,) and torques (M, n), experiments one after the other.
    """

    method: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    theta: Array
    covariance: Array
    std: Array
    essential: NDArray[np.bool_]
    relative_error_pct: float
    relative_error_pct_by_joint: Array
    iterations: int
    converged: bool
    stop_reason: str
    whiteness: tuple[JointWhiteness, ...]
    noise_model: dict[str, Any]
    controller: dict[str, Any]
    timing_s: dict[str, float]
    warnings: tuple[str, ...]
    options: Options
    idim_ls: tuple[Array, Array]
    idim_ls_relative_error_pct: float
    t: Array
    tau_measured: Array
    tau_predicted: Array
    residual_autocorrelation: Array
    autocorrelation_bound: Array


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
    options = options or Options()
    experiments = [experiments] if isinstance(experiments, Experiment) else list(experiments)
    _check(experiments, robot)
    clock = _Clock(progress or (lambda stage, share: None))
    warnings: list[str] = []

    clock.enter("model", 0.0)
    model = ArmModel.from_config(robot)
    dt = experiments[0].dt
    bandwidth = options.bandwidth_hz or robot.bandwidth_hz or motion_bandwidth([e.q for e in experiments], dt)

    clock.enter("derivatives", 0.05)
    method = options.derivatives or "irwsm"
    signals = [differentiate(e.q, dt, method, options.nvr, bandwidth) for e in experiments]

    clock.enter("idim-ls", 0.2)
    factor = options.decimation if options.method != "idim-piv" else None
    ls_decimation = design(dt, _cutoff(dt, LS_CUTOFF * bandwidth, factor), factor)
    if options.derivatives is None and options.decimation is None and robot.preprocessing is not None:
        ls_blocks = published_equations(model, experiments, robot.preprocessing)
    else:
        ls_blocks = equations(model, experiments, signals, ls_decimation)
    ls = idim_ls(ls_blocks, model.base.names)

    controller: dict[str, Any] = {"kind": "none"}
    if options.method == "idim-ls":
        estimate, blocks = ls, ls_blocks
    else:
        clock.enter("controller", 0.35)
        if options.method == "idim-piv":
            decimation = design(dt, _cutoff(dt, PIV_CUTOFF * bandwidth, options.decimation), options.decimation)
        else:
            decimation = ls_decimation
        blocks = equations(model, experiments, signals, decimation)
        auxiliary, start, controller = _auxiliary(
            model, experiments, signals, options, ls.theta, decimation, bandwidth, warnings
        )
        clock.enter(options.method, 0.5)
        if options.method == "idim-iv":
            estimate = idim_iv(blocks, auxiliary, start)
        else:
            plain_blocks = equations(model, experiments, signals, ls_decimation)
            estimate, blocks = _prefiltered(
                blocks, auxiliary, plain_blocks, ls_decimation, start, options, model.base.names, warnings
            )
        warnings += estimate.warnings
        if not estimate.converged:
            warnings.append(f"{options.method} did not converge: {estimate.stop_reason}")

    clock.enter("statistics", 0.9)
    result = _result(options, model, estimate, blocks, ls, ls_blocks, controller, warnings, clock)
    clock.done()
    return result


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


def _cutoff(dt: float, wanted: float, factor: int | None) -> float:
    """Cut-off (Hz) of a decimation: as wanted, or what a factor given by hand leaves."""
    return wanted if factor is None else 0.5 / (dt * factor)


def _prefiltered(
    blocks: list[Block],
    auxiliary: AuxiliaryModel,
    plain_blocks: list[Block],
    plain_decimation: Decimation,
    start: Array,
    options: Options,
    names: Sequence[str],
    warnings: list[str],
) -> tuple[Estimate, list[Block]]:
    """IDIM-PIV, unless the prefilter contradicts IDIM-IV.

    A noise model may move the estimate within its uncertainty only. Where it moves it further, the residual
    is not noise but what the model lacks, and its inverse filter amplifies that (thesis section 6.2.3); then, as in
    SEP-PEM, the dynamic model is estimated without it and it only enters the covariance (6.2.1).
    """
    plain_auxiliary = replace(auxiliary, decimation=plain_decimation, warnings=[])
    plain = idim_iv(plain_blocks, plain_auxiliary, start, serial_order=options.max_ar_order)
    estimate = idim_piv(blocks, auxiliary, plain.theta, max_order=options.max_ar_order)
    shift = np.abs(estimate.theta - plain.theta) / plain.std
    worst = int(np.argmax(shift))
    if shift[worst] <= CONTRADICTION:
        return estimate, blocks
    warnings.append(
        f"the prefilter of idim-piv moves {names[worst]} by {shift[worst]:.0f} standard deviations from "
        "idim-iv: the residuals are model error, not noise; the parameters are those of idim-iv, the noise model only "
        "enters their standard deviations"
    )
    return plain, plain_blocks


def _auxiliary(
    model: ArmModel,
    experiments: Sequence[Experiment],
    signals: Sequence[Derivatives],
    options: Options,
    ls: Array,
    decimation: Decimation,
    bandwidth: float,
    warnings: list[str],
) -> tuple[AuxiliaryModel, Array, dict[str, Any]]:
    """The first closed loop that runs and moves like the robot, the theta it starts from, and what it is."""
    dt = experiments[0].dt
    starts = [("idim-ls", ls), ("initial_parameters", _initial_parameters(model))]
    fastest = RUNAWAY * np.max([np.abs(s.qd).max(axis=0) for s in signals], axis=0) + 1e-3
    surrogate = [butterworth(s.q, dt, min(PIV_CUTOFF * bandwidth, 0.4 / dt)) for s in signals]
    closest: tuple[float, AuxiliaryModel, Array, dict[str, Any]] | None = None
    for controller, references, description in _controllers(
        model, experiments, signals, options, ls, bandwidth, surrogate
    ):
        for origin, start in starts:
            auxiliary = AuxiliaryModel(
                model, controller, references, [(s.q[0], s.qd[0]) for s in signals], dt, decimation, fastest
            )
            runs = auxiliary.simulate(start)
            if runs is None:
                continue
            miss = float(
                np.sqrt(
                    sum(np.sum((r.qd - s.qd) ** 2) for r, s in zip(runs, signals, strict=True))
                    / sum(np.sum(s.qd**2) for s in signals)
                )
            )
            found = description | {"start": origin, "velocity_error_pct": 100 * miss}
            if closest is None or miss < closest[0]:
                closest = (miss, auxiliary, start, found)
            break
        if closest is not None and closest[0] < RELEVANT:
            break
    if closest is None:
        raise DataError("no closed loop could be simulated: it diverges with every controller and start tried")
    _, auxiliary, start, found = closest
    if found["kind"] == "nominal":
        warnings.append(found["reason"])
    return auxiliary, start, found


def _controllers(
    model: ArmModel,
    experiments: Sequence[Experiment],
    signals: Sequence[Derivatives],
    options: Options,
    ls: Array,
    bandwidth: float,
    surrogate: Sequence[Array],
) -> Iterator[tuple[DiscreteController, Sequence[Array], dict[str, Any]]]:
    """Controllers with their references, the preferred one first, a stiff stand-in last."""
    robot, dt = model.robot, experiments[0].dt
    references = [e.q_ref for e in experiments if e.q_ref is not None]
    reason = "no reference trajectory in the recording: instruments from a simulation that follows the smoothed motion"
    if len(references) == len(experiments):
        if options.controller == "known":
            yield known_controller(robot, dt), references, {"kind": "known"}
        else:
            ratios = robot.transmission_matrix
            found = identify_crc(
                [e.q @ ratios.T for e in experiments],
                [r @ ratios.T for r in references],
                [e.tau @ np.linalg.inv(ratios) for e in experiments],
                dt,
                saturation=saturation(robot),
            )
            yield found.controller, references, {"kind": "crc"} | _describe(found, robot)
        reason = "the identified controller does not move the simulated arm like the real one: a stiff stand-in is used"
    stand_in = nominal_controller(
        model, ls, np.concatenate([s.q[:: max(1, s.q.shape[0] // 200)] for s in signals]), dt, bandwidth
    )
    yield stand_in, surrogate, {"kind": "nominal", "reason": reason, "error_taps": stand_in.error_taps.tolist()}


def _describe(found: IdentifiedController, robot: RobotConfig) -> dict[str, Any]:
    return {
        "joints": [
            {
                "joint": joint.name,
                "error_taps": r.error_taps.tolist(),
                "position_taps": r.position_taps.tolist(),
                "prewhitening_order": r.prewhitening_order,
                "fit_pct": r.fit_pct,
            }
            for joint, r in zip(robot.joints, found.responses, strict=True)
        ]
    }


def _initial_parameters(model: ArmModel) -> Array:
    """Base parameters of the configuration's ``initial_parameters`` (standard names), the rest zero."""
    standard = np.zeros(len(model.names))
    for name, value in model.robot.initial_parameters.items():
        if name not in model.names:
            raise ConfigError(f"initial_parameters: {model.robot.name} has no standard parameter {name!r}")
        standard[model.names.index(name)] = value
    theta: Array = model.base.regroup @ standard
    return theta


def _result(
    options: Options,
    model: ArmModel,
    estimate: Estimate,
    blocks: Sequence[Block],
    ls: Estimate,
    ls_blocks: Sequence[Block],
    controller: dict[str, Any],
    warnings: Sequence[str],
    clock: _Clock,
) -> Identification:
    joints = [joint.name for joint in model.robot.joints]
    overall, by_joint = _relative_errors(ls_blocks, estimate.theta)
    tests = [whiteness(series) for series in estimate.residuals]
    used = sum(r.size for series in estimate.residuals for r in series)
    return Identification(
        method=options.method,
        names=model.base.names,
        units=tuple(unit(name, model.robot) for name in model.base.names),
        theta=estimate.theta,
        covariance=estimate.covariance,
        std=estimate.std,
        essential=essential_parameters(estimate.theta, estimate.covariance, used),
        relative_error_pct=overall,
        relative_error_pct_by_joint=by_joint,
        iterations=estimate.iterations,
        converged=estimate.converged,
        stop_reason=estimate.stop_reason,
        whiteness=tuple(
            JointWhiteness(name, test.lags, test.fraction_outside) for name, test in zip(joints, tests, strict=True)
        ),
        noise_model={
            "rate_hz": float(1 / (blocks[0].t[1] - blocks[0].t[0])),
            "joints": [
                {"joint": name, "order": ar.order, "variance": ar.variance, "coefficients": ar.coefficients.tolist()}
                for name, ar in zip(joints, estimate.noise, strict=True)
            ],
        },
        controller=controller,
        timing_s=clock.spent,
        warnings=tuple(dict.fromkeys(warnings)),
        options=options,
        idim_ls=(ls.theta, ls.std),
        idim_ls_relative_error_pct=_relative_errors(ls_blocks, ls.theta)[0],
        t=np.concatenate([b.t for b in ls_blocks]),
        tau_measured=np.concatenate([b.y for b in ls_blocks]),
        tau_predicted=np.concatenate([b.x @ estimate.theta for b in ls_blocks]),
        residual_autocorrelation=np.stack([test.autocorrelation for test in tests]),
        autocorrelation_bound=np.array([test.bound for test in tests]),
    )


def _relative_errors(blocks: Sequence[Block], theta: Array) -> tuple[float, Array]:
    """``|y - X theta| / |y|`` in percent, overall and per joint (n,)."""
    errors = residuals(blocks, theta)
    miss = sum(np.sum(np.where(b.keep, e, 0.0) ** 2, axis=0) for e, b in zip(errors, blocks, strict=True))
    power = sum(np.sum(np.where(b.keep, b.y, 0.0) ** 2, axis=0) for b in blocks)
    return 100 * float(np.sqrt(np.sum(miss) / np.sum(power))), 100 * np.sqrt(miss / np.maximum(power, 1e-300))


UNITS = {"ia": ("kg m^2", "kg"), "fv": ("N m s/rad", "N s/m"), "fc": ("N m", "N"), "of": ("N m", "N")}
"""Of friction, offset and rotor inertia of a revolute and of a prismatic joint, by the first two letters."""


def unit(name: str, robot: RobotConfig) -> str:
    """SI unit of a base parameter, joint side."""
    kind = name[:2]
    if kind in ("mx", "my", "mz"):
        return "kg m"
    if kind in ("xx", "xy", "xz", "yy", "yz", "zz"):
        return "kg m^2"
    if kind not in UNITS:
        return "kg"
    coupled = {c.name: c.joints[0] for c in robot.couplings}
    joints = {str(k): joint for k, joint in enumerate(robot.joints, start=1)}
    joints |= {c: joint for c, first in coupled.items() for joint in robot.joints if joint.name == first}
    joint = joints.get(name.removeprefix("off").removeprefix(kind).removesuffix("r"))
    return UNITS[kind][joint is not None and joint.type == "prismatic"]
