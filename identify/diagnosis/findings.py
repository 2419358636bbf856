"""Findings of a search as entries of the document: parameters, confidence, alternatives, undetectable effects."""

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import special

from armident.configs.schema.robot import Effect as Stanza
from armident.identify.diagnosis.candidates import Candidate, places
from armident.identify.diagnosis.experiment import recommended_experiment
from armident.identify.diagnosis.numbers import NumbersFinding
from armident.identify.diagnosis.precision import standard_deviations
from armident.identify.diagnosis.regression import relative_errors
from armident.identify.diagnosis.retrial import in_loop_of
from armident.identify.diagnosis.search import Search
from armident.identify.diagnosis.simulated import foretold_errors
from armident.identify.diagnosis.stanzas import without
from armident.identify.diagnosis.state import State, nearer, power_put_right, share_explained, with_values
from armident.identify.diagnosis.study import ALIKE
from armident.identify.diagnosis.trial import CLOSE, Trial, judge
from armident.identify.diagnosis.where import Disagreement, strangers
from armident.identify.document import Alternative, Finding, Gap, NotVisible
from armident.identify.effects.effect import Effect
from armident.identify.effects.recorded import of_recording
from armident.identify.effects.registry import catalogue, known
from armident.identify.effects.terms import place_of

Array = NDArray[np.float64]

RIVALS = 3
"""Alternatives named beside every finding."""

DOUBTFUL = 0.6
"""Confidence below which another experiment is recommended."""


def described(search: Search, first: State, final: State, left: Sequence[Disagreement]) -> list[Finding]:
    """Findings in the order in which they were made.

    Every finding is compared with its rivals in the model of all others. Its confidence is its share of the likelihood,
    times the share of the error of its joint that it explains.

    Parameters
    ----------
    search
        The search, with its settings.
    first, final
        Model as configured, and with the findings.
    left
        Dependences of the residual of the final model.
    """
    own = len(first.study.robot.effects)
    stanzas = list(with_values(final).effects)
    deviations = dict(zip(_terms(final), standard_deviations(final), strict=True))
    findings: list[Finding] = []
    for k in range(own, len(stanzas)):
        if of_recording(stanzas[k]):
            deviations[k] = _still_missing(final, stanzas[k])
        rest = search.state(without(final.study.robot, k), final)
        findings.append(_finding(search, rest, final, stanzas[k], deviations.get(k, {}), left))
    return findings


def _still_missing(final: State, stanza: Stanza) -> dict[str, float]:
    """Standard deviation of the parameter of a correction: that of a further correction in the final model."""
    effect = of_entry(stanza)
    place = place_of(stanza, effect, final.study.robot, stanza.effect)
    rest = judge(final.fit, Candidate(effect, place, ((),)), (), final.workshop)
    return {} if rest is None else {effect.linear[0].name: float(rest.std[0])}


