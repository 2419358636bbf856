"""Identification of a model from recordings, and the check of their set-up."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.daq.recording import Recording
from armident.identify.api.arguments import Progress, Recorded, Robot, recordings_of, robot_of
from armident.identify.api.result_base import Result
from armident.identify.api.result_tables import ParameterTable, Table
from armident.identify.documents.files import load_document
from armident.identify.documents.identification import IdentificationDocument, VerdictReason
from armident.identify.estimators.methods import Method
from armident.identify.identification.identification_result import IdentificationResult
from armident.identify.identification.identify_recording import identify_recording
from armident.identify.identification.options import ControllerName, Options
from armident.identify.identification.robot_model import IN_MEMORY, RobotModel
from armident.identify.identification.saved_model import model_of, used_configuration
from armident.identify.signals.choices import DerivativesName


@dataclass(frozen=True, repr=False)
class Identification(Result):
    """The dynamic model of a robot identified from recordings; SI units, joint side.

    Parameters
    ----------
    document
        Everything that ``identification.json`` holds.
    robot
        Configuration that the model is of.
    recordings
        The recordings it was identified from; none if it was read from a file.
    estimate
        Curves of the report: residuals, measured and predicted torques; ``None`` if it was read from a file.
    path
        File that it was read from.

    Examples
    --------
    >>> import armident
    >>> recording = armident.simulate_recording("emps", "emps_excitation", seed=1)
    >>> result = armident.identify(recording, method="idim-ls")
    >>> result.names
    ('m1', 'fv1', 'fc1', 'off1')
    >>> result.model.inverse_dynamics([[0.1]], [[0.0]], [[1.0]]).shape
    (1, 1)
    """

    document: IdentificationDocument
    robot: RobotConfig
    recordings: tuple[Recording, ...] = ()
    estimate: IdentificationResult | None = None
    path: Path = IN_MEMORY
    file = "identification.json"

    @property
    def verdict(self) -> str:
        """``trustworthy``, ``doubtful`` or ``unusable``; an unusable result must not be used."""
        return self.document.verdict or "not judged"

    @property
    def reasons(self) -> tuple[VerdictReason, ...]:
        """Reasons of the verdict with the next step in words, the most severe first; empty if trustworthy."""
        return tuple(self.document.reasons)

    @property
    def parameters(self) -> ParameterTable:
        """Table of the base parameters (b,): ``parameters["zz1r"].value``, ``parameters.to_pandas()``."""
        return ParameterTable(self.document.parameters, f"{self.document.robot}: {self.document.method}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the base parameters, (b,)."""
        return tuple(p.name for p in self.document.parameters)

    @property
    def theta(self) -> Array:
        """Values of the base parameters, (b,), each in its unit."""
        return np.array([p.value for p in self.document.parameters])

    @property
    def std(self) -> Array:
        """Standard deviations of the base parameters, (b,), each in its unit."""
        return np.array([p.std for p in self.document.parameters])

    @property
    def covariance(self) -> Array:
        """Covariance matrix of the base parameters, (b, b)."""
        return np.array(self.document.covariance)

    @property
    def relative_error_pct(self) -> float:
        """Norm of the torque residual relative to that of the torque, percent."""
        return self.document.relative_error_pct

    @property
    def warnings(self) -> tuple[str, ...]:
        """Remarks on data and result, one sentence each."""
        return tuple(self.document.warnings)

    @cached_property
    def model(self) -> RobotModel:
        """The identified model, which knows its parameters: ``result.model.inverse_dynamics(q, qd, qdd)``.

        Raises
        ------
        DataError
            If the identification is unusable.
        """
        return model_of(self.document, self.path, self.robot)

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
        from armident.identify.model_export.verification import motion_of

        model = exported_model(self.model, nearest=nearest)
        if urdf is not None:
            model = model.in_frames_of(source_for(self.robot, Path(urdf)))
        return tuple(export_model(model, format, Path(path), motion_of(model))[0])

    def _html(self) -> str:
        from armident.identify.report.identification_report import identification_report

        return identification_report(self.recordings, self.robot, self.estimate, self.document)

    def _summary(self) -> str:
        document = self.document
        essential = sum(p.essential for p in document.parameters)
        return (
            f"{document.robot}, {document.method}: torque error {document.relative_error_pct:.2f} %, "
            f"{essential} of {len(document.parameters)} base parameters essential, {document.sentence}"
        )

    def _table(self) -> Table:
        rows = [(p.name, p.value, p.std, p.relative_std_pct, p.unit) for p in self.document.parameters if p.essential]
        return Table(("name", "value", "std", "std %", "unit"), rows)


