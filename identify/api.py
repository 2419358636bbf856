"""Identification, diagnosis, comparison and trajectory design, as ``import armident`` offers them."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import yaml
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError, RobotConfig, Trajectory, load_robot
from armident.daq.recording import Recording, read_recording
from armident.identify.documents.base import reference
from armident.identify.documents.diagnosis import DiagnosisDocument
from armident.identify.documents.files import load_document, to_json, write_atomically
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.effects.effect import Effect as Effect
from armident.identify.effects.registry import catalogue
from armident.identify.experiment import Experiment
from armident.identify.identification.api import experiments_of, identify_recording
from armident.identify.identification.from_recording import rest_notes
from armident.identify.identification.options import (
    ControllerName,
    DerivativesName,
    Method,
    NoiseModelName,
    Options,
)
from armident.identify.identification.result import Identification as Estimation
from armident.identify.identification.verdict import Reason
from armident.identify.monitoring.change_test import ParameterChangeTest
from armident.identify.monitoring.change_test import compare as test_parameter_change
from armident.identify.prediction import TorquePrediction, predict_recording
from armident.identify.regression.equations import MAX_AR_ORDER
from armident.identify.report.files import robot_yaml
from armident.identify.saved_model import load_model, model_of
from armident.identify.setup.check import check_setup
from armident.identify.setup.result import SetupCheck
from armident.identify.signals.differentiate import NvrRule
from armident.identify.tables import EffectTable, ParameterTable, Table

if TYPE_CHECKING:
    from armident.identify.diagnosis.diagnose import Diagnosis as DiagnosisResult
    from armident.identify.excitation.design import Design as DesignResult
    from armident.identify.excitation.safety import CheckedTrajectory, SafetyChecks

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]
Robot = RobotConfig | str | Path
Recorded = Recording | str | Path


class _Result(ABC):
    """Result that prints itself, shows itself in a notebook and writes a report."""

    def report(self, path: str | Path) -> Path:
        """Write the report, one HTML file that needs nothing else.

        Parameters
        ----------
        path
            The file to write; its folder is made.

        Returns
        -------
        Path
            The file.
        """
        file = Path(path)
        write_atomically(file, self._html())
        return file

    def __repr__(self) -> str:
        table = self._table()
        return self._summary() if table is None else f"{self._summary()}\n{table}"

    def _repr_html_(self) -> str:
        table = self._table()
        return f"<p>{escape(self._summary())}</p>{'' if table is None else table._repr_html_()}"

    @abstractmethod
    def _html(self) -> str:
        """Return the report."""

    @abstractmethod
    def _summary(self) -> str:
        """Return one line of text."""

    @abstractmethod
    def _table(self) -> Table | None:
        """Return the table below the line, if there is one."""


@dataclass(frozen=True, repr=False)
class Identification(_Result):
    """The dynamic model of a robot identified from recordings; SI units, joint side.

    Parameters
    ----------
    document
        Everything that ``identification.json`` holds.
    robot
        Configuration that the model is of.
    recordings
        The recordings it was identified from.
    result
        The estimate with its curves: residuals, measured and predicted torques.
    """

    document: IdentificationDocument
    robot: RobotConfig
    recordings: tuple[Recording, ...]
    result: Estimation

    @property
    def verdict(self) -> str:
        """``trustworthy``, ``doubtful`` or ``unusable``; an unusable result must not be used."""
        return self.result.verdict.level

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Reasons of the verdict with the next step in words, the most severe first; empty if trustworthy."""
        return self.result.verdict.reasons

    @property
    def parameters(self) -> ParameterTable:
        """Table of the base parameters (b,): ``parameters["zz1r"].value``, ``parameters.to_pandas()``."""
        return ParameterTable(self.document.parameters, f"{self.document.robot}: {self.document.method}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the base parameters, (b,)."""
        return self.result.names

    @property
    def theta(self) -> Array:
        """Values of the base parameters, (b,), each in its unit."""
        return self.result.theta

    @property
    def std(self) -> Array:
        """Standard deviations of the base parameters, (b,), each in its unit."""
        return self.result.std

    @property
    def covariance(self) -> Array:
        """Covariance matrix of the base parameters, (b, b)."""
        return self.result.covariance

    @property
    def relative_error_pct(self) -> float:
        """Norm of the torque residual relative to that of the torque, percent."""
        return self.document.relative_error_pct

    @property
    def warnings(self) -> tuple[str, ...]:
        """Remarks on data and result, one sentence each."""
        return tuple(self.document.warnings)

    def save(self, folder: str | Path) -> tuple[Path, Path]:
        """Write ``identification.json`` and ``report.html``.

        Parameters
        ----------
        folder
            Folder of the files; made if it does not exist.

        Returns
        -------
        tuple of Path
            The document and the report.
        """
        document = Path(folder) / "identification.json"
        write_atomically(document, to_json(self.document))
        return document, self.report(Path(folder) / "report.html")

    def export(
        self, path: str | Path, format: str, *, urdf: str | Path | None = None, nearest: bool = False
    ) -> tuple[Path, ...]:
        """Write the model for a simulator or a controller, with a page of what the format cannot hold.

        Parameters
        ----------
        path
            File, or folder in which the file is named after the robot.
        format
            ``urdf``, ``mjcf``, ``sdf``, ``pinocchio``, or another format that ``armident export-model --help`` lists.
        urdf
            URDF of the arm, whose link frames and names the file takes.
        nearest
            True to accept the nearest physical arm where the estimate differs significantly from every physical one.

        Returns
        -------
        tuple of Path
            Files written, the model first, the page of its limits last.

        Raises
        ------
        ConfigError
            If there is no such format, or the URDF is of another arm.
        DataError
            If the identification is unusable, or no physical arm has these parameters.
        """
        from armident.identify.model_export.exported_model import exported_model
        from armident.identify.model_export.formats import export_model
        from armident.identify.model_export.source_urdf import source_for

        saved = model_of(self.document, Path("identification.json"), self.robot)
        model = exported_model(saved, nearest=nearest)
        if urdf is not None:
            model = model.in_frames_of(source_for(self.robot, Path(urdf)))
        return tuple(export_model(model, format, Path(path))[0])

    def _html(self) -> str:
        from armident.identify.report.identification import identification_report

        return identification_report(self.recordings, self.robot, self.result, self.document)

    def _summary(self) -> str:
        document = self.document
        essential = sum(p.essential for p in document.parameters)
        return (
            f"{document.robot}, {document.method}: torque error {document.relative_error_pct:.2f} %, "
            f"{essential} of {len(document.parameters)} base parameters essential, {self.result.verdict.sentence}"
        )

    def _table(self) -> Table:
        rows = [(p.name, p.value, p.std, p.relative_std_pct, p.unit) for p in self.document.parameters if p.essential]
        return Table(("name", "value", "std", "std %", "unit"), rows)


def identify(
    recordings: Recorded | Sequence[Recorded],
    robot: Robot | None = None,
    *,
    method: Method = "idim-piv",
    derivatives: DerivativesName | None = None,
    controller: ControllerName = "crc",
    nvr: float | NvrRule | None = None,
    noise_model: NoiseModelName = "black-box",
    max_ar_order: int = MAX_AR_ORDER,
    bandwidth_hz: float | None = None,
    decimation: int | Literal["noise"] | None = None,
    weighted: bool = True,
    physical: bool = False,
    progress: Progress | None = None,
) -> Identification:
    """Identify the dynamic model of a robot from one or several recordings.

    Parameters
    ----------
    recordings
        A recording, the path of one, or a sequence of them; all of one robot at one sampling rate.
    robot
        Configuration to use, or the path or shipped name of one; by default the one inside the first recording.
    method
        ``idim-piv`` (thesis section 6.2), ``idim-iv`` (2.3.3), ``idim-ls`` (2.3.1), ``didim``, ``clie``, ``cloe`` or
        ``sep-pem``.
    derivatives
        ``irwsm``, ``irwsm2`` or ``bandpass``; by default IRWSM of order 1 (thesis chapter 5).
    controller
        ``crc`` (impulse response by correlation analysis), ``parametric`` (cascade or PID by refined instrumental
        variables) or ``known`` (gains of the configuration).
    nvr
        Noise-variance ratio of IRWSM, or the rule that finds it: ``automatic``, ``cross-validation``, ``likelihood``,
        ``tracking-error``.
    noise_model
        Noise model of IDIM-PIV: ``black-box`` (thesis 6.27) or ``grey-box`` (6.28).
    max_ar_order
        Highest order of the autoregressive noise models.
    bandwidth_hz
        Closed-loop bandwidth, Hz; by default from the configuration, else from the data.
    decimation
        Keep one sample of so many, or ``noise``: of as many as the noise is correlated over (thesis 6.2.3); by default
        from the bandwidth.
    weighted
        True to weight each joint of IDIM-LS by its noise (thesis 2.23).
    physical
        True to compute the nearest physically consistent parameters, too.
    progress
        Called with the name of a stage and the share done, 0 to 1.

    Returns
    -------
    Identification
        Parameters with standard deviations and covariance, errors, diagnostics.

    Raises
    ------
    ConfigError
        If an option is wrong or a file does not exist.
    DataError
        If the data cannot support the request.

    Examples
    --------
    >>> import armident
    >>> recording = armident.simulate_recording("tx40", "tx40_excitation", seed=1)
    >>> result = armident.identify(recording, method="idim-ls")
    >>> result.theta.shape, result.covariance.shape
    ((61,), (61, 61))
    """
    options = Options(
        method=method,
        derivatives=derivatives,
        controller=controller,
        decimation=decimation,
        nvr=nvr,
        bandwidth_hz=bandwidth_hz,
        noise_model=noise_model,
        max_ar_order=max_ar_order,
        weighted=weighted,
        physical=physical,
    )
    read = _read(recordings)
    config = _robot(robot, read)
    outcome = identify_recording(read, config, options, progress)
    return Identification(outcome.document, outcome.robot, read, outcome.result)


def check(recordings: Recorded | Sequence[Recorded], robot: Robot | None = None) -> SetupCheck:
    """Check signs, order, units, gear ratios, gravity and clocks of recordings against the configuration; seconds.

    Parameters
    ----------
    recordings
        A recording, the path of one, or a sequence of them; all of one robot at one sampling rate.
    robot
        Configuration to check, or the path or shipped name of one; by default the one inside the first recording.

    Returns
    -------
    SetupCheck
        Mistakes with their probability and the line of configuration that corrects each.

    Raises
    ------
    ConfigError
        If a file does not exist or a configuration is wrong.
    DataError
        If the recordings are too short, or their sampling rates differ.

    Examples
    --------
    >>> import armident
    >>> recording = armident.simulate_recording("tx40", "tx40_excitation", seed=1)
    >>> armident.check(recording).findings
    ()
    """
    read = _read(recordings)
    config = _robot(robot, read)
    experiments, _ = experiments_of(read, config, name_files=True)
    return check_setup(experiments, config)


@dataclass(frozen=True, repr=False)
class Diagnosis(_Result):
    """Disagreement of a model with recordings, and the effects that explain it.

    Parameters
    ----------
    document
        Everything that ``diagnosis.json`` holds.
    robot
        The configuration with the effects found added to it; `identify` and `simulate_recording` accept it.
    configured
        The configuration that was judged.
    result
        The findings with their curves.
    """

    document: DiagnosisDocument
    robot: RobotConfig
    configured: RobotConfig
    result: "DiagnosisResult"

    @property
    def verdict(self) -> str:
        """``no_gap``, ``explained``, ``partly_explained`` or ``unexplained``."""
        return self.document.verdict

    @property
    def findings(self) -> Table:
        """Table of the effects found, in the order found; gaps are torque errors in percent on held-out data."""
        rows = [
            (
                finding.effect,
                finding.joint if finding.other is None else f"{finding.joint}, {finding.other}",
                ", ".join(f"{name} {value:.4g}" for name, value in finding.parameters.items()),
                finding.confidence,
                finding.gap_before,
                finding.gap_after,
            )
            for finding in self.document.findings
        ]
        columns = ("effect", "joint", "parameters", "confidence", "gap_before", "gap_after")
        return Table(columns, rows, f"{self.document.robot}: {self.verdict}")

    @property
    def gap_pct(self) -> tuple[float, float]:
        """Torque error on held-out data of the model as configured, and with the findings, percent."""
        gap = self.document.gap.validation
        return gap.before.all, gap.after.all

    def save(self, folder: str | Path) -> DiagnosisDocument:
        """Write ``diagnosis.json``, ``report.html`` and, where effects were found, the new model ``model.yaml``.

        Parameters
        ----------
        folder
            Folder of the files; made if it does not exist.

        Returns
        -------
        DiagnosisDocument
            The document as written, with the path of the model.
        """
        place, document = Path(folder), self.document
        if self.robot != self.configured:
            model = place / "model.yaml"
            write_atomically(model, robot_yaml(self.robot))
            document = document.model_copy(update={"model": str(model)})
        write_atomically(place / "diagnosis.json", to_json(document))
        written = replace(self, document=document)
        written.report(place / "report.html")
        return document

    def _html(self) -> str:
        from armident.identify.report.diagnosis import diagnosis_report

        return diagnosis_report(self.result, self.document)

    def _table(self) -> Table | None:
        return self.findings if self.document.findings else None

    def _summary(self) -> str:
        before, after = self.gap_pct
        return (
            f"{self.document.robot}: {self.verdict}; torque error on held-out data {before:.2f} % before, "
            f"{after:.2f} % after"
        )


def diagnose(
    recordings: Recorded | Sequence[Recorded],
    robot: Robot | None = None,
    *,
    validate: Recorded | None = None,
    baseline: Identification | IdentificationDocument | str | Path | None = None,
    false_alarm_rate: float = 0.01,
    material: float = 0.2,
    time_limit_s: float | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Find the effects that a model lacks: where it disagrees with the data, which effect is missing, what is left.

    Parameters
    ----------
    recordings
        A recording, the path of one, or a sequence of them; the models are fitted to these.
    robot
        Configuration in question, or the path or shipped name of one; by default the one inside the first recording.
    validate
        A recording to judge by; by default the last part of the data is held out.
    baseline
        An identification of the healthy robot; changes of its parameters are judged too.
    false_alarm_rate
        Probability that a diagnosis of a faultless model finds something.
    material
        Least change of a joint's torque by a finding, percent of the root mean square of its torque; effects that
        change less are listed as ``negligible``.
    time_limit_s
        Wall-clock time after which the selection of effects ends with what it has found, s, greater than 0;
        ``None``: without limit. Confirmation and report of these effects take further seconds.
    progress
        Called with the name of a stage and the share done, 0 to 1.

    Returns
    -------
    Diagnosis
        Verdict, findings, gaps before and after, and the configuration with the findings added.

    Raises
    ------
    ConfigError
        If a file does not exist, a configuration is wrong, or the time limit is not greater than 0.
    DataError
        If the recordings cannot support a diagnosis, or the baseline is of another robot.

    Examples
    --------
    >>> import armident
    >>> worn = armident.simulate_recording("tx40", "tx40_excitation", scenario="tx40_worn_joint2", seed=1)
    >>> found = armident.diagnose(worn)
    >>> found.findings[0]["effect"], found.findings[0]["joint"]
    ('asymmetric_viscous_friction', 'joint_2')
    """
    from armident.identify.diagnosis.criteria import Criteria
    from armident.identify.diagnosis.diagnose import diagnose as run

    if time_limit_s is not None and not time_limit_s > 0:
        raise ConfigError(f"--time-limit: expected a time greater than 0 s, found {time_limit_s:g}")
    begin = time.monotonic()
    read = _read(recordings)
    config = _robot(robot, read)
    numbers = None if baseline is None else _document(baseline)
    if numbers is not None and numbers.robot != config.name:
        name = baseline if isinstance(baseline, str | Path) else "baseline"
        raise DataError(f"{name}: the baseline is of robot {numbers.robot!r}, the recording of {config.name!r}")
    training, notes = experiments_of(read, config, name_files=True)
    held_out: Sequence[Experiment] = []
    if validate is not None:
        read = (*read, *_read(validate))
        held_out, more = experiments_of(read[-1:], config, name_files=True)
        notes += more
    notes += rest_notes(training, config)
    criteria = Criteria(false_alarm_rate=false_alarm_rate, material_pct=material)
    references = [reference(recording) for recording in read]
    found = run(
        training,
        held_out,
        config,
        references,
        numbers,
        list(dict.fromkeys(notes)),
        progress,
        criteria,
        None if time_limit_s is None else time_limit_s - (time.monotonic() - begin),
    )
    return Diagnosis(found.document, found.robot, config, found)


@dataclass(frozen=True, repr=False)
class ChangeTest:
    """Test for a change of the parameters between two identifications of one robot.

    Parameters
    ----------
    result
        Differences, standard deviations and p-values of parameters and groups.
    """

    result: ParameterChangeTest

    @property
    def changed(self) -> bool:
        """True if the parameters have changed, at the false-alarm rate asked for."""
        return self.result.drifted

    @property
    def p_value(self) -> float:
        """Probability of so large a difference of all parameters together without a change."""
        return self.result.p_joint

    @property
    def parameters(self) -> Table:
        """Table of the parameters: value before and after, standard deviation of the difference, p-value (Holm)."""
        result = self.result
        rows = [
            (p.name, float(before), p.value, float(std), float(p_value), p.unit)
            for p, before, std, p_value in zip(
                result.parameters, result.before, result.std, result.p_values, strict=True
            )
        ]
        return Table(("name", "before", "after", "std_of_difference", "p_value", "unit"), rows, result.words)

    def __bool__(self) -> bool:
        return self.changed

    def __repr__(self) -> str:
        return self.result.words

    def _repr_html_(self) -> str:
        return self.parameters._repr_html_()


def compare(
    baseline: Identification | IdentificationDocument | str | Path,
    now: Identification | IdentificationDocument | str | Path,
    *,
    false_alarm_rate: float = 1e-4,
) -> ChangeTest:
    """Test if the parameters of a robot have changed since a baseline.

    Parameters
    ----------
    baseline, now
        Two identifications of one robot with the same model, or the paths of their ``identification.json``.
    false_alarm_rate
        Probability of the answer "changed" without a change.

    Returns
    -------
    ChangeTest
        True in a condition if the parameters have changed.

    Raises
    ------
    DataError
        If the two are of different robots or models, or too imprecise for an answer.

    Examples
    --------
    >>> import armident
    >>> runs = [armident.simulate_recording("tx40", "tx40_excitation", seed=seed) for seed in (1, 2)]
    >>> first, second = (armident.identify(run, method="idim-iv") for run in runs)
    >>> bool(armident.compare(first, second))
    False
    """
    return ChangeTest(test_parameter_change(_document(baseline), _document(now), false_alarm_rate))


def predict(
    recording: Recorded,
    model: Identification | str | Path,
    robot: Robot | None = None,
    *,
    progress: Progress | None = None,
) -> TorquePrediction:
    """Predict the torques of a recording with an identified model.

    Parameters
    ----------
    recording
        A recording, or the path of one; best one that the model was not identified from.
    model
        An identification, or the path of ``identification.json``, ``diagnosis.json``, or the folder of one.
    robot
        Configuration of the model, or the path or shipped name of one; by default that of the result.
    progress
        Called with the name of a stage and the share done, 0 to 1.

    Returns
    -------
    TorquePrediction
        Measured and predicted torques (M, n), N m or N, and the ``document`` with the errors.

    Raises
    ------
    ConfigError
        If a file does not exist.
    DataError
        If the model is unusable, or the recording is of another robot or too short.

    Examples
    --------
    >>> import armident
    >>> seen, unseen = (armident.simulate_recording("emps", name, seed=1) for name in ("emps_1", "emps_2"))
    >>> armident.predict(unseen, armident.identify(seen, method="idim-ls")).document.held_out
    True
    """
    (read,) = _read(recording)
    config = None if robot is None else _robot(robot, ())
    if isinstance(model, Identification):
        loaded = model_of(model.document, Path("(in memory)"), config)
    else:
        loaded = load_model(Path(model), config, default=read.robot, progress=progress)
    return predict_recording(read, loaded, progress)


@dataclass(frozen=True, repr=False)
class Design:
    """A reference trajectory and the precision to expect from a recording of it.

    Parameters
    ----------
    checked
        Trajectory with its predicted precision and its checks.
    """

    checked: "CheckedTrajectory"

    @property
    def robot(self) -> RobotConfig:
        """The robot it is for."""
        return self.checked.robot

    @property
    def result(self) -> "DesignResult":
        """Trajectory, condition number, predicted standard deviations and torques."""
        return self.checked.design

    @property
    def checks(self) -> "SafetyChecks":
        """Properties that were checked, with the results (``checked``), and those that were not (``unchecked``)."""
        return self.checked.checks

    @property
    def trajectory(self) -> Trajectory:
        """The reference trajectory, within the limits of the robot."""
        return self.result.trajectory

    @property
    def condition(self) -> float:
        """Condition number of the filtered, weighted base regressor along the trajectory."""
        return self.result.condition

    @property
    def std(self) -> Array | None:
        """Predicted standard deviations of the base parameters, (b,); ``None`` where the torque noise is unknown."""
        return self.result.std

    def save(self, path: str | Path) -> Path:
        """Write the trajectory as a YAML file that ``capture`` and ``robot`` play.

        Parameters
        ----------
        path
            The file to write.

        Returns
        -------
        Path
            The file.
        """
        content = self.trajectory.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        write_atomically(Path(path), yaml.safe_dump(content, sort_keys=False))
        return Path(path)

    def report(self, path: str | Path) -> Path:
        """Write the report, one HTML file that needs nothing else.

        Parameters
        ----------
        path
            The file to write; its folder is made.

        Returns
        -------
        Path
            The file.
        """
        from armident.identify.report.trajectory import trajectory_report

        write_atomically(Path(path), trajectory_report(self.checked))
        return Path(path)

    def __repr__(self) -> str:
        return f"{self.robot.name}: {self.trajectory.duration:.2f} s, condition number {self.condition:.0f}"

    def _repr_html_(self) -> str:
        return f"<p>{escape(repr(self))}</p>"


def design_trajectory(
    robot: Robot,
    duration: float = 7.5,
    *,
    seed: int = 0,
    evaluations: int = 2000,
    shape: Literal["moves", "fourier"] = "moves",
    harmonics: int | None = None,
    known: Identification | IdentificationDocument | str | Path | None = None,
    masses: str | Path | None = None,
    effect: str | None = None,
    joint: str | None = None,
    against: str | None = None,
    progress: Progress | None = None,
) -> Design:
    """Design an exciting trajectory within the limits of a robot (thesis section 2.3.5).

    It keeps the bodies of ``collision`` in the configuration apart. Torques stay within their limits if ``known``,
    ``masses`` or the URDF of the robot has masses.

    Parameters
    ----------
    robot
        Configuration with joint limits, or the path or shipped name of one.
    duration
        Length, s.
    seed
        Seed of the random search; the same seed gives the same trajectory.
    evaluations
        Number of candidates to try.
    shape
        ``moves`` (point to point, trapezoidal velocities) or ``fourier`` (finite Fourier series).
    harmonics
        Number of harmonics of a Fourier series.
    known
        An earlier identification: torques stay within their limits, and the noise weights the joints.
    masses
        JSON file of standard parameters (SI), as ``armident robot --truth`` writes it; used without ``known``.
    effect
        Name of an effect that the trajectory is to show; by default the base parameters count.
    joint
        Joint at which the effect is to show; by default any.
    against
        Another effect from which it is to be distinguished.
    progress
        Called with the name of a stage and the share done, 0 to 1.

    Returns
    -------
    Design
        The trajectory, its condition number and the predicted standard deviations.

    Raises
    ------
    ConfigError
        If the robot cannot make a single move in that time, an option is wrong, or no trajectory keeps all limits.
    DataError
        If ``known`` is of another robot or model, or is not physical.

    Examples
    --------
    >>> import armident
    >>> design = armident.design_trajectory("emps", duration=5.0, evaluations=50)
    >>> round(design.trajectory.duration, 2)
    5.0
    """
    from armident.identify.excitation.design import design_trajectory as run
    from armident.identify.excitation.design import with_objective
    from armident.identify.excitation.previous_estimate import physical_estimate
    from armident.identify.excitation.safety import checked_trajectory, safety_model

    config = _robot(robot, ())
    earlier = None if known is None else physical_estimate(_document(known), config, "known")
    safety = safety_model(
        config,
        None if isinstance(robot, RobotConfig) else robot,
        earlier,
        "known",
        None if masses is None else Path(masses),
    )
    found = run(
        config,
        duration,
        seed,
        noise=None if earlier is None else earlier.noise,
        evaluations=evaluations,
        theta=safety.theta,
        aim=with_objective(config, effect, joint, against, safety.theta),
        shape=shape,
        harmonics=harmonics,
        collision=safety.collision,
        progress=None if progress is None else lambda share: progress("search", share),
    )
    return Design(checked_trajectory(config, found, safety, earlier))


def effects() -> EffectTable:
    """Return the effects that a model can have and a diagnosis looks for.

    Effects of other packages (entry points of group ``armident.effects``) are among them.

    Raises
    ------
    ConfigError
        If the entry point of another package cannot be loaded.

    Examples
    --------
    >>> import armident
    >>> armident.effects()["stribeck_friction"].scope
    'joint'
    """
    return EffectTable(catalogue())


def _read(recordings: Recorded | Sequence[Recorded]) -> tuple[Recording, ...]:
    given = [recordings] if isinstance(recordings, Recording | str | Path) else list(recordings)
    if not given:
        raise ConfigError("no recording was given")
    return tuple(one if isinstance(one, Recording) else read_recording(Path(one)) for one in given)


def _robot(robot: Robot | None, recordings: Sequence[Recording]) -> RobotConfig:
    if robot is None:
        return recordings[0].robot
    return robot if isinstance(robot, RobotConfig) else load_robot(robot, "identify")


def _document(given: Identification | IdentificationDocument | str | Path) -> IdentificationDocument:
    if isinstance(given, Identification):
        return given.document
    if isinstance(given, IdentificationDocument):
        return given
    path = Path(given)
    return load_document(path / "identification.json" if path.is_dir() else path, IdentificationDocument)
