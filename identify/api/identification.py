"""Identification of a model from recordings, and the check of their set-up."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig
from armident.daq.recording import Recording
from armident.identify.api.arguments import Progress, Recorded, Robot, recordings_of, robot_of
from armident.identify.api.result import Result
from armident.identify.documents.files import load_document, to_json, write_atomically
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.estimators.methods import Method
from armident.identify.estimators.reason import Reason
from armident.identify.identification.identification_result import IdentificationResult as Estimation
from armident.identify.identification.identify_recording import experiments_of, identify_recording
from armident.identify.identification.options import ControllerName, NoiseModelName, Options
from armident.identify.regression.orders import MAX_AR_ORDER
from armident.identify.saved_model import model_of
from armident.identify.setup.check import check_setup
from armident.identify.setup.result import SetupCheck
from armident.identify.signals.choices import DerivativesName, NvrRule
from armident.identify.tables import ParameterTable, Table

Array = NDArray[np.float64]


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
    read = recordings_of(recordings)
    config = robot_of(robot, read)
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
    read = recordings_of(recordings)
    config = robot_of(robot, read)
    experiments, _ = experiments_of(read, config, name_files=True)
    return check_setup(experiments, config)


def document_of(given: Identification | IdentificationDocument | str | Path) -> IdentificationDocument:
    """Return the document of an identification.

    Parameters
    ----------
    given
        An identification, its document, or the path of ``identification.json`` or of its folder.

    Raises
    ------
    ConfigError
        If there is no such file.
    DataError
        If the file is no such document.
    """
    if isinstance(given, Identification):
        return given.document
    if isinstance(given, IdentificationDocument):
        return given
    path = Path(given)
    return load_document(path / "identification.json" if path.is_dir() else path, IdentificationDocument)
