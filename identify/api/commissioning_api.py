"""Commissioning: a new arm from its configuration to a trusted model."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from armident.configs import ConfigError, RobotConfig, Trajectory
from armident.daq.recording import Recording
from armident.identify.api.arguments import Progress, Robot, robot_of
from armident.identify.api.identification_api import Identification
from armident.identify.api.result_base import Result
from armident.identify.api.result_tables import Table
from armident.identify.documents.commissioning import CommissioningDocument


@dataclass(frozen=True, repr=False)
class Commissioning(Result):
    """Stages of a new arm, their results, and the model if it came so far.

    Parameters
    ----------
    document
        Everything that ``commissioning.json`` holds.
    robot
        The configuration that was used.
    recordings
        Recordings of the motions, the first one first.
    identification
        The identified model; ``None`` if an earlier stage did not pass.
    """

    document: CommissioningDocument
    robot: RobotConfig
    recordings: tuple[Recording, ...]
    identification: Identification | None
    file = "commissioning.json"

    @property
    def outcome(self) -> str:
        """``trusted``, ``set_up`` (wrong configuration), ``not_trusted`` (something is missing) or ``stopped``."""
        return self.document.outcome

    def _html(self) -> str:
        from armident.identify.report.page import render

        return render("commissioning.html", document=self.document, glossary=None)

    def _table(self) -> Table:
        return Table(("stage", "result"), list(self.document.stages.items()))

    def _summary(self) -> str:
        document = self.document
        motions = f"{len(document.motions)} motions, {document.motion_s:.0f} s"
        return f"{document.robot}: {document.outcome.replace('_', ' ')} after {motions}. Next: {document.next_step}"


def commission(
    robot: Robot | None,
    ask: Callable[[Trajectory], Recording],
    *,
    out: str | Path | None = None,
    resume: str | Path | None = None,
    say: Callable[[str], None] | None = None,
    progress: Progress | None = None,
) -> Commissioning:
    """Commission a new arm: small motions of each joint, growing motions of all, identification, held-out prediction.

    A mistake of the configuration ends it before the next motion, with the line that corrects it.

    Parameters
    ----------
    robot
        Configuration with joint limits, or the path or shipped name of one; ``None`` with ``resume``.
    ask
        Plays a trajectory on the robot and returns the recording; it raises `DataError` if the robot refuses to move.
    out
        Folder of documents, trajectories and recordings: a commissioning that is kept can be resumed.
    resume
        Folder of a commissioning to go on with. A stage that did not pass is judged again by its recordings and the
        ``robot.yaml`` of the folder.
    say
        Called with the result of each stage in one line.
    progress
        Called with what moves next, before it moves, and the share done.

    Returns
    -------
    Commissioning
        Outcome, results of the stages, next step, and the identified model.

    Raises
    ------
    ConfigError
        If a limit is missing, or the folder has a commissioning already.
    DataError
        If a recording changed since the commissioning used it.

    Examples
    --------
    >>> import armident
    >>> def ask(trajectory):
    ...     return armident.simulate_recording("emps", trajectory, seed=2)
    >>> armident.commission("emps", ask).outcome
    'trusted'
    """
    from armident.identify.commissioning.commission import resumed, started

    if resume is not None:
        going = resumed(Path(resume))
    elif robot is None:
        raise ConfigError("robot: expected a configuration, or resume")
    else:
        source = None if isinstance(robot, RobotConfig) else robot
        going = started(robot_of(robot, (), "trajectory"), source, None if out is None else Path(out))
    going.run(ask, say or (lambda line: None), progress or (lambda stage, share: None))
    return Commissioning(going.document, going.robot, tuple(going.recordings), going.identification)
