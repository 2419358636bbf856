"""Characterisation of one joint: friction over speed, torque ripple, and friction about reversals."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from armident.configs import Trajectory
from armident.daq.recording import Recording
from armident.identify.api.arguments import Progress, Recorded, Robot, recordings_of, robot_of
from armident.identify.api.result_base import Result
from armident.identify.api.result_tables import Table
from armident.identify.documents.characterisation import CharacterisationDocument, Estimate


@dataclass(frozen=True, repr=False)
class Characterisation(Result):
    """Friction over speed, torque ripple and friction about reversals of one joint.

    Parameters
    ----------
    document
        Everything that ``characterisation.json`` holds.
    """

    document: CharacterisationDocument
    file = "characterisation.json"

    @property
    def friction(self) -> Table:
        """Friction at each constant speed, rad/s or m/s, with standard deviations, N m or N.

        ``friction``: half the difference of both directions; ``forward``, ``backward``: of each direction.
        """
        names = ("friction", "forward", "backward")
        columns = ("speed", *(column for name in names for column in (name, f"{name}_std")))
        points = [] if self.document.friction is None else self.document.friction.points
        rows = [(p.speed, *(x for name in names for x in _value_and_std(getattr(p, name)))) for p in points]
        return Table(columns, rows)

    @property
    def curve(self) -> Table:
        """Parameters of the fitted friction curve with 95 % intervals."""
        found = {} if self.document.friction is None else self.document.friction.curve
        return Table(
            ("name", "value", "low", "high", "unit"),
            [(name, e.value, e.low, e.high, e.unit) for name, e in found.items()],
        )

    @property
    def ripple(self) -> Table:
        """Torque ripples above the noise floor: cycles per revolution, or metre, of joint and motor, and amplitudes."""
        peaks = [] if self.document.ripple is None else self.document.ripple.peaks
        rows = [(p.order, p.motor_order, p.amplitude.value, p.amplitude.low, p.amplitude.high) for p in peaks]
        return Table(("order", "motor_order", "amplitude", "low", "high"), rows)

    def _html(self) -> str:
        from armident.identify.report.characterisation_report import characterisation_report

        return characterisation_report(self.document, self.friction, self.curve)

    def _table(self) -> Table | None:
        return self.friction if len(self.friction) else None

    def _summary(self) -> str:
        lines = [f"{self.document.robot}, {self.document.joint}"]
        return "\n".join([*lines, *(f"{name}: {text}" for name, text in self.document.statements.items())])


def characterise(
    recordings: Recorded | Sequence[Recorded] = (),
    joint: str = "",
    *,
    robot: Robot | None = None,
    ask: Callable[[Trajectory], Recording] | None = None,
    progress: Progress | None = None,
) -> Characterisation:
    """Measure friction over speed, torque ripple and friction about reversals of one joint.

    The other joints rest meanwhile. Friction is half the difference of the torques forth and back at one speed over the
    same positions (Armstrong-Helouvry 1991, Control of Machines with Friction).

    Parameters
    ----------
    recordings
        Recordings in parts of which the joint moves alone: at constant speeds, and to and fro.
    joint
        Name of the joint.
    robot
        Configuration, or the path or shipped name of one; by default the one inside the first recording.
    ask
        Plays a trajectory on the robot and returns the recording: two motions of the joint are added to ``recordings``,
        at most 1.5 times as fast as these; without any, they use a tenth of the limits.
    progress
        Called with the name of a stage and the share done, 0 to 1.

    Returns
    -------
    Characterisation
        Tables, document and report.

    Raises
    ------
    ConfigError
        If a file does not exist, or the robot has no such joint.
    DataError
        If a recording cannot be used, or no motion of the joint is allowed.

    Examples
    --------
    >>> import armident
    >>> def ask(trajectory):
    ...     return armident.simulate_recording("emps", trajectory, seed=1)
    >>> armident.characterise(joint="joint_1", robot="emps", ask=ask).curve["name"]
    ['fc', 'fv', 'fva', 'offset']
    """
    from armident.identify.characterisation.characterise import characterised, joint_number
    from armident.identify.characterisation.motions import MOTIONS, motion_of
    from armident.identify.excitation.safety import safety_model

    given = recordings_of(recordings) if ask is None or isinstance(recordings, Recorded) or recordings else ()
    config = robot_of(robot, given, "identify" if ask is None else "trajectory")
    number = joint_number(config, joint)
    if ask is not None:
        config.check_movable("characterise")
        collision = safety_model(config, robot if isinstance(robot, str | Path) else None, None).collision
        for family in MOTIONS:
            words, trajectory = motion_of(family, config, number, given, collision)
            if progress is not None:
                progress(words, 0.0)
            given = (*given, ask(trajectory))
    return Characterisation(characterised(given, config, joint))


def _value_and_std(estimate: Estimate | None) -> tuple[float | None, float | None]:
    return (None, None) if estimate is None else (estimate.value, estimate.std)
