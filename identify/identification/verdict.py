"""Verdict of an identification: trustworthy, doubtful or unusable, with reasons and the next step in words."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from armident.identify.estimators.reason import LEVELS, Kind, Level, Reason
from armident.identify.setup.result import ABOUT_URDF, SetupCheck, SetupFinding

AT_REST = ("standstill", "joint_at_rest")
"""Findings of the set-up that are a matter of the excitation."""


@dataclass(frozen=True)
class Verdict:
    """Judgement: trustworthy, doubtful (usable within the limits of its reasons) or unusable; worst reason first."""

    level: Level
    reasons: tuple[Reason, ...] = ()

    def of_kind(self, kind: Kind) -> tuple[Reason, ...]:
        """Return the reasons of one kind. ``kind``: property that was judged."""
        return tuple(reason for reason in self.reasons if reason.kind == kind)

    def document(self) -> dict[str, Any]:
        """Return the verdict as plain strings, lists and dictionaries."""
        return {
            "level": self.level,
            "reasons": [
                {"level": r.level, "kind": r.kind, "joint": r.joint, "message": r.message, "next_step": r.next_step}
                for r in self.reasons
            ],
        }


def judge(reasons: Sequence[Reason], setup: SetupCheck | None = None) -> Verdict:
    """Verdict of the most severe reason; each message occurs once, sorted by severity, those of the set-up first."""
    every = _merged(reasons, setup)
    once = {reason.message: reason for reason in reversed(every)}
    found = sorted(reversed(once.values()), key=lambda reason: -LEVELS.index(reason.level))
    return Verdict(found[0].level if found else "trustworthy", tuple(found))


def _merged(reasons: Sequence[Reason], setup: SetupCheck | None) -> list[Reason]:
    """Reasons of the set-up and of the result, each defect once."""
    if setup is None:
        return list(reasons)
    kinds = {reason.kind for reason in reasons}
    findings = [f for f in setup.findings if f.kind not in AT_REST or "excitation" not in kinds]
    shifted = any(finding.kind == "time_shift" for finding in findings)
    rest = [reason for reason in reasons if not (shifted and reason.kind == "delay")]
    lost = [k for k, reason in enumerate(rest) if reason.kind == "error" and reason.level == "unusable"]
    if setup.joints_not_understood and not lost:
        return [*_setup_reasons(findings), _not_understood(setup), *rest]
    if setup.joints_not_understood:
        first = rest[lost[0]]
        rest[lost[0]] = replace(
            first, message=f"{first.message}; no hypothesis of the set-up explains it{_tried(setup)}"
        )
    return [*_setup_reasons(findings), *rest]


def _setup_reasons(findings: Sequence[SetupFinding]) -> list[Reason]:
    """Return a reason for every finding of the set-up that concerns the result."""
    return [
        Reason(
            "unusable" if finding.decisive else "doubtful",
            f"{finding.message[:1].upper()}{finding.message[1:].rstrip('.')} (probability {finding.probability:.2f})",
            finding.remedy.rstrip("."),
            finding.joints[0] if len(finding.joints) == 1 else None,
            "setup",
        )
        for finding in findings
        if finding.kind not in ABOUT_URDF
    ]


def _not_understood(setup: SetupCheck) -> Reason:
    """Reason for joints that the rigid model does not explain with any hypothesis."""
    joints, tried = enumerated(setup.joints_not_understood), _tried(setup)
    message = f"The rigid model leaves more than a third of the torque of {joints}{tried}"
    step = "check signs, order, units and gear ratios of the recording: armident check RECORDING"
    return Reason("unusable", message, step, kind="setup")


def _tried(setup: SetupCheck) -> str:
    return f" (tried: {', '.join(setup.tried)})" if setup.tried else ""


def enumerated(names: Sequence[str], most: int = 12) -> str:
    """Return at least one name as a list in words, cut after ``most``."""
    shown = list(names[:most])
    if len(names) > most:
        return f"{', '.join(shown)} and {len(names) - most} more"
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}"
