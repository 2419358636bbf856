"""The result documents, ``identification.json`` and ``diagnosis.json``: schema, reading and writing."""

import json
import math
import os
import platform
import tempfile
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from armident import configs
from armident.configs import ConfigError, DataError, RobotConfig
from armident.daq.recording import Recording

if TYPE_CHECKING:
    from armident.identify.identification.result import Identification

LIBRARIES = ("armident", "numpy", "scipy", "numba")
T = TypeVar("T", bound=BaseModel)


class Document(BaseModel):
    """A part of a result document: no unknown keys, no NaN."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=True)


class RecordingReference(Document):
    """Which recording the numbers come from; ``samples`` counts rows (one per SYNC)."""

    path: str | None
    sha256: str
    sample_rate_hz: float
    samples: int


class Parameter(Document):
    """One estimated parameter, SI; ``relative_std_pct`` is null where the value is zero.

    ``formula`` is the parameter in standard ones, where several act as one: ``my5 - mz6``.
    """

    name: str
    value: float
    std: float
    relative_std_pct: float | None
    unit: str
    essential: bool
    formula: str | None = None


class Whiteness(Document):
    """Autocorrelation of a joint's residual: the share of ``lags`` outside two standard deviations."""

    joint: str
    lags: int
    fraction_outside_2sigma: float


class Comparison(Document):
    """The estimate of a simpler method from the same data, beside the result."""

    method: str
    parameters: list[Parameter]
    relative_error_pct: float | None = None


class IdentificationDocument(Document):
    """``identification.json``: what was identified, from what, how, and how well.

    ``torque_delay_samples`` has, per joint, by how many samples the torque runs ahead of the position (0.5 if the drive
    reports the torque it holds), and the standard deviation.
    """

    schema_: Literal["armident/identification/1"] = Field("armident/identification/1", alias="schema")
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


class Alternative(Document):
    """A competitor of a finding; ``score`` is its gain in held-out log-likelihood."""

    effect: str
    joint: str
    score: float


Verdict = Literal["no_gap", "explained", "partly_explained", "unexplained"]


class Finding(Document):
    """One missing effect; gaps are relative torque errors in percent on held-out data."""

    effect: str
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
    def doubt(self) -> str:
        """Its name and place, and what without a name explains more, for a list of those that did not convince."""
        better = self.evidence.get("better_without_name", [])
        reason = f" (the {' and the '.join(better)} explains more)" if better else ""
        return f"{self.effect.replace('_', ' ')} of {self.joint}{reason}"


class Unexplained(Document):
    """What no effect of the catalogue explains, and what it varies with."""

    joint: str
    share_of_residual: float
    varies_with: str
    hint: str


class Invisible(Document):
    """An effect of the catalogue that these recordings cannot show at a joint, whatever its size."""

    effect: str
    joint: str
    reason: str
    needs: str


class Hideable(Document):
    """An effect that could be in the arm without showing in these recordings, up to a size.

    ``below`` holds, for each parameter by itself, the size from which on nine diagnoses of ten would have found it.
    """

    effect: str
    joint: str
    other: str | None = None
    below: dict[str, float]
    units: dict[str, str]


class Gap(Document):
    """Relative torque error in percent, of all joints together and of each; ``rms`` is that of each in N m or N."""

    all: float
    by_joint: dict[str, float]
    rms: dict[str, float] = {}


class BeforeAfter(Document):
    """A gap of the model as configured, and with what was found added."""

    before: Gap
    after: Gap


class Gaps(Document):
    """The gap on the data the models were fitted to, and on data they have not seen."""

    train: BeforeAfter
    validation: BeforeAfter


class DiagnosisDocument(Document):
    """``diagnosis.json``: where model and data disagree, what is missing, and what stays unexplained.

    ``considered`` are effects that passed the tests and did not convince in the end; they are not in the model.
    """

    schema_: Literal["armident/diagnosis/1"] = Field("armident/diagnosis/1", alias="schema")
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
    not_visible: list[Invisible] = []
    could_hide: list[Hideable] = []
    simulated: dict[str, dict[str, float]] | None = None
    considered: list[Finding] = []


SCHEMA_FILES: dict[str, type[Document]] = {
    "identification.schema.json": IdentificationDocument,
    "diagnosis.schema.json": DiagnosisDocument,
}


def identification_document(
    result: "Identification", recording: Recording, robot: RobotConfig, notes: Sequence[str] = ()
) -> IdentificationDocument:
    """The document of an identification; ``notes`` of the conversion come before the estimator's warnings."""
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
        robot=robot.name,
        recording=reference(recording),
        method=result.method,
        options=plain(result.options),
        parameters=parameters,
        covariance=np.asarray(result.covariance, dtype=float).tolist(),
        relative_error_pct=float(result.relative_error_pct),
        relative_error_pct_by_joint=dict(
            zip(joints, (float(v) for v in result.relative_error_pct_by_joint), strict=True)
        ),
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
    )


def parameter(name: str, value: float, std: float, unit: str, essential: bool, formula: str | None = None) -> Parameter:
    """One parameter with its relative standard deviation in percent."""
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
    """How a document refers to a recording."""
    return RecordingReference(
        path=None if recording.path is None else str(recording.path),
        sha256=recording.sha256,
        sample_rate_hz=recording.sample_rate_hz,
        samples=int(recording.samples.sync.size),
    )


def versions() -> dict[str, str]:
    """Versions of whatever the numbers depend on."""
    found = {"python": platform.python_version()}
    for library in LIBRARIES:
        try:
            found[library] = metadata.version(library)
        except metadata.PackageNotFoundError:
            continue
    return found


def plain(value: Any) -> Any:
    """The same in what JSON knows: lists, dicts, numbers, text; numbers that are not finite become null."""
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
    """JSON text of a document, keys in the order of the schema."""
    return document.model_dump_json(by_alias=True, indent=1) + "\n"


def from_json(text: str, kind: type[T], where: str) -> T:
    """A document from its JSON text.

    Raises
    ------
    DataError
        Naming ``where``, the key and what was expected.
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
    """A document from a file.

    Raises
    ------
    ConfigError
        If there is no such file.
    DataError
        If the file cannot be read or is not such a document.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    return from_json(text, kind, str(path))


def write_atomically(path: Path, text: str) -> None:
    """Write a file so that a reader sees all of it or none of it; missing folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        # mkstemp makes the file private; a result is as readable as any other file of its folder.
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def schema_text(kind: type[Document]) -> str:
    """JSON Schema of a document as it stands in ``configs/``."""
    return json.dumps(kind.model_json_schema(by_alias=True), indent=2) + "\n"


def main() -> None:
    """Write the schema files: ``python -m armident.identify.document``."""
    for name, kind in SCHEMA_FILES.items():
        write_atomically(Path(configs.__file__).parent / "json_schemas" / name, schema_text(kind))


if __name__ == "__main__":
    main()
