"""Parts that several result documents share."""

import math
import platform
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ConfigDict, Field

from armident.configs.schema.base import DescribedModel
from armident.daq.recording import Recording

LIBRARIES = ("armident", "numpy", "scipy", "numba")
"""Distributions whose versions a document records."""


class Document(DescribedModel):
    """Part of a result document, without unknown keys and without NaN."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=True)


class SignedDocument(Document):
    """Document of a file that may be signed; when it is written anew, the file has its own signature or none.

    Parameters
    ----------
    schema_
        Name and version of the document.
    robot
        Name of the robot.
    versions
        Versions of Python and of the libraries.
    provenance
        Origin of the file: version of ``armident``, ``host``, ``user``, and ``time`` of the signature (UTC).
    signature
        ``certificate`` of the signer (DER) and ``value`` (ECDSA, P-256, SHA-256), base64. Signed is the document
        without this entry as JSON: keys sorted, no blanks, ASCII, floats as Python writes them.
    """

    provenance: dict[str, str] | None = Field(None, exclude=True)
    signature: dict[str, str] | None = Field(None, exclude=True)


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
