"""The loop of a diagnosis: is there a gap, what fills it, does it close on unseen data, what is left."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from configs import RobotConfig
from configs.robot import Effect
from identify.discrepancy.catalogue import CATALOGUE, effect_names
from identify.discrepancy.compete import FALSE_ALARMS, Trial, try_catalogue, try_shapes
from identify.discrepancy.problem import Fit, Problem, build_problem, fit, relative_errors, with_effects
from identify.document import (
    Alternative,
    BeforeAfter,
    DiagnosisDocument,
    Finding,
    Gap,
    Gaps,
    IdentificationDocument,
    RecordingReference,
    Unexplained,
    versions,
)
from identify.experiment import Experiment

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

MIN_SCORE = math.log(20.0)
"""Held-out log-likelihood that a finding must gain: the data are twenty times as likely with it."""
MIN_SHARE = 0.025
"""Share of the joint's held-out residual variance a finding must take away. Feedback correlates measured motion with
disturbances, so least squares leaves terms of a percent or two that are significant and mean nothing."""
MIN_UNEXPLAINED_SHARE = 0.10
"""Share from which on a residual that follows no effect of the catalogue is reported."""
MAX_FINDINGS = 8
RUNNERS_UP = 3


@dataclass(frozen=True)
class Diagnosis:
    """What was found, and the curves that show it.

    Parameters
    ----------
    document
        ``diagnosis.json`` without the path of the model.
    robot
        The configuration with the findings added.
    t, measured, before, after
        Held-out instants (M,), s, and torques (M, n): measured, and of the model without and with the findings.
    qd
        Held-out joint velocities (M, n).
    """

    document: DiagnosisDocument
    robot: RobotConfig
    t: Array
    measured: Array
    before: Array
    after: Array
    qd: Array


def diagnose(
    training: Sequence[Experiment],
    validation: Sequence[Experiment],
    robot: RobotConfig,
    recordings: Sequence[RecordingReference] = (),
    baseline: IdentificationDocument | None = None,
    notes: Sequence[str] = (),
    progress: Progress | None = None,
) -> Diagnosis:
    """Find the effects a model lacks, one after the other, until none passes.

    Parameters
    ----------
    training
        Experiments to fit.
    validation
        Experiments to judge by; without them the last part of the training experiments is held out.
    robot
        The model in question.
    recordings
        References to where the experiments come from, for the document.
    baseline
        Numbers to judge too: which of them no longer hold.
    notes
        Of the conversion, for the document's warnings.
    progress
        Called with a stage and the share done.

    Raises
    ------
    DataError
        If the recordings cannot support a diagnosis.
    """
    begin = time.perf_counter()
    report = progress or (lambda stage, share: None)
    report("base fit", 0.0)
    original = build_problem(training, validation, robot)
    if robot.effects:
        original = with_effects(original, robot)
    first = fit(original)
    problem, current = original, first
    findings: list[Finding] = []
    while len(findings) < MAX_FINDINGS:
        report(f"candidates, round {len(findings) + 1}", 0.2 + 0.6 * len(findings) / MAX_FINDINGS)
        step = _add_winner(problem, current)
        if step is None:
            break
        finding, problem, current = step
        findings.append(finding)
    problem_robot = _with_values(problem, current)
    report("what is left", 0.85)
    unexplained = _unexplained(problem, current)
    numbers = [] if baseline is None else _changed_numbers(problem, current, baseline)
    document = DiagnosisDocument(
        robot=robot.name,
        recordings=list(recordings),
        verdict=_verdict(bool(findings or numbers), bool(unexplained)),
        findings=[*findings, *numbers],
        unexplained=unexplained,
        gap=Gaps(
            train=BeforeAfter(
                before=_gap(original, first.theta, held_out=False), after=_gap(problem, current.theta, held_out=False)
            ),
            validation=BeforeAfter(
                before=_gap(original, first.theta, held_out=True), after=_gap(problem, current.theta, held_out=True)
            ),
        ),
        noise_floor=_floor(problem, current, unexplained),
        recommended_experiment=_recommendation(findings),
        model=None,
        timing_s={"total": time.perf_counter() - begin},
        versions=versions(),
        warnings=list(notes),
    )
    report("done", 1.0)
    held = problem.held_out
    before = [piece.block.x for piece in original.held_out]
    return Diagnosis(
        document=document,
        robot=problem_robot,
        t=_continued([piece.block.t for piece in held]),
        measured=np.concatenate([piece.block.y for piece in held]),
        before=np.concatenate([x @ first.theta for x in before]),
        after=np.concatenate([piece.block.x @ current.theta for piece in held]),
        qd=np.concatenate([piece.signals.qd[problem.decimation.instants(piece.signals.qd.shape[0])] for piece in held]),
    )


def _add_winner(problem: Problem, current: Fit) -> tuple[Finding, Problem, Fit] | None:
    """Add the candidate that predicts the held-out data best, if any passes and really makes it smaller."""
    trials = try_catalogue(problem, current)
    passing = [
        t for t in trials if t.score >= MIN_SCORE and t.share >= MIN_SHARE and t.p_value * len(trials) < FALSE_ALARMS
    ]
    for winner in passing:
        name = problem.robot.joints[winner.joint].name
        stanza = Effect(effect=winner.effect, joint=name, parameters=winner.shape)
        robot = problem.robot.model_copy(update={"effects": (*problem.robot.effects, stanza)})
        extended = with_effects(problem, robot)
        refit = fit(extended)
        before = relative_errors(problem, current.theta, held_out=True)[1][winner.joint]
        after = relative_errors(extended, refit.theta, held_out=True)[1][winner.joint]
        if after < before:
            return _finding(problem, extended, refit, winner, trials, before, after), extended, refit
    return None


def _finding(
    problem: Problem, extended: Problem, refit: Fit, winner: Trial, trials: list[Trial], before: float, after: float
) -> Finding:
    rivals = [t for t in trials if t is not winner]
    odds = sum(math.exp(min(t.score - winner.score, 0.0)) for t in rivals if t.score > 0)
    deviations = np.sqrt(np.diag(refit.covariance()))
    effect = CATALOGUE[winner.effect]
    count = len(effect.linear)
    values = dict(zip(effect.linear, (float(v) for v in refit.theta[-count:]), strict=True))
    spread = dict(zip(effect.linear, (float(v) for v in deviations[-count:]), strict=True))
    return Finding(
        effect=winner.effect,
        joint=problem.robot.joints[winner.joint].name,
        kind="structure",
        parameters={**winner.shape, **values},
        confidence=1.0 / (1.0 + odds),
        alternatives=[
            Alternative(effect=t.effect, joint=problem.robot.joints[t.joint].name, score=t.score)
            for t in rivals[:RUNNERS_UP]
        ],
        gap_before=before,
        gap_after=after,
        evidence={
            "says": effect.says,
            "score": winner.score,
            "p_value": winner.p_value,
            "tests": len(trials),
            "share_of_residual": winner.share,
            "std": spread,
            "relative_to_friction_pct": _relative(extended, refit, winner, values),
        },
    )


def _relative(problem: Problem, refit: Fit, winner: Trial, values: dict[str, float]) -> float | None:
    """Size of a viscous asymmetry as a share of the joint's viscous friction, percent."""
    name = f"fv{winner.joint + 1}"
    if winner.effect != "asymmetric_viscous_friction" or name not in problem.names:
        return None
    return 100.0 * values["fva"] / float(refit.theta[problem.names.index(name)])


