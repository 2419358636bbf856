"""Every estimate that the tables share, made once and kept: the thesis's protocol in one place."""

import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from armident.identify.controller.crc import IdentifiedController, identify_crc
from armident.identify.controller.nominal import saturation
from armident.identify.controller.parametric import identify_parametric
from armident.identify.effects.terms import arm_model
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.clie import clie
from armident.identify.estimators.cloe import cloe
from armident.identify.estimators.didim import didim
from armident.identify.estimators.idim_iv import idim_iv
from armident.identify.estimators.idim_ls import idim_ls
from armident.identify.estimators.idim_piv import idim_piv
from armident.identify.estimators.sep_pem import sep_pem
from armident.identify.identification.auxiliary_loop import RUNAWAY, initial_parameters
from armident.identify.identification.equations import equations
from armident.identify.identification.result import relative_errors
from armident.identify.regression.equations import MAX_AR_ORDER, Estimate, ExperimentEquations
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.simulation import Simulation
from armident.identify.robot.subset import restricted_to
from armident.identify.signals.bandpass import butterworth, central_difference
from armident.identify.signals.decimate import Decimation, design
from armident.identify.signals.differentiate import Derivatives, NvrRule, differentiate, encoder_resolution
from armident.identify.thesis.recordings import Recorded
from armident.identify.thesis.reference import essential_names
from armident.identify.thesis.tables import Cell, Column, Source

Array = NDArray[np.float64]
T = TypeVar("T")

GOOD_BANDPASS_HZ, GOOD_CUTOFF_HZ = 50.0, 20.0
"""Filters of an arm whose bandwidth, 10 Hz, is known (B.2): five times and twice the bandwidth."""
PIV_CUTOFF_HZ = 50.0
"""Rough decimation before IDIM-PIV (section 7.2)."""
WHITENING_ORDER = 250
"""Highest AR order tried without decimation; the thesis finds 141 on average (6.3.1)."""
RESPONSE_LENGTHS = (10, 20, 3, 13, 10, 20)
"""Of the thesis's impulse responses, samples (table 5.12)."""
SLOWEST = 1e-3
"""Joint speed (rad/s) that never counts as run away."""

Method = Literal["idim-ls", "idim-iv", "didim", "clie", "cloe", "sep-pem", "idim-piv", "idim-piv, grey box"]
SIMULATED = ("didim", "clie", "cloe", "sep-pem")
"""Methods whose error is that of the simulated torque; the others' is that of the inverse model at measured signals."""


@dataclass(frozen=True)
class Case:
    """How a recording is filtered and what simulates beside it; the defaults are those of a well-known arm.

    Parameters
    ----------
    derivatives
        ``bandpass`` (Butterworth at ``bandpass_hz`` and central differences), ``differences`` (nothing before them),
        ``irwsm`` or ``irwsm2``.
    nvr
        Noise-variance ratio of the smoother, or the rule to find it, see ``differentiate``.
    cutoff_hz
        Of the parallel filter, which decimates to twice as many samples per second; ``None``: neither.
    encoder_points
        Points per turn that the recorded joint positions are rounded to; ``None``: they stay as recorded.
    gear_ratio
        Gear ratios of the simulator over the right ones.
    controller
        Of the simulator: the arm's own, or one identified, of known structure (``parametric``) or as impulse responses:
        ``crc`` with structure and lengths by held-out data, ``cra`` as the thesis's are, from the tracking error alone
        and with the lengths of table 5.12.
    midway
        Without decimation only: the equations hold midway between the samples, where the torque as recorded belongs,
        so that its noise stays white. Otherwise they hold at the samples, with the mean of two torques.
    start
        Of the iterations: the rotor inertias and nothing else (4.1.4), or the estimate of IDIM-LS.
    """

    derivatives: Literal["bandpass", "differences", "irwsm", "irwsm2"] = "irwsm"
    bandpass_hz: float = GOOD_BANDPASS_HZ
    nvr: float | NvrRule = "automatic"
    cutoff_hz: float | None = GOOD_CUTOFF_HZ
    encoder_points: int | None = None
    gear_ratio: float = 1.0
    controller: Literal["actual", "crc", "cra", "parametric"] = "actual"
    midway: bool = False
    start: Literal["rotors", "idim-ls"] = "rotors"


@dataclass(frozen=True)
class Run:
    """An estimate with what the tables say about it.

    Parameters
    ----------
    error_pct
        Relative torque error on the equations it was estimated from: ``|y - X theta| / |y|``.
    seconds
        Time the estimator took, filters apart.
    simulations
        Closed-loop simulations it asked for.
    """

    estimate: Estimate
    error_pct: float
    seconds: float
    simulations: int


