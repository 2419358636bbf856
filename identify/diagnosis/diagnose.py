"""Diagnosis of a model: set-up, missing effects, confirmation on data not used for selection, unexplained residual."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property

import numpy as np
from threadpoolctl import threadpool_limits

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.identify.diagnosis.baseline_stage import BaselineStage, against_baseline
from armident.identify.diagnosis.candidate_comparison import Addition
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.detection_limits import detection_limits
from armident.identify.diagnosis.findings import (
    experiment_to_separate,
    findings_of,
    gap_of,
    negligible,
    noise_floor,
    undetectable,
)
from armident.identify.diagnosis.lack_of_fit import LackOfFit, ResidualDependence
from armident.identify.diagnosis.model_state import ModelState, with_entries, with_report_part
from armident.identify.diagnosis.probabilities import calibration, judged
from armident.identify.diagnosis.selected import Selected
from armident.identify.diagnosis.selection import StepwiseSelection
from armident.identify.diagnosis.setup_stage import set_up
from armident.identify.diagnosis.simulated import SimulatedErrors, simulated_errors
from armident.identify.diagnosis.study import build_study
from armident.identify.documents.base import RecordingReference, versions
from armident.identify.documents.diagnosis import (
    BeforeAfter,
    DiagnosisDocument,
    Finding,
    Gap,
    Gaps,
    Unexplained,
    Verdict,
)
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.effects.friction import TRANSITION
from armident.identify.effects.recording_corrections import of_recording
from armident.identify.effects.registry import known
from armident.identify.effects.unnamed import NAME as UNNAMED
from armident.identify.regression.equations import applied
from armident.identify.signals.experiments import Experiment

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class DiagnosisResult:
    """Result of a diagnosis, with the curves of its report; held-out signals are (M,) or (M, n), SI.

    ``robot``: configuration with the findings. ``before``, ``after``: torques of the model without and with the
    findings. ``lacking``: torques with all findings but one; ``own``: torques of each finding itself. They are ``None``
    for findings outside the model. ``after - lacking`` differs from ``own``: other parameters compensate. ``left``:
    dependences of the residual with the findings. ``first``: model without
    them; ``None`` where a change against a baseline is all that was found.
    """

    document: DiagnosisDocument
    robot: RobotConfig
    t: Array
    measured: Array
    before: Array
    after: Array
    lacking: tuple[Array | None, ...]
    own: tuple[Array | None, ...]
    q: Array
    qd: Array
    left: tuple[ResidualDependence, ...]
    simulated: SimulatedErrors
    first: ModelState | None

    @cached_property
    def where(self) -> tuple[ResidualDependence, ...]:
        """Dependences of the residual without the findings; only a report needs them."""
        if self.first is None:
            return ()
        with threadpool_limits(1):
            return LackOfFit(self.first.fit).dependences


def run_diagnosis(
    training: Sequence[Experiment],
    validation: Sequence[Experiment],
    robot: RobotConfig,
    recordings: Sequence[RecordingReference] = (),
    baseline: IdentificationDocument | None = None,
    notes: Sequence[str] = (),
    progress: Progress | None = None,
    criteria: Criteria | None = None,
    time_limit_s: float | None = None,
) -> DiagnosisResult:
    """Find the effects that a model lacks by stepwise selection.

    Without ``validation`` the last part of the training experiments is the report part. ``baseline``: identification
    whose parameters are tested for change. ``notes``: messages of the conversion, for the warnings. ``progress``:
    called with a stage and the share done, 0 to 1. After ``time_limit_s`` of wall-clock time the selection ends with
    what it has found.
    """
    deadline = float("inf") if time_limit_s is None else time.monotonic() + time_limit_s
    # Threads gain little on tall and narrow matrices, and round otherwise.
    with threadpool_limits(1):
        return _diagnose(
            training, validation, robot, recordings, baseline, notes, _Steps(progress), criteria or Criteria(), deadline
        )


BEGINS = {
    "set-up": 0.0,
    "derivatives and closed loop": 0.15,
    "changed parameters": 0.17,
    "base fit": 0.2,
    "unexplained dependences": 0.85,
    "simulation": 0.9,
    "detection limits": 0.95,
}
"""Share of the time before each stage; the steps of the selection lie between."""
SELECTION = (0.22, 0.85)
"""Shares of the time at the begin and at the end of the selection."""
LIKELY = 0.5
"""Probability of a name that explains something: more probably right than wrong."""
STEP = 0.4
"""Share of the remaining selection that one step takes: their number is unknown, and mostly one to six."""


class _Steps:
    """Reports the progress of a search with an unknown number of steps; the share never falls."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress = progress or (lambda stage, share: None)
        self._done = 0.0
        self._step = SELECTION[0], SELECTION[0]
        self._begin = self._since = time.perf_counter()
        self._stage = ""
        self.spent: dict[str, float] = {}

    def __call__(self, stage: str) -> None:
        self._note()
        self._stage = stage
        begin = BEGINS.get(stage)
        if begin is None:
            begin = self._step[1]
            self._step = begin, begin + STEP * (SELECTION[1] - begin)
        self._show(begin)

    def tested(self, share: float) -> None:
        """Report the share of the candidates of one step of the selection that have been tested."""
        begin, end = self._step
        self._show(begin + share * (end - begin))

    def _show(self, share: float) -> None:
        self._done = max(self._done, share)
        self._progress(self._stage, self._done)

    def finish(self) -> dict[str, float]:
        self._note()
        self._progress("done", 1.0)
        return {**self.spent, "total": time.perf_counter() - self._begin}

    def _note(self) -> None:
        now = time.perf_counter()
        if self._stage:
            kind = "search" if self._stage.startswith(("adding", "removing", "exchang")) else self._stage
            self.spent[kind] = self.spent.get(kind, 0.0) + now - self._since
        self._since = now


