"""Options of ``armident init``; the work is imported when the command runs."""

from pathlib import Path
from typing import Annotated, Literal

import typer


def init(
    urdf: Annotated[Path | None, typer.Argument(help="URDF of the arm.")] = None,
    out: Annotated[Path, typer.Option("--out", help="Folder of robot.yaml and session.yaml.")] = Path(),
    recording: Annotated[
        Path | None, typer.Option("--recording", help="Recording of the arm: CSV, MAT, NPZ, Parquet, rosbag2, or MCAP.")
    ] = None,
    robot: Annotated[
        str | None, typer.Option("--robot", help="Robot of the library instead of a URDF: ur5e, ...")
    ] = None,
    base: Annotated[str | None, typer.Option("--base", help="First link of the chain. [default: the root]")] = None,
    tip: Annotated[str | None, typer.Option("--tip", help="Last link of the chain. [default: its end]")] = None,
    name: Annotated[str | None, typer.Option("--name", help="Name of the robot. [default: that of the source]")] = None,
    signal: Annotated[
        Literal["torque", "current", "voltage"] | None,
        typer.Option("--signal", help="Effort that the drives report. [default: that of the recording, or torque]"),
    ] = None,
    names: Annotated[
        str, typer.Option("--map", help="Names in the recording: position=qm,torque=tau_J; demand=- omits it.")
    ] = "",
    joints: Annotated[
        str, typer.Option("--joints", help="Joint names in the recording, in the robot's order: NAME,NAME,...")
    ] = "",
    by_position: Annotated[
        bool, typer.Option("--by-position", help="Take joints of other names in the order of the recording.")
    ] = False,
    topic: Annotated[str | None, typer.Option("--topic", help="Topic of joint states in a bag.")] = None,
    motor_side: Annotated[bool, typer.Option("--motor-side", help="Recorded values are those of the motors.")] = False,
    units: Annotated[
        str, typer.Option("--units", help="Units of the recording: position=deg,torque=mnm. [default: by magnitude]")
    ] = "",
    time_unit: Annotated[
        str | None, typer.Option("--time-unit", help="Unit of its times: s, ms, us, ns. [default: by magnitude]")
    ] = None,
    rate: Annotated[
        float | None, typer.Option("--rate", help="Its sampling rate, Hz. [default: by its times]", min=0.001)
    ] = None,
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
) -> None:
    """Write the configuration of an arm and of its cell, from a URDF or a robot of the library, and a recording.

    What is not known yet is marked FILL_IN, with the way to find it. All blanks are listed at the end; a command asks
    only for those that it needs.

    Example: armident init arm.urdf --recording data.csv --out my_arm
    """
    from armident.configs import ConfigError
    from armident.daq.init.command import InitOptions, run_init
    from armident.daq.interchange.text_files import pairs_of

    try:
        nodes = [int(word) for word in node_ids.split(",") if word.strip()]
    except ValueError as error:
        raise ConfigError(f"--node-ids: expected whole numbers, NUMBER,NUMBER,...; found {node_ids!r}") from error
    stated = {
        "names": pairs_of("--map", names),
        "joints": [word.strip() for word in joints.split(",") if word.strip()],
        "by_position": by_position,
        "topic": topic,
        "motor_side": motor_side,
        "units": pairs_of("--units", units),
        "time_unit": time_unit,
        "rate_hz": rate,
    }
    of_cell = {"cell": cell, "channel": channel, "bitrate": bitrate, "node_ids": nodes or None, "eds": eds}
    options = InitOptions(
        out=out,
        urdf=urdf,
        robot=robot,
        base=base,
        tip=tip,
        recording=recording,
        stated=stated,
        name=name,
        signal=signal,
        cell={key: value for key, value in of_cell.items() if value is not None},
        overwrite=overwrite,
    )
    print(run_init(options))