@dataclass
class CountingModel(AuxiliaryModel):
    """An auxiliary model that counts its simulations, those of its ``fresh`` copies included."""

    asked: list[int] = field(default_factory=list)
    midway: bool = False

    def instruments(self, theta: Array) -> list[Array]:
        """As the auxiliary model does, midway between the samples where that is wanted."""
        zeta = super().instruments(theta)
        return [between(z) for z in zeta] if self.midway else zeta

    def simulate(self, theta: Array) -> list[Simulation] | None:
        """As the auxiliary model does."""
        self.asked.append(1)
        return super().simulate(theta)


class Laboratory:
    """One arm, its recording, and the estimates made of it with the essential parameters of the thesis.

    The model has the 28 essential parameters alone, as the thesis's, so that standard deviations compare.

    Parameters
    ----------
    recorded
        Gives the recording when it is first needed.
    """

    def __init__(self, recorded: Callable[[], Recorded]) -> None:
        self._recorded = recorded
        self._kept: dict[Hashable, Any] = {}

    def once(self, key: Hashable, make: Callable[[], T]) -> T:
        """What ``make`` gives, made at the first call with this key."""
        if key not in self._kept:
            self._kept[key] = make()
        value: T = self._kept[key]
        return value

    def recording(self, case: Case) -> Recorded:
        """The recording of a case."""
        as_recorded = self.once("recording", self._recorded)
        points = case.encoder_points
        if points is None:
            return as_recorded
        return self.once(("recording", points), lambda: as_recorded.coarsened(points))

    @property
    def model(self) -> ArmModel:
        """The arm with its essential parameters."""
        return self.once("model", lambda: restricted_to(arm_model(self.recording(Case()).robot), essential_names()))

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters of the model."""
        return self.model.base.names

    @property
    def truth(self) -> Array:
        """The virtual arm's own parameters (b,)."""
        values = self.recording(Case()).truth
        return np.array([values[name] for name in self.names])

    def derivatives(self, case: Case) -> Derivatives:
        """Positions, velocities and accelerations of a case."""
        recording = self.recording(case)
        key = ("derivatives", case.derivatives, case.bandpass_hz, case.nvr, case.encoder_points)
        return self.once(key, lambda: derive(recording, case))

    def decimation(self, case: Case) -> Decimation:
        """The parallel filter of a case."""
        dt = self.recording(case).experiment.dt
        return design(dt, GOOD_CUTOFF_HZ, 1) if case.cutoff_hz is None else design(dt, case.cutoff_hz)

    def equations(self, case: Case) -> list[ExperimentEquations]:
        """Filtered equations of a case; made anew at each call, since at 5 kHz they are large."""
        experiment = self.recording(case).experiment
        blocks = equations(self.model, [experiment], [self.derivatives(case)], self.decimation(case))
        if not case.midway:
            return blocks
        assert case.cutoff_hz is None
        return [
            ExperimentEquations(experiment.tau[:-1], between(b.x), b.keep[:-1], b.t[:-1] + experiment.dt / 2)
            for b in blocks
        ]

    def identified(self, case: Case) -> IdentifiedController:
        """The identified controller of a case (5.2)."""
        return self.first_stage(case)[0]

    def first_stage(self, case: Case) -> tuple[IdentifiedController, float]:
        """The identified controller of a case, and the seconds that it took."""
        kind, recording = case.controller, self.recording(case)

        def timed() -> tuple[IdentifiedController, float]:
            begin = time.perf_counter()
            found = identify_controller(recording, kind)
            return found, time.perf_counter() - begin

        return self.once(("controller", kind, case.encoder_points), timed)

    def controller(self, case: Case) -> DiscreteController:
        """The simulator's controller."""
        return self.recording(case).controller() if case.controller == "actual" else self.identified(case).controller

    def auxiliary(self, case: Case) -> CountingModel:
        """The simulated closed loop of a case."""
        experiment = self.recording(case).experiment
        assert experiment.q_ref is not None
        motion = self.derivatives(Case("bandpass", encoder_points=case.encoder_points))
        loop = CountingModel(
            model=self.model,
            controller=self.controller(case),
            references=[experiment.q_ref],
            initial=[(motion.q[0], motion.qd[0])],
            dt=experiment.dt,
            decimation=self.decimation(case),
            max_velocity=RUNAWAY * np.abs(motion.qd).max(axis=0) + SLOWEST,
            midway=case.midway,
        )
        return loop if case.gear_ratio == 1.0 else loop.with_gear_ratios(case.gear_ratio)

    def run(self, method: Method, case: Case) -> Run:
        """The estimate of a method in a case."""
        return self.once((method, case), lambda: self._run(method, case))

    def _run(self, method: Method, case: Case) -> Run:
        blocks = self.equations(case)
        auxiliary = None if method == "idim-ls" else self.auxiliary(case)
        begin = time.perf_counter()
        estimate = idim_ls(blocks, self.names) if auxiliary is None else self._iterate(method, case, blocks, auxiliary)
        seconds = time.perf_counter() - begin
        simulations = 0 if auxiliary is None else len(auxiliary.asked)
        if auxiliary is not None and method in SIMULATED:
            blocks = auxiliary.equations(blocks, estimate.theta)
        return Run(estimate, relative_errors(blocks, estimate.theta)[0], seconds, simulations)

    def _iterate(
        self, method: Method, case: Case, blocks: list[ExperimentEquations], auxiliary: AuxiliaryModel
    ) -> Estimate:
        if case.start == "rotors":
            start = initial_parameters(self.model)
        else:
            start = self.run("idim-ls", replace(case, controller="actual", start="rotors")).estimate.theta
        match method:
            case "idim-iv":
                return idim_iv(blocks, auxiliary, start)
            case "didim":
                return didim(blocks, auxiliary, start)
            case "clie":
                return clie(blocks, auxiliary, start)
            case "cloe":
                return cloe(blocks, self.positions(case), auxiliary, start)
            case "sep-pem":
                return sep_pem(blocks, auxiliary, start, max_order=WHITENING_ORDER)
            case "idim-piv" | "idim-piv, grey box":
                first = self.run("idim-iv", replace(case, cutoff_hz=GOOD_CUTOFF_HZ)).estimate.theta
                return idim_piv(blocks, auxiliary, first, max_order=MAX_AR_ORDER, grey_box=method != "idim-piv")
            case _:
                raise ValueError(f"{method} does not iterate")

    def simulated(self, run: Run, case: Case) -> list[ExperimentEquations]:
        """Equations of a case with the regressor simulated with the parameters of a run."""
        return self.auxiliary(case).equations(self.equations(case), run.estimate.theta)

    def positions(self, case: Case) -> list[Array]:
        """Measured positions after the parallel filter of a case, (M, n)."""
        return [self.decimation(case)(self.recording(case).experiment.q)]

    def distance(self, theta: Array, std: Array) -> float:
        """How far from the virtual arm's own parameters: root mean square in the standard deviations given.

        An unbiased estimate with these standard deviations is at about 1.
        """
        return float(np.sqrt(np.mean(((theta - self.truth) / std) ** 2)))

    def column(self, name: str, run: Run, source: Source = "virtual") -> Column:
        """Estimates as a column of a table."""
        return Column(source, name, estimate_cells(self.names, run.estimate))

    def own(self) -> Column:
        """The virtual arm's own parameters as a column."""
        return Column("arm", "own", {n: Cell(float(v)) for n, v in zip(self.names, self.truth, strict=True)})


