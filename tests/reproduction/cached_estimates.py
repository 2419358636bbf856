"""Cached estimates shared by the tables, obtained by the protocol of the thesis."""

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
from armident.identify.identification.identification_result import relative_torque_errors
from armident.identify.regression.equations import Estimate, ExperimentEquations
from armident.identify.regression.orders import MAX_AR_ORDER
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.simulation import Simulation
from armident.identify.signals.bandpass import butterworth, central_difference
from armident.identify.signals.choices import NvrRule
from armident.identify.signals.decimate import Decimation, design
from armident.identify.signals.differentiate import Derivatives, differentiate, encoder_resolution
from tests.reproduction.gear_ratios import with_gear_ratios
from tests.reproduction.recordings import Recorded
from tests.reproduction.reference import essential_names
from tests.reproduction.subset import restricted_to
from tests.reproduction.tables import Cell, Column, Source

Array = NDArray[np.float64]
T = TypeVar("T")

GOOD_BANDPASS_HZ, GOOD_CUTOFF_HZ = 50.0, 20.0
"""Filters for a known bandwidth of 10 Hz (thesis section B.2): five times and twice the bandwidth."""
PIV_CUTOFF_HZ = 50.0
"""Rough decimation before IDIM-PIV (section 7.2)."""
WHITENING_ORDER = 250
"""Highest AR order tried without decimation; the thesis finds 141 on average (6.3.1)."""
RESPONSE_LENGTHS = (10, 20, 3, 13, 10, 20)
"""Lengths of the impulse responses of the thesis, samples (table 5.12)."""
SLOWEST = 1e-3
"""Joint speed below which a simulation never counts as diverged, rad/s."""

Method = Literal["idim-ls", "idim-iv", "didim", "clie", "cloe", "sep-pem", "idim-piv", "idim-piv, grey box"]
SIMULATED = ("didim", "clie", "cloe", "sep-pem")
"""Methods whose error is that of the simulated torque; for the others that of the inverse model."""