def _finding(
    search: Search, rest: State, final: State, stanza: Stanza, std: dict[str, float], left: Sequence[Disagreement]
) -> Finding:
    study, material = final.study, search.settings.material
    effect = of_entry(stanza)
    place = place_of(stanza, effect, study.robot, stanza.effect)
    trials = [t for t in rest.trials if not t.forbidden]
    mine = next((t for t in trials if t.candidate.key == (effect.name, place.joint, place.other)), None)
    rivals = [t for t in trials if t is not mine]
    # Only candidates that pass in its place reduce the confidence of a finding.
    serious = [t for t in rest.passing(search.settings) if t is not mine]
    if mine is not None and effect.undo is not None:
        # With torques that belong to other positions no loop simulates the arm, and scores mean little: rivals are
        # those that fit the recordings as well when they are in the model.
        again = in_loop_of(study, rest.fit, mine.candidate)
        mine = again if again is not None and again.score > mine.score else mine
        others = [(t, search.with_trial(rest, t)) for t in serious]
        serious = [
            t for t, other in others if other and nearer(other, rest, material) and not nearer(final, other, material)
        ]
    # The share refers to rows of the joint itself; a change in rows of other joints does not count.
    share = 0.0 if mine is None else min(mine.share, 1.0)
    if mine is not None and effect.undo is not None:
        was, now = power_put_right(rest, final), power_put_right(final, rest)
        share = max(share, float(1.0 - now[place.joint] / was[place.joint]))
    elif mine is not None and final.study.likeness_lost(rest.study, range(study.robot.n), held=True) < ALIKE:
        # A loop whose motion differs without the effect does not show how much it explains.
        share = max(share, float(share_explained(final, rest)[place.joint]))
    scores = [] if mine is None else [mine.score, *(_instead(t, final) for t in serious)]
    close = [] if mine is None else [score for score in scores if abs(score - mine.score) < CLOSE]
    # An effect that couples two joints has to explain both.
    at = (stanza.joint, stanza.other) if effect.scope == "pair" else (stanza.joint,)
    nameless: dict[str, float] = {}
    if mine is not None and effect.undo is None:
        nameless = _nameless(search, rest, final, mine, {study.joints.index(name) for name in at if name})
    everything = special.logsumexp([*scores, *nameless.values()]) if scores else 0.0
    alone = 0.0 if mine is None else float(np.exp(mine.score - everything))
    among = float(np.exp(special.logsumexp(close) - everything)) if close else 0.0
    remaining = max((d.share for d in left if d.joint in at), default=0.0)
    # The remaining share refers to the smaller residual with the finding.
    explained = share / max(share + (1 - share) * remaining, 1e-300) if share > 0 else 0.0
    joint = place.joint
    foretold_gap = float(foretold_errors(rest, final)[joint])
    return Finding(
        effect=effect.name,
        joint=stanza.joint,
        other=stanza.other,
        kind="structure",
        parameters=stanza.parameters,
        confidence=alone * explained,
        alternatives=[
            Alternative(effect=t.candidate.effect.name, joint=study.joints[t.candidate.place.joint], score=t.score)
            for t in rivals[:RIVALS]
        ],
        gap_before=float(relative_errors(rest.fit, held=True)[1][joint]),
        gap_after=float(relative_errors(final.fit, held=True)[1][joint]),
        evidence={
            "title": effect.title,
            "description": effect.says,
            "reference": effect.reference,
            "score": None if mine is None else mine.score,
            "p_value": None if mine is None else mine.p_value,
            "tests": rest.tests,
            "share_of_residual": share,
            "gap_without_derivative_noise": foretold_gap if np.isfinite(foretold_gap) else None,
            "std": std,
            "units": _units(effect, study.robot.joints[joint].type == "prismatic"),
            "confidence_with_ambiguous": among * explained,
            "ambiguous_with": [
                t.candidate.effect.name for t in serious if mine and _instead(t, final) > mine.score - CLOSE
            ],
            "better_unnamed_dependences": [words for words, score in nameless.items() if mine and score > mine.score],
        },
    )


def _nameless(search: Search, rest: State, final: State, mine: Trial, joints: Collection[int]) -> dict[str, float]:
    """Scores of unnamed dependences on other joints in place of a finding, less their scores in the final model."""
    found = strangers(rest.fit, rest.workshop, joints, search.settings.false_alarms)
    near = [s for s in found if s.score > mine.score - CLOSE]
    scores = [s.score - s.beside(final.fit, final.workshop) for s in near]
    told = [s.disagreement() for s in near]
    return {f"{d.varies_with} at {d.joint}": score for d, score in zip(told, scores, strict=True)}


def _instead(rival: Trial, final: State) -> float:
    """Score of a rival in place of a finding, less its score in addition to the finding.

    A part that only both together explain counts against neither.
    """
    beside = [t.score for t in final.trials if t.candidate.key == rival.candidate.key and not t.forbidden]
    return rival.score - max([0.0, *beside])


def gap_of(state: State, *, held: bool) -> Gap:
    """Relative torque errors of a model.

    Parameters
    ----------
    state
        The model.
    held
        True for the held-out data, false for the training data.
    """
    overall, each = relative_errors(state.fit, held=held)
    errors = np.concatenate(state.fit.errors(state.fit.theta, held=held))
    rms = np.sqrt(np.mean(errors**2, axis=0))
    joints = state.study.joints
    return Gap(
        all=overall,
        by_joint=dict(zip(joints, (float(v) for v in each), strict=True)),
        rms=dict(zip(joints, (float(v) for v in rms), strict=True)),
    )