def _diagnose(
    training: Sequence[Experiment],
    validation: Sequence[Experiment],
    robot: RobotConfig,
    recordings: Sequence[RecordingReference],
    baseline: IdentificationDocument | None,
    notes: Sequence[str],
    steps: _Steps,
    criteria: Criteria,
    deadline: float,
) -> DiagnosisResult:
    steps("set-up")
    stage = set_up(training, validation, robot, criteria)
    steps("derivatives and closed loop")
    study = build_study(stage.training, stage.validation, stage.robot, criteria=criteria)
    change = BaselineStage()
    if baseline is not None:
        steps("changed parameters")
        change = against_baseline(stage, baseline, criteria)
        study = study.of_robot(with_entries(study.robot, change.entries))
        study = replace(study, sought=change.sought, sign_given=study.sign_given or change.complete)
    steps("base fit")
    selection = StepwiseSelection(study, steps, deadline, steps.tested, shifts=stage.shifts)
    first = selection.start()
    steps("comparison of effects")
    chosen, every = (first, ()) if change.complete else selection.run(first)
    if validation and selection.absent:
        own = _diagnose(training, (), robot, recordings, baseline, notes, steps, criteria, deadline)
        lines = _changed_between(own.document, selection.absent)
        if lines:
            return replace(own, document=own.document.model_copy(update={"warnings": [*own.document.warnings, *lines]}))
    final = with_report_part(chosen)
    # Where the instant of all torques is unknown, a delay of one drive is known to the sample only.
    conventional = [one for one in every if one.conventional(final, 0.0 if stage.shift_known else final.study.sample)]
    selected = [one for one in every if one not in conventional]
    after = gap_of(final, held=True)
    steps("unexplained dependences")
    fit_test = LackOfFit(final.fit)
    dependences, small = ((), ()) if change.complete else (fit_test.unexplained, fit_test.immaterial)
    rest = [
        Unexplained(joint=d.joint, share_of_residual=d.share, varies_with=d.varies_with, hint=d.hint)
        for d in dependences
    ]
    named = findings_of(final, selected, rest)
    stopped = _stopped(selection, len(named))
    doubtful = {entry.joint for entry in stage.doubtful(after)}
    explained = [(f, one) for f, one in zip(named, selected, strict=True) if f.joint not in doubtful]
    first_findings = [*stage.findings, *change.beside([f for f, _ in explained], study.joints)]
    findings = [*first_findings, *(f for f, _ in explained)]
    chosen_for = [*(None for _ in first_findings), *(one for _, one in explained)]
    left = stage.left(change.left(named, rest, study.joints), after)
    findings, explanations = judged(findings, left, study.joints, calibration(several=len(training) > 1))
    steps("simulation")
    simulated = simulated_errors(first, final)
    steps("detection limits")
    last = selection.last(chosen)
    limits = detection_limits(final, last)
    document = DiagnosisDocument(
        robot=robot.name,
        recordings=list(recordings),
        verdict=_verdict(findings, left),
        findings=findings,
        explanations=explanations,
        unexplained=left,
        gap=Gaps(
            train=_gaps(stage.as_configured(gap_of(first, held=False)), gap_of(final, held=False), change, 0),
            validation=_gaps(stage.as_configured(gap_of(first, held=True)), after, change, 1),
        ),
        noise_floor=noise_floor(final, left),
        recommended_experiment=experiment_to_separate(findings, criteria),
        model=None,
        timing_s=steps.finish(),
        versions=versions(),
        warnings=[*notes, *stage.warnings, *change.warnings, *selection.study.warnings, *stopped],
        not_visible=undetectable(first, selection.hidden),
        detection_limits=limits,
        simulated=simulated.document(),
        negligible=negligible(final, conventional, last, selection.immaterial, small),
        sign_smoothing=dict(zip(study.joints, map(float, first.robot.sign_smoothing), strict=True)),
        transitions={e.joint: e.parameters["velocity"] for e in final.robot.effects if e.effect == TRANSITION},
        criteria=asdict(criteria),
        alpha=criteria.alpha,
    )
    held = final.study.held
    return DiagnosisResult(
        document=document,
        robot=final.with_values(),
        t=_continued([s.t for s in held]),
        measured=np.concatenate([s.y for s in held]),
        before=_predicted_for_final(final, first),
        after=_predicted(final),
        lacking=_of_findings(_lacking, final, chosen_for),
        own=_of_findings(_own, final, chosen_for),
        q=_sampled(final, "q"),
        qd=_sampled(final, "qd"),
        left=dependences,
        simulated=simulated,
        first=None if change.complete else first,
    )


