"""Command ``armident view``."""

import os
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from armident.identify.view.contents import Contents


def view(
    recording: Annotated[Path, typer.Argument(help="Recording (.mcap).")],
    config: Annotated[
        Path | None, typer.Option("--config", help="Robot configuration. [default: the one inside the recording]")
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            "--model",
            help="Result (file or folder) whose torques are subtracted. [default: RECORDING.identification, if any]",
        ),
    ] = None,
    urdf: Annotated[
        Path | None,
        typer.Option("--urdf", help="URDF with the shapes of the links. [default: the one that --config names]"),
    ] = None,
    viewer: Annotated[Literal["rerun", "foxglove"], typer.Option("--viewer", help="Program that shows it.")] = "rerun",
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="File to write: .rrd (rerun), or .json (layout of foxglove, beside an .mcap with the data). "
            "[default: a file in RECORDING.view, and rerun opens it where there is a display]",
        ),
    ] = None,
) -> None:
    """Show a recording and what a model does not explain of it: the arm in 3D, curves and findings.

    The joints of the arm have the colour of their unexplained torque, in standard deviations.

    Example: armident view tuesday.mcap --model monday.identification --urdf arm.urdf

    Example: armident view tuesday.mcap --viewer foxglove --out tuesday.json
    """
    from armident.extras import require

    require("armident view", "identify", "viewer")
    from armident.configs import ConfigError, load_robot
    from armident.daq.recording import read_recording
    from armident.identify.cli.progress import progress, warn
    from armident.identify.cli.result_commands import beside, writing
    from armident.identify.documents.files import whole_file
    from armident.identify.identification.from_recording import check_same_robot
    from armident.identify.model_export.source_urdf import source_for, source_of
    from armident.identify.view.arm import arm_of
    from armident.identify.view.contents import contents_of, prediction_of

    suffixes = {"rerun": [".rrd"], "foxglove": [".json", ".mcap"]}[viewer]
    files = [(out or beside(recording, "view") / f"{viewer}.x").with_suffix(suffix) for suffix in suffixes]
    if out is not None and out != files[0]:
        raise ConfigError(f"--out {out}: expected a name that ends in {suffixes[0]}")
    existing = next((file for file in files if out is not None and file.exists()), None)
    if existing is not None:
        raise ConfigError(f"--out {out}: {existing} exists already: give another name, or remove it")
    read = read_recording(recording)
    given = None if config is None else load_robot(config, "identify")
    robot = given or read.robot
    check_same_robot(read.robot, robot)
    source = source_for(robot, urdf) if urdf is not None else None if config is None else source_of(config)
    arm, remarks = arm_of(robot, source)
    if read.missing is not None:
        remarks.append(f"{recording}: torn: {read.missing}")
    with progress(f"view {recording.name}") as report:
        prediction = prediction_of(read, model, beside(recording, "identification"), given, remarks, report)
        shown = contents_of(read, robot, arm, prediction, beside(recording, "diagnosis") / "diagnosis.json")
    warn(remarks)
    # The viewer listens for further data, by default on every interface.
    rerun = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", str(files[0])]
    writers: list[Callable[[Contents, Path], None]]
    if viewer == "foxglove":
        from armident.identify.view.foxglove_files import write_layout, write_mcap

        writers = [write_layout, write_mcap]
        how = f"open {files[1]} and {recording} together in Foxglove, and import the layout {files[0]}"
    else:
        from armident.identify.view.rerun_file import write_rrd

        writers, how = [write_rrd], shlex.join(rerun)
    # The layout comes last: it is of no use without the data.
    for file, write in reversed(list(zip(files, writers, strict=True))):
        with writing(file), whole_file(file) as temporary:
            write(shown, temporary)
        print(f"written: {file}")
    print(f"to see it: {how}")
    if viewer == "rerun" and out is None and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        subprocess.Popen(rerun, start_new_session=True)
