"""Investigation: questions to an arm until its recordings decide what is missing."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

from armident.configs import ConfigError, DataError, RobotConfig, Trajectory
from armident.daq.recording import Recording
from armident.identify.api.arguments import Progress, Recorded, Robot, recordings_of, robot_of
from armident.identify.api.identification_api import Identification, identified
from armident.identify.api.result_base import Result
from armident.identify.api.result_tables import Table
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.documents.investigation import InvestigationDocument
from armident.identify.report.robot_file import robot_yaml

if TYPE_CHECKING:
    from armident.identify.investigation.investigate import Investigating


@dataclass(frozen=True, repr=False)
class Investigation(Result):
    """Questions to an arm, its answers, and what they say about the effects that its model lacks.

    Parameters
    ----------
    document
        Everything that ``investigation.json`` holds.
    robot
        The configuration with the effects found added to it; `identify` and `simulate_recording` accept it.
    recordings
        All recordings, the answers at the end.
    trajectories
        Motions that were asked for; ``None`` for a recording of the past.
    """

    document: InvestigationDocument
    robot: RobotConfig
    recordings: tuple[Recording, ...]
    trajectories: tuple[Trajectory | None, ...]
    file = "investigation.json"

    @property
    def outcome(self) -> str:
        """``healthy``, ``named``, ``set_up``, ``unnamed``, ``cannot_tell``; ``running`` while a motion is pending."""
        return self.document.outcome

    @property
    def pending(self) -> Trajectory | None:
        """The motion whose recording is awaited; ``None`` if there is none."""
        last = self.document.rounds[-1] if self.document.rounds else None
        waits = last is not None and last.recording is None and last.refused is None
        return self.trajectories[-1] if waits else None

    @property
    def rounds(self) -> Table:
        """Table of questions and answers; gains are expected falls of the entropy, nats."""
        rows = [
            (
                number,
                one.question,
                one.chosen.words,
                one.chosen.duration_s,
                one.chosen.expected_gain,
                one.refused or ("answered" if one.recording is not None else "awaited"),
            )
            for number, one in enumerate(self.document.rounds, 1)
        ]
        return Table(("round", "question", "motion", "duration_s", "expected_gain", "answer"), rows)

    def _for_folder(self, folder: Path) -> tuple[Self, dict[Path, str]]:
        model = folder / "model.yaml"
        document = self.document.model_copy(update={"model": str(model)})
        return replace(self, document=document), {model: robot_yaml(self.robot)}

    def _html(self) -> str:
        from armident.identify.report.investigation_report import investigation_report

        return investigation_report(self.document, self.trajectories, self.robot)

    def _table(self) -> Table | None:
        return self.rounds if self.document.rounds else None

    def _summary(self) -> str:
        count = len(self.document.rounds)
        motions = f"{count} motion{'' if count == 1 else 's'}, {self.document.motion_s:.0f} s"
        return f"{self.document.robot}: {self.outcome} after {motions}. {self.document.statement}".rstrip()


def investigate(
    robot: Robot | None = None,
    ask: Callable[[Trajectory], Recording] | None = None,
    recordings: Recorded | Sequence[Recorded] = (),
    *,
    choose_from: Recorded | Sequence[Recorded] = (),
    baseline: Identification | IdentificationDocument | str | Path | None = None,
    experiments: int = 6,
    minutes: float = 10.0,
    material: float = 0.2,
    out: str | Path | None = None,
    resume: str | Path | None = None,
    progress: Progress | None = None,
) -> Investigation:
    """Ask an arm to move until its recordings decide what its model lacks, or no allowed motion can tell.

    Each round diagnoses all recordings and chooses the motion that tells the explanations apart most per second
    (Box, Hill 1967, Technometrics 9(1); Kolchinsky, Tracey 2017, Entropy 19(7)).

    Parameters
    ----------
    robot
        Configuration with joint limits, or the path or shipped name of one; by default the one inside the first
        recording.
    ask
        Plays a trajectory on the robot and returns the recording; it raises `DataError` if the robot refuses to move,
        and `armident.configs.MotionStopped` if the arm was stopped and must not move again. By default the
        investigation ends with the motion in ``pending``, and ``resume`` goes on.
    recordings
        Recordings from before; without them the first motion is a slow excitation of all joints. With ``resume``, the
        recording of the pending motion.
    choose_from
        Recordings of the past to ask in place of the arm.
    baseline
        An identification of the arm before it changed; then the question is what has changed since.
    experiments
        Most motions.
    minutes
        Longest motion of all rounds together, min.
    material
        Least change of a joint's torque by a finding, percent, as for `diagnose`.
    out
        Folder of documents, trajectories and recordings: an investigation that is kept can be resumed.
    resume
        Folder of an investigation to go on with; robot and limits are those of the folder, and ``robot``, if it is
        given, has the shapes of the bodies.
    progress
        Called with the name of a stage and the share done, 0 to 1.

    Returns
    -------
    Investigation
        Outcome, rounds, and the configuration with what was found.

    Raises
    ------
    ConfigError
        If a file does not exist, a configuration is wrong, or the folder has an investigation already.
    DataError
        If the recordings cannot support a diagnosis, one changed since the investigation used it, or the baseline is
        of another robot.

    Examples
    --------
    >>> import armident
    >>> def ask(trajectory):
    ...     return armident.simulate_recording("emps", trajectory, seed=2)
    >>> first = armident.simulate_recording("emps", "emps_excitation", seed=1)
    >>> armident.investigate("emps", ask, first).outcome
    'healthy'
    """
    from armident.identify.diagnosis.criteria import Criteria
    from armident.identify.excitation.safety import safety_model
    from armident.identify.investigation.investigate import Waiting, resumed, started

    criteria = Criteria(material_pct=material)
    given, offered = (recordings_of(each) if _any(each) else () for each in (recordings, choose_from))
    source = robot if isinstance(robot, str | Path) else None
    if resume is not None:
        known = None if robot is None else robot_of(robot, (), "trajectory")
        shapes = None if known is None else safety_model(known, source, None).collision
        going = resumed(Path(resume), criteria, shapes)
        if known is not None and known.name != going.document.robot:
            raise ConfigError(f"{resume}: is an investigation of robot {going.document.robot!r}, not {known.name!r}")
        answers: Iterator[Recording] = iter(given)
    else:
        config = robot_of(robot, (*given, *offered), "trajectory")
        collision = safety_model(config, source, None).collision
        before = None if baseline is None else identified(baseline)[0]
        if before is not None and before.robot != config.name:
            raise DataError(f"the baseline is of robot {before.robot!r}, the arm is {config.name!r}")
        folder = None if out is None else Path(out)
        going = started(config, given, experiments, minutes, criteria, collision, folder, before)
        answers = iter(())
    going.offered = offered

    def answer(trajectory: Trajectory) -> Recording:
        one = next(answers, None)
        if one is not None:
            return one
        if ask is None:
            raise Waiting
        return ask(trajectory)

    with suppress(Waiting):
        going.run(answer, progress)
    return _of(going)


def _any(recordings: Recorded | Sequence[Recorded]) -> bool:
    return isinstance(recordings, Recording | str | Path) or bool(recordings)


def _of(going: "Investigating") -> Investigation:
    return Investigation(going.document, going.model, tuple(going.recordings), tuple(going.trajectories))
