"""Ways to ask an arm for a motion that commands share: a program, a cell on its bus, and the question beforehand."""

import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from armident.configs import RobotConfig, SessionConfig, Trajectory
    from armident.daq.recording import Recording

RATE_HZ = 1000.0
"""Rate of a trajectory for a program where no recording gives one, Hz."""
RobotCommand = Annotated[
    str | None,
    typer.Option(
        "--robot-command",
        help="Program that moves the robot: it is called with TRAJECTORY.csv and the file to write, and fails to "
        "refuse the motion.",
    ),
]
"""Option of the commands that move a robot by a program."""
PRINTED = 400
"""Last characters of the output of a program that a refusal quotes."""


def moving_session(config: Path | None) -> "SessionConfig | None":
    """Return the session of a configuration whose arm can be moved; ``None`` for the configuration of a robot."""
    from armident.configs import config_path
    from armident.configs.loading import is_session
    from armident.identify.monitoring.reidentify.cell import load_moving_session

    if config is None or not is_session(file := config_path(config, of_folder="session.yaml")):
        return None
    return load_moving_session(file)


def door_of(
    name: str,
    robot_command: str | None,
    session: "SessionConfig | None",
    robot: "Callable[[], RobotConfig]",
    folder: Path,
    rate_hz: float,
    *,
    yes: bool,
) -> "Callable[[Trajectory], Recording] | None":
    """Return what moves the robot for a command: a program, or the cell of a session; ``None`` without both."""
    from armident.configs import ConfigError
    from armident.identify.monitoring.reidentify.cell import Cell

    if robot_command is None and session is None:
        return None
    command = shlex.split(robot_command or "")
    if robot_command is not None and shutil.which(next(iter(command), "")) is None:
        raise ConfigError(f"--robot-command {robot_command}: no such program")
    if not yes and not sys.stdin.isatty():
        raise ConfigError("the robot would move, and nobody can be asked here: add --yes")
    if robot_command is not None:
        return Program(command, robot(), folder, rate_hz)
    assert session is not None
    return Cell(session, folder, lambda line: print(f"{name}: {line}", file=sys.stderr, flush=True))


class Bars(ExitStack):
    """Progress of the stages; it pauses while the user is asked."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self._name = name
        self._report: Callable[[str, float], None] | None = None
        self.stage = ""

    def report(self, stage: str, share: float) -> None:
        """Show a stage and its share."""
        from armident.identify.cli.progress import progress

        self.stage = stage
        if self._report is None:
            self._report = self.enter_context(progress(self._name))
        self._report(stage, share)

    def pause(self) -> None:
        """Remove the bar until the next stage."""
        self._report = None
        self.close()


def confirmed(
    door: "Callable[[Trajectory], Recording]", bars: Bars, *, always: bool
) -> "Callable[[Trajectory], Recording]":
    """Return a door that says what it will do, and asks before it moves the robot."""

    def asked(trajectory: "Trajectory") -> "Recording":
        bars.pause()
        print(f"{bars.stage}, {trajectory.duration:.1f} s", file=sys.stderr)
        if not always and not typer.confirm("Move the robot?", err=True):
            raise typer.Abort
        return door(trajectory)

    return asked


class Program:
    """A program that moves the robot: ``PROGRAM TRAJECTORY.csv OUT``."""

    def __init__(self, command: list[str], robot: "RobotConfig", folder: Path, rate_hz: float) -> None:
        self._command, self._robot, self._folder, self._rate_hz = command, robot, folder, rate_hz

    def __call__(self, trajectory: "Trajectory") -> "Recording":
        """Return the file that the program leaves, imported; DataError if it refuses or leaves none."""
        import numpy as np

        from armident.configs import DataError
        from armident.daq.interchange.importing import import_recording
        from armident.daq.interchange.readers import reader_of
        from armident.daq.recording import read_recording

        number = len(list(self._folder.glob("motion_*.yaml")))
        if not (answers := list(self._folder.glob(f"answer_{number}.*"))):
            reference, left = self._folder / f"reference_{number}.csv", self._folder / f"left_{number}.csv"
            period = 1.0 / self._rate_hz
            q = trajectory.sample(period)
            header = ",".join(["t", *(f"qr{j + 1}" for j in range(q.shape[1]))])
            table = np.column_stack([period * np.arange(len(q)), q])
            np.savetxt(reference, table, "%.9g", delimiter=",", header=header, comments="")
            for torn in self._folder.glob(f"{left.stem}.*"):
                torn.unlink()
            words = [*self._command, str(reference), str(left)]
            done = subprocess.run(words, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                printed = " ".join((done.stderr or done.stdout).split())[-PRINTED:]
                raise DataError(
                    f"the program ended with exit code {done.returncode}: {printed or 'it printed nothing'}"
                )
            written = [path for path in sorted(self._folder.glob(f"{left.stem}.*")) if path.is_file()]
            if not written:
                raise DataError(f"the program left no file {left}")
            name = f"answer_{number}{written[0].name.removeprefix(left.stem)}"
            answers = [written[0].replace(self._folder / name)]
        answer = answers[0]
        return read_recording(answer) if reader_of(answer).own else import_recording(answer, self._robot)
