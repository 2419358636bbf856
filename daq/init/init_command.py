"""Options of ``armident init``; the work is imported when the command runs."""

import sys
from pathlib import Path
from typing import Annotated, Literal, Unpack

import typer

from armident.daq.interchange.import_options import ImportOptions, with_import_options
from armident.daq.interchange.readers import names_of_formats


@with_import_options("polled", "resample_hz")
def init(
    urdf: Annotated[Path | None, typer.Argument(help="URDF of the arm.")] = None,
    out: Annotated[Path, typer.Option("--out", help="Folder of robot.yaml and session.yaml.")] = Path(),
    recording: Annotated[
        Path | None, typer.Option("--recording", help=f"Recording of the arm: {names_of_formats()}.")
    ] = None,
    robot: Annotated[
        str | None, typer.Option("--robot", help="Robot of the library instead of a URDF: ur5e, ...")
    ] = None,
    dh: Annotated[
        Path | None, typer.Option("--dh", help="Table of Denavit-Hartenberg parameters instead: theta, d, a, alpha.")
    ] = None,
    convention: Annotated[
        Literal["classical", "modified"] | None,
        typer.Option("--convention", help="Of that table. [default: modified with a column r, else classical]"),
    ] = None,
    axes: Annotated[
        int | None, typer.Option("--axes", help="Number of joints, if the geometry is not known yet.", min=1)
    ] = None,
    base: Annotated[str | None, typer.Option("--base", help="First link of the chain. [default: the root]")] = None,
    tip: Annotated[str | None, typer.Option("--tip", help="Last link of the chain. [default: its end]")] = None,
    name: Annotated[str | None, typer.Option("--name", help="Name of the robot. [default: that of the source]")] = None,
    signal: Annotated[
        Literal["torque", "current", "voltage"] | None,
        typer.Option("--signal", help="Effort that the drives report. [default: that of the recording, or torque]"),
    ] = None,
    torque_sensors: Annotated[
        bool, typer.Option("--torque-sensors", help="Efforts are measured behind the gears: a model without rotors.")
    ] = False,
    gravity: Annotated[
        str, typer.Option("--gravity", help="Gravity in the frame of the base, X,Y,Z in m/s^2. [default: 0,0,-9.81]")
    ] = "",
    cell: Annotated[str | None, typer.Option("--cell", help="Name of the cell. [default: that of the robot]")] = None,
    channel: Annotated[str | None, typer.Option("--channel", help="CAN interface of the drives, such as can0.")] = None,
    bitrate: Annotated[
        int | None, typer.Option("--bitrate", help="Bit rate of the bus, bit/s; 0 for a virtual bus.", min=0)
    ] = None,
    node_ids: Annotated[
        str, typer.Option("--node-ids", help="CANopen nodes of the joints, base to tip: 1,2,3,...")
    ] = "",
    eds: Annotated[str | None, typer.Option("--eds", help="Electronic data sheet of the drives.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that exist.")] = False,
    **stated: Unpack[ImportOptions],
) -> None:
    """Write the configuration of an arm and of its cell, from what is known of it and a recording.

    Sources of the geometry: a URDF, a robot of the library, a table of Denavit-Hartenberg parameters. Without any,
    questions are asked on a terminal. What is not known yet is marked FILL_IN, with the way to find it. All blanks are
    listed at the end; a command asks only for those that it needs.

    Example: armident init arm.urdf --recording data.csv --out my_arm
    """
    from armident.configs import ConfigError
    from armident.daq.init.initialize import InitOptions, run_init

    def numbers(option: str, text: str) -> list[float]:
        try:
            return [float(word) for word in text.split(",") if word.strip()]
        except ValueError as error:
            raise ConfigError(f"{option}: expected numbers, NUMBER,NUMBER,...; found {text!r}") from error

    nodes = [int(number) for number in numbers("--node-ids", node_ids)]
    down = numbers("--gravity", gravity)
    if len(down) not in (0, 3):
        raise ConfigError(f"--gravity: expected X,Y,Z, found {gravity!r}")
    of_cell = {"cell": cell, "channel": channel, "bitrate": bitrate, "node_ids": nodes or None, "eds": eds}
    options = InitOptions(
        out=out,
        urdf=urdf,
        robot=robot,
        dh=dh,
        axes=axes,
        convention=convention,
        base=base,
        tip=tip,
        recording=recording,
        stated=stated,
        name=name,
        signal=signal,
        link_torques=torque_sensors,
        gravity=(down[0], down[1], down[2]) if down else None,
        cell={key: value for key, value in of_cell.items() if value is not None},
        overwrite=overwrite,
    )
    if urdf is None and robot is None and dh is None and axes is None and sys.stdin.isatty():
        from armident.daq.init.questionnaire import questionnaire

        def ask(question: str, default: str) -> str:
            return str(typer.prompt(question, default=default, show_default=bool(default)))

        options = questionnaire(options, ask, print)
    print(run_init(options))