def identify(
    recordings: Recorded | Sequence[Recorded],
    robot: Robot | None = None,
    *,
    method: Method | None = None,
    derivatives: DerivativesName | None = None,
    controller: ControllerName | None = None,
    bandwidth_hz: float | None = None,
    physical: bool | None = None,
    options: Options | None = None,
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
        Estimator, by default ``idim-piv`` (thesis section 6.2); ``armident identify --help`` lists all.
    derivatives
        ``irwsm``, ``irwsm2`` or ``bandpass``; by default IRWSM of order 1 (thesis chapter 5).
    controller
        ``crc`` (impulse response by correlation analysis, the default), ``parametric`` (cascade or PID by refined
        instrumental variables) or ``known`` (gains of the configuration).
    bandwidth_hz
        Closed-loop bandwidth, Hz; by default from the configuration, else from the data.
    physical
        True to compute the nearest physically consistent parameters, too.
    options
        All options, such as ``armident.Options(nvr="likelihood", decimation=20)``; those above replace its own.
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
    >>> recording = armident.simulate_recording("emps", "emps_excitation", seed=1)
    >>> result = armident.identify(recording, method="idim-ls")
    >>> result.theta.shape, result.covariance.shape
    ((4,), (4, 4))
    """
    usual = {
        "method": method,
        "derivatives": derivatives,
        "controller": controller,
        "bandwidth_hz": bandwidth_hz,
        "physical": physical,
    }
    chosen: dict[str, Any] = {name: value for name, value in usual.items() if value is not None}
    every = replace(options or Options(), **chosen)
    read = recordings_of(recordings)
    config = robot_of(robot, read)
    outcome = identify_recording(read, config, every, progress)
    return Identification(outcome.document, outcome.robot, read, outcome.result)


def load_identification(path: str | Path, robot: Robot | None = None) -> Identification:
    """Read the result of an identification, which stands wherever a fresh one does; its report has no curves.

    Parameters
    ----------
    path
        ``identification.json``, or the folder that `Identification.save` wrote.
    robot
        Configuration of the model, or the path or shipped name of one; by default that of the document.

    Returns
    -------
    Identification
        The result as it was saved.

    Raises
    ------
    ConfigError
        If there is no such file, or the document is of a former version and has no configuration.
    DataError
        If the file is no such document, or of another robot.

    Examples
    --------
    >>> import armident, tempfile
    >>> recording = armident.simulate_recording("emps", "emps_excitation", seed=1)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     written = armident.identify(recording, method="idim-ls").save(folder)
    ...     armident.load_identification(folder).names
    ('m1', 'fv1', 'fc1', 'off1')
    """
    document, file = identified(path)
    given = None if robot is None else robot_of(robot, ())
    return Identification(document, used_configuration(document, file, given), path=file)


def identified(given: Identification | IdentificationDocument | str | Path) -> tuple[IdentificationDocument, Path]:
    """Return the document of an identification, or of the file or folder of one, and its file for messages."""
    if isinstance(given, Identification):
        return given.document, given.path
    if isinstance(given, IdentificationDocument):
        return given, IN_MEMORY
    path = Path(given)
    file = path / "identification.json" if path.is_dir() else path
    return load_document(file, IdentificationDocument), file
