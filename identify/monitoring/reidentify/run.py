"""Command ``armident reidentify`` of one arm: check, move, identify, compare, store and publish."""

import json
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from armident.configs import (
    ArmidentError,
    ConfigError,
    DataError,
    RobotConfig,
    SessionConfig,
    load_robot,
    load_trajectory,
)
from armident.configs.errors import FOUND
from armident.daq.recording import Recording
from armident.identify.diagnosis.baseline_comparison import Inconclusive
from armident.identify.diagnosis.change_test import ParameterChangeTest, compare
from armident.identify.documents.diagnosis import DiagnosisDocument
from armident.identify.documents.files import from_json, to_json
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.documents.investigation import InvestigationDocument
from armident.identify.documents.signing import sign_file
from armident.identify.effects.terms import arm_model
from armident.identify.excitation.point_to_point import sample_trajectory
from armident.identify.excitation.previous_estimate import previous_estimate
from armident.identify.identification.options import options_of
from armident.identify.monitoring.reidentify.baseline import Baseline, baseline_of
from armident.identify.monitoring.reidentify.cell import load_moving_session
from armident.identify.monitoring.reidentify.identify_once import identify_once
from armident.identify.monitoring.reidentify.job_metrics import drift_values, identified_values, reported
from armident.identify.monitoring.reidentify.keep import HistoryEntry, history_or_reason, recorded_in_history
from armident.identify.monitoring.reidentify.publish import StatusPublisher
from armident.identify.monitoring.reidentify.record_run import POLL_S, Say, record_run, running
from armident.identify.monitoring.reidentify.reidentify_options import ReidentifyOptions
from armident.identify.monitoring.reidentify.summary import change_lines, finding_lines
from armident.metrics import Value

CHECK_PERIOD = 1e-3
"""Sampling period of predicted torques, s."""
DIAGNOSIS_S = 3600.0
"""Time limit of a diagnosis, s."""


@dataclass(frozen=True)
class Job:
    """Checked inputs of a job; ``experiments``: most motions of an investigation, 0 for none."""

    config: Path
    session: SessionConfig
    robot: RobotConfig
    baseline: Baseline
    store: str
    out: Path
    false_alarms: float
    material: float | None = None
    time_limit_s: float | None = None
    experiments: int = 0
    minutes: float = 0.0
    warning: str | None = None


@dataclass(frozen=True)
class Outcome:
    """Result of a job; ``drift``: ``None`` for a first or unusable run; ``answer``: that of the investigation."""

    document: IdentificationDocument
    path: Path
    drift: ParameterChangeTest | None
    words: tuple[str, ...]
    diagnosis: Path | None = None
    findings: tuple[str, ...] = ()
    unusable: bool = False
    investigation: Path | None = None
    answer: str | None = None

    @property
    def changed(self) -> bool:
        """True if the arm has changed: by the tests, or because the diagnosis of an unusable run found why."""
        return self.unusable or (self.drift is not None and self.drift.drifted)


def reidentify_command(asked: ReidentifyOptions, *, as_json: bool) -> int:
    """Carry out ``armident reidentify`` without ``--recordings``; returns 0 or `FOUND`."""
    for option, given in (
        ("--scheduler", asked.scheduler),
        ("--workers", asked.workers),
        ("--results", asked.results),
    ):
        if given is not None:
            raise ConfigError(f"{option}: needs --recordings")
    if asked.config is None:
        raise ConfigError("--config: give the session of the cell, or --recordings")

    def say(line: str) -> None:
        print(f"reidentify: {line}", file=sys.stderr, flush=True)

    with reported(asked.metrics, asked.config, say) as values:
        job = prepare(asked.config, asked.baseline, asked.store, asked.out, asked.false_alarms)
        job = replace(job, material=asked.material, time_limit_s=asked.time_limit_s)
        if asked.investigate:
            job = replace(job, experiments=asked.experiments, minutes=asked.minutes)
        with StatusPublisher(job.session, job.robot) as announcer:
            outcome = carry_out(job, announcer, say, values)
        values |= {"changed": outcome.changed, "exit_code": FOUND if outcome.changed else 0}
        values["investigated"] = outcome.investigation is not None
    if as_json:
        print(json.dumps(entry(job, outcome), indent=1))
    else:
        show(job, outcome)
    return FOUND if outcome.changed else 0


def prepare(config: Path, baseline: Path | None, store: str, out: Path | None, false_alarms: float) -> Job:
    """Load and check the inputs of a job; by default the first run in the history is the baseline."""
    session = load_moving_session(config)
    robot = load_robot(session.robot)
    history, warning = history_or_reason(store, needed=baseline is None or not baseline.exists())
    chosen = baseline_of(baseline, history, robot.name, session.cell)
    check_trajectory(session, robot, chosen)
    folder = out or session.recording.directory
    return Job(config, session, robot, chosen, store, folder, false_alarms, warning=warning)


