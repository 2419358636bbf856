"""Health of the model of an axis: what the last documents and the history of its cell say about it."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import takewhile
from typing import Literal, NamedTuple

from armident.identify.documents.diagnosis import DiagnosisDocument, Finding
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.change.comparison import joint_of
from armident.identify.page.attention import CellView
from armident.identify.page.cells import ResultFolder

WIDTH = 1.96
"""Half the 95 % interval in standard deviations."""
NONE = "none"
"""Effect at an axis without a finding."""
ACT, LOOK, CALM = 800, 500, 100
"""Severities of the alarm: somebody has to act, somebody should look, and nothing is wrong."""


class Reading(NamedTuple):
    """Value with its status code of OPC UA; it has none if the status is bad."""

    value: object
    status: Literal["Good", "Uncertain", "BadNoData", "BadDataUnavailable"] = "Good"


UNKNOWN, UNREADABLE = Reading(None, "BadNoData"), Reading(None, "BadDataUnavailable")
"""Readings without a result, and of a result that cannot be read."""
OF_DIAGNOSIS = ("Effect", "Probability", "Parameter", "Size", "Interval")
NAMES = ("Verdict", *OF_DIAGNOSIS, "Since", "Drift")
"""Readings of an axis, in the order in which they are shown."""


@dataclass(frozen=True)
class Health:
    """Readings of an axis by `NAMES`, and ``Unit`` of its size; docs/opcua.md has their meaning."""

    readings: Mapping[str, Reading]

    @property
    def state(self) -> tuple[Reading, ...]:
        """Readings whose change is announced."""
        return tuple(self.readings[name] for name in ("Verdict", "Effect", "Drift"))

    @property
    def severity(self) -> int:
        """Severity of the alarm, which is active above `CALM`."""
        verdict, effect, drift = self.state
        if verdict.value == "unusable" or drift.value == "changed" or UNREADABLE in self.state:
            return ACT
        return LOOK if verdict.value == "doubtful" or effect.value not in (None, NONE) else CALM

    @property
    def sentence(self) -> str:
        """The state in words."""
        words = {UNKNOWN: "unknown", UNREADABLE: "unreadable"}
        verdict, effect, drift = (words.get(each, str(each.value).replace("_", " ")) for each in self.state)
        probability = self.readings["Probability"].value
        sure = f" (probability {probability:.2f})" if isinstance(probability, float) else ""
        return f"model {verdict}, effect {effect}{sure}, drift {drift}"


def health_of(view: CellView, joint: str) -> Health:
    """Return the health of the model of a joint of a cell."""
    readings = dict.fromkeys(NAMES, UNKNOWN) | {"Unit": Reading(""), "Drift": _drift(view, joint)}
    last, diagnoses = view.identification, view.files.documents("diagnosis")
    if last is not None:
        readings |= {"Verdict": _verdict(last), "Since": Reading(last.made)}
    if diagnoses:
        found = [_of_diagnosis(each, joint) for each in diagnoses]
        same = takewhile(lambda pair: pair[1]["Effect"] == found[0]["Effect"], zip(diagnoses, found, strict=True))
        readings |= found[0] | {"Since": Reading(min(each.made for each, _ in same))}
    return Health(readings)


def _verdict(last: ResultFolder) -> Reading:
    """Return the verdict of an identification, which is one of the whole arm."""
    if not isinstance(last.document, IdentificationDocument):
        return UNREADABLE
    return Reading(last.document.verdict) if last.document.verdict else Reading("not judged", "Uncertain")


def _drift(view: CellView, joint: str) -> Reading:
    """Return the drift of a joint; a change that no parameter shows is one of all joints."""
    if isinstance(view.drift, str):
        return UNREADABLE
    if view.drift is None or view.drift.drifted is None or view.cell.robot is None:
        return UNKNOWN
    joints = [each.name for each in view.cell.robot.joints]
    at = {joint_of(name, joints) for name in view.drift.changed}.intersection(joints)
    return Reading("changed" if view.drift.drifted and (joint in at or not at) else "unchanged")


def _of_diagnosis(result: ResultFolder, joint: str) -> dict[str, Reading]:
    """Return the readings of a diagnosis: its most probable finding at a joint."""
    document = result.document
    if not isinstance(document, DiagnosisDocument):
        return dict.fromkeys(OF_DIAGNOSIS, UNREADABLE)
    readings = dict.fromkeys(OF_DIAGNOSIS, UNKNOWN)
    findings = [each for each in document.findings if joint in (each.joint, each.other)]
    if not findings:
        nothing = [
            each.names["nothing"] for each in document.explanations if each.joint == joint and "nothing" in each.names
        ]
        return readings | {"Effect": Reading(NONE), "Probability": Reading(nothing[0]) if nothing else UNKNOWN}
    finding = max(findings, key=lambda each: each.confidence)
    readings |= {"Effect": Reading(finding.effect), "Probability": Reading(finding.confidence)}
    for name, size in list(finding.parameters.items())[:1]:
        std, unit = _evidence(finding, "std", name), _evidence(finding, "units", name)
        readings |= {"Parameter": Reading(name), "Size": Reading(size), "Unit": Reading(str(unit or ""))}
        if isinstance(std, float):
            readings["Interval"] = Reading((size - WIDTH * std, size + WIDTH * std))
    return readings


def _evidence(finding: Finding, key: str, name: str) -> object:
    """Return the evidence of a parameter, such as its ``std``; ``None`` if there is none."""
    found = finding.evidence.get(key)
    return found.get(name) if isinstance(found, dict) else None
