"""Questions to an arm until its recordings decide what is missing, or no allowed motion can tell."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from armident.configs import ConfigError, DataError, MotionStopped, RobotConfig, Trajectory, load_robot
from armident.configs.loading import load_trajectory
from armident.daq.recording import Recording, read_recording
from armident.daq.recording.writer import write_recording
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.diagnose import DiagnosisResult, run_diagnosis
from armident.identify.diagnosis.model_state import ModelState
from armident.identify.diagnosis.probabilities import NOTHING
from armident.identify.documents.base import reference, versions
from armident.identify.documents.diagnosis import Explanation, Finding
from armident.identify.documents.files import load_document, to_json, write_atomically
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.documents.investigation import (
    InvestigationDocument,
    InvestigationRound,
    MotionChoice,
    Outcome,
)
from armident.identify.effects.registry import known
from armident.identify.effects.unnamed import NAME as UNNAMED
from armident.identify.excitation.collision import CollisionModel
from armident.identify.identification.from_recording import experiments_of, rest_notes
from armident.identify.investigation.choice import (
    LEAST_GAIN,
    Chosen,
    confirming_motion,
    first_motion,
    next_motion,
    next_recording,
    too_long,
)
from armident.identify.investigation.folder import Ask, Progress, answer_of, keep_motion, read_again
from armident.identify.investigation.rivals import uncertain, with_decided
from armident.identify.report.robot_file import robot_yaml
from armident.identify.signals.bandwidth import motion_bandwidth

FILE, ROBOT, MODEL, BASELINE = "investigation.json", "robot.yaml", "model.yaml", "baseline.json"
"""Files of a folder: the document, the configuration, the same with what was found, and the arm before it changed."""
AGAIN = "Find the cause before the arm moves again; then begin with another --out"
"""The next step where the arm did not move, or was stopped."""


class Waiting(Exception):
    """The recording of a motion comes later: the investigation pauses."""


@dataclass
class Investigating:
    """An investigation that goes on: its document, its recordings, and the folder that keeps both.

    A kill at any moment loses nothing but the diagnosis or the motion that runs: `resumed` goes on with the last round.
    ``offered``: recordings of the past to ask in place of the arm. ``baseline``: see `run_diagnosis`.
    """

    robot: RobotConfig
    recordings: list[Recording]
    document: InvestigationDocument
    folder: Path | None
    criteria: Criteria
    collision: CollisionModel
    trajectories: list[Trajectory | None] = field(default_factory=list)
    offered: Sequence[Recording] = ()
    baseline: IdentificationDocument | None = None
    result: DiagnosisResult | None = None

    @property
    def pending(self) -> bool:
        """True if the recording of the last motion is missing."""
        last = self.document.rounds[-1] if self.document.rounds else None
        return last is not None and last.recording is None and last.refused is None

    @property
    def left_s(self) -> float:
        """Time of motion that is left, s."""
        return 60.0 * self.document.minutes - self.document.motion_s

    @property
    def model(self) -> RobotConfig:
        """The configuration with what was found, in an earlier run of the folder if this one diagnosed nothing."""
        if self.result is not None:
            return self.result.robot
        saved = None if self.folder is None else self.folder / MODEL
        return self.robot if saved is None or not saved.exists() else load_robot(saved, "investigate")

    def run(self, ask: Ask, progress: Progress | None = None) -> None:
        """Ask until the outcome is known; `Waiting` of ``ask`` leaves the investigation as it is."""
        report = progress or (lambda stage, share: None)
        while self.document.outcome == "running":
            if self.pending:
                self._answer(ask, report)
            else:
                self._step(report)

    def _step(self, progress: Progress) -> None:
        """Diagnose all recordings, and enter the next motion or the outcome."""

        def report(stage: str, share: float) -> None:
            progress(f"round {len(self.document.rounds) + 1}: {stage}", share)

        if not self.recordings:
            if rounds := self.document.rounds:
                self._stop(f"{rounds[-1].chosen.words} was refused: {rounds[-1].refused}. {AGAIN}")
            else:
                self._affordable(first_motion(self.robot, self.collision))
            return
        self.result = result = self._diagnosed(report)
        document, rounds, state = result.document, self.document.rounds, result.first
        self._update(explanations=document.explanations)
        if self.folder is not None:
            write_atomically(self.folder / "diagnosis.json", to_json(document))
        healthy = document.verdict == "no_gap"
        # The first motion of an arm without a recording is slow and answers no question.
        asked = [one for one in rounds if one.explanations]
        answered = any(one.recording is not None for one in asked)
        if state is None or (not uncertain(document.explanations) and (answered or not healthy)):
            outcome, statement = _outcome(result)
            self._update(outcome=outcome, statement=statement)
        elif len(rounds) >= self.document.experiments:
            self._stop(f"all {len(rounds)} motions have been used; allow more with --experiments")
        else:
            report("next motion", 1.0)
            state = with_decided(state, result.robot, document.explanations)
            self._affordable(self.choose(state, document.explanations, [one.chosen for one in asked]))

    def choose(self, state: ModelState, explanations: Sequence[Explanation], done: Sequence[MotionChoice]) -> Chosen:
        """Return the next motion, or recording of the past. ``done``: those of earlier rounds."""
        if self.offered:
            return next_recording(state, explanations, self.offered, done)
        if not uncertain(explanations):
            return confirming_motion(state, self.collision, done)
        return next_motion(state, explanations, self.collision, done, self.left_s)

    def _affordable(self, chosen: Chosen) -> None:
        """Enter a motion if there is one and the budget allows it; else stop."""
        choice = chosen.choice
        if choice is None:
            self._stop(_no_motion(chosen, uncertain(self.document.explanations)))
        elif (reason := too_long(choice, self.left_s)) is not None:
            self._stop(f"{choice.words} {reason}")
        else:
            self._enter(chosen)

    def _diagnosed(self, report: Progress) -> DiagnosisResult:
        """Diagnose all recordings in the band of the first one: in small motions, noise would count as motion."""
        experiments, notes = experiments_of(self.recordings, self.robot, name_files=True)
        notes += rest_notes(experiments, self.robot)
        references = [reference(recording) for recording in self.recordings]
        first, _ = experiments_of(self.recordings[:1], self.robot, name_files=True)
        band = self.robot.bandwidth_hz or motion_bandwidth([e.q for e in first], first[0].dt)
        robot = self.robot.model_copy(update={"bandwidth_hz": band})
        found = run_diagnosis(
            experiments, [], robot, references, self.baseline, list(dict.fromkeys(notes)), report, self.criteria
        )
        return replace(found, robot=found.robot.model_copy(update={"bandwidth_hz": self.robot.bandwidth_hz}))

    def _enter(self, chosen: Chosen) -> None:
        """Enter a motion that is to be asked for, or the recording that answers already."""
        assert chosen.choice is not None
        number = len(self.document.rounds) + 1
        name = None
        if self.folder is not None and chosen.trajectory is not None:
            name = keep_motion(self.folder, number, chosen.trajectory)
        asked = InvestigationRound(
            explanations=self.document.explanations,
            question=chosen.question,
            considered=list(chosen.considered),
            chosen=chosen.choice,
            trajectory=name,
            recording=None if chosen.answer is None else reference(chosen.answer),
        )
        self.trajectories.append(chosen.trajectory)
        rounds = [*self.document.rounds, asked]
        if chosen.answer is None:
            self._update(rounds=rounds)
        else:
            self._keep(chosen.answer, chosen.choice.duration_s, rounds)

    def _answer(self, ask: Ask, report: Progress) -> None:
        """Ask for the last motion, and enter the recording, or the reason for which the robot refused it."""
        rounds = self.document.rounds
        last, trajectory = rounds[-1], self.trajectories[-1]
        assert trajectory is not None
        report(f"round {len(rounds)}: {last.chosen.words}", 0.0)
        try:
            recording = answer_of(self.folder, len(rounds), trajectory, ask)
        except (DataError, MotionStopped) as error:
            refused = [*rounds[:-1], last.model_copy(update={"refused": str(error)})]
            if isinstance(error, DataError):
                self._update(rounds=refused)
            else:
                self._stop(f"{last.chosen.words} was stopped: {error}. {AGAIN}", rounds=refused)
            return
        answered = last.model_copy(update={"recording": reference(recording)})
        self._keep(recording, trajectory.duration, [*rounds[:-1], answered])

    def _keep(self, recording: Recording, duration: float, rounds: Sequence[InvestigationRound]) -> None:
        """Enter a recording of a motion, duration in s, with the rounds that have it."""
        self.recordings.append(recording)
        self._update(rounds=list(rounds), motion_s=self.document.motion_s + duration)

    def _stop(self, reason: str, **changes: object) -> None:
        """End without a decision, for a reason; ``changes``: of the document, with which it is written once."""
        doubtful = uncertain(self.document.explanations)
        unnamed = all(one.likely[0] == UNNAMED for one in doubtful)
        outcome: Outcome = "unnamed" if doubtful and unnamed else "cannot_tell"
        left = "; ".join(f"{one.joint}: {one.sentence}" for one in doubtful) or "nothing is decided"
        sure = [one for one in self.document.explanations if not one.doubtful and one.likely != [NOTHING]]
        found = "; ".join(f"{one.joint}: {one.sentence}" for one in sure)
        statement = f"{left}. {reason[0].upper()}{reason[1:]}."
        self._update(outcome=outcome, statement=f"Found: {found}. Open: {statement}" if found else statement, **changes)

    def _update(self, **changes: object) -> None:
        self.document = self.document.model_copy(update=changes)
        if self.folder is not None:
            write_atomically(self.folder / FILE, to_json(self.document))


def started(
    robot: RobotConfig,
    recordings: Sequence[Recording],
    experiments: int,
    minutes: float,
    criteria: Criteria,
    collision: CollisionModel,
    folder: Path | None,
    baseline: IdentificationDocument | None = None,
) -> Investigating:
    """Return a new investigation; ConfigError if one has begun in the folder, or a limit is not positive."""
    if experiments < 1 or not minutes > 0.0:
        raise ConfigError("--experiments and --minutes: expected at least one motion and a time greater than 0")
    robot.check_movable("investigate")
    kept = list(recordings)
    if folder is not None:
        former = load_document(folder / FILE, InvestigationDocument) if (folder / FILE).exists() else None
        if former is not None and (former.rounds or former.explanations):
            raise ConfigError(f"{folder}: has an investigation already; go on with --continue, or give another --out")
        write_atomically(folder / ROBOT, robot_yaml(robot))
        if baseline is None:
            (folder / BASELINE).unlink(missing_ok=True)
        else:
            write_atomically(folder / BASELINE, to_json(baseline))
        for k, recording in enumerate(kept):
            if recording.path is None:
                write_recording(recording, folder / f"start_{k + 1}.mcap")
                kept[k] = read_recording(folder / f"start_{k + 1}.mcap")
    document = InvestigationDocument(
        robot=robot.name,
        recordings=[reference(recording) for recording in kept],
        experiments=experiments,
        minutes=minutes,
        versions=versions(),
    )
    found = Investigating(robot, kept, document, folder, criteria, collision, baseline=baseline)
    found._update()
    return found


def resumed(folder: Path, criteria: Criteria, collision: CollisionModel | None = None) -> Investigating:
    """Return the investigation of a folder. Raises ConfigError if there is none, DataError if a recording changed."""
    if not (folder / FILE).is_file():
        raise ConfigError(f"{folder}: no {FILE} in this folder")
    document = load_document(folder / FILE, InvestigationDocument)
    robot = load_robot(folder / ROBOT, "investigate")
    expected = [*document.recordings, *(one.recording for one in document.rounds if one.recording is not None)]
    recordings = [read_again(one) for one in expected]
    trajectories = [
        None if one.trajectory is None else load_trajectory(folder / one.trajectory) for one in document.rounds
    ]
    baseline = load_document(folder / BASELINE, IdentificationDocument) if (folder / BASELINE).exists() else None
    collision = collision or CollisionModel(robot, [])
    return Investigating(robot, recordings, document, folder, criteria, collision, trajectories, baseline=baseline)


def _outcome(result: DiagnosisResult) -> tuple[Outcome, str]:
    """Return the outcome of a diagnosis in which every joint is decided, in one word and in one sentence."""
    document = result.document
    findings = [one for one in document.findings if one.effect != UNNAMED]
    mistakes = [one for one in findings if "corrected" in one.evidence]
    if mistakes:
        return "set_up", f"{_named(mistakes)}: correct the configuration, then record again."
    if findings:
        return "named", f"{_named(findings)}."
    if document.verdict == "no_gap":
        return "healthy", "The model explains all recordings; none of the motions shows a missing effect."
    left = "; ".join(one.sentence for one in document.unexplained)
    return "unnamed", f"Something is missing that has no name in the catalogue. {left}".strip()


def _named(findings: Sequence[Finding]) -> str:
    return "; ".join(
        f"{one.effect.replace('_', ' ')} at {one.joint}, probability {one.probability}" for one in findings
    )


def _no_motion(chosen: Chosen, doubtful: Sequence[Explanation]) -> str:
    """Return the reason for which no motion is left, and what would tell the explanations apart."""
    gains = [one.expected_gain or 0.0 for one in chosen.considered]
    barred = next((one for one in chosen.considered if one.excluded is not None), None)
    if barred is not None and (barred.expected_gain is None or barred.expected_gain >= LEAST_GAIN):
        return f"the motion that would tell most ({barred.words}) is not allowed: {barred.excluded}"
    reason = f"no motion of the list tells them apart: the best one promises {max(gains, default=0.0):.2f} nats"
    if not any(gains):
        reason = "no motion is left that has not been asked for"
    names = dict.fromkeys(name for one in doubtful for name in one.likely if name not in (NOTHING, UNNAMED))
    needed = [
        f"{name.replace('_', ' ')} by {effect.direct_evidence or effect.required_motion}"
        for name, effect in ((name, known(name)) for name in names)
    ]
    return f"{reason}. These would show it: {'; '.join(needed)}" if needed else reason
