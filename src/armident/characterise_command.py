"""Command ``armident characterise``: friction, ripple and reversals of one joint, from recordings or by a program."""

import sys
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from armident.asking import RATE_HZ, Bars, RobotCommand, confirmed, door_of, moving_session

if TYPE_CHECKING:
    from armident.configs import Trajectory
    from armident.daq.recording import Recording


def characterise(
    joint: Annotated[str, typer.Option("--joint", help="Name of the joint.")],
    recordings: Annotated[
        list[Path] | None,
        typer.Argument(help="Recordings in which the joint moves alone.", show_default=False),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            help="Robot configuration, or a session whose arm moves on its bus under the guard. [default: the robot "
            "inside the recording]",
        ),
    ] = None,
    robot_command: RobotCommand = None,
    yes: Annotated[bool, typer.Option("--yes", help="Move without asking.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the results. [default: characterisation]")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print only the result document on stdout.")] = False,
) -> None:
    """Measure friction over speed, torque ripple and friction about reversals of one joint.

    With a session or --robot-command the joint moves at constant speeds and then to and fro, at most 1.5 times as fast
    as the recordings; without a recording it uses a tenth of its limits.

    Example: armident characterise speeds.mcap reversals.mcap --joint joint_2

    Example: armident characterise --joint joint_2 --config tx40.yaml --robot-command 'python move.py'

    Example: armident characterise --joint joint_2 --config cell.yaml
    """
    from armident.configs import ConfigError, RobotConfig, load_robot
    from armident.daq.recording import read_recording
    from armident.identify.api.characterisation_api import characterise as run
    from armident.identify.investigation.folder import keep_motion

    folder, session = out or Path("characterisation"), moving_session(config) if robot_command is None else None
    read = [read_recording(path) for path in recordings or ()]
    if not read and session is None and (robot_command is None or config is None):
        raise ConfigError(
            "give recordings, or what moves the joint: --config SESSION, or --config ROBOT with --robot-command PROGRAM"
        )

    def robot() -> RobotConfig:
        return read[0].robot if config is None else load_robot(config, "trajectory")

    rate_hz = read[0].sample_rate_hz if read else RATE_HZ
    door = door_of("characterise", robot_command, session, robot, folder, rate_hz, yes=yes)
    if session is not None:
        config = session.robot
    bars, asked = Bars("characterise"), door
    if door is not None:
        if any(folder.glob("motion_*.yaml")):
            raise ConfigError(f"{folder}: has motions already; give another --out")
        folder.mkdir(parents=True, exist_ok=True)
        play, numbers = confirmed(door, bars, always=yes), count(1)

        def kept(trajectory: "Trajectory") -> "Recording":
            keep_motion(folder, next(numbers), trajectory)
            return play(trajectory)

        asked = kept

    with bars:
        found = run(read, joint, robot=config, ask=asked, progress=bars.report)
    written, html = found.save(folder)
    if json:
        sys.stdout.write(written.read_text(encoding="utf-8"))
    else:
        print(f"{found}\nresult: {written}\nreport: {html}")
