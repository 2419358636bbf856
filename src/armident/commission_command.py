"""Command ``armident commission``: a new arm from its configuration to a trusted model."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from armident.asking import RATE_HZ, Bars, RobotCommand, confirmed, door_of, moving_session


def commission(
    config: Annotated[
        Path,
        typer.Argument(help="Session whose arm moves on its bus under the guard, or robot configuration with limits."),
    ],
    robot_command: RobotCommand = None,
    resume: Annotated[
        Path | None,
        typer.Option("--continue", help="Folder of a commissioning to go on with, by the robot.yaml in it."),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Move without asking.")] = False,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for the results. [default: commissioning]")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print only the result document on stdout.")] = False,
) -> int:
    """Move a new arm from small motions of each joint to a trusted model, and check it at every stage.

    The stages: configuration and bus; each joint alone at a tenth of its limits; all joints at a tenth, half and full
    speed; identification, and prediction of a motion that the model has not seen. Each motion is named before it is
    played. A mistake ends the command with the line of the configuration that corrects it.

    Exit code 0 if the model is trusted, 3 if set-up or data are wrong, 4 if the model is not trusted.

    Example: armident commission cell.yaml

    Example: armident commission tx40.yaml --robot-command 'armident robot --config tx40.yaml --to-command'
    """
    from armident.configs import ConfigError, DataError, load_robot
    from armident.configs.errors import FOUND
    from armident.daq.doctor import checks_for
    from armident.identify.api.commissioning_api import commission as run

    if resume is not None and out is not None:
        raise ConfigError("--continue: the results stay in its folder; leave --out out")
    folder = resume or out or Path("commissioning")
    session = moving_session(config) if robot_command is None else None
    robot = config if session is None else session.robot
    if robot_command is None and session is None:
        raise ConfigError(f"{config}: is no session; add --robot-command PROGRAM, which moves the robot")
    checks = checks_for(config, "trajectory" if session is None else "capture")
    for check in checks:
        print(f"{check.verdict:8} {check.name}: {check.message}", file=sys.stderr)
    if any(check.verdict == "failed" for check in checks):
        raise ConfigError(f"{config}: correct what has failed before the arm moves")
    given = robot if resume is None else folder / "robot.yaml"
    bars = Bars("commission")
    door = door_of(
        "commission", robot_command, session, lambda: load_robot(given, "trajectory"), folder, RATE_HZ, yes=yes
    )
    assert door is not None

    def say(line: str) -> None:
        bars.pause()
        print(line, file=sys.stderr)

    with bars:
        found = run(
            robot if resume is None else None, confirmed(door, bars, always=yes),
            out=out or (None if resume else folder), resume=resume, say=say, progress=bars.report,
        )  # fmt: skip
    written, html = found.save(folder)
    if json:
        sys.stdout.write(written.read_text(encoding="utf-8"))
    else:
        print(f"{found.document.robot}: {found.outcome.replace('_', ' ')}. Next: {found.document.next_step}")
        print(f"result: {written}\nreport: {html}")
    return {"trusted": 0, "not_trusted": FOUND}.get(found.outcome, DataError.exit_code)