def _with_values(problem: Problem, current: Fit) -> RobotConfig:
    """Write the estimated values into the effects of the configuration."""
    theta = dict(zip(effect_names(problem.robot), current.theta[problem.model.base.b :], strict=True))
    joints = [joint.name for joint in problem.robot.joints]
    stanzas = []
    for stanza in problem.robot.effects:
        number = joints.index(stanza.joint) + 1
        values = {symbol: float(theta[f"{symbol}{number}"]) for symbol in CATALOGUE[stanza.effect].linear}
        stanzas.append(stanza.model_copy(update={"parameters": {**stanza.parameters, **values}}))
    return problem.robot.model_copy(update={"effects": tuple(stanzas)})


def _unexplained(problem: Problem, current: Fit) -> list[Unexplained]:
    trials = try_shapes(problem, current)
    found: dict[int, Trial] = {}
    for trial in trials:
        enough = trial.share >= MIN_UNEXPLAINED_SHARE and trial.score >= MIN_SCORE
        if enough and trial.p_value * len(trials) < FALSE_ALARMS and trial.joint not in found:
            found[trial.joint] = trial
    return [
        Unexplained(
            joint=problem.robot.joints[joint].name,
            share_of_residual=trial.share,
            varies_with=trial.effect,
            hint=f"a torque that changes with {trial.effect} in a way no effect of the catalogue has",
        )
        for joint, trial in sorted(found.items())
    ]


