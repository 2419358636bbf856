"""Stages of a new arm: first contact, scale, full excitation, and the model that they give."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from armident.arrays import Array
from armident.configs import ConfigError, DataError, MotionStopped, RobotConfig, Trajectory, load_robot
from armident.daq.recording import Recording
from armident.identify.api.identification_api import Identification, identify, load_identification
from armident.identify.api.prediction_api import predict
from armident.identify.api.setup_api import check
from armident.identify.commissioning.model_so_far import model_so_far
from armident.identify.commissioning.small_motion import SmallMotion, wrong_answer
from armident.identify.documents.base import reference, versions
from armident.identify.documents.commissioning import CommissioningDocument, CommissioningMotion
from armident.identify.documents.files import load_document, to_json, write_atomically
from armident.identify.effects.recording_corrections import corrected_experiments
from armident.identify.excitation.design import PERIOD
from armident.identify.excitation.safety import SafetyModel, safety_model
from armident.identify.identification.from_recording import experiments_of
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.investigation.choice import excitation_of, excluded, home_of
from armident.identify.investigation.folder import Ask, Progress, answer_of, keep_motion, read_again
from armident.identify.investigation.motions import FASTER, FIRST_CONTACT, MARGIN, Reach, reach_of
from armident.identify.report.robot_file import robot_yaml
from armident.identify.setup.result import SetupFinding
from armident.identify.signals.experiments import Experiment

FILE, ROBOT, MODEL = "commissioning.json", "robot.yaml", "model"
"""The document, the configuration, and the folder of the identification."""
STEPS = ((FIRST_CONTACT, 16.0), (0.5, 10.0), (MARGIN, 10.0))
"""Motions of all joints: share of the limits of velocity and acceleration, and duration, s."""
FULL_S, SEEDS = 10.0, (11, 12)
"""Duration of a full excitation, s, and seeds: of that which is identified with the last of `STEPS`, and of that which
is predicted."""


class Ended(Exception):
    """The commissioning ends in a stage that did not pass: outcome, reason, and next step."""


@dataclass
class CommissioningRun:
    """A commissioning that goes on; each stage asks for its motions in the same order after a kill."""

    robot: RobotConfig
    document: CommissioningDocument
    folder: Path | None
    safety: SafetyModel
    recordings: list[Recording] = field(default_factory=list)
    identification: Identification | None = None

    def run(self, ask: Ask, say: Callable[[str], None], progress: Progress) -> None:
        """Go through the stages that are left; ``say`` takes the result of each."""
        stages = {
            "configuration": self._configuration,
            "small motions": self._small_motions,
            "scale": self._scale,
            "full excitation": self._full_excitation,
        }
        for number, (name, stage) in enumerate(stages.items(), 1):
            if self.document.outcome != "running" or name in self.document.stages:
                continue
            self._ask, self._progress, self._stage = ask, progress, name
            self._played = sum(one.stage != name for one in self.document.motions)
            self._title = f"stage {number} of {len(stages)}, {name}"
            try:
                sentence, changes = stage(), dict[str, object]()
            except (Ended, DataError) as error:
                unusable = ("stopped", str(error), "mend the cause, then begin with another --out")
                outcome, sentence, next_step = error.args if isinstance(error, Ended) else unusable
                changes = {"outcome": outcome, "next_step": next_step}
            self._update(stages={**self.document.stages, name: sentence}, **changes)
            say(f"{self._title}: {sentence}")
        if self.document.outcome == "running":
            where = self.folder or Path()
            self._update(outcome="trusted", next_step=f"armident reidentify --baseline {where / MODEL} watches the arm")

    def _configuration(self) -> str:
        self.robot.check_movable("commission")
        left = f"; not checked: {'; '.join(self.safety.remarks)}" if self.safety.remarks else ""
        pairs = f"{self.safety.collision.pairs} pairs of bodies are kept apart"
        return f"{self.robot.n} joints have limits; {pairs}{left}"

    def _small_motions(self) -> str:
        for joint in range(self.robot.n):
            trajectory, words = self._small_motion(joint)
            recording = self._play(trajectory, words)
            asked = trajectory.sample(PERIOD)[:, joint]
            mistake = wrong_answer(self.robot, joint, asked, self._experiments([recording]))
            if mistake is not None:
                raise _wrong(mistake)
        return f"every joint moves as asked; {self._checked(self.recordings)}"

    def _small_motion(self, joint: int) -> tuple[Trajectory, str]:
        """Return the largest small motion of a joint that is allowed."""
        family, names = SmallMotion(), [each.name for each in self.robot.joints]
        for size in family.sizes:
            trajectory = family.trajectory(self._reach(FIRST_CONTACT), joint, size)
            reason = excluded(self.robot, trajectory, self.safety.theta, self.safety.collision)
            if reason is None:
                return trajectory, family.in_words(names, joint)
        raise Ended("not_trusted", f"{names[joint]} cannot move: {reason}", "correct limits, collision or home posture")

    def _scale(self) -> str:
        used = ""
        for seed, (share, duration) in enumerate(STEPS):
            used = self._checked([self._excite(self._theta(), share, duration, seed)])
        return used

    def _full_excitation(self) -> str:
        theta = self._theta()
        first, second = (self._excite(theta, MARGIN, FULL_S, seed) for seed in SEEDS)
        self._progress(f"{self._title}: identification", 0.0)
        self.identification = found = identify([self.recordings[self._played - 3], first], self.robot)
        if self.folder is not None:
            found.save(self.folder / MODEL)
            write_atomically(self.folder / MODEL / ROBOT, robot_yaml(found.robot))
        self._update(verdict=found.verdict)
        if found.verdict == "unusable":
            raise self._not_trusted(f"the model is unusable: {found.reasons[0].message}", found.reasons[0].next_step)
        errors = predict(second, found).document.relative_error_pct_by_joint
        self._update(held_out_error_pct_by_joint=errors)
        worst = max(errors, key=lambda name: errors[name])
        sentence = f"{found.verdict}; a motion not seen is predicted to {errors[worst]:.1f} % of {worst} at worst"
        if found.verdict != "trustworthy":
            raise self._not_trusted(f"{sentence}: {found.reasons[0].message}", found.reasons[0].next_step)
        if errors[worst] > IdentificationCriteria().max_joint_error_pct:
            raise self._not_trusted(sentence, "find what the model lacks")
        return sentence

    def _not_trusted(self, sentence: str, step: str) -> Ended:
        motions = " ".join(str(one.recording.path) for one in self.document.motions[-2:] if one.recording.path)
        return Ended("not_trusted", sentence, f"{step}; or: armident investigate {motions}")

    def _theta(self) -> Array:
        """Return the model of the motions of all joints so far, else of the small ones."""
        so_far = self.recordings[: self._played]
        return model_so_far(self.robot, self._experiments(so_far[self.robot.n :] or so_far), self.safety.theta)

    def _excite(self, theta: Array, share: float, duration: float, seed: int) -> Recording:
        """Move all joints at a share of their limits, as far as a model of the motions so far allows it."""
        reach, collision = self._reach(share), self.safety.collision
        choice, trajectory = excitation_of(self.robot, reach, theta, collision, duration, seed)
        if trajectory is None:
            raise Ended("not_trusted", f"{choice.words}: {choice.excluded}", "correct the limits, then continue")
        return self._play(trajectory, f"{choice.words}, up to {100 * share:.0f} % of the limits")

    def _reach(self, share: float) -> Reach:
        limits = np.array([(each.limits.velocity, each.limits.acceleration) for each in self.robot.joints])
        return reach_of(self.robot, home_of(self.robot), *(share / FASTER * limits.T))

    def _experiments(self, recordings: Sequence[Recording]) -> Sequence[Experiment]:
        return corrected_experiments(experiments_of(recordings, self.robot, name_files=True)[0], self.robot)

    def _checked(self, recordings: Sequence[Recording]) -> str:
        """Return what the check of the set-up says of recordings that pass it."""
        found = check(recordings, self.robot)
        for finding in found.result.findings:
            if finding.decisive or finding.kind == "unusual_weight":
                raise _wrong(finding)
        if found.document.unexplained_joints:
            names = ", ".join(found.document.unexplained_joints)
            step = "check geometry, gear ratios and drive.gain of these joints"
            raise Ended("set_up", f"the rigid model does not explain the torque of {names}", step)
        remarks = "".join(f"; {each.message}" for each in found.findings)
        return f"signs, order, units, gravity and clocks are right{remarks}"

    def _play(self, trajectory: Trajectory, words: str) -> Recording:
        """Return the recording of the next motion, which is not asked for again after a kill."""
        number = self._played = self._played + 1
        if number <= len(self.recordings):
            return self.recordings[number - 1]
        if self.folder is not None:
            keep_motion(self.folder, number, trajectory)
        self._progress(f"{self._title}: {words}", 0.0)
        try:
            recording = answer_of(self.folder, number, trajectory, self._ask)
        except (DataError, MotionStopped) as error:
            raise Ended("stopped", f"{words}: {error}", "find the cause before the arm moves again") from error
        self.recordings.append(recording)
        played = CommissioningMotion(
            stage=self._stage, words=words, duration_s=trajectory.duration, recording=reference(recording)
        )
        self._update(motions=[*self.document.motions, played])
        return recording

    def _update(self, **changes: object) -> None:
        self.document = self.document.model_copy(update=changes)
        if self.folder is not None:
            write_atomically(self.folder / FILE, to_json(self.document))


def _wrong(finding: SetupFinding) -> Ended:
    return Ended("set_up", f"{finding.message} (probability {finding.probability:.2f})", finding.remedy)


def started(robot: RobotConfig, source: str | Path | None, folder: Path | None) -> CommissioningRun:
    """Return a new commissioning; ``source``: path or name of the configuration, whose URDF has masses and shapes."""
    if folder is not None:
        if (folder / FILE).exists():
            raise ConfigError(f"{folder}: has a commissioning already; go on with --continue, or give another --out")
        write_atomically(folder / ROBOT, robot_yaml(robot))
    document = CommissioningDocument(robot=robot.name, versions=versions())
    return CommissioningRun(robot, document, folder, safety_model(robot, source, None))


def resumed(folder: Path) -> CommissioningRun:
    """Return the commissioning of a folder; a stage that did not pass is judged again by the present configuration."""
    document = load_document(folder / FILE, CommissioningDocument)
    robot = load_robot(folder / ROBOT, "trajectory")
    recordings = [read_again(one.recording) for one in document.motions]
    known = load_identification(folder / MODEL) if document.outcome == "trusted" else None
    if document.outcome not in ("running", "trusted"):
        stages = dict(list(document.stages.items())[:-1])
        document = document.model_copy(update={"outcome": "running", "stages": stages, "next_step": ""})
    return CommissioningRun(robot, document, folder, safety_model(robot, folder / ROBOT, None), recordings, known)