@dataclass(frozen=True)
class Case:
    """Filters and auxiliary simulation of an estimate; the defaults are those of a known bandwidth.

    Parameters
    ----------
    derivatives
        ``bandpass`` (Butterworth at ``bandpass_hz`` and central differences), ``differences`` (without a filter),
        ``irwsm`` or ``irwsm2``.
    nvr
        Noise-variance ratio of the smoother, or the rule that chooses it, see ``differentiate``.
    cutoff_hz
        Cut-off of the parallel filter, Hz, which decimates to twice as many samples per second; ``None``: none.
    encoder_points
        Points per turn to which joint positions are rounded; ``None``: as recorded.
    gear_ratio
        Gear ratios of the simulator over the correct ones.
    controller
        Controller of the simulator: ``actual``, or identified. ``parametric``: of known structure. ``crc``: impulse
        responses with structure and lengths chosen on held-out data. ``cra``: impulse responses as in the thesis, from
        the tracking error alone and with the lengths of table 5.12.
    midway
        Without decimation only: the equations are midway between the samples, at the instants of the recorded torque,
        so that its noise stays white. Otherwise they are at the samples, with the mean of two torques.
    start
        Initial parameters: rotor inertias only (thesis section 4.1.4), or the estimate of IDIM-LS.
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
    """An estimate with its error and cost.

    ``error_pct``: relative torque error on the equations of the estimate, percent: ``|y - X theta| / |y|``;
    ``seconds``: computing time of the estimator without filters, s; ``simulations``: number of closed-loop simulations.
    """

    estimate: Estimate
    error_pct: float
    seconds: float
    simulations: int


@dataclass
class CountingModel(AuxiliaryModel):
    """Auxiliary model that counts its simulations, including those of its ``fresh`` copies."""

    asked: list[int] = field(default_factory=list)
    midway: bool = False

    def instruments(self, theta: Array) -> Sequence[Array]:
        """Return the instruments (N, n, b) per experiment, midway between the samples if ``midway``."""
        zeta = super().instruments(theta)
        return [between(z) for z in zeta] if self.midway else zeta

    def simulate(self, theta: Array, disturbances: Sequence[Array] | None = None) -> Sequence[Simulation] | None:
        """Simulate the closed loop and count the simulation; ``None`` if it diverges.

        ``theta``: base parameters (b,), SI; ``disturbances``: additional motor torques, N m or N, one (N, n) array per
        experiment.
        """
        self.asked.append(1)
        return super().simulate(theta, disturbances)


class Laboratory:
    """One arm with its recording and cached estimates.

    The model has only the 28 essential parameters of the thesis, so that standard deviations are comparable.

    ``recorded``: function that returns the recording; called at first use.
    """

    def __init__(self, recorded: Callable[[], Recorded]) -> None:
        self._recorded = recorded
        self._kept: dict[Hashable, Any] = {}

    def once(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the value of ``make``, computed at the first call with this key.

        ``make``: function without arguments that computes the value.
        """
        if key not in self._kept:
            self._kept[key] = make()
        value: T = self._kept[key]
        return value

    def recording(self, case: Case) -> Recorded:
        """Return the recording of a case."""
        as_recorded = self.once("recording", self._recorded)
        points = case.encoder_points
        if points is None:
            return as_recorded
        return self.once(("recording", points), lambda: as_recorded.coarsened(points))

    @property
    def model(self) -> ArmModel:
        """Model of the arm with the essential parameters."""
        return self.once("model", lambda: restricted_to(arm_model(self.recording(Case()).robot), essential_names()))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters of the model."""
        return self.model.base.names

    @property
    def truth(self) -> Array:
        """True parameters (b,) of the virtual arm."""
        values = self.recording(Case()).truth
        return np.array([values[name] for name in self.names])

    def derivatives(self, case: Case) -> Derivatives:
        """Return positions, velocities and accelerations of a case."""
        recording = self.recording(case)
        key = ("derivatives", case.derivatives, case.bandpass_hz, case.nvr, case.encoder_points)
        return self.once(key, lambda: derive(recording, case))

    def decimation(self, case: Case) -> Decimation:
        """Return the parallel filter of a case."""
        dt = self.recording(case).experiment.dt
        return design(dt, GOOD_CUTOFF_HZ, 1) if case.cutoff_hz is None else design(dt, case.cutoff_hz)

    def equations(self, case: Case) -> Sequence[ExperimentEquations]:
        """Return the filtered equations of a case; not cached, as they are large at 5 kHz."""
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
        """Return the identified controller of a case (thesis section 5.2)."""
        return self.first_stage(case)[0]

    def first_stage(self, case: Case) -> tuple[IdentifiedController, float]:
        """Return the identified controller of a case and its computing time, s."""
        kind, recording = case.controller, self.recording(case)

        def timed() -> tuple[IdentifiedController, float]:
            begin = time.perf_counter()
            found = identify_controller(recording, kind)
            return found, time.perf_counter() - begin

        return self.once(("controller", kind, case.encoder_points), timed)

    def controller(self, case: Case) -> DiscreteController:
        """Return the controller of the simulator."""
        return self.recording(case).controller() if case.controller == "actual" else self.identified(case).controller

    def auxiliary(self, case: Case) -> CountingModel:
        """Return the simulated closed loop of a case."""
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
        return loop if case.gear_ratio == 1.0 else with_gear_ratios(loop, case.gear_ratio)

    def run(self, method: Method, case: Case) -> Run:
        """Return the estimate of a method in a case.

        ``method``: identification method; ``case``: filters and auxiliary simulation.
        """
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
        return Run(estimate, relative_torque_errors(blocks, estimate.theta)[0], seconds, simulations)

    def _iterate(
        self, method: Method, case: Case, blocks: Sequence[ExperimentEquations], auxiliary: AuxiliaryModel
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

    def simulated(self, run: Run, case: Case) -> Sequence[ExperimentEquations]:
        """Return the equations of a case with the regressor simulated with the parameters of a run.

        ``run``: estimate whose parameters are used; ``case``: filters and auxiliary simulation.
        """
        return self.auxiliary(case).equations(self.equations(case), run.estimate.theta)

    def positions(self, case: Case) -> list[Array]:
        """Return measured positions after the parallel filter of a case, (M, n)."""
        return [self.decimation(case)(self.recording(case).experiment.q)]

    def distance(self, theta: Array, std: Array) -> float:
        """Return the RMS error of parameters in given standard deviations.

        An unbiased estimate with these standard deviations has about 1.

        ``theta``: parameters (b,), SI units; ``std``: standard deviations (b,) in the same units.
        """
        return float(np.sqrt(np.mean(((theta - self.truth) / std) ** 2)))

    def column(self, name: str, run: Run, source: Source = "virtual") -> Column:
        """Return the estimates of a run as a column of a table. ``source``: origin of the column."""
        return Column(source, name, estimate_cells(self.names, run.estimate))

    def own(self) -> Column:
        """Return the true parameters of the virtual arm as a column."""
        return Column("arm", "own", {n: Cell(float(v)) for n, v in zip(self.names, self.truth, strict=True)})


def between(x: Array) -> Array:
    """Return means of neighbouring samples along the first axis, (N, ...) to (N - 1, ...)."""
    return np.asarray((x[1:] + x[:-1]) / 2, dtype=np.float64)


def estimate_cells(names: Sequence[str], estimate: Estimate) -> dict[str, Cell]:
    """Return value and relative standard deviation (percent) of every parameter.

    ``names``: names of the parameters, b of them; ``estimate``: estimate of the b parameters.
    """
    percent = 100 * estimate.std / np.maximum(np.abs(estimate.theta), np.finfo(np.float64).tiny)
    return {n: Cell(float(v), float(p)) for n, v, p in zip(names, estimate.theta, percent, strict=True)}


def derive(recording: Recorded, case: Case) -> Derivatives:
    """Return derivatives of the measured positions by the method of a case.

    ``case``: method (``derivatives``) and its settings (``bandpass_hz``, ``nvr``).
    """
    experiment = recording.experiment
    q, dt = experiment.q, experiment.dt
    if case.derivatives in ("irwsm", "irwsm2"):
        resolution = encoder_resolution(recording.robot) if case.nvr == "tracking-error" else None
        return differentiate(q, dt, case.derivatives, case.nvr, q_ref=experiment.q_ref, resolution=resolution)
    smooth = butterworth(q, dt, case.bandpass_hz) if case.derivatives == "bandpass" else q
    qd = central_difference(smooth, dt)
    return Derivatives(smooth, qd, central_difference(qd, dt), None)


def identify_controller(recording: Recorded, kind: str) -> IdentifiedController:
    """Identify the controller from reference, position and torque of each motor (thesis sections 5.2.2, 5.2.3).

    ``kind``: ``parametric``, ``crc`` or ``cra``, see `Case`.
    """
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
