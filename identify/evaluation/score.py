"""What a diagnosis is worth, beside what was hidden."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from armident.identify.evaluation.cases import Case, InjectedEffect
from armident.identify.evaluation.store import Record

Document = dict[str, Any]

SIGMAS = 3.0
"""Distance from the truth, in standard deviations, that a parameter may have."""
LEAST_GAP = 0.05
"""Injected gap, as a share of the noise's power, under which the share closed means nothing: what a few
parameters more cost by chance alone is half a percent of it."""
LOW_CONFIDENCE = 0.5
"""A name that is stated with less is called more probably wrong than right by the diagnosis itself."""


@dataclass(frozen=True)
class Score:
    """How one case went.

    Parameters
    ----------
    verdict
        Of the diagnosis.
    first, second
        Whether every hidden effect has its right name and place among the findings; among the findings and what each
        of them calls its closest rival. ``None`` where nothing is hidden that has a name.
    missed
        Nothing was found, and nothing left unexplained.
    invisible
        Not found, nothing else in its place and nothing left unexplained, and the diagnosis says that these recordings
        cannot show the effect, at all or of this size; of a pair one may have been found.
    extra
        Findings beside what is hidden and what comes with it.
    closed
        Share of the injected gap above the noise floor that is closed on held-out data; ``None`` without a gap.
    within
        Of every parameter that can be compared, whether it is within three standard deviations of the truth.
    confidence
        Highest of any finding; zero without one.
    named
        First finding, as ``effect joint``.
    shown
        Whether the held-out recording has the injected gap at all: a bump that the motion does not pass is not in it.
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
    named: str | None
    shown: bool = True


def score(case: Case, record: Record, healthy: Record | None) -> Score:
    """Judge the record of a case.

    Parameters
    ----------
    healthy
        Record of its healthy twin, which says what the noise alone costs; ``None`` where nothing is hidden.
    """
    document: Document = record["document"]
    findings: list[Document] = document["findings"]
    matched = [next((f for f in findings if matches(part, f)), None) for part in case.parts]
    known = bool(case.parts) and case.kind != "outside"
    first = second = None
    if known:
        first = all(f is not None for f in matched)
        if len(case.parts) == 1:
            # One effect: what the diagnosis names before all else.
            first = bool(findings) and matches(case.parts[0], findings[0])
        second = all(_among(part, findings) for part in case.parts)
    truths = [*record["truth"], *({} for _ in case.parts)]
    absent = [(p, truth) for p, truth, f in zip(case.parts, truths, matched, strict=False) if f is None]
    extra = sum(not any(matches(part, f) or _comes_with(part, f) for part in case.parts) for f in findings)
    right = [f for f in matched if f is not None] if known else []
    return Score(
        verdict=document["verdict"],
        first=first,
        second=second,
        missed=document["verdict"] == "no_gap" and bool(case.parts),
        invisible=bool(absent)
        and not case.baseline
        and not extra
        and document["verdict"] in ("no_gap", "explained")
        and all(_called_invisible(part, truth, document) for part, truth in absent),
        extra=extra,
        closed=None if healthy is None else closed_share(case, document, healthy["document"]),
        within=tuple(
            ok
            for f, truth in zip(matched, record["truth"], strict=False)
            if f is not None and f in right
            for ok in within(f, truth)
        ),
        confidence=max((f["confidence"] for f in findings), default=0.0),
        named=f"{findings[0]['effect']} {findings[0]['joint']}" if findings else None,
        shown=healthy is None or _injected(case, document, healthy["document"]) >= LEAST_GAP,
    )


def matches(part: InjectedEffect, finding: Document) -> bool:
    """Whether a finding (or a rival of one) names a hidden effect and its place; a pair in either order."""
    if finding["effect"] not in part.names:
        return False
    if part.arm:
        return True
    places = {part.joint, part.other} - {None}
    found = {finding["joint"], finding.get("other")} - {None}
    return found == places or (finding.get("other") is None and found <= places)


def closed_share(case: Case, document: Document, healthy: Document) -> float | None:
    """``(before^2 - after^2) / (before^2 - clean^2)`` of the held-out torque errors, over the joints concerned.

    Errors of the torques at measured motion, or of the simulated closed loop's, whichever shows the injected gap more
    clearly. Measured motion differentiated once more brings noise that a delay or an elastic joint does not have: what
    the findings change is taken at measured or at simulated motion, whichever leaves less.
    In N m or N: an arm that lost half its friction needs less torque, of which the same noise is a larger percentage.
    ``None`` where there is no gap to speak of, or where reported torques have another size than the healthy arm's.
    """
    if any(part.rescales for part in case.parts) and not case.baseline:
        return None
    before, after, clean = _clearest(case, document, healthy)
    if before - clean < LEAST_GAP * clean:
        return None
    return (before - after) / (before - clean)


