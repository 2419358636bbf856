"""Selected effects as entries of the document: parameters, evidence, alternatives, undetectable effects."""

from collections.abc import Mapping, Sequence

import numpy as np

from armident.identify.diagnosis.candidate_comparison import Addition, SelectionStep
from armident.identify.diagnosis.candidates import ColumnCache, Key
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.lack_of_fit import ResidualDependence
from armident.identify.diagnosis.model_state import ModelState
from armident.identify.diagnosis.next_experiment import recommended_experiment
from armident.identify.diagnosis.precision import standard_deviations
from armident.identify.diagnosis.selected import Selected
from armident.identify.documents.diagnosis import Alternative, Finding, Gap, Negligible, NotVisible, Unexplained
from armident.identify.effects.effect import Effect
from armident.identify.effects.parameter_change import ParameterChange
from armident.identify.effects.registry import catalogue, known, of_entry
from armident.identify.effects.unnamed import NAME as UNNAMED
from armident.identify.effects.wiring import SignalMistake


def findings_of(final: ModelState, selected: Sequence[Selected], left: Sequence[Unexplained]) -> list[Finding]:
    """Return the findings of a selection, in order, without probabilities; ``left``: dependences of the residual."""
    deviations = standard_deviations(final)
    entries = list(final.robot.effects)
    values = final.with_values().effects
    rest = _known_shares(left)
    found = []
    for one in selected:
        number = entries.index(one.entry)
        found.append(_finding(final, one, values[number].parameters, deviations[number], rest))
    return found


def _finding(
    final: ModelState, one: Selected, parameters: Mapping[str, float], std: dict[str, float], rest: Mapping[str, float]
) -> Finding:
    addition, report = one.addition, one.confirmation
    assert report is not None
    effect, place = of_entry(one.entry), addition.candidate.place
    # The gap is that of the joint of the effect, or of the joint whose errors it reduces most.
    joint = place.joint
    if effect.scope == "arm" or report.share[joint] <= 0.0:
        joint = int(np.argmax(report.share))
    chance = min(1.0, one.step.tests * float(np.exp(-addition.gain)))
    rivals = one.step.rivals(addition)
    odds = tempered_odds(one.step, addition)
    name = final.study.joints[joint]
    before, after = float(report.before[joint]), float(report.best[joint])
    taken, unknown = max(before**2 - after**2, 0.0), rest.get(name, 0.0) * after**2
    return Finding(
        effect=effect.name,
        law=effect.law,
        joint=name if effect.scope == "arm" else one.entry.joint,
        other=one.entry.other,
        kind="structure",
        parameters=dict(parameters),
        confidence=0.0,
        alternatives=_alternatives(final, addition, rivals),
        gap_before=before,
        gap_after=after,
        evidence={
            "title": effect.title,
            "description": effect.description,
            "reference": effect.reference,
            "score": addition.gain,
            "p_value": report.p_value,
            "gap_joint": name,
            "gap_at_measured_motion": float(report.after[joint]),
            "p_value_selection": chance,
            "p_value_parameters": one.p_value,
            "tests": one.step.tests,
            "share_of_residual": float(report.share[joint]),
            "change_of_torque_pct": addition.material_pct,
            "fall": float(report.fall[joint]),
            "std": std,
            "units": _units(effect, final.robot.joints[place.joint].type == "prismatic"),
            # Of the error that is known not to be noise; what is left may be the rest of another effect.
            "share_explained": taken / (taken + unknown) if unknown > 0.0 else 1.0,
            "margin": -float(np.log(max([*odds.values(), 1e-300]))),
            "odds": {
                key[0]: ratio
                for key, ratio in odds.items()
                if key[0] != effect.name
                and (known(key[0]).scope == "arm" or not {joint, place.joint}.isdisjoint(key[1:]))
            },
        },
    )


def _known_shares(left: Sequence[Unexplained]) -> dict[str, float]:
    """Share of each joint's remaining error power that is known not to be noise, by name; dependences may overlap."""
    shares: dict[str, float] = {}
    for entry in left:
        shares[entry.joint] = min(1.0, max(shares.get(entry.joint, 0.0), entry.share_of_residual))
    return shares


def tempered_odds(step: SelectionStep, one: Addition) -> dict[Key, float]:
    """Return the posterior odds of each other effect in place of one, whatever its law, with equal prior odds.

    Differences of log-likelihood are reduced by the serial correlation that the noise models leave.
    """
    factor = float(np.clip(one.gain / one.raw_gain, 0.0, 1.0)) if one.raw_gain > 0.0 else 1.0
    odds: dict[Key, float] = {}
    for rival in step.rivals(one):
        if rival.named:
            odds.setdefault(rival.family, float(np.exp(min(0.0, factor * (rival.log_likelihood - one.log_likelihood)))))
    return odds


def _alternatives(final: ModelState, one: Addition, rivals: Sequence[Addition]) -> list[Alternative]:
    """Best law of each other effect, highest log-likelihood first."""
    found: dict[Key, Alternative] = {}
    for rival in rivals:
        if rival.named:
            joint = final.study.joints[rival.candidate.place.joint]
            entry = Alternative(effect=rival.family[0], joint=joint, score=rival.log_likelihood - one.log_likelihood)
            found.setdefault(rival.family, entry)
    return list(found.values())[: final.study.criteria.alternatives]


