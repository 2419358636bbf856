"""Diagnosis of a model: lack of fit, missing effects, held-out validation, unexplained residual dependences."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from armident.configs import RobotConfig
from armident.identify.diagnosis.doubt import Outcome, convincing
from armident.identify.diagnosis.findings import (
    experiment_to_separate,
    gap_of,
    noise_floor,
    outdated,
    undetectable,
)
from armident.identify.diagnosis.hiding import detection_limits
from armident.identify.diagnosis.numbers import stale_numbers
from armident.identify.diagnosis.search import Search
from armident.identify.diagnosis.setup_stage import set_up
from armident.identify.diagnosis.simulated import SimulatedErrors, simulated_errors
from armident.identify.diagnosis.state import Settings, State, with_values
from armident.identify.diagnosis.study import Study, build_study
from armident.identify.diagnosis.where import Disagreement, beyond_noise, survey, where
from armident.identify.document import (
    BeforeAfter,
    DiagnosisDocument,
    Finding,
    Gaps,
    IdentificationDocument,
    RecordingReference,
    Unexplained,
    Verdict,
    versions,
)
from armident.identify.experiment import Experiment

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Diagnosis:
    """Result of a diagnosis, with the curves of its report.

    Parameters
    ----------
    document
        ``diagnosis.json`` without the path of the model.
    robot
        Configuration with the findings added.
    t, measured, before, after
        Held-out instants (M,), s, and torques (M, n), N m or N: measured, and of the model without and with the
        findings.
    lacking
        Torques (M, n) of the model with all findings but one, for each finding of the document; ``None`` for a finding
        that is not a part of the model (wiring, parameter changes).
    q, qd
        Held-out joint positions and velocities (M, n), rad and rad/s, or m and m/s.
    where
        Dependences of the residual of the model as configured.
    left
        Dependences of the residual of the model with the findings.
    simulated
        Errors of the simulated closed loop before and after.
    """

    document: DiagnosisDocument
    robot: RobotConfig
    t: Array
    measured: Array
    before: Array
    after: Array
    lacking: tuple[Array | None, ...]
    q: Array
    qd: Array
    where: tuple[Disagreement, ...]
    left: tuple[Disagreement, ...]
    simulated: SimulatedErrors


def diagnose(
    training: Sequence[Experiment],
    validation: Sequence[Experiment],
    robot: RobotConfig,
    recordings: Sequence[RecordingReference] = (),
    baseline: IdentificationDocument | None = None,
    notes: Sequence[str] = (),
    progress: Progress | None = None,
    settings: Settings | None = None,
) -> Diagnosis:
    """Find the effects that a model lacks by stepwise selection.

    Parameters
    ----------
    training
        Experiments to fit.
    validation
        Held-out experiments; without them the last part of the training experiments is held out.
    robot
        Configuration of the model to diagnose.
    recordings
        References to the recordings of the experiments, for the document.
    baseline
        Identification whose parameters are tested for change.
    notes
        Messages of the conversion, for the document's warnings.
    progress
        Called with a stage and the share done, 0 to 1.
    settings
        Error rates.

    Returns
    -------
    Diagnosis
        Document, configuration with the findings, and curves.

    Raises
    ------
    DataError
        If the recordings cannot support a diagnosis.
    """
    # Threads gain little on tall and narrow matrices, and round otherwise.
    with threadpool_limits(1):  # type: ignore[no-untyped-call]
        return _diagnose(
            training, validation, robot, recordings, baseline, notes, _Steps(progress), settings or Settings()
        )


class _Steps:
    """Reports the progress of a search with an unknown number of steps."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress = progress or (lambda stage, share: None)
        self._done = 0.0
        self._begin = self._since = time.perf_counter()
        self._stage = ""
        self.spent: dict[str, float] = {}

    def __call__(self, stage: str) -> None:
        self._note()
        self._stage = stage
        self._done += 0.15 * (1.0 - self._done)
        self._progress(stage, self._done)

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
    settings: Settings,
) -> Diagnosis:
    steps("set-up")
    stage = set_up(training, validation, robot)
    found = _searched(stage.training, stage.validation, stage.robot, steps, settings)
    study, first, outcome = found.study, found.first, found.outcome
    final = outcome.state
    after = gap_of(final, held=True)
    findings = stage.named(outcome.findings, after)
    places = {id(f): k for k, f in enumerate(outcome.findings)}
    lacking = [_beside(final, outcome.lacking[places[id(f)]]) if id(f) in places else None for f in findings]
    left = stage.left(
        [
            Unexplained(joint=d.joint, share_of_residual=d.share, varies_with=d.varies_with, hint=d.hint)
            for d in found.left
        ],
        after,
    )
    if baseline is not None:
        steps("changed parameters")
        findings += outdated(stale_numbers(final.fit, final.workshop, baseline, settings.false_alarms))
    steps("simulation")
    simulated = simulated_errors(first, final)
    steps("detection limits")
    limits = detection_limits(final, settings)
    document = DiagnosisDocument(
        robot=robot.name,
        recordings=list(recordings),
        verdict=_verdict(findings, left),
        findings=findings,
        considered=list(outcome.considered),
        unexplained=left,
        gap=Gaps(
            train=BeforeAfter(before=stage.as_configured(gap_of(first, held=False)), after=gap_of(final, held=False)),
            validation=BeforeAfter(before=stage.as_configured(gap_of(first, held=True)), after=after),
        ),
        noise_floor=noise_floor(final, found.left),
        recommended_experiment=experiment_to_separate(findings),
        model=None,
        timing_s=steps.finish(),
        versions=versions(),
        warnings=[*notes, *stage.warnings, *study.warnings],
        not_visible=undetectable(first),
        detection_limits=limits,
        simulated=simulated.document(),
        sign_smoothing=dict(zip(study.joints, map(float, study.robot.sign_smoothing), strict=True)),
    )
    held = final.study.held
    return Diagnosis(
        document=document,
        robot=with_values(final),
        t=_continued([s.t for s in held]),
        measured=np.concatenate([s.y for s in held]),
        before=_beside(final, first),
        after=_predicted(final),
        lacking=(*lacking, *(None for _ in findings[len(lacking) :])),
        q=_sampled(final, "q"),
        qd=_sampled(final, "qd"),
        where=found.where,
        left=found.left,
        simulated=simulated,
    )


