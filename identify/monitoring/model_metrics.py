"""Metrics of the last identification, which worker and job have in common."""

from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.change.comparison import joint_of, places_of
from armident.metrics import Family, Value

_PARAMETER = ("joint", "parameter", "unit")
VERDICTS = ("trustworthy", "doubtful", "unusable")

IDENTIFICATION = (
    Family("parameters", "parameter_value", "Estimate of a parameter in its unit.", _PARAMETER),
    Family("deviations", "parameter_std", "Standard deviation of the estimate in its unit.", _PARAMETER),
    Family("error", "torque_error_ratio", "Torque error of all joints over the torque (norms)."),
    Family("error_of", "joint_torque_error_ratio", "Torque error of a joint over its torque (norms).", ("joint",)),
    Family("identified_s", "identification_seconds", "Time that the identification took."),
)
"""Metrics of an identification. Each parameter has two, and each joint one."""


def identification_values(document: IdentificationDocument) -> dict[str, Value]:
    """Return the values of an identification."""
    places = places_of(document)
    labels = {p.name: (joint_of(p.name, *places), p.name, p.unit) for p in document.parameters}
    errors = document.relative_error_pct_by_joint.items()
    return {
        "parameters": {labels[p.name]: p.value for p in document.parameters},
        "deviations": {labels[p.name]: p.std for p in document.parameters},
        "error": document.relative_error_pct / 100,
        "error_of": {(joint,): percent / 100 for joint, percent in errors},
        "identified_s": sum(document.timing_s.values()),
    }


def one_of(chosen: str | None, names: tuple[str, ...]) -> Value:
    """Return 1 for the chosen name, and 0 for the others; ``None`` if none is chosen."""
    return None if chosen is None else {(name,): float(name == chosen) for name in names}