def _injected(case: Case, document: Document, healthy: Document) -> float:
    """Power that is injected, over that of the healthy arm's errors."""
    before, _, clean = _clearest(case, document, healthy)
    return before / max(clean, 1e-300) - 1.0


def _clearest(case: Case, document: Document, healthy: Document) -> "Powers":
    """Where the gap shows most."""
    views = [_at_measured_motion(case, document, healthy)]
    both = [(of.get("simulated") or {}).get("torque_before") for of in (document, healthy)]
    if all(both) and not case.baseline:
        views.append(_of_the_simulated_loop(case, document, healthy))
    return max(views, key=lambda v: v[0] / max(v[2], 1e-300))


Powers = tuple[float, float, float]
"""Of the errors before and after, and of the healthy arm."""


def _at_measured_motion(case: Case, document: Document, healthy: Document) -> Powers:
    def power(gap: Document) -> float:
        return sum(float(gap["rms"][j]) ** 2 for j in _joints(case, gap["rms"]))

    validation = document["gap"]["validation"]
    numbers = [f for f in document["findings"] if f["kind"] == "numbers"]
    if case.baseline and numbers:
        place = numbers[0]["joint"]
        torque = _torques(document, "before")[place]
        return (
            (float(numbers[0]["gap_before"]) * torque) ** 2,
            (float(numbers[-1]["gap_after"]) * torque) ** 2,
            float(healthy["gap"]["validation"]["before"]["rms"][place]) ** 2,
        )
    after = power(validation["after"])
    foretold = (document.get("simulated") or {}).get("torque_without_derivative_noise")
    if foretold is not None:
        torques = _torques(document, "after")
        after = min(after, sum((foretold[j] * torques[j]) ** 2 for j in _joints(case, foretold)))
    return power(validation["before"]), after, power(healthy["gap"]["validation"]["before"])


def _of_the_simulated_loop(case: Case, document: Document, healthy: Document) -> Powers:
    def power(of: Document, when: str) -> float:
        errors, torques = of["simulated"][f"torque_{when}"], _torques(of, when)
        return float(sum((errors[j] * torques[j]) ** 2 for j in _joints(case, errors)))

    return power(document, "before"), power(document, "after"), power(healthy, "before")


def _torques(document: Document, when: str) -> dict[str, float]:
    """A hundredth of the torque of each joint (RMS), N m or N, of which errors ``before`` or ``after`` are percentages.

    They differ where torques have been put right.
    """
    gap = document["gap"]["validation"][when]
    return {joint: gap["rms"][joint] / max(gap["by_joint"][joint], 1e-300) for joint in gap["rms"]}


def _joints(case: Case, every: Iterable[str]) -> set[str]:
    """Joints that the effects of a case act on."""
    if any(part.arm for part in case.parts):
        return set(every)
    return {j for part in case.parts for j in (part.joint, part.other) if j is not None}


def within(finding: Document, truth: dict[str, float]) -> list[bool]:
    """Of the parameters that finding and truth share, whether they agree."""
    deviations = finding["evidence"].get("std", {})
    out = []
    for name, value in truth.items():
        std = deviations.get(name)
        if name in finding["parameters"] and std is not None and math.isfinite(std):
            out.append(abs(finding["parameters"][name] - value) <= SIGMAS * std)
    return out


def _comes_with(part: InjectedEffect, finding: Document) -> bool:
    return finding["effect"] in part.brings and finding["joint"] == part.joint


def _among(part: InjectedEffect, findings: Sequence[Document]) -> bool:
    return any(matches(part, f) or any(matches(part, rival) for rival in f["alternatives"][:1]) for f in findings)


def _called_invisible(part: InjectedEffect, truth: dict[str, float], document: Document) -> bool:
    """Whether the diagnosis says that an effect cannot show, or could hide with parameters of this size."""
    if any(matches(part, entry) for entry in document["not_visible"]):
        return True
    limits = [entry["limits"] for entry in document.get("detection_limits", []) if matches(part, entry)]
    sizes = [[abs(value) < below[name] for name, value in truth.items() if name in below] for below in limits]
    return any(bool(compared) and all(compared) for compared in sizes)