def _changed_between(document: DiagnosisDocument, absent: Sequence[Addition]) -> list[str]:
    """Warnings of effects that the training recordings have, by their own report part, and the validation does not."""
    likely = {(f.effect, f.joint): f for f in document.findings if f.confidence >= LIKELY}
    gone = {(one.candidate.effect.name, str(one.entry.joint)): one for one in absent}
    return [
        f"{joint}: {known(effect).title} explains {100 * one.share:.0f} % of its residual in the recordings to learn "
        "from, and is absent from those of --validate: the arm changed between them; this diagnosis is of the former, "
        "judged by their last part; diagnose the latter alone"
        for (effect, joint), one in gone.items()
        if (effect, joint) in likely
    ]


def _gaps(before: Gap, after: Gap, change: BaselineStage, part: int) -> BeforeAfter:
    """Gap of a part of the data: of the baseline and with its changes, or of the models if there is none."""
    if change.before is None or change.after is None:
        return BeforeAfter(before=before, after=after)
    return BeforeAfter(before=change.before[part], after=change.after[part] if change.complete else after)


def _stopped(selection: StepwiseSelection, findings: int) -> list[str]:
    """Warning of a selection that its time limit ended."""
    if not selection.stopped:
        return []
    steps, plural = selection.compared, "" if findings == 1 else "s"
    return [
        f"the time limit ended the selection of effects after {steps} complete comparison{'' if steps == 1 else 's'} "
        f"and {findings} finding{plural}: other effects were not compared, only the lack of fit was tested; "
        "repeat with a larger --time-limit"
    ]


def _verdict(findings: Sequence[Finding], left: Sequence[Unexplained]) -> Verdict:
    """Verdict: terms without a name, doubtful names, and mistakes of the set-up left uncorrected explain nothing."""
    explains = [f.effect != UNNAMED and f.confidence >= LIKELY and f.evidence.get("corrected", True) for f in findings]
    if not findings and not left:
        return "no_gap"
    if not any(explains):
        return "unexplained"
    return "partly_explained" if left or not all(explains) else "explained"


def _predicted(state: ModelState) -> Array:
    """Torques of the model on the held-out data, (M, n)."""
    return np.concatenate([applied(e.x, state.fit.theta) for e in state.fit.equations.held])


def _predicted_for_final(final: ModelState, state: ModelState) -> Array:
    """Torques (M, n) of another model, with its residuals referred to the corrected recordings of the final one."""
    pairs = zip(final.study.held, state.study.held, strict=True)
    return np.asarray(_predicted(state) + np.concatenate([right.y - own.y for right, own in pairs]))


def _lacking(final: ModelState, one: Selected) -> Array | None:
    """Torques (M, n) of the model without one finding."""
    return None if one.without is None else _predicted_for_final(final, one.without)


def _own(final: ModelState, one: Selected) -> Array | None:
    """Torques (M, n) of a finding that is a term of the model."""
    if of_recording(one.entry):
        return None
    own = [final.study.model.base.names.index(name) for name in final.term_of(one.entry).names]
    return np.concatenate([e.x[:, :, own] @ final.fit.theta[own] for e in final.fit.equations.held])


def _of_findings(
    curve: Callable[[ModelState, Selected], Array | None],
    final: ModelState,
    selected: Sequence[Selected | None],
) -> tuple[Array | None, ...]:
    """Curves of all findings: those of the set-up and of changes against a baseline, which come first, have none."""
    return tuple(None if one is None else curve(final, one) for one in selected)


def _sampled(state: ModelState, name: str) -> Array:
    """A measured signal at the held-out instants, (M, n)."""
    signals = [getattr(s.measured, name) for s in state.study.held]
    return np.concatenate([s[state.study.decimation.instants(s.shape[0])] for s in signals])


def _continued(times: Sequence[Array]) -> Array:
    """Instants of one stretch after the other on one axis, each from where the last one ended."""
    parts: list[Array] = []
    end = 0.0
    for t in times:
        parts.append(t - t[0] + end)
        end = float(parts[-1][-1])
    return np.concatenate(parts)