def check_trajectory(session: SessionConfig, robot: RobotConfig, baseline: Baseline) -> None:
    """Check a trajectory against the limits of motion and, predicted with a baseline, of torque."""
    assert session.setpoints is not None
    name = str(session.setpoints.trajectory)
    trajectory = load_trajectory(session.setpoints.trajectory)
    trajectory.check(robot, name)
    if baseline.document is None:
        return
    prior = previous_estimate(baseline.document, robot, baseline.name)
    torque = arm_model(robot).inverse_dynamics(prior.theta, *sample_trajectory(trajectory, CHECK_PERIOD))
    for joint, peak in zip(robot.joints, np.abs(torque).max(axis=0), strict=True):
        if peak > joint.limits.torque:
            raise ConfigError(
                f"{name}: {joint.name} needs a torque of {peak:.1f}, allowed is {joint.limits.torque:.1f} "
                "(predicted by the baseline)"
            )


def carry_out(job: Job, announcer: StatusPublisher, say: Say, values: dict[str, Value] | None = None) -> Outcome:
    """Carry out a job, store its result in the history, and publish it; raises ArmidentError if it fails."""
    values = {} if values is None else values
    say(f"{job.robot.name} in cell {job.session.cell}; baseline: {job.baseline.name}")
    if job.warning is not None:
        say(f"warning: {job.warning}; the run goes on with the baseline that is given")
    announcer.status("moving")
    job.out.mkdir(parents=True, exist_ok=True)
    recording = record_run(job.config, job.out, say)
    say(f"recorded {recording.path}")
    announcer.status("identifying", recording=str(recording.path))
    options = options_of(job.session)
    done = identify_once(recording, job.robot, options, job.out, announcer, say)
    document, path = done.document, done.path
    values |= identified_values(document)
    for reason in document.reasons:
        say(f"{reason.level}: {reason.message}. Next: {reason.next_step}")
    for warning in document.warnings:
        say(f"warning: {warning}")
    say(f"identified: relative torque error {document.relative_error_pct:.2f} %")
    if document.verdict == "unusable" or not document.converged:
        defect = document.reasons[0].message if document.reasons else document.stop_reason
        return _unexpected(
            job, recording, document, path, f"the identification is not usable ({defect})", announcer, say
        )
    try:
        drift = (
            None
            if job.baseline.document is None
            else compare(job.baseline.document, document, job.false_alarms, job.robot)
        )
    except Inconclusive as error:
        return _unexpected(job, recording, document, path, str(error), announcer, say)
    values |= {} if drift is None else drift_values(drift, document)
    with recorded_in_history(HistoryEntry(job.store, recording, document, path, job.baseline.document, drift), say):
        return _concluded(job, recording, document, path, drift, announcer, say)


def _concluded(
    job: Job,
    recording: Recording,
    document: IdentificationDocument,
    path: Path,
    drift: ParameterChangeTest | None,
    announcer: StatusPublisher,
    say: Say,
) -> Outcome:
    """Return the outcome of a comparison, after the diagnosis if the arm has changed, and publish it."""
    if drift is not None and drift.residuals.reason:
        say(f"warning: {drift.residuals.reason}")
    if drift is None:
        outcome = Outcome(document, path, None, (job.baseline.become(document),))
    elif not drift.drifted:
        outcome = Outcome(document, path, drift, (drift.words,))
    else:
        say("changed; diagnosing")
        announcer.status("diagnosing", words=drift.words)
        outcome = _diagnosed(job, recording, Outcome(document, path, drift, tuple(change_lines(drift, job.robot))), say)
        if outcome.diagnosis is not None:
            announcer.diagnosis(sign_file(outcome.diagnosis, announcer.signer.identity))
        outcome = _investigated(job, recording, outcome, announcer, say)
    _announce(outcome, announcer)
    return outcome


def _unexpected(
    job: Job,
    recording: Recording,
    document: IdentificationDocument,
    path: Path,
    defect: str,
    announcer: StatusPublisher,
    say: Say,
) -> Outcome:
    """Outcome of a run that cannot be compared: changed if the diagnosis against the baseline finds why."""
    # The diagnosis decides what the comparison left open.
    defect = defect.removesuffix(": whether the arm has changed is unknown")
    unknown = DataError(f"{recording.path}: {defect}: whether the arm has changed is unknown (result: {path})")
    with recorded_in_history(HistoryEntry(job.store, recording, document, path), say):
        if job.baseline.document is None:
            raise unknown
        say(f"{defect}; diagnosing")
        announcer.status("diagnosing", words=defect)
        outcome = _diagnosed(job, recording, Outcome(document, path, None, (defect,), unusable=True), say)
        if outcome.diagnosis is None or not outcome.findings:
            raise unknown
        announcer.diagnosis(sign_file(outcome.diagnosis, announcer.signer.identity))
        outcome = _investigated(job, recording, outcome, announcer, say)
        _announce(outcome, announcer)
        return outcome


def _announce(outcome: Outcome, announcer: StatusPublisher) -> None:
    """Publish that the job is done, with all that it found."""
    words, findings = list(outcome.words), list(outcome.findings)
    asked = None if outcome.investigation is None else str(outcome.investigation)
    announcer.status(
        "done", drifted=outcome.changed, words=words, findings=findings, investigation=asked, answer=outcome.answer
    )