@dataclass(frozen=True, eq=False)
class _Found:
    """Result of a search: data, first and final model, and remaining dependences."""

    study: Study
    first: State
    outcome: Outcome
    where: tuple[Disagreement, ...]
    left: tuple[Disagreement, ...]


def _searched(
    training: Sequence[Experiment],
    validation: Sequence[Experiment],
    robot: RobotConfig,
    steps: _Steps,
    settings: Settings,
) -> _Found:
    """Search for effects in the corrected set-up."""
    steps("derivatives and closed loop")
    study = build_study(training, validation, robot)
    steps("base fit")
    search = Search(study, settings, steps)
    first = search.start()
    steps("residual dependences")
    seen = survey(first.fit, first.workshop, settings.false_alarms)
    places = where(first.fit, first.workshop, seen=seen)
    outcome = convincing(search, first, search.run(), seen)
    steps("unexplained dependences")
    left = beyond_noise(outcome.state.fit, outcome.left, settings.false_alarms)
    return _Found(study, first, outcome, tuple(places), tuple(left))


def _verdict(findings: Sequence[Finding], left: Sequence[Unexplained]) -> Verdict:
    """Verdict; with ``no_gap`` and ``explained`` the residual is noise (see `excess`) and depends on no variable."""
    if findings:
        return "partly_explained" if left else "explained"
    return "unexplained" if left else "no_gap"


def _predicted(state: State) -> Array:
    """Torques of the model on the held-out data, (M, n)."""
    return np.concatenate([x @ state.fit.theta for x, _, _ in state.fit.equations.held])


def _beside(final: State, state: State) -> Array:
    """Torques (M, n) of another model, with its residuals referred to the corrected recordings of the final one."""
    pairs = zip(final.study.held, state.study.held, strict=True)
    return np.asarray(_predicted(state) + np.concatenate([right.y - own.y for right, own in pairs]))


def _sampled(state: State, name: str) -> Array:
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
