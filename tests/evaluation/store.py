"""Results of a suite on disk: one JSON line per case, so that an interrupted run can be continued."""

import hashlib
import json
import os
import threading
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError, field_serializer, field_validator

from armident.configs import DataError
from armident.identify.documents.diagnosis import DiagnosisDocument

DECIDING = (
    "armident.configs",
    "armident.identify",
    "armident.virtual_robot",
    "armident.daq.recording",
    "tests.evaluation",
)
"""Packages whose code and data determine a result."""
DECIDING_SUFFIXES = (".py", ".yaml")
NOT_DECIDING = (
    "armident.identify.report",
    *(
        f"tests.evaluation.{module}"
        for module in ("__main__", "command", "report", "run", "score", "store", "suite", "tables")
    ),
)
"""Packages and modules without influence on a result.

The suite is part of each case's key; the other modules run after the result.
"""
NOT_STORED = ("recordings", "versions", "model")
"""Parts of a diagnosis document that depend on the machine or are not needed."""
EMPTY: dict[str, Any] = {"recordings": [], "versions": {}, "model": None}
"""Values of these parts in a document from the file."""


class CaseResult(BaseModel):
    """Result of one case: a diagnosis, or an error.

    Parameters
    ----------
    key, case
        Key and name of the case.
    effects
        Simulated effects with numeric parameters.
    truth
        True values of the linear parameters, one dictionary per effect.
    hidden
        Truth of a random arm, see `tests.evaluation.plants.cases.Truth`.
    document, twin
        The diagnosis, and that of the healthy twin of a random arm; ``None`` after an error.
    seconds
        Times of ``simulate`` and ``diagnose``, s.
    error
        Message of the error; ``None`` without one.
    code
        `code_version` that produced the result.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    key: str
    case: str = ""
    effects: list[dict[str, Any]] = []
    truth: list[dict[str, float]] = []
    hidden: dict[str, Any] | None = None
    document: DiagnosisDocument | None = None
    twin: DiagnosisDocument | None = None
    seconds: dict[str, float] = {}
    error: str | None = None
    code: str = ""

    @field_validator("document", "twin", mode="before")
    @classmethod
    def _with_parts_not_stored(cls, value: Any) -> Any:
        return {**EMPTY, **value} if isinstance(value, Mapping) else value

    @field_serializer("document", "twin")
    def _without_parts_not_stored(self, document: DiagnosisDocument | None) -> dict[str, Any] | None:
        return None if document is None else document.model_dump(mode="json", by_alias=True, exclude=set(NOT_STORED))

    @property
    def diagnosis(self) -> DiagnosisDocument:
        """The diagnosis document; a DataError if the case failed."""
        if self.document is None:
            raise DataError(f"{self.case}: no diagnosis: {self.error}")
        return self.document

    def to_line(self) -> str:
        """Return the result as one line of JSON."""
        return json.dumps({k: v for k, v in self.model_dump(mode="json").items() if v is not None}) + "\n"


def code_version(packages: Mapping[str, Path] | None = None) -> str:
    """Hash of the code and the data files that determine the results; ``packages``: folders by import name."""
    if packages is None:
        packages = {name: _folder(name) for name in DECIDING}
    digest = hashlib.sha256()
    for package, folder in packages.items():
        for path in sorted(folder.rglob("*")):
            name = ".".join((package, *path.relative_to(folder).parts))
            if path.suffix in DECIDING_SUFFIXES and not name.startswith(tuple(f"{p}." for p in NOT_DECIDING)):
                digest.update(name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def _folder(package: str) -> Path:
    spec = find_spec(package)
    assert spec is not None, package
    assert spec.submodule_search_locations, package
    return Path(spec.submodule_search_locations[0])


class Store:
    """File of results; it keeps the results of other versions of the code, and uses them with ``any_version``.

    A line that is no result is a DataError. An incomplete last line is removed: an interrupted run leaves one.
    """

    def __init__(self, path: Path, version: str, *, any_version: bool = False) -> None:
        self.path, self.version = path, version
        self._lock = threading.Lock()
        self._results: dict[str, CaseResult] = {}
        for number, line in self._lines():
            if any_version or line.get("code") == version:
                try:
                    result = CaseResult.model_validate(line)
                except ValidationError as error:
                    first = error.errors()[0]
                    key = ".".join(str(part) for part in first["loc"])
                    raise DataError(
                        f"{path}:{number}: {key}: {first['msg']}; remove the line to run the case again"
                    ) from error
                self._results[result.key] = result

    def get(self, key: str) -> CaseResult | None:
        """Return the result of a case; ``None`` if it has none or failed."""
        with self._lock:
            result = self._results.get(key)
        return None if result is None or result.error is not None else result

    @property
    def results(self) -> list[CaseResult]:
        """All results and failures."""
        with self._lock:
            return list(self._results.values())

    def failure(self, key: str) -> CaseResult | None:
        """Return the last failure of a case; ``None`` if it has a result or has not been run."""
        with self._lock:
            result = self._results.get(key)
        return result if result is not None and result.error is not None else None

    def add(self, result: CaseResult) -> CaseResult:
        """Append a result to the file, which contains it then, and return it with the version of the code."""
        result = result.model_copy(update={"code": self.version})
        line = result.to_line()
        with self._lock:
            self._results[result.key] = result
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a", encoding="utf-8") as file:
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        return result

    def _lines(self) -> Iterator[tuple[int, dict[str, Any]]]:
        lines = self.path.read_text(encoding="utf-8").splitlines() if self.path.exists() else []
        for number, line in enumerate(lines, 1):
            try:
                content = json.loads(line)
            except json.JSONDecodeError as error:
                if number == len(lines):
                    self._remove_incomplete_line()
                    return
                raise DataError(f"{self.path}:{number}: not JSON: {error.msg}") from error
            yield number, content

    def _remove_incomplete_line(self) -> None:
        content = self.path.read_bytes()
        with self.path.open("r+b") as file:
            file.truncate(content.rfind(b"\n", 0, len(content) - 1) + 1)
