"""Data of a diagnosis: training and held-out stretches of motion, with their torques in one band."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import DataError, RobotConfig
from armident.configs.schema.robot import Effect as Entry
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.regressor_cache import RegressorCache
from armident.identify.diagnosis.stretch import (
    KINDS,
    MotionStretch,
    at_rows,
    distances,
    dragged_joints,
    moving_rows,
    rows_before,
    usual_speeds,
)
from armident.identify.effects.drive import Correction
from armident.identify.effects.friction import TRANSITION
from armident.identify.effects.recording_corrections import corrected_experiments, of_recording
from armident.identify.effects.registry import known
from armident.identify.effects.terms import arm_model, terms_of
from armident.identify.effects.wiring import SignalMistake
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.idim_ls import idim_ls
from armident.identify.identification.auxiliary_loop import closed_loop
from armident.identify.identification.equations import Prepared, equations, least_rows
from armident.identify.identification.options import CONTROLLERS, Options
from armident.identify.identification.sign_smoothing import recorded_speeds, unsaturated_joints, with_sign_smoothing
from armident.identify.identification.solvers import decimation_of
from armident.identify.regression.ar_noise import ar_models
from armident.identify.regression.fir import filter_columns
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.motion import Motion
from armident.identify.robot.simulation import Simulation
from armident.identify.signals.bandwidth import motion_bandwidth
from armident.identify.signals.decimate import Decimation, design
from armident.identify.signals.differentiate import Derivatives, differentiate
from armident.identify.signals.experiments import Experiment, check_one_rate

WORKING_RATE = 20.0
"""Rate at which effects are evaluated, over the frequency up to which model and data are compared: their harmonics up
to the tenth are below half that rate."""
ROUNDS = 4
"""Most simulations of a loop with terms: instruments have to follow the arm, not to solve its equations."""
TOLERATED = 0.05
"""Difference between the torque of the terms and the simulated load that ends these simulations, over the torque of a
joint: less hardly moves an arm under feedback."""
PERTURBATION = 1e-3
"""Noise over the spread of a torque: small enough for a nonlinear correction to be linear."""
NOISE_ORDER = 10
"""Highest order of the autoregressive models of corrected noise: 20 gives the same log likelihood to 1e-6 nats per row,
5 errs by 0.003 for a lag of 15 ms."""
REACH = 16
"""Samples to either side from which torques are interpolated between samples."""
KAISER = 6.0
"""Shape of the window of that interpolation: errors below 0.1 % up to 0.4 times the sampling rate."""


@dataclass(frozen=True)
class Study:
    """Training and held-out stretches of one robot.

    ``decimation``: from the working rate (period ``dt``, s) to that of the comparison; ``thinning``: from the recorded
    to the working rate. ``loop``: kind of controller; ``auxiliary``: that loop with the IDIM-LS estimate. ``sources``:
    training and validation recordings without corrections; ``signals``: derivatives of their positions. ``volume``
    (n,): see `log_volume`. ``references``: see `predictive_score.references_of`; empty before the fit.
    ``sought``: joints at which effects are looked for; ``None``: all. ``tied``: joints the transition of whose dry
    friction has the size of that friction.
    """

    robot: RobotConfig
    model: ArmModel
    decimation: Decimation
    dt: float
    duration: float
    train: tuple[MotionStretch, ...]
    held: tuple[MotionStretch, ...]
    loop: str
    auxiliary: AuxiliaryModel
    thinning: Decimation
    sources: tuple[Sequence[Experiment], Sequence[Experiment]]
    signals: tuple[Derivatives, ...]
    volume: Array
    warnings: tuple[str, ...] = ()
    sign_given: bool = True
    criteria: Criteria = field(default_factory=Criteria)
    regressors: RegressorCache = field(default_factory=RegressorCache, repr=False, compare=False)
    references: tuple[Array | None, ...] = ()
    sought: tuple[int, ...] | None = None
    tied: frozenset[str] = frozenset()

    @property
    def recorded(self) -> tuple[Entry, ...]:
        """Effect entries that correct the recordings."""
        return tuple(entry for entry in self.robot.effects if of_recording(entry))

    def of_robot(self, robot: RobotConfig) -> "Study":
        """The same recordings for another model, corrected again where its effect entries require other corrections.

        Other wiring is another arm. Other torque corrections keep the simulated motion: instruments need not be exact.
        """
        changed = replace(self, robot=robot, model=self.model.with_effects_of(robot, terms_of(robot)))
        if changed.recorded == self.recorded:
            return changed
        wiring = [
            [s for s in study.recorded if isinstance(known(s.effect), SignalMistake)] for study in (self, changed)
        ]
        if wiring[0] == wiring[1]:
            return changed._with_torques(self.sources)
        rebuilt = build_study(*self.sources, robot, criteria=self.criteria)
        rebuilt = rebuilt.with_noise(np.array([s.noise for s in self.train]))
        return replace(rebuilt, sought=self.sought, tied=self.tied)

    def with_torque_shift(self, samples: float) -> "Study":
        """The study with all torques late by another time, samples."""
        training, validation = ([replace(e, torque_shift=samples) for e in part] for part in self.sources)
        return self._with_torques((training, validation))

    def with_noise(self, noise: Array) -> "Study":
        """The study whose training stretches have noise of these sizes beside that of all, (S, n)."""
        return replace(self, train=tuple(s.with_noise(own) for s, own in zip(self.train, noise, strict=True)))

    def with_own_controller(self) -> "Study":
        """The study with the controller that its corrected torques identify, and the loop that this makes."""
        experiments = _continued(corrected_experiments([*self.sources[0], *self.sources[1]], self.robot))
        bandwidth = self.robot.bandwidth_hz or motion_bandwidth([e.q for e in experiments], experiments[0].dt)
        simulated, loop, auxiliary, _ = _simulated(
            self.model, experiments, self.signals, bandwidth, self.auxiliary.anchor
        )
        changed = replace(self, loop=loop, auxiliary=auxiliary)
        motions = dict(enumerate(simulated))
        return replace(changed, train=changed._moved(self.train, motions), held=changed._moved(self.held, motions))

    def _with_torques(self, sources: tuple[Sequence[Experiment], Sequence[Experiment]]) -> "Study":
        """The study with torques of the same motion that were recorded or corrected otherwise."""
        experiments = [*sources[0], *sources[1]]
        torques = [self.thinning(_aligned(e)) for e in corrected_experiments(experiments, self.robot)]

        def of(s: MotionStretch) -> MotionStretch:
            torque = torques[s.experiment][s.span]
            return replace(s, torque=torque, y=self.decimation(torque) * s.weights)

        return replace(
            self, sources=sources, train=tuple(map(of, self.train)), held=tuple(map(of, self.held)),
            volume=log_volume(experiments, self.robot, lambda tau: self.decimation(self.thinning(tau))),
        )  # fmt: skip

    @property
    def sample(self) -> float:
        """Sampling period of the recording, s."""
        return self.dt / self.thinning.factor

    @property
    def joints(self) -> list[str]:
        """Names of the joints."""
        return [joint.name for joint in self.robot.joints]

    def reversing_velocity(self, joint: int) -> float:
        """Return the velocity under which the dry friction of a joint reverses, rad/s or m/s."""
        own = [e for e in self.robot.effects if e.effect == TRANSITION and e.joint == self.joints[joint]]
        widths = [1.0 / float(self.robot.sign_smoothing[joint]), *(e.parameters["velocity"] for e in own)]
        return self.criteria.reversal * max(widths)

    def dragged(self, qd: Array) -> NDArray[np.bool_]:
        """Return true for joints that a motion with velocities ``qd`` (N, n) only drags, (n,)."""
        fastest = np.max([usual_speeds(s.qd) for s in self.signals], axis=0)
        return dragged_joints(usual_speeds(qd), fastest, self.criteria.dragged_speed)

    def motion(self, stretch: MotionStretch, kind: str, theta: Array | None) -> Motion:
        """Signals (``measured`` or ``simulated``) on which effects depend; ``theta`` (b,) predicts their torques."""
        parts: list[Derivatives] = [getattr(stretch, kind)]
        if stretch.before is not None:
            parts.insert(0, stretch.before[KINDS.index(kind)])
        q, qd, qdd = (np.concatenate([getattr(p, name) for p in parts]) for name in ("q", "qd", "qdd"))
        lead = q.shape[0] - parts[-1].q.shape[0]
        return Motion(self.model, q, qd, qdd, self.dt, parts[0].start, theta, self.duration, lead=lead)

    def terms(self, stretch: MotionStretch, kind: str, theta: Array | None) -> Array:
        """Columns (N, n, e) of terms at ``measured`` or ``simulated`` signals; ``theta`` (b,) predicts torques."""
        motion = self.motion(stretch, kind, theta)
        return self.model.term_regressor(motion)[motion.lead :]

    def residual(self, stretch: MotionStretch, theta: Array) -> Array:
        """Torques less those of the model with its terms, at the working rate, (N, n), N m or N."""
        motion, e = stretch.measured, self.model.e
        rigid = self.model.inverse_dynamics(theta, motion.q, motion.qd, motion.qdd)
        return stretch.torque - (rigid + self.terms(stretch, "measured", theta) @ theta[-e:] if e else rigid)

    def resimulated(self, theta: Array) -> "Study":
        """The study with the closed-loop motion of its model at ``theta`` (b,), except experiments held out altogether.

        The same where that loop diverges or follows the arm less closely: it may be too stiff (`robot.relaxation`).
        """
        motions = self._simulated(theta, sorted({s.experiment for s in self.train}))
        if motions is None:
            return self
        train = self._moved(self.train, motions)
        # A stiff nominal controller follows the motion whatever the arm: its loop must only not get much worse.
        bound = distances(self.train).sum() * (1.0 if self.loop in CONTROLLERS else self.criteria.stiff_loop)
        if not distances(train).sum() < bound:
            return self
        return replace(self, train=train, held=self._moved(self.held, motions))

    def with_first_motions(self, theta: Array) -> "Study":
        """The study whose simulations begin with the torques of terms at the motion of its own loop.

        Loops of models with one effect more or less then take one simulation instead of several.
        """
        if self.auxiliary.first_motions is None or not self.model.e:
            return self
        numbers = sorted({s.experiment for s in self.train})
        runs = self._runs(theta, numbers, AuxiliaryModel.rounds)
        if runs is None:
            return self
        motions = list(self.auxiliary.first_motions)
        for k, run in zip(numbers, runs, strict=True):
            motions[k] = replace(motions[k], q=run.q, qd=run.qd, qdd=run.qdd)
        return replace(self, auxiliary=replace(self.auxiliary, first_motions=motions))

    def with_report_part(self, theta: Array) -> "Study":
        """The study with the motion of its loop for the experiments that are held out altogether."""
        trained = {s.experiment for s in self.train}
        numbers = sorted({s.experiment for s in self.held} - trained)
        motions = self._simulated(theta, numbers) if numbers else None
        if motions is None:
            return self
        held = self._moved(self.held, motions)
        bound = self.criteria.stiff_loop * distances(self.held).sum()
        return replace(self, held=held) if distances(held).sum() < bound else self

    def _simulated(self, theta: Array, numbers: Sequence[int]) -> dict[int, Derivatives] | None:
        """Motion of the closed loop with the model of the study by experiment; ``None`` if it diverges."""
        runs = self._runs(theta, numbers)
        if runs is None:
            return None
        measured = {s.experiment: s.measured for s in (*self.train, *self.held)}
        return {k: _seen(run.q, measured[k], self.auxiliary.dt) for k, run in zip(numbers, runs, strict=True)}

    def _runs(self, theta: Array, numbers: Sequence[int], rounds: int = ROUNDS) -> Sequence[Simulation] | None:
        """Simulations of the closed loop with the model of the study by experiment; ``None`` if one diverges."""
        auxiliary = replace(
            self.auxiliary.fresh(), model=self.model.anchored(theta), anchor=None, rounds=rounds, tolerated=TOLERATED
        )
        return auxiliary.of_experiments(numbers).simulate(theta)

    def _moved(
        self, stretches: Sequence[MotionStretch], motions: Mapping[int, Derivatives]
    ) -> tuple[MotionStretch, ...]:
        """Stretches with other simulated motions."""
        dt, factor = self.auxiliary.dt, self.thinning.factor
        return tuple(
            s.resimulated(motions[s.experiment], dt, factor) if s.experiment in motions else s for s in stretches
        )


def build_study(
    training: Sequence[Experiment],
    validation: Sequence[Experiment],
    robot: RobotConfig,
    criteria: Criteria | None = None,
) -> Study:
    """Differentiate, simulate, split and filter the experiments; without ``validation`` their last part is held out."""
    criteria = criteria or Criteria()
    experiments = corrected_experiments([*training, *validation], robot)
    check_one_rate(experiments)
    dt = experiments[0].dt
    experiments = _continued(experiments)
    bandwidth = robot.bandwidth_hz or motion_bandwidth([e.q for e in experiments], dt)
    speeds = recorded_speeds(experiments, bandwidth)
    given, robot = robot, with_sign_smoothing(robot, speeds)
    model = arm_model(robot)
    cutoff = min(criteria.band * bandwidth, 0.25 / dt)
    factor = max(1, int(1.0 / (dt * WORKING_RATE * cutoff)))
    first = design(dt, 0.4 / (dt * factor), factor) if factor > 1 else design(dt, 0.5 / dt, 1)
    second = design(dt * factor, cutoff)
    signals = [replace(differentiate(e.q, dt, bandwidth_hz=bandwidth), start=e.start) for e in experiments]
    simulated, loop, auxiliary, warnings = _simulated(model, experiments, signals, bandwidth)
    warnings += unsaturated_joints(given, robot, speeds)
    slowest = 1.0 / np.asarray(robot.sign_smoothing)
    usual = np.array([usual_speeds(s.qd) for s in signals])
    train: list[MotionStretch] = []
    held: list[MotionStretch] = []
    for k, (e, s, z) in enumerate(zip(experiments, signals, simulated, strict=True)):
        torque = first(_aligned(e))
        kept = first.instants(e.tau.shape[0])
        pieces = [(train if k < len(training) else held, slice(0, None))]
        if not validation:
            cut = int((1 - criteria.held_out_share) * torque.shape[0])
            pieces = [(train, slice(0, cut)), (held, slice(cut, None))]
        for into, span in pieces:
            rows = kept[span]
            y = second(torque[span])
            t = e.start + dt * (rows[0] + factor * second.instants(rows.size))
            earlier = rows_before(kept, rows)
            before = None if earlier.size == 0 else (at_rows(s, earlier, dt, factor), at_rows(z, earlier, dt, factor))
            measured, noiseless = at_rows(s, rows, dt, factor), at_rows(z, rows, dt, factor)
            at = second.instants(rows.size)
            moving = moving_rows(measured.qd, slowest, second.factor, at)
            moving &= ~dragged_joints(usual[k], usual.max(axis=0), criteria.dragged_speed)
            y = np.where(moving, y, 0.0)
            even = np.ones(robot.n)
            into.append(MotionStretch(measured, noiseless, y, torque[span], t, k, rows, span, moving, even, before))
    duration = max(e.start + dt * e.q.shape[0] for e in experiments)
    return Study(
        robot, model, second, dt * factor, duration, tuple(train), tuple(held), loop, auxiliary, first,
        (training, validation), tuple(signals),
        log_volume([*training, *validation], robot, lambda tau: second(first(tau))),
        tuple(warnings), given.friction.sign_smoothing is not None, criteria,
    )  # fmt: skip


def log_volume(experiments: Sequence[Experiment], robot: RobotConfig, band: Callable[[Array], Array]) -> Array:
    """Return the logarithm of the volume by which corrections scale the noise of each joint's torque, per row, (n,).

    It refers likelihoods of corrected torques to the recorded ones: a low-pass correction makes no model better.
    Szegoe's theorem: log ratio of the innovations of white noise with and without the correction.
    """
    if not any(of_recording(e) and isinstance(known(e.effect), Correction) for e in robot.effects):
        return np.zeros(robot.n)
    rng = np.random.default_rng(0)
    noise = [PERTURBATION * e.tau.std(axis=0) * rng.standard_normal(e.tau.shape) for e in experiments]
    disturbed = [replace(e, tau=e.tau + x) for e, x in zip(experiments, noise, strict=True)]
    pairs = zip(corrected_experiments(disturbed, robot), corrected_experiments(experiments, robot), strict=True)
    after = [band(one.tau - other.tau) for one, other in pairs]
    before = [band(x) for x in noise]
    innovations = [[ar.variance for ar in ar_models(part, NOISE_ORDER)] for part in (after, before)]
    return np.asarray(0.5 * np.log(np.array(innovations[0]) / np.array(innovations[1])))


def _aligned(e: Experiment) -> Array:
    """Torques (N, n) at the instants of the positions, N m or N; a held torque belongs half a sample later.

    Windowed-sinc interpolation keeps all frequencies up to Nyquist, unlike the mean of two samples.
    """
    k = np.arange(-REACH, REACH + 1)
    taps = np.sinc(k - (e.torque_shift - 0.5)) * np.kaiser(k.size, KAISER)
    padded = np.pad(e.tau, ((REACH, REACH), (0, 0)), mode="edge")
    return filter_columns(taps[::-1] / taps.sum(), padded)


def _simulated(
    model: ArmModel,
    experiments: Sequence[Experiment],
    signals: Sequence[Derivatives],
    bandwidth: float,
    theta: Array | None = None,
) -> tuple[list[Derivatives], str, AuxiliaryModel, list[str]]:
    """Motion of the simulated closed loop at rigid ``theta`` (b,), by default that of IDIM-LS, one per experiment."""
    dt = experiments[0].dt
    rigid = model.without_terms()
    lengths = [e.q.shape[0] for e in experiments]
    decimation = decimation_of("idim-ls", dt, bandwidth, None, samples=lengths, rows=least_rows(rigid))
    if theta is None:
        theta = idim_ls(equations(rigid, experiments, signals, decimation), rigid.base.names).theta
    prepared = Prepared(rigid, experiments, signals)
    auxiliary, start, description, warnings = closed_loop(
        prepared, Options(method="idim-iv"), theta, decimation, bandwidth
    )
    runs = auxiliary.simulate(start)
    if runs is None:
        raise DataError("the closed loop cannot be simulated with the model as it stands")
    motions = [Derivatives(run.q, run.qd, run.qdd, None, dt, e.start) for run, e in zip(runs, experiments, strict=True)]
    return motions, str(description["kind"]), replace(auxiliary, first_motions=motions), list(warnings)


def _seen(q: Array, measured: Derivatives, dt: float) -> Derivatives:
    """Simulated motion after the smoother of the measured one.

    Set points arrive in steps, which the smoother removes: columns at either should differ by the noise alone.
    """
    assert measured.nvr is not None
    return replace(differentiate(q, dt, nvr=measured.nvr[:, 0]), start=measured.start)


def _continued(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Experiments in absolute time where it is known; each begins at zero where their times overlap."""
    end = 0.0
    for e in experiments:
        if e.start < end:
            return [replace(e, start=0.0) for e in experiments]
        end = e.start + e.dt * e.q.shape[0]
    return list(experiments)
