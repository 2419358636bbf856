"""The result documents, ``identification.json`` and ``diagnosis.json``: schema, reading and writing.

`DiagnosisDocument` reads version 1 of ``diagnosis.json`` too and converts it to version 2.
"""

import json
import math
import os
import platform
import tempfile
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from armident import configs
from armident.configs import ConfigError, DataError, RobotConfig
from armident.configs.schema.base import DescribedModel
from armident.daq.recording import Recording

if TYPE_CHECKING:
    from armident.identify.identification.result import Identification

LIBRARIES = ("armident", "numpy", "scipy", "numba")
"""Distributions whose versions a document records."""

T = TypeVar("T", bound=BaseModel)


class Document(DescribedModel):
    """Part of a result document, without unknown keys and without NaN."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=True)


class RecordingReference(Document):
    """Recording that was used.

    Parameters
    ----------
    path
        File; null for a recording in memory.
    sha256
        Digest of the raw samples, hexadecimal.
    sample_rate_hz
        Sampling rate, Hz.
    samples
        Number of rows, one per SYNC.
    """

    path: str | None
    sha256: str
    sample_rate_hz: float
    samples: int


class Parameter(Document):
    """One estimated parameter, SI.

    Parameters
    ----------
    name
        Name of the base parameter, for example ``zz1r``.
    value
        Estimate.
    std
        Standard deviation of the estimate.
    relative_std_pct
        Standard deviation in percent of the value; null where the value is zero.
    unit
        Unit of value and standard deviation.
    essential
        True for an essential parameter (thesis appendix B.2).
    formula
        Standard parameters that a base parameter groups, for example ``my5 - mz6``.
    """

    name: str
    value: float
    std: float
    relative_std_pct: float | None
    unit: str
    essential: bool
    formula: str | None = None


class Whiteness(Document):
    """Residual autocorrelation of a joint.

    Parameters
    ----------
    joint
        Name of the joint.
    lags
        Number of lags that are tested.
    fraction_outside_2sigma
        Fraction of the lags outside two standard deviations; 0.05 for white residuals.
    """

    joint: str
    lags: int
    fraction_outside_2sigma: float


class ResidualStatistics(Document):
    """Statistics of the residuals of a joint, for the comparison with a later run of the same motion.

    Parameters
    ----------
    joint
        Name of the joint.
    position_range
        Lowest and highest position of the free functions, rad or m.
    velocity_limit
        Largest absolute velocity of the free functions, rad/s or m/s.
    score
        Score of the coefficients of free functions of position (two thirds of them) and of velocity.
    information
        Information matrix of these coefficients, estimated beside all parameters.
    band_edges_hz
        Edges of the frequency bands, Hz.
    band_power
        Mean square of the residuals between two edges, (N m)^2 or N^2.
    band_degrees
        Degrees of freedom of each band power.
    """

    joint: str
    position_range: tuple[float, float]
    velocity_limit: float
    score: list[float]
    information: list[list[float]]
    band_edges_hz: list[float]
    band_power: list[float]
    band_degrees: list[float]


class VerdictReason(Document):
    """Defect of an identification.

    Parameters
    ----------
    level
        Verdict that the defect causes.
    kind
        Property that is judged, for example ``convergence`` or ``negative_friction``.
    joint
        Joint with the defect; null if it belongs to the whole robot.
    message
        Defect in one sentence.
    next_step
        Remedy in one sentence.
    """

    level: Literal["doubtful", "unusable"]
    kind: str
    joint: str | None
    message: str
    next_step: str


class Comparison(Document):
    """Estimate of a simpler method from the same data, for comparison.

    Parameters
    ----------
    method
        Name of the method.
    parameters
        Its estimates.
    relative_error_pct
        Its relative torque error, percent.
    """

    method: str
    parameters: list[Parameter]
    relative_error_pct: float | None = None


class IdentificationDocument(Document):
    """Content of ``identification.json``: estimated parameters, their covariance, the data, method and diagnostics.

    Parameters
    ----------
    schema_
        Name and version of the document.
    verdict
        Usability of the parameters by the limits in ``criteria``; null in documents of former versions.
    reasons
        Defects behind the verdict; empty for a trustworthy one.
    robot
        Name of the robot.
    recording
        Recording that was identified.
    method
        Estimator.
    options
        Options of the identification.
    parameters
        Estimated base parameters.
    covariance
        Covariance matrix of the parameters, in their order.
    relative_error_pct
        Norm of the torque error over the norm of the torque, percent.
    relative_error_pct_by_joint
        The same of each joint, percent.
    iterations
        Number of iterations.
    converged
        True if the iterations converged.
    stop_reason
        Reason for which the iterations ended.
    whiteness
        Residual autocorrelation of each joint.
    noise_model
        Noise model of the estimator: kind, and order and coefficients by joint.
    controller
        Controller of the simulated loop: source, gains and quality of its fit.
    timing_s
        Time of each step, s.
    versions
        Versions of Python and of the libraries.
    warnings
        Messages of conversion and estimation.
    comparison
        IDIM-LS estimate from the same data; null if the method is IDIM-LS.
    diagnostics
        Statistical tests of the estimate, with p-values.
    physical
        Nearest physically consistent parameters, where they were asked for.
    torque_delay_samples
        Number of samples by which the torque of each joint leads the position, and its standard
        deviation. A drive that reports the torque that it holds until the next sample has a lead of 0.5.
    further_recordings
        Further recordings that were identified together with the first one.
    bias
        Bias by derivatives, encoder noise and sampling that was subtracted from each parameter; null where it is
        irrelevant.
    sign_smoothing
        ``g`` of each joint's ``sign(qd) -> (2/pi) atan(g qd)``, s/rad or s/m.
    criteria
        Limits of the verdict.
    residual_statistics
        Statistics of the residuals for later comparison; null in documents of former versions.
    configuration
        Robot configuration that the parameters belong to; null in documents of former versions.
    held_out_error_pct
        Torque error where each fifth of the recordings is predicted by least squares from the rest, percent; null where
        the rest does not determine the parameters, and in documents of former versions.
    held_out_error_pct_by_joint
        The same of each joint, percent.
    """

    schema_: Literal["armident/identification/1"] = Field("armident/identification/1", alias="schema")
    verdict: Literal["trustworthy", "doubtful", "unusable"] | None = None
    reasons: list[VerdictReason] = Field(default_factory=list)
    robot: str
    recording: RecordingReference
    method: str
    options: dict[str, Any]
    parameters: list[Parameter]
    covariance: list[list[float]]
    relative_error_pct: float
    relative_error_pct_by_joint: dict[str, float]
    iterations: int
    converged: bool
    stop_reason: str
    whiteness: list[Whiteness]
    noise_model: dict[str, Any]
    controller: dict[str, Any]
    timing_s: dict[str, float]
    versions: dict[str, str]
    warnings: list[str]
    comparison: Comparison | None = None
    diagnostics: dict[str, Any] | None = None
    physical: dict[str, Any] | None = None
    torque_delay_samples: dict[str, list[float]] | None = None
    further_recordings: list[RecordingReference] | None = None
    bias: dict[str, float] | None = None
    sign_smoothing: dict[str, float] | None = None
    criteria: dict[str, float] | None = None
    residual_statistics: list[ResidualStatistics] | None = None
    configuration: dict[str, Any] | None = None
    held_out_error_pct: float | None = None
    held_out_error_pct_by_joint: dict[str, float] | None = None


class Alternative(Document):
    """Another effect in place of a finding.

    Parameters
    ----------
    effect
        Name of the effect.
    joint
        Name of its joint.
    score
        Its gain in log-likelihood, training and held-out data.
    """

    effect: str
    joint: str
    score: float


DERIVATIVE_NOISE = 0.98
"""Ratio of the gap without derivative noise to the gap; below it both are shown."""

Verdict = Literal["no_gap", "explained", "partly_explained", "unexplained"]


class Finding(Document):
    """One effect that the model lacks; gaps are relative torque errors in percent on held-out data.

    Parameters
    ----------
    effect
        Name of the effect; ``unnamed``: a regular torque without a known cause.
    law
        Formula of the effect: empty for the first one of the catalogue, ``table`` for a free shape. For ``unnamed`` the
        variable that the torque depends on.
    joint
        Joint at which it acts.
    other
        Second joint of an effect between two joints.
    kind
        ``structure``: the model lacks a term; ``numbers``: parameters differ from those of the baseline.
    parameters
        Estimated parameters, SI.
    confidence
        Probability that this effect is there, 0 to 1.
    alternatives
        Rivals of the finding, the best first.
    gap_before
        Torque error of the joint without the finding, percent.
    gap_after
        Torque error of the joint with it, percent.
    evidence
        Further figures: standard deviations, share of the error power, p-value of the confirmation.
    """

    effect: str
    law: str = ""
    joint: str
    other: str | None = None
    kind: Literal["structure", "numbers"]
    parameters: dict[str, float]
    confidence: float
    alternatives: list[Alternative]
    gap_before: float
    gap_after: float
    evidence: dict[str, Any]

    @property
    def gap_without_derivative_noise(self) -> float | None:
        """Gap after the finding without derivative noise, percent; ``None`` if this noise makes no difference."""
        without = self.evidence.get("gap_without_derivative_noise")
        return None if without is None or without >= DERIVATIVE_NOISE * self.gap_after else float(without)

    @property
    def rejection(self) -> str:
        """Effect, joint and the reason for the rejection, for the list of rejected effects."""
        better = self.evidence.get("better_unnamed_dependences", [])
        reason = f" (the {' and the '.join(better)} explains more)" if better else ""
        return f"{self.effect.replace('_', ' ')} of {self.joint}{reason}"


class Unexplained(Document):
    """Part of a joint's residual that no effect of the catalogue explains.

    Parameters
    ----------
    joint
        Name of the joint.
    share_of_residual
        Share of the power of the residual, 0 to 1.
    varies_with
        Variable that it depends on.
    hint
        Probable causes.
    """

    joint: str
    share_of_residual: float
    varies_with: str
    hint: str


class Negligible(Document):
    """Effect that is significant and smaller than what counts as a cause; it is not in the model.

    Parameters
    ----------
    effect
        Name of the effect.
    joint
        Name of the joint.
    change_of_torque_pct
        Its torque in percent of that of the joint.
    share_of_residual
        Share of the power of the joint's residual that it removes, 0 to 1.
    """

    effect: str
    joint: str
    change_of_torque_pct: float
    share_of_residual: float


class NotVisible(Document):
    """Effect that these recordings cannot show at a joint at any size.

    Parameters
    ----------
    effect
        Name of the effect.
    joint
        Name of the joint.
    reason
        Reason for which it is invisible.
    required_motion
        Motion that would show it.
    """

    effect: str
    joint: str
    reason: str
    required_motion: str


class DetectionLimit(Document):
    """Smallest size at which an effect at a joint would be detected with a probability of 0.9.

    Parameters
    ----------
    effect
        Name of the effect.
    joint
        Name of the joint.
    other
        Second joint of an effect between two joints.
    limits
        Size of each linear parameter with the others at zero.
    units
        Unit of each.
    """

    effect: str
    joint: str
    other: str | None = None
    limits: dict[str, float]
    units: dict[str, str]


class Gap(Document):
    """Relative torque error.

    Parameters
    ----------
    all
        Of all joints together, percent.
    by_joint
        Of each joint, percent.
    rms
        Root mean square of the torque error of each joint, N m or N.
    """

    all: float
    by_joint: dict[str, float]
    rms: dict[str, float] = Field(default_factory=dict)


class BeforeAfter(Document):
    """Gap of two models.

    Parameters
    ----------
    before
        Gap of the model as configured.
    after
        Gap of the model with the findings added.
    """

    before: Gap
    after: Gap


class Gaps(Document):
    """Gap on both parts of the data.

    Parameters
    ----------
    train
        Gap on the training data.
    validation
        Gap on the held-out data.
    """

    train: BeforeAfter
    validation: BeforeAfter


class DiagnosisDocument(Document):
    """``diagnosis.json``: effects that the model lacks, their share of the torque error, and the unexplained rest.

    Parameters
    ----------
    schema_
        Name and version of the document.
    robot
        Name of the robot.
    recordings
        Recordings that were diagnosed.
    verdict
        Summary of findings and unexplained parts.
    findings
        Effects that the model lacks, those with a name first.
    unexplained
        Parts of the residual that depend on the motion and have no cause.
    gap
        Torque errors before and after the findings.
    noise_floor
        Torque error that noise alone causes.
    recommended_experiment
        Motion or recording that would decide between alternatives.
    model
        Robot configuration with the findings; null if there are none or it was not written.
    timing_s
        Time of each step, s.
    versions
        Versions of Python and of the libraries.
    warnings
        Messages of conversion and diagnosis.
    not_visible
        Effects that these recordings cannot show.
    detection_limits
        Sizes from which effects would be detected.
    simulated
        Errors of the simulated closed loop with both models, percent.
    considered
        Effects that documents of former versions list beside the findings.
    negligible
        Effects below the least change that counts (``--material``).
    sign_smoothing
        ``g`` of each joint's ``sign(qd) -> (2/pi) atan(g qd)``, s/rad or s/m.
    transitions
        Velocity over which the dry friction of a joint reverses, rad/s or m/s, where the data show it.
    criteria
        All thresholds.
    alpha
        Division of the false-alarm rate among the tests.
    """

    schema_: Literal["armident/diagnosis/2"] = Field("armident/diagnosis/2", alias="schema")
    robot: str
    recordings: list[RecordingReference]
    verdict: Verdict
    findings: list[Finding]
    unexplained: list[Unexplained]
    gap: Gaps
    noise_floor: Gap
    recommended_experiment: str | None
    model: str | None
    timing_s: dict[str, float]
    versions: dict[str, str]
    warnings: list[str]
    not_visible: list[NotVisible] = Field(default_factory=list)
    detection_limits: list[DetectionLimit] = Field(default_factory=list)
    simulated: dict[str, dict[str, float]] | None = None
    considered: list[Finding] = Field(default_factory=list)
    negligible: list[Negligible] = Field(default_factory=list)
    sign_smoothing: dict[str, float] | None = None
    transitions: dict[str, float] | None = None
    criteria: dict[str, float] | None = None
    alpha: dict[str, float] | None = None

    @model_validator(mode="before")
    @classmethod
    def _from_version_1(cls, data: Any) -> Any:
        if isinstance(data, Mapping) and data.get("schema") == DIAGNOSIS_1:
            return diagnosis_from_version_1(data)
        return data


DIAGNOSIS_1 = "armident/diagnosis/1"
"""Former schema of ``diagnosis.json``, see ``configs/json_schemas/diagnosis-1.schema.json``."""

EVIDENCE_1 = {
    "says": "description",
    "gap_foretold": "gap_without_derivative_noise",
    "confidence_with_equals": "confidence_with_ambiguous",
    "better_without_name": "better_unnamed_dependences",
    "equally_good": "equally_likely",
}
"""Keys of ``evidence`` in version 1 and their names in version 2."""


def diagnosis_from_version_1(data: Mapping[str, Any]) -> dict[str, Any]:
    """Convert a diagnosis document from version 1 to version 2; only names change.

    Parameters
    ----------
    data
        Content of a ``diagnosis.json`` with the schema ``armident/diagnosis/1``.

    Returns
    -------
    dict
        The same content with the names of ``armident/diagnosis/2``. ``data`` is not changed.
    """

    def renamed(entry: Any, names: Mapping[str, str]) -> Any:
        return {names.get(k, k): v for k, v in entry.items()} if isinstance(entry, Mapping) else entry

    def each(entries: Any, change: Callable[[Any], Any]) -> Any:
        return [change(entry) for entry in entries] if isinstance(entries, list) else entries

    def finding(entry: Any) -> Any:
        if not isinstance(entry, Mapping) or "evidence" not in entry:
            return entry
        return {**entry, "evidence": renamed(entry["evidence"], EVIDENCE_1)}

    def unexplained(entry: Any) -> Any:
        bursts = isinstance(entry, Mapping) and entry.get("varies_with") == "time, in bursts"
        return {**entry, "varies_with": "transients"} if bursts else entry

    changes: dict[str, Callable[[Any], Any]] = {
        "findings": lambda v: each(v, finding),
        "considered": lambda v: each(v, finding),
        "unexplained": lambda v: each(v, unexplained),
        "not_visible": lambda v: each(v, lambda e: renamed(e, {"needs": "required_motion"})),
        "could_hide": lambda v: each(v, lambda e: renamed(e, {"below": "limits"})),
        "simulated": lambda v: renamed(v, {"torque_foretold": "torque_without_derivative_noise"}),
        "schema": lambda _: "armident/diagnosis/2",
    }
    names = {"could_hide": "detection_limits"}
    return {names.get(key, key): changes[key](value) if key in changes else value for key, value in data.items()}


def schema_files() -> dict[str, type[Document]]:
    """Return the documents that have a JSON Schema in ``configs/json_schemas``, by the name of its file."""
    from armident.identify.model_documents import (
        ComparisonDocument,
        PredictionDocument,
        PredictionsDocument,
        SimulationDocument,
    )

    return {
        "identification.schema.json": IdentificationDocument,
        "diagnosis.schema.json": DiagnosisDocument,
        "prediction.schema.json": PredictionDocument,
        "predictions.schema.json": PredictionsDocument,
        "comparison.schema.json": ComparisonDocument,
        "simulation.schema.json": SimulationDocument,
    }


def identification_document(
    result: "Identification", recordings: Sequence[Recording], robot: RobotConfig, notes: Sequence[str] = ()
) -> IdentificationDocument:
    """Return the document of an identification.

    Parameters
    ----------
    result
        Estimates of the base parameters with covariance, residual statistics and timing.
    recordings
        Recordings that they come from.
    robot
        Configuration of the robot, which the document keeps.
    notes
        Messages of the conversion; they precede the estimator's warnings.
    """
    joints = [joint.name for joint in robot.joints]
    essential = np.asarray(result.essential, dtype=bool)
    parameters = [
        parameter(name, value, std, unit, bool(keep), result.formulas.get(name))
        for name, value, std, unit, keep in zip(
            result.names, result.theta, result.std, result.units, essential, strict=True
        )
    ]
    comparison = None
    if result.idim_ls is not None and result.method != "idim-ls":
        theta, std = result.idim_ls
        comparison = Comparison(
            method="idim-ls",
            parameters=[
                parameter(name, value, deviation, unit, bool(keep))
                for name, value, deviation, unit, keep in zip(
                    result.names, theta, std, result.units, essential, strict=True
                )
            ],
        )
    return IdentificationDocument(
        verdict=result.verdict.level,
        reasons=[VerdictReason(**plain(reason)) for reason in result.verdict.reasons],
        robot=robot.name,
        recording=reference(recordings[0]),
        method=result.method,
        options=plain(result.options),
        parameters=parameters,
        covariance=np.asarray(result.covariance, dtype=float).tolist(),
        relative_error_pct=float(result.relative_error_pct),
        relative_error_pct_by_joint=dict(
            zip(joints, (float(v) for v in result.relative_error_pct_by_joint), strict=True)
        ),
        held_out_error_pct=None if result.held_out is None else result.held_out[0],
        held_out_error_pct_by_joint=None
        if result.held_out is None
        else dict(zip(joints, (float(v) for v in result.held_out[1]), strict=True)),
        iterations=int(result.iterations),
        converged=bool(result.converged),
        stop_reason=result.stop_reason,
        whiteness=[Whiteness(**plain(w)) for w in result.whiteness],
        noise_model=plain(result.noise_model),
        controller=plain(result.controller),
        timing_s={k: float(v) for k, v in result.timing_s.items()},
        versions=versions(),
        warnings=[*notes, *result.warnings],
        comparison=comparison,
        diagnostics=result.diagnostics.document(),
        physical=None if result.physical is None else result.physical.document(),
        torque_delay_samples=None
        if result.delay is None
        else {
            name: [float(samples), float(std)]
            for name, samples, std in zip(joints, result.delay.samples, result.delay.std, strict=True)
        },
        further_recordings=[reference(recording) for recording in recordings[1:]] or None,
        bias=None if result.bias is None else dict(zip(result.names, map(float, result.bias), strict=True)),
        sign_smoothing=dict(zip(joints, (float(g) for g in result.sign_smoothing), strict=True)),
        criteria=plain(result.criteria),
        residual_statistics=[ResidualStatistics(**plain(each)) for each in result.residual_statistics] or None,
        configuration=robot.model_dump(mode="json", by_alias=True),
    )


def parameter(name: str, value: float, std: float, unit: str, essential: bool, formula: str | None = None) -> Parameter:
    """Return one parameter with its relative standard deviation in percent, null where that is not finite.

    Parameters
    ----------
    name, value, std, unit
        As in the document, SI.
    essential
        True for an essential parameter.
    formula
        Standard parameters that it groups.
    """
    relative = 100.0 * float(std) / abs(float(value)) if value != 0.0 else None
    if relative is not None and not math.isfinite(relative):
        relative = None
    return Parameter(
        name=name,
        value=float(value),
        std=float(std),
        relative_std_pct=relative,
        unit=unit,
        essential=essential,
        formula=formula,
    )


def reference(recording: Recording) -> RecordingReference:
    """Return the reference to a recording as documents hold it."""
    return RecordingReference(
        path=None if recording.path is None else str(recording.path),
        sha256=recording.sha256,
        sample_rate_hz=recording.sample_rate_hz,
        samples=int(recording.samples.sync.size),
    )


def versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries that determine the numbers."""
    found = {"python": platform.python_version()}
    for library in LIBRARIES:
        try:
            found[library] = metadata.version(library)
        except metadata.PackageNotFoundError:
            continue
    return found


