"""Score of a diagnosis: comparison with the simulated effects."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from armident.identify.documents.diagnosis import Alternative, DetectionLimit, DiagnosisDocument, Finding, NotVisible
from tests.evaluation.cases import UNSEEN, Case, InjectedEffect
from tests.evaluation.store import CaseResult

SIGMAS = 3.0
"""Accepted deviation of a parameter from the truth, in standard deviations."""
LEAST_GAP = 0.05
"""Smallest injected gap, as a fraction of the noise power, for which the closed share is evaluated.

For comparison: a few additional parameters change the error power by half a percent of the noise by chance.
"""
UNNAMED = "unnamed"
"""Effect of terms that a diagnosis adds without a cause; they name nothing."""
LOW_CONFIDENCE = 0.5
"""Confidence below which the diagnosis considers a finding more probably wrong than right."""

Named = Finding | Alternative | NotVisible | DetectionLimit
"""Parts of a document that name an effect and a joint."""


@dataclass(frozen=True)
class Score:
    """Result of the comparison of one case.

    Parameters
    ----------
    verdict
        Verdict of the diagnosis.
    first
        All simulated effects are among the findings with the right effect and joint; a single effect is the first
        finding. ``None`` where nothing in the catalogue is simulated.
    second
        The same, with the closest alternative of each finding counted too; of random arms, with all names.
    missed
        The verdict is ``no_gap`` although an effect is simulated.
    invisible
        Not found, without another finding and without an unexplained rest. The document states that the recording
        cannot show the effect, or that its size is below the detection limit. Of a pair, one may be found.
    extra
        Number of findings besides the simulated effects and their side effects.
    closed
        Share of the injected gap above the noise floor that is closed on held-out data; ``None`` without a gap.
    within
        For each comparable parameter, ``True`` if it is within three standard deviations of the truth.
    confidence
        Highest confidence of the findings; zero without findings.
    named
        Findings with their joints, in their order.
    shown
        ``False`` if the held-out recording does not contain the injected gap, for example if the motion does not pass
        the position of a disturbance.
    worse
        There are findings, and the reported error is no smaller with them.
    """

    verdict: str
    first: bool | None
    second: bool | None
    missed: bool
    invisible: bool
    extra: int
    closed: float | None
    within: tuple[bool, ...]
    confidence: float
    named: tuple[str, ...]
    shown: bool = True
    worse: bool = False


def score(case: Case, result: CaseResult, healthy: DiagnosisDocument | None) -> Score:
    """Compare the diagnosis of a case with the simulated effects.

    ``healthy``: diagnosis of the healthy twin, which has the torque error of the noise alone; ``None`` without one.
    """
    document = result.diagnosis
    findings = [f for f in document.findings if f.effect != UNNAMED]
    matched = [next((f for f in findings if matches(case, part, f)), None) for part in case.parts]
    known = bool(case.parts) and case.kind != "outside"
    first = second = None
    if known:
        first = all(f is not None for f in matched)
        if len(case.parts) == 1:
            first = bool(findings) and matches(case, case.parts[0], findings[0])
        second = all(_among(case, part, findings) for part in case.parts)
    truths = [*result.truth, *({} for _ in case.parts)]
    absent = [(p, truth) for p, truth, f in zip(case.parts, truths, matched, strict=False) if f is None]
    extra = sum(not any(matches(case, part, f) or _is_side_effect(part, f) for part in case.parts) for f in findings)
    correct = [f for f in matched if f is not None] if known else []
    gap = document.gap.validation
    return Score(
        verdict=document.verdict,
        first=first,
        second=second,
        missed=document.verdict == "no_gap" and bool(case.parts),
        invisible=bool(absent)
        and not case.baseline
        and not case.random
        and not extra
        and document.verdict in ("no_gap", "explained")
        and all(_below_limit(case, part, truth, document) for part, truth in absent),
        extra=extra,
        closed=None if healthy is None or case.level == UNSEEN else closed_share(case, document, healthy),
        within=tuple(
            ok
            for f, truth in zip(matched, result.truth, strict=False)
            if f is not None and f in correct
            for ok in within(f, truth)
        ),
        confidence=max((f.confidence for f in findings), default=0.0),
        named=tuple(" ".join(word for word in (f.effect, f.joint, f.other) if word) for f in findings),
        shown=healthy is None or _injected(case, document, healthy) >= LEAST_GAP,
        worse=bool(document.findings) and gap.after.all >= gap.before.all,
    )


def matches(case: Case, part: InjectedEffect, named: Named) -> bool:
    """``True`` if a part of a document names a simulated effect at its joint; two joints in either order.

    On random arms one of the joints of the truth is enough, and so is the whole arm.
    """
    if named.effect not in part.names:
        return False
    if part.arm:
        return True
    other = None if isinstance(named, Alternative | NotVisible) else named.other
    found = {joint for joint in (named.joint, other) if joint}
    if case.random:
        return not found or bool(found & set(case.joints))
    expected = {part.joint, part.other} - {None}
    return found == expected or (len(found) == 1 and found <= expected)


def closed_share(case: Case, document: DiagnosisDocument, healthy: DiagnosisDocument) -> float | None:
    """Return ``(before^2 - after^2) / (before^2 - healthy^2)`` of the held-out torque errors of the joints concerned.

    The errors are those at measured motion or those of the simulated closed loop, whichever show the injected gap more
    clearly. A further derivative of measured motion adds noise that a delay or an elastic joint does not cause. The
    change by the findings is therefore the smaller of that at measured and that at simulated motion. The unit is N m or
    N: percentages depend on the torque, which an effect such as lost friction reduces.

    ``None`` without an injected gap, or if the reported torques are scaled differently from the healthy arm's.
    """
    if any(part.rescales for part in case.parts) and not case.baseline:
        return None
    before, after, clean = _clearest(case, document, healthy)
    if before - clean < LEAST_GAP * clean:
        return None
    return (before - after) / (before - clean)


Powers = tuple[float, float, float]
"""Error power before and after the findings are added, and that of the healthy arm, (N m)^2 or N^2."""
When = Literal["before", "after"]


def _injected(case: Case, document: DiagnosisDocument, healthy: DiagnosisDocument) -> float:
    """Injected error power relative to that of the healthy arm."""
    before, _, clean = _clearest(case, document, healthy)
    return before / max(clean, 1e-300) - 1.0


def _clearest(case: Case, document: DiagnosisDocument, healthy: DiagnosisDocument) -> Powers:
    """Powers at measured motion or of the simulated loop, whichever show the larger gap."""
    views = [_at_measured_motion(case, document, healthy)]
    if not case.baseline and all((of.simulated or {}).get("torque_before") for of in (document, healthy)):
        views.append(_of_simulated_loop(case, document, healthy))
    return max(views, key=lambda v: v[0] / max(v[2], 1e-300))


def _at_measured_motion(case: Case, document: DiagnosisDocument, healthy: DiagnosisDocument) -> Powers:
    def power(rms: dict[str, float]) -> float:
        return sum(rms[j] ** 2 for j in _joints(case, rms))

    validation, clean = document.gap.validation, healthy.gap.validation.before.rms
    numbers = [f for f in document.findings if f.kind == "numbers"]
    if case.baseline and numbers:
        joint = numbers[0].joint
        torque = _torques(document, "before")[joint]
        return (numbers[0].gap_before * torque) ** 2, (numbers[-1].gap_after * torque) ** 2, clean[joint] ** 2
    after = power(validation.after.rms)
    simulated = (document.simulated or {}).get("torque_without_derivative_noise")
    if simulated is not None:
        torques = _torques(document, "after")
        after = min(after, sum((simulated[j] * torques[j]) ** 2 for j in _joints(case, simulated)))
    return power(validation.before.rms), after, power(clean)


def _of_simulated_loop(case: Case, document: DiagnosisDocument, healthy: DiagnosisDocument) -> Powers:
    def power(of: DiagnosisDocument, when: When) -> float:
        errors, torques = (of.simulated or {})[f"torque_{when}"], _torques(of, when)
        return float(sum((errors[j] * torques[j]) ** 2 for j in _joints(case, errors)))

    return power(document, "before"), power(document, "after"), power(healthy, "before")


def _torques(document: DiagnosisDocument, when: When) -> dict[str, float]:
    """RMS torque of each joint over 100, N m or N: the unit of percentage errors.

    The values before and after differ if a finding corrects the torques.
    """
    validation = document.gap.validation
    gap = validation.before if when == "before" else validation.after
    return {joint: gap.rms[joint] / max(gap.by_joint[joint], 1e-300) for joint in gap.rms}


def _joints(case: Case, every: Iterable[str]) -> list[str]:
    """Joints on which the effects of a case act."""
    if any(part.arm for part in case.parts):
        return sorted(every)
    return sorted({j for part in case.parts for j in (part.joint, part.other) if j is not None})


def within(finding: Finding, truth: dict[str, float]) -> list[bool]:
    """``True`` for each parameter of finding and truth within three standard deviations of the truth."""
    deviations = finding.evidence.get("std", {})
    out = []
    for name, value in truth.items():
        std = deviations.get(name)
        if name in finding.parameters and std is not None and math.isfinite(std):
            out.append(abs(finding.parameters[name] - value) <= SIGMAS * std)
    return out


def _is_side_effect(part: InjectedEffect, finding: Finding) -> bool:
    return finding.effect in part.brings and finding.joint == part.joint


def _among(case: Case, part: InjectedEffect, findings: Sequence[Finding]) -> bool:
    """``True`` if the effect is named; on the two robots, as the closest alternative of a finding too."""
    named: list[Named] = [*findings]
    if not case.random:
        named += [other for finding in findings for other in finding.alternatives[:1]]
    return any(matches(case, part, each) for each in named)


def _below_limit(case: Case, part: InjectedEffect, truth: dict[str, float], document: DiagnosisDocument) -> bool:
    """``True`` if the document calls an effect not visible, or its detection limits exceed the true parameters."""
    if any(matches(case, part, entry) for entry in document.not_visible):
        return True
    limits = [entry.limits for entry in document.detection_limits if matches(case, part, entry)]
    sizes = [[abs(value) < limit[name] for name, value in truth.items() if name in limit] for limit in limits]
    return any(bool(compared) and all(compared) for compared in sizes)