def _diagnosed(job: Job, recording: Recording, outcome: Outcome, say: Say) -> Outcome:
    """Return the outcome with a diagnosis against the baseline; a failed diagnosis only prints a warning."""
    assert job.baseline.document is not None
    folder = _beside(recording, job.out, "diagnosis")
    folder.mkdir(parents=True, exist_ok=True)
    numbers = folder / "baseline.json"
    numbers.write_text(to_json(job.baseline.document), encoding="utf-8")
    command = ["diagnose", str(recording.path), "--config", str(job.session.robot), "--baseline", str(numbers)]
    for option, value in (("--material", job.material), ("--time-limit", job.time_limit_s)):
        command += [] if value is None else [option, f"{value:g}"]
    try:
        done = subprocess.run(
            [sys.executable, "-m", "armident.daq.cli", *command, "--out", str(folder), "--json"],
            capture_output=True,
            text=True,
            timeout=DIAGNOSIS_S,
            check=False,
        )
        if done.returncode not in (0, FOUND):
            raise DataError((done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1])
        document = from_json(done.stdout, DiagnosisDocument, "diagnosis")
    except (subprocess.TimeoutExpired, ArmidentError) as error:
        say(f"warning: no diagnosis: {error}")
        return outcome
    findings = tuple(finding_lines(document))
    path = folder / "diagnosis.json"
    return replace(outcome, diagnosis=path, findings=findings)


def _investigated(job: Job, recording: Recording, outcome: Outcome, announcer: StatusPublisher, say: Say) -> Outcome:
    """Return the outcome with what the arm answered to further motions; a failure only prints a warning."""
    if job.experiments == 0:
        return outcome
    say(f"investigating: at most {job.experiments} motions of {job.minutes:g} min")
    announcer.status("investigating", words=list(outcome.words), findings=list(outcome.findings))
    folder, before = _beside(recording, job.out, "investigation"), _beside(recording, job.out, "diagnosis")
    command = ["investigate", str(recording.path), "--config", str(job.config), "--yes", "--json", "--out", str(folder)]
    command += ["--baseline", str(before / "baseline.json")]
    command += ["--experiments", str(job.experiments), "--minutes", f"{job.minutes:g}"]
    command += [] if job.material is None else ["--material", f"{job.material:g}"]
    until = time.monotonic() + (job.experiments + 1) * DIAGNOSIS_S
    try:
        with running(command) as process:
            while process.running:
                if time.monotonic() > until:
                    raise ArmidentError("it takes too long")
                time.sleep(POLL_S)
        if not process.output():
            raise ArmidentError(process.last_error())
        document = from_json(process.output(), InvestigationDocument, "investigation")
    except ArmidentError as error:
        say(f"warning: no investigation: {error}")
        return outcome
    with suppress(OSError):
        sign_file(folder / "investigation.json", announcer.signer.identity)
    answer = f"{document.outcome.replace('_', ' ')}: {document.statement}"
    return replace(outcome, investigation=folder / "investigation.json", answer=answer)


def _beside(recording: Recording, out: Path, suffix: str) -> Path:
    name = "recording" if recording.path is None else recording.path.name.removesuffix(".mcap")
    return out / f"{name}.{suffix}"


def entry(job: Job, outcome: Outcome) -> dict[str, Any]:
    """Return the result as a document. ``job``, ``outcome``: inputs and result of the job."""
    drift = outcome.drift
    return {
        "robot": job.robot.name,
        "cell": job.session.cell,
        "recording": outcome.document.recording.path,
        "identification": str(outcome.path),
        "baseline": job.baseline.name,
        "drift": None if drift is None else drift.entry,
        "changed": outcome.changed,
        "words": list(outcome.words),
        "diagnosis": None if outcome.diagnosis is None else str(outcome.diagnosis),
        "findings": list(outcome.findings),
        "investigation": None if outcome.investigation is None else str(outcome.investigation),
        "answer": outcome.answer,
    }


def show(job: Job, outcome: Outcome) -> None:
    """Print the result. ``job``, ``outcome``: inputs and result of the job."""
    drift = outcome.drift
    if not outcome.changed:
        print("\n".join(outcome.words))
    else:
        if drift is None:
            statistic = "by a run that cannot be compared"
        else:
            statistic = f"chi-square {drift.chi_square:.1f} of {drift.degrees} degrees of freedom"
        print(f"changed since the baseline ({job.baseline.name}), {statistic}:")
        print("\n".join(f"  {line}" for line in outcome.words))
        if outcome.findings:
            print("diagnosis:")
            print("\n".join(f"  {line}" for line in outcome.findings))
        if outcome.answer is not None:
            print(f"investigation:\n  {outcome.answer}")
    print(f"result: {outcome.path}")
    if outcome.diagnosis is not None:
        print(f"diagnosis: {outcome.diagnosis}")
    if outcome.investigation is not None:
        print(f"investigation: {outcome.investigation}")
