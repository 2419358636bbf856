"""Version 1 of ``diagnosis.json``, and its conversion to version 2."""

from collections.abc import Callable, Mapping
from typing import Any

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