def negligible(
    final: ModelState,
    conventional: Sequence[Selected],
    step: SelectionStep | None,
    immaterial: Sequence[Addition],
    dependences: Sequence[tuple[ResidualDependence, float]],
) -> list[Negligible]:
    """Return what is significant and no cause: too small, or within the sampling convention of drives.

    ``dependences``: of residuals, with the fall of the error without them, percent.
    """
    found: dict[Key, Negligible] = {}
    small = [*(one.addition for one in conventional), *immaterial]
    if step is not None:
        needed = final.study.criteria.needed_gain(step.tests)
        small += [a for a in step.ranked if a.gain > needed and a not in step.passing]
    for addition in small:
        if addition.allowed and addition.named:
            joint = final.study.joints[addition.candidate.place.joint]
            entry = Negligible(
                effect=addition.candidate.effect.name,
                joint=joint,
                change_of_torque_pct=addition.material_pct,
                share_of_residual=addition.share,
            )
            found.setdefault(addition.family, entry)
    rest = [
        Negligible(
            effect=UNNAMED,
            joint=d.joint,
            varies_with=d.varies_with,
            change_of_torque_pct=fall,
            share_of_residual=d.share,
        )
        for d, fall in dependences
    ]
    return [*found.values(), *rest]


def gap_of(state: ModelState, *, held: bool) -> Gap:
    """Relative torque errors of a model. ``held``: True for the held-out data, false for the training data."""
    stretches, errors = state.study.held if held else state.study.train, state.fit.errors(state.fit.theta, held=held)
    error = np.concatenate([e * s.noise for e, s in zip(errors, stretches, strict=True)])
    torque = np.concatenate([s.torques for s in stretches])
    each = 100 * np.linalg.norm(error, axis=0) / np.maximum(np.linalg.norm(torque, axis=0), 1e-300)
    rms = np.sqrt(np.mean(error**2, axis=0))
    joints = state.study.joints
    return Gap(
        all=100 * float(np.linalg.norm(error) / np.linalg.norm(torque)),
        by_joint=dict(zip(joints, (float(v) for v in each), strict=True)),
        rms=dict(zip(joints, (float(v) for v in rms), strict=True)),
    )


def noise_floor(final: ModelState, left: Sequence[Unexplained]) -> Gap:
    """Return the remaining held-out error, less the shares that are known not to be noise."""
    gap = gap_of(final, held=True)
    known_shares = {name: 0.0 for name in gap.by_joint} | _known_shares(left)
    by_joint = {name: error * float(np.sqrt(1.0 - known_shares[name])) for name, error in gap.by_joint.items()}
    rms = {name: gap.rms[name] * float(np.sqrt(1.0 - known_shares[name])) for name in by_joint}
    torque = {name: gap.rms[name] / max(gap.by_joint[name], 1e-300) for name in by_joint}
    total = float(np.sqrt(sum(v**2 for v in rms.values()) / max(sum(v**2 for v in torque.values()), 1e-300)))
    return Gap(all=total, by_joint=by_joint, rms=rms)


def undetectable(state: ModelState, hidden: frozenset[Key]) -> list[NotVisible]:
    """Return the effects that this motion cannot show at some joint, with the reason.

    ``hidden``: effects and places that the model contains or the motion does not excite.
    """
    study = state.study
    motion = ColumnCache(study, state.fit.theta).motion(study.train[0], "measured")
    found: dict[tuple[str, str], NotVisible] = {}
    for effect in catalogue().values():
        if isinstance(effect, SignalMistake) or effect.two_joints or effect.law:
            continue
        for place in effect.places(study.robot.n):
            reason = effect.invisible(motion, place)
            if isinstance(effect, ParameterChange):
                reason = "it changes parameters of the model, not its structure: it is visible against a baseline only"
            elif (effect.key, place.joint, place.other) in hidden:
                reason = "the motion does not excite it, or the model already contains it"
            if reason is not None:
                name, joint, motion_text = effect.name, study.joints[place.joint], effect.required_motion
                entry = NotVisible(effect=name, joint=joint, reason=reason, required_motion=motion_text)
                found.setdefault((name, joint), entry)
    return list(found.values())


def experiment_to_separate(findings: Sequence[Finding], criteria: Criteria) -> str | None:
    """Return the experiment that separates a finding from the other names of its set, or raises a low probability."""
    named = [f for f in findings if f.effect in catalogue()]
    for finding in named:
        rivals = [known(name) for name in finding.evidence.get("ambiguous_with", []) if name in catalogue()]
        if rivals:
            return recommended_experiment(known(finding.effect), finding.joint, rivals)
    doubtful = [f for f in named if f.kind == "structure" and f.confidence < criteria.doubtful]
    return recommended_experiment(known(doubtful[0].effect), doubtful[0].joint) if doubtful else None


def _units(effect: Effect, prismatic: bool) -> dict[str, str]:
    return {name: unit[int(prismatic)] for name, unit in effect.units.items()}