def _changed_numbers(problem: Problem, current: Fit, baseline: IdentificationDocument) -> list[Finding]:
    """One finding per joint whose parameters have moved further than both uncertainties allow."""
    theta = dict(zip(problem.names, current.theta, strict=True))
    deviation = dict(zip(problem.names, np.sqrt(np.diag(current.covariance())), strict=True))
    known = [p for p in baseline.parameters if p.essential and p.name in theta]
    numbers = np.array(current.theta)
    moved: dict[str, list[tuple[str, float]]] = {}
    for p in baseline.parameters:
        if p.name in theta:
            numbers[problem.names.index(p.name)] = p.value
    for p in known:
        z = (theta[p.name] - p.value) / math.hypot(deviation[p.name], p.std)
        if math.erfc(abs(z) / math.sqrt(2)) * len(known) < FALSE_ALARMS:
            moved.setdefault("".join(c for c in p.name if c.isdigit())[-1:], []).append((p.name, z))
    old = relative_errors(problem, numbers, held_out=True)[1]
    new = relative_errors(problem, current.theta, held_out=True)[1]
    findings = []
    for number, changes in sorted(moved.items()):
        joint = int(number) - 1 if number else 0
        findings.append(
            Finding(
                effect="changed_parameters",
                joint=problem.robot.joints[joint].name,
                kind="numbers",
                parameters={name: float(theta[name]) for name, _ in changes},
                confidence=1.0 - FALSE_ALARMS,
                alternatives=[],
                gap_before=old[joint],
                gap_after=new[joint],
                evidence={
                    "says": "the structure of the model holds, but these numbers are no longer those of the baseline",
                    "deviations": {name: z for name, z in changes},
                },
            )
        )
    return [f for f in findings if f.gap_after < f.gap_before]


def _verdict(found: bool, left: bool) -> str:
    if found:
        return "partly_explained" if left else "explained"
    return "unexplained" if left else "no_gap"


def _gap(problem: Problem, theta: Array, *, held_out: bool) -> Gap:
    overall, each = relative_errors(problem, theta, held_out=held_out)
    return Gap(all=overall, by_joint=dict(zip([j.name for j in problem.robot.joints], each, strict=True)))


def _floor(problem: Problem, current: Fit, unexplained: Sequence[Unexplained]) -> Gap:
    """What remains on the training data, less the shares that are known not to be noise."""
    _, each = relative_errors(problem, current.theta, held_out=False)
    torque = np.concatenate([piece.block.y for piece in problem.train])
    shares = {u.joint: min(u.share_of_residual, 1.0) for u in unexplained}
    names = [joint.name for joint in problem.robot.joints]
    floor = np.array([e * math.sqrt(1 - shares.get(name, 0.0)) for e, name in zip(each, names, strict=True)])
    power = (torque**2).sum(axis=0)
    overall = math.sqrt(float((floor**2) @ power) / float(power.sum()))
    return Gap(all=overall, by_joint=dict(zip(names, (float(f) for f in floor), strict=True)))


def _recommendation(findings: Sequence[Finding]) -> str | None:
    """An experiment that separates a finding from a runner-up nearly as good."""
    for finding in findings:
        for rival in finding.alternatives:
            if rival.score > finding.evidence["score"] - MIN_SCORE and rival.effect in CATALOGUE:
                return (
                    f"{finding.effect} and {rival.effect} of {rival.joint} are hard to tell apart here: record "
                    f"{CATALOGUE[finding.effect].needs}, and {CATALOGUE[rival.effect].needs}"
                )
    return None


def _continued(times: Sequence[Array]) -> Array:
    """Instants of one piece after the other on one axis."""
    parts, end = [], 0.0
    for t in times:
        parts.append(t + end)
        end = float(parts[-1][-1])
    return np.concatenate(parts)
