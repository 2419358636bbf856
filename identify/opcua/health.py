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

Status = Literal["Good", "Uncertain", "BadNoData", "BadDataUnavailable"]
"""Status codes of OPC UA: ``BadNoData`` without a result, ``BadDataUnavailable`` of one that cannot be read."""
WIDTH = 1.96
"""Half the 95 % interval in standard deviations."""
NONE = "none"
"""Effect at an axis without a finding."""
ACT, LOOK, CALM = 800, 500, 100
"""Severities of the alarm: somebody has to act, somebody should look, and nothing is wrong."""


class Reading(NamedTuple):
    """Value with its status; it has none if the status is bad."""

    value: object = None
    status: Status = "BadNoData"


OF_DIAGNOSIS = ("Effect", "Probability", "Parameter", "Size", "Interval")
NAMES = ("Verdict", *OF_DIAGNOSIS, "Since", "Drift")
"""Readings of an axis, in the order in which they are shown."""


@dataclass(frozen=True)
class Health:
    """Readings of an axis by `NAMES`, and the unit of its size.

    ``Verdict``: that of the last identification, for the whole arm. ``Effect``: most probable finding of the last
    diagnosis at the axis, or `NONE`. ``Size``: value of its first ``Parameter``, with a 95 % ``Interval``. ``Since``:
    time of the first of the documents, without a gap, that say the same. ``Drift``: ``changed`` or ``unchanged``.
    """

    readings: Mapping[str, Reading]
    unit: str

    @property
    def state(self) -> tuple[Reading, ...]:
        """Readings whose change is announced."""
        return tuple(self.readings[name] for name in ("Verdict", "Effect", "Drift"))

    @property
    def severity(self) -> int:
        """Severity of the alarm, which is active above `CALM`."""
        verdict, effect, drift = self.state
        if (
            verdict.value == "unusable"
            or drift.value == "changed"
            or "BadDataUnavailable" in {e.status for e in self.state}
        ):
            return ACT
        return LOOK if verdict.value == "doubtful" or effect.value not in (None, NONE) else CALM

    @property
    def sentence(self) -> str:
        """The state in words."""
        words = {"BadNoData": "unknown", "BadDataUnavailable": "unreadable"}
        verdict, effect, drift = (str(each.value or words[each.status]).replace("_", " ") for each in self.state)
        probability = self.readings["Probability"].value
        sure = "" if not isinstance(probability, float) else f" (probability {probability:.2f})"
        return f"model {verdict}, effect {effect}{sure}, drift {drift}"


def health_of(view: CellView, joint: str) -> Health:
    """Return the health of the model of a joint of a cell."""
    readings, unit = dict.fromkeys(NAMES, Reading()), ""
    last, diagnoses = view.identification, view.files.documents("diagnosis")
    if last is not None:
        readings["Verdict"] = _verdict(last)
        readings["Since"] = Reading(last.made, "Good")
    if diagnoses:
        found = diagnoses[0].document
        readings["Since"] = Reading(_since(diagnoses, joint), "Good")
        if isinstance(found, DiagnosisDocument):
            finding = _finding(found, joint)
            readings |= _without(found, joint) if finding is None else _with(finding)
            unit = "" if finding is None else str(_of_first(finding, "units") or "")
        else:
            readings |= dict.fromkeys(OF_DIAGNOSIS, Reading(None, "BadDataUnavailable"))
    readings["Drift"] = _drift(view, joint)
    return Health(readings, unit)


def _verdict(last: ResultFolder) -> Reading:
    if not isinstance(last.document, IdentificationDocument):
        return Reading(None, "BadDataUnavailable")
    verdict = last.document.verdict
    return Reading("not judged", "Uncertain") if verdict is None else Reading(verdict, "Good")


def _drift(view: CellView, joint: str) -> Reading:
    """Return the drift of a joint; a change that no parameter shows is one of all joints."""
    if isinstance(view.drift, str):
        return Reading(None, "BadDataUnavailable")
    if view.drift is None or view.drift.drifted is None or view.cell.robot is None:
        return Reading()
    joints = [each.name for each in view.cell.robot.joints]
    at = {joint_of(name, joints) for name in view.drift.changed}.intersection(joints)
    return Reading("changed" if view.drift.drifted and (joint in at or not at) else "unchanged", "Good")


def _finding(document: DiagnosisDocument, joint: str) -> Finding | None:
    """Return the most probable finding at a joint."""
    found = [each for each in document.findings if joint in (each.joint, each.other)]
    return max(found, key=lambda each: each.confidence, default=None)


def _since(diagnoses: list[ResultFolder], joint: str) -> object:
    """Return the time of the oldest of the last diagnoses that name the same effect."""

    def effect(result: ResultFolder) -> str | None:
        found = _finding(result.document, joint) if isinstance(result.document, DiagnosisDocument) else None
        return None if found is None else found.effect

    newest = diagnoses[0]
    same = takewhile(
        lambda each: (each.document is None, effect(each)) == (newest.document is None, effect(newest)), diagnoses
    )
    return min(each.made for each in same)


def _without(document: DiagnosisDocument, joint: str) -> dict[str, Reading]:
    """Return the readings of a joint without a finding."""
    nothing = [
        each.names["nothing"] for each in document.explanations if each.joint == joint and "nothing" in each.names
    ]
    return {"Effect": Reading(NONE, "Good"), "Probability": Reading(nothing[0], "Good") if nothing else Reading()}


def _with(finding: Finding) -> dict[str, Reading]:
    """Return the readings of a finding."""
    found = {"Effect": Reading(finding.effect, "Good"), "Probability": Reading(finding.confidence, "Good")}
    if finding.parameters:
        (name, size), std = next(iter(finding.parameters.items())), _of_first(finding, "std")
        found |= {"Parameter": Reading(name, "Good"), "Size": Reading(size, "Good")}
        if isinstance(std, float):
            found["Interval"] = Reading((size - WIDTH * std, size + WIDTH * std), "Good")
    return found


def _of_first(finding: Finding, key: str) -> object:
    """Return the evidence of the first parameter of a finding, such as its ``std``; ``None`` if there is none."""
    found = finding.evidence.get(key)
    return found.get(next(iter(finding.parameters), "")) if isinstance(found, dict) else None
