"""Backward elimination of findings whose posterior share is below 0.5; a likelier effect may take their place."""

from collections.abc import Sequence
from dataclasses import dataclass

from armident.identify.diagnosis.findings import described
from armident.identify.diagnosis.search import MOST, Search
from armident.identify.diagnosis.stanzas import without
from armident.identify.diagnosis.state import Places, State, nearer, places_of, supersedes
from armident.identify.diagnosis.trial import CLOSE
from armident.identify.diagnosis.where import Disagreement, Survey, strangers, unexplained
from armident.identify.document import Finding

CONVINCING = 0.5
"""Confidence, including that of ambiguous effects, below which a finding is more probably wrong than right."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Model after backward elimination.

    Parameters
    ----------
    state
        The model with the findings that remain.
    findings, considered
        Effects added to the model, ordered by the share of the gap of their joint that they close; and effects that
        were removed again or never accepted.
    lacking
        The model without each of the findings.
    left
        Dependences of the residual of that model.
    """

    state: State
    findings: tuple[Finding, ...]
    considered: tuple[Finding, ...]
    lacking: tuple[State, ...]
    left: tuple[Disagreement, ...]


def convincing(search: Search, first: State, final: State, seen: Survey) -> Outcome:
    """Model after removal of the findings with the lowest posterior share, one after the other.

    Where a joint lacks an effect that the catalogue does not contain, many other effects take a part of it, on held-out
    data too, because similar motions repeat the same error. Tests against noise do not reject them. A finding is kept
    only if it explains more than it leaves unnamed, and if no other effect in its place is twenty times likelier; such
    a rival takes its place.

    Parameters
    ----------
    search
        The search, with its settings.
    first, final
        Model as configured, and at the end of the search.
    seen
        Survey of the first.
    """
    considered: list[Finding] = []
    been = {places_of(final)}
    for _ in range(2 * MOST):
        left = unexplained(
            final.fit, final.workshop, search.settings.false_alarms, seen=seen if final is first else None
        )
        findings = described(search, first, final, left)
        worst = min(range(len(findings)), key=lambda k: _confidence(findings[k]), default=None)
        if worst is None or _confidence(findings[worst]) >= CONVINCING:
            better = _exchanged(search, first, final, considered, been)
            if better is None:
                break
            final = better
            been.add(places_of(final))
            continue
        considered.append(findings[worst])
        search.progress(f"removing {findings[worst].effect}")
        final = _without(search, first, final, worst, been)
        been.add(places_of(final))
    order = sorted(range(len(findings)), key=lambda k: _left_open(findings[k]))
    ordered = tuple(findings[k] for k in order)
    taken_out = _unique(considered, ordered)
    own = len(first.study.robot.effects)
    lacking = tuple(search.state(without(final.study.robot, own + k), final) for k in order)
    return Outcome(final, ordered, taken_out, lacking, (*left, *_instead_of(search, final, taken_out, left)))


def _confidence(finding: Finding) -> float:
    return float(finding.evidence["confidence_with_ambiguous"])


def _left_open(finding: Finding) -> float:
    """Held-out error of the joint of a finding with it, over the error without it."""
    return finding.gap_after / max(finding.gap_before, 1e-300)


def _instead_of(
    search: Search, final: State, taken_out: Sequence[Finding], left: Sequence[Disagreement]
) -> list[Disagreement]:
    """Unnamed dependences in place of removed findings, at joints without any other, however small."""
    told: list[Disagreement] = []
    for finding in taken_out:
        at = {finding.joint, finding.other or finding.joint}
        if not finding.evidence["better_unnamed_dependences"] or at & {d.joint for d in (*left, *told)}:
            continue
        numbers = {final.study.joints.index(joint) for joint in at}
        found = strangers(final.fit, final.workshop, numbers, search.settings.false_alarms)
        told += [s.disagreement() for s in sorted(found, key=lambda s: -s.score)[:1]]
    return told


def _without(search: Search, first: State, final: State, finding: int, been: set[Places]) -> State:
    """The model without a finding, or with the effect that beats it."""
    number = len(first.study.robot.effects) + finding
    stanza = final.study.robot.effects[number]
    rest = search.state(without(final.study.robot, number), final)
    mine = [
        t.score
        for t in rest.trials
        if (t.candidate.effect.name, rest.study.joints[t.candidate.place.joint]) == (stanza.effect, stanza.joint)
    ]
    for best in rest.passing(search.settings)[:1]:
        if mine and best.score < max(mine) + CLOSE:
            continue
        other = search.with_trial(rest, best)
        if other is not None and nearer(other, rest, search.settings.material) and places_of(other) not in been:
            return other
    return rest


def _exchanged(
    search: Search, first: State, final: State, considered: Sequence[Finding], been: set[Places]
) -> State | None:
    """Model with a removed effect in place of a finding of its joint, where that fits better; otherwise ``None``.

    Of two effects that shared a gap, the less likely one may be the right one once it is alone.
    """
    own, joints = len(first.study.robot.effects), final.study.joints
    for number in range(own, len(final.study.robot.effects)):
        joint = final.study.robot.effects[number].joint
        names = {finding.effect for finding in considered if finding.joint == joint}
        if not names:
            continue
        rest = search.state(without(final.study.robot, number), final)
        for trial in rest.passing(search.settings):
            if trial.candidate.effect.name not in names or joints[trial.candidate.place.joint] != joint:
                continue
            other = search.with_trial(rest, trial)
            if other is None or places_of(other) in been:
                continue
            if supersedes(other, final, search.settings.material):
                return other
    return None


def _unique(considered: Sequence[Finding], findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Every removed finding once, without those that are in the final model."""
    kept: dict[tuple[str, str, str | None], Finding] = {}
    stated = {(f.effect, f.joint, f.other) for f in findings}
    for f in considered:
        if (f.effect, f.joint, f.other) not in stated:
            kept.setdefault((f.effect, f.joint, f.other), f)
    return tuple(kept.values())