def noise_floor(final: State, left: Sequence[Disagreement]) -> Gap:
    """Remaining error on the held-out data, less the shares that are known not to be noise.

    Parameters
    ----------
    final
        The model with the findings.
    left
        Dependences of its residual.
    """
    study = final.study
    _, each = relative_errors(final.fit, held=True)
    power = np.sum(np.concatenate([s.y for s in study.held]) ** 2, axis=0)
    known_shares = {name: 0.0 for name in study.joints}
    for d in left:
        if d.kind == "frequency":
            # Its share is one of the working rate, most of which lies beyond the band of the comparison.
            continue
        # The share that follows the motion contains the named dependences.
        own = known_shares[d.joint] + d.share if d.kind != "motion" else max(known_shares[d.joint], d.share)
        known_shares[d.joint] = min(1.0, own)
    floor = np.array([e * np.sqrt(1 - known_shares[name]) for e, name in zip(each, study.joints, strict=True)])
    overall = float(np.sqrt((floor**2) @ power / power.sum()))
    return Gap(all=overall, by_joint=dict(zip(study.joints, (float(v) for v in floor), strict=True)))


def undetectable(state: State) -> list[NotVisible]:
    """Effects of the catalogue that this motion cannot show at some joint, with the reason."""
    study = state.study
    motion = state.workshop.motion(study.train[0], "measured")
    found: list[NotVisible] = []
    for effect in catalogue().values():
        if effect.rewires or effect.scope == "pair":
            continue
        for place in places(effect, study.robot.n):
            reason = None if effect.visible is None else effect.visible(motion, place)
            if effect.numbers is not None:
                reason = "it changes parameters of the model, not its structure: it is visible against a baseline only"
            elif (effect.name, place.joint, place.other) in state.hidden:
                reason = "the motion does not excite it, or the model already contains it"
            if reason is not None:
                joint = study.joints[place.joint]
                found.append(NotVisible(effect=effect.name, joint=joint, reason=reason, required_motion=effect.needs))
    return found


def outdated(numbers: Sequence[NumbersFinding]) -> list[Finding]:
    """Changed parameters of a baseline as findings."""
    return [
        Finding(
            effect=n.effect,
            joint=n.joint,
            other=n.other,
            kind="numbers",
            parameters=n.parameters,
            confidence=n.confidence,
            alternatives=[Alternative(effect=e, joint=j, score=score) for e, j, score in n.alternatives],
            gap_before=n.gap_before,
            gap_after=n.gap_after,
            evidence={
                "title": known(n.effect).title if n.effect in catalogue() else "parameters that have changed",
                "description": n.words,
                "p_value": n.p_value,
                "std": n.std,
                "ambiguous_with": list(n.ambiguous_with),
            },
        )
        for n in numbers
    ]


def experiment_to_separate(findings: Sequence[Finding]) -> str | None:
    """Experiment that separates a finding from a close rival or raises a low confidence; ``None`` if none is needed."""
    for finding in findings:
        rivals = [known(name) for name in finding.evidence.get("ambiguous_with", [])]
        if rivals:
            return recommended_experiment(known(finding.effect), finding.joint, rivals)
    doubtful = [f for f in findings if f.kind == "structure" and f.confidence < DOUBTFUL]
    return recommended_experiment(known(doubtful[0].effect), doubtful[0].joint) if doubtful else None


def _terms(state: State) -> list[int]:
    """Numbers of the effects of the configuration that are terms."""
    return [k for k, stanza in enumerate(state.study.robot.effects) if not of_recording(stanza)]


def _units(effect: Effect, prismatic: bool) -> dict[str, str]:
    of_linear = {p.name: p.unit[int(prismatic)] for p in effect.linear}
    return of_linear | {shape.name: shape.unit[int(prismatic)] for shape in effect.shapes}
