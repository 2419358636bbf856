"""Command ``armident investigate``: ask an arm on its bus, by a program, by hand, or from recordings of the past."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from armident.asking import RATE_HZ, Bars, RobotCommand, confirmed, door_of, moving_session

if TYPE_CHECKING:
    from armident.identify.api.investigation_api import Investigation


def investigate(
    recordings: Annotated[
        list[Path] | None,
        typer.Argument(help="Recordings from before, or with --continue that of the last motion.", show_default=False),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            help="Session whose arm is asked on its bus under the guard, or robot configuration with limits. [default: "
            "the robot inside the recording]",
        ),
    ] = None,
    robot_command: RobotCommand = None,
    by_hand: Annotated[
        bool, typer.Option("--by-hand", help="Write the next trajectory, say what to do, and end.")
    ] = False,
    choose_from: Annotated[
        Path | None, typer.Option("--replay", help="Folder of recordings of the past to ask in place of the arm.")
    ] = None,
    baseline: Annotated[
        Path | None,
        typer.Option("--baseline", help="identification.json of the arm before: asks what has changed since."),
    ] = None,
    resume: Annotated[Path | None, typer.Option("--continue", help="Folder of an investigation to go on with.")] = None,
    experiments: Annotated[int, typer.Option("--experiments", help="Most motions.", min=1)] = 6,
    minutes: Annotated[float, typer.Option("--minutes", help="Longest motion of all rounds together, min.")] = 10.0,
    material: Annotated[
        float, typer.Option("--material", help="Least change of a joint's torque by a finding, percent.", min=0.0)
    ] = 0.2,
    yes: Annotated[bool, typer.Option("--yes", help="Move without asking.")] = False,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for the results. [default: investigation]")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print only the result document on stdout.")] = False,
) -> int:
    """Ask an arm to move until its recordings decide what its model lacks.

    Each round diagnoses all recordings and asks for the motion that tells the explanations apart most per second. It
    ends with a name and its probability, or says why no motion can tell.

    The program of --robot-command reads columns t and qr1, qr2 ... (s, rad or m, at the rate of the recordings), moves
    the robot to the first row, plays the rows, and writes a file that `armident import` reads.

    With a session the arm moves on its bus under the guard, as by reidentify. A motion that the guard stops is the
    last one.

    Exit code 0 if nothing is missing, 3 if the set-up is wrong, 4 if something is missing or is not decided, or waits.

    Example: armident investigate monday.mcap --by-hand --out why

    Example: armident investigate --continue why tuesday.mcap

    Example: armident investigate monday.mcap --robot-command 'armident robot --config tx40.yaml --to-command'

    Example: armident investigate monday.mcap --config cell.yaml
    """
    from armident.configs import ConfigError, DataError, RobotConfig, load_robot
    from armident.configs.errors import FOUND
    from armident.daq.recording import read_recording
    from armident.identify.api.investigation_api import investigate as run
    from armident.identify.documents.files import load_document
    from armident.identify.documents.investigation import OUTCOMES, InvestigationDocument

    doors = [robot_command is not None, by_hand, choose_from is not None]
    session = None if any(doors) else moving_session(config)
    if sum(doors) > 1 or (resume is None and session is None and not any(doors)):
        raise ConfigError(
            "give one way to ask: --config with a session, --robot-command PROGRAM, --by-hand, or --replay FOLDER"
        )
    if resume is not None and (out is not None or baseline is not None or (config is not None and session is None)):
        raise ConfigError(
            "--continue: robot, baseline and folder are those of the investigation; leave --config, --baseline and "
            "--out out"
        )
    folder = resume or out or Path("investigation")
    read = [read_recording(path) for path in recordings or ()]
    if config is None and not read and resume is None:
        raise ConfigError("--config: give the robot, or a recording from before")
    offered = [] if choose_from is None else [read_recording(path) for path in sorted(choose_from.glob("*.mcap"))]
    if choose_from is not None and not offered:
        raise ConfigError(f"--replay {choose_from}: no recordings (.mcap) in this folder")
    bars, given = Bars("investigate"), folder / "robot.yaml" if resume is not None else config

    def robot() -> RobotConfig:
        return read[0].robot if given is None else load_robot(given, "trajectory")

    rate_hz = read[0].sample_rate_hz if read else RATE_HZ
    door = door_of("investigate", robot_command, session, robot, folder, rate_hz, yes=yes)
    if session is not None:
        config = session.robot
    asked = None if door is None else confirmed(door, bars, always=yes)
    if door is not None:
        former = None if resume is None else load_document(resume / "investigation.json", InvestigationDocument)
        most = experiments if former is None else former.experiments - len(former.rounds)
        left_s = 60.0 * minutes if former is None else 60.0 * former.minutes - former.motion_s
        print(f"investigate: motions to come: at most {most}, of {left_s:.0f} s in total", file=sys.stderr)
    with bars:
        found = run(
            config, asked, read, choose_from=offered, baseline=baseline, experiments=experiments, minutes=minutes,
            material=material, out=None if resume is not None else folder, resume=resume, progress=bars.report,
        )  # fmt: skip
    written, html, model = found.save(folder)
    if json:
        sys.stdout.write(written.read_text(encoding="utf-8"))
    else:
        _print(found, folder, OUTCOMES[found.document.outcome])
        print(f"result: {written}\nreport: {html}\nmodel:  {model}")
    return {"healthy": 0, "set_up": DataError.exit_code}.get(found.outcome, FOUND)


def _print(found: "Investigation", folder: Path, meaning: str) -> None:
    document = found.document
    for number, one in enumerate(document.rounds, 1):
        answer = one.refused or ("answered" if one.recording is not None else "awaited")
        print(f"round {number}: {one.question}\n  {one.chosen.words}, {one.chosen.duration_s:.1f} s: {answer}")
    print(f"{document.robot}: {document.outcome.replace('_', ' ')}. {document.statement or meaning}")
    if found.pending is not None:
        file = folder / str(document.rounds[-1].trajectory)
        print(f"next: record the motion of {file}, then: armident investigate --continue {folder} RECORDING")