def between(x: Array) -> Array:
    """Means of neighbouring samples along the first axis, (N, ...) to (N - 1, ...)."""
    return np.asarray((x[1:] + x[:-1]) / 2, dtype=np.float64)


def estimate_cells(names: Sequence[str], estimate: Estimate) -> dict[str, Cell]:
    """Value and relative standard deviation of every parameter."""
    percent = 100 * estimate.std / np.maximum(np.abs(estimate.theta), np.finfo(np.float64).tiny)
    return {n: Cell(float(v), float(p)) for n, v, p in zip(names, estimate.theta, percent, strict=True)}


def derive(recording: Recorded, case: Case) -> Derivatives:
    """Derivatives of the measured positions as a case says."""
    experiment = recording.experiment
    q, dt = experiment.q, experiment.dt
    if case.derivatives in ("irwsm", "irwsm2"):
        resolution = encoder_resolution(recording.robot) if case.nvr == "tracking-error" else None
        return differentiate(q, dt, case.derivatives, case.nvr, q_ref=experiment.q_ref, resolution=resolution)
    smooth = butterworth(q, dt, case.bandpass_hz) if case.derivatives == "bandpass" else q
    qd = central_difference(smooth, dt)
    return Derivatives(smooth, qd, central_difference(qd, dt), None)


def identify_controller(recording: Recorded, kind: str) -> IdentifiedController:
    """The controller from reference, position and torque of each motor, by the kinds of ``Case`` (5.2.2, 5.2.3)."""
    robot, experiment = recording.robot, recording.experiment
    assert experiment.q_ref is not None
    ratios = robot.transmission_matrix
    q, reference = experiment.q @ ratios.T, experiment.q_ref @ ratios.T
    torque = experiment.tau @ np.linalg.inv(ratios)
    signals, limits = ([q], [reference], [torque], experiment.dt), saturation(robot)
    if kind == "parametric":
        return identify_parametric(*signals, saturation=limits)
    if kind == "crc":
        return identify_crc(*signals, saturation=limits)
    return identify_crc(*signals, length=RESPONSE_LENGTHS, velocity_loop=False, saturation=limits)