def plain(value: Any) -> Any:
    """Convert to JSON types: lists, dicts, numbers, text; numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


def to_json(document: Document) -> str:
    """Return the JSON text of a document, keys in the order of the schema."""
    return document.model_dump_json(by_alias=True, indent=1) + "\n"


def from_json(text: str, kind: type[T], where: str) -> T:
    """Return the document of a JSON text; older versions are converted.

    Parameters
    ----------
    text
        JSON.
    kind
        Class of the document.
    where
        Source of the text, for messages.

    Raises
    ------
    DataError
        If the text is no such document; the message names ``where``, the key and the expected value.
    """
    try:
        return kind.model_validate(json.loads(text))
    except json.JSONDecodeError as error:
        raise DataError(f"{where}: line {error.lineno}: not valid JSON: {error.msg}") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "document"
        raise DataError(f"{where}: {key}: {first['msg'][0].lower() + first['msg'][1:]}") from error


def load_document(path: Path, kind: type[T]) -> T:
    """Read a document from a file; older versions are converted.

    Parameters
    ----------
    path
        JSON file.
    kind
        Class of the document.

    Raises
    ------
    ConfigError
        If there is no such file.
    DataError
        If the file cannot be read or is not such a document.
    """
    return from_json(_text(path), kind, str(path))


def read_json(path: Path) -> dict[str, Any]:
    """Return the JSON object of a file, for instance to find out the schema of a document.

    Parameters
    ----------
    path
        JSON file.

    Raises
    ------
    ConfigError
        If there is no such file.
    DataError
        If the file cannot be read or is no JSON object.
    """
    try:
        found = json.loads(_text(path))
    except json.JSONDecodeError as error:
        raise DataError(f"{path}: line {error.lineno}: not valid JSON: {error.msg}") from error
    if not isinstance(found, dict):
        raise DataError(f"{path}: expected a JSON object")
    return found


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not a JSON document") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error


def write_atomically(path: Path, text: str) -> None:
    """Write a file so that a reader sees all of it or none of it; missing folders are created.

    Parameters
    ----------
    path
        File to write.
    text
        Its content, written as UTF-8.

    Raises
    ------
    OSError
        If it cannot be written; its file name is ``path``.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        # mkstemp restricts the file to its owner; results are readable like any other file.
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as error:
        Path(temporary).unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from error
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def schema_text(kind: type[Document]) -> str:
    """Return the JSON Schema of a document as it stands in ``configs/json_schemas``."""
    return json.dumps(kind.model_json_schema(by_alias=True), indent=2) + "\n"


def main() -> None:
    """Write the schema files: ``python -m armident.identify.document``."""
    for name, kind in schema_files().items():
        write_atomically(Path(configs.__file__).parent / "json_schemas" / name, schema_text(kind))


if __name__ == "__main__":
    main()
