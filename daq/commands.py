"""Commands of data acquisition: options and help texts; the work is imported when a command runs."""

import logging
from functools import partial
from inspect import cleandoc
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Unpack

import typer

from armident.daq.interchange.import_options import ImportOptions, with_import_options
from armident.daq.interchange.readers import help_of_formats, names_of_formats, reader_of, written_suffixes

if TYPE_CHECKING:
    from armident.daq.recording import Recording


def capture(
    config: Annotated[str, typer.Option("--config", help="Session configuration.")] = "tx40_cell.yaml",
    out: Annotated[
        Path | None, typer.Option("--out", help="Directory of recordings; default: that of the session.")
    ] = None,
    duration: Annotated[float | None, typer.Option("--duration", help="Stop after this time, s.", min=0.001)] = None,
    listen_only: Annotated[bool, typer.Option("--listen-only", help="Send nothing to the bus.")] = False,
    sniff: Annotated[
        float | None,
        typer.Option("--sniff", min=0.1, help="With --listen-only: discover the TPDOs of the drives in this time, s."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print path and counters as JSON.")] = False,
) -> None:
    """Record the drives of a session to an MCAP file and publish them on Zenoh.

    The capture configures and supervises the drives and moves the arm along the trajectory of the session, if there is
    one. It ends with the trajectory, after --duration, on Ctrl-C or SIGTERM; the file is finished in every case. With
    --listen-only nothing is sent, and the drives are not configured: their TPDOs are those of the session, or with
    --sniff those that are received.

    Example: armident capture --config tx40_cell.yaml --out recordings
    """
    from armident.daq.capture.capture import run_capture

    run_capture(config, out, duration, listen_only, as_json, sniff)


def command(
    name: Annotated[str, typer.Argument(help="save, mark, reload or stop.")],
    text: Annotated[str, typer.Argument(help="Text of the mark.")] = "",
    config: Annotated[str, typer.Option("--config", help="Session configuration of the capture.")] = "tx40_cell.yaml",
) -> None:
    """Send a command to a running capture: save the last seconds, set a mark, reload the session, or stop.

    The session must permit it (zenoh.commands: true). `save` applies to sessions with recording.trigger, which record
    only around events; `systemctl kill -s USR1` does the same without Zenoh. `reload` reads the session again, as
    `systemctl reload` does, and applies the keys that can change without losing a sample.

    Example: armident command mark "gripper changed" --config cell.yaml
    """
    from armident.configs import ConfigError, load_robot, load_session
    from armident.daq.capture.remote_commands import COMMANDS, Command, send_command

    known = next((each for each in COMMANDS if each == name), None)
    if known is None:
        raise ConfigError(f"no command {name!r}; choose from {', '.join(COMMANDS)}")
    session = load_session(config, name)
    send_command(session, load_robot(session.robot, name).name, Command(known, text))
    print(f"{name}: accepted")


@with_import_options()
def import_(
    file: Annotated[Path, typer.Argument(help=f"File or folder: {names_of_formats()}.")],
    out: Annotated[Path, typer.Option("--out", help="The recording to write.")],
    config: Annotated[
        str | None,
        typer.Option(
            "--config",
            help="Robot configuration; for a bus log the session configuration. [required, except for a recording]",
        ),
    ] = None,
    **options: Unpack[ImportOptions],
) -> None:
    """Convert measurements of other tools to a recording, in SI units.

    FORMATS

    Missing samples are gaps. Damaged lines are left out, counted and named.

    Example: armident import DATA_EMPS.mat --config emps.yaml --out emps.mcap
    """
    from armident.configs import ConfigError, load_robot, load_session
    from armident.configs.blanks import LOG
    from armident.daq.interchange.importing import import_recording
    from armident.daq.recording import write_recording

    reader = reader_of(file)
    if config is None and not reader.own:
        raise ConfigError(f"{file}: --config is missing, the {'session' if reader.session else 'robot'} configuration")
    load = partial(load_session, command=LOG) if reader.session else partial(load_robot, command="import")
    try:
        configuration = None if config is None else load(config)
    except ConfigError as error:
        if not str(error).endswith("is wanted"):
            raise
        of_log = "" if reader.session else ", not a bus log, whose text has columns for time, identifier and data"
        raise ConfigError(f"{error}: {file} is a {reader.name}{of_log}") from error
    recording = import_recording(file, configuration, **options)
    write_recording(recording, out)
    rows, gaps = recording.samples.sync.size, recording.counters.get("samples.in_gaps", 0)
    lost = f"{gaps} in gaps, " if gaps or reader.session else ""
    print(f"{out}: {rows} samples at {recording.sample_rate_hz:g} Hz, {lost}{_fields(recording)}")


import_.__doc__ = cleandoc(str(import_.__doc__)).replace("FORMATS", help_of_formats())


def _fields(recording: "Recording") -> str:
    return ", ".join(name for stream in recording.streams.values() for name in stream.fields)


def export(
    recording: Annotated[Path, typer.Argument(help="The recording.")],
    out: Annotated[
        Path,
        typer.Option("--out", help=f"File to write: {written_suffixes()}; .mcap is a bag of ROS 2."),
    ],
) -> None:
    """Export a recording for other tools, in SI units at the joints.

    .mcap is a rosbag2 file with sensor_msgs/msg/JointState; .log (candump -l), .asc, .blf and .trc hold the SYNCs and
    TPDOs of the recording.

    Example: armident export tx40.mcap --out tx40.csv
    """
    from armident.daq.interchange.exporting import export_recording
    from armident.daq.recording import read_recording

    read = read_recording(recording)
    if read.missing is not None:
        logging.getLogger(__name__).warning("%s: %s", recording, read.missing)
    export_recording(read, out)
    print(out)


def doctor(
    config: Annotated[
        str, typer.Option("--config", help="Session configuration; a robot configuration for other commands.")
    ] = "tx40_cell.yaml",
    as_json: Annotated[bool, typer.Option("--json", help="Print the checks as JSON.")] = False,
    command: Annotated[
        Literal["capture", "import", "identify", "trajectory", "robot"],
        typer.Option("--for", help="Command in mind: capture, import, identify, trajectory or robot."),
    ] = "capture",
) -> None:
    """Check what a command needs; before a capture: configuration, bus, clock, disk, Zenoh.

    For other commands, everything that is missing in the configuration is named with the way to find it. Nothing is
    sent to the bus. The exit code is 2 if the command would not run, and 0 if there are only warnings.

    Example: armident doctor --config cell.yaml

    Before an identification: armident doctor --for identify --config robot.yaml
    """
    from armident.daq.doctor import doctor as run

    run(config, as_json, command)


def service(
    action: Annotated[str, typer.Argument(help="install, status or uninstall.")],
    cell: Annotated[str, typer.Argument(help="Name of the cell, whose session is /etc/armident/CELL.yaml.")],
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print what is to be done, and change nothing.")] = False,
    root: Annotated[
        Path, typer.Option("--root", help="Root folder of the system, for system images.", file_okay=False, exists=True)
    ] = Path("/"),
    executable: Annotated[
        Path | None,
        typer.Option(
            "--executable", help="Path of armident in the units. [default: this one; in an image that in /opt/armident]"
        ),
    ] = None,
) -> int:
    """Install, list or remove the services of a cell on a machine with systemd: user, folders, permissions and units.

    install: what is there already is left alone; a second run does nothing. No service is enabled or started.

    status: every part, whether its units are enabled and active, and the recordings. Exit code 4 if a part is missing.

    uninstall: stops and disables the units of the cell. Recordings, results and configurations are never deleted.

    Example: armident service install line3 --dry-run
    """
    from armident.configs import ConfigError
    from armident.configs.errors import FOUND
    from armident.daq.service import install, status, uninstall

    if action == "status":
        lines, complete = status(cell, root, executable)
    elif action in ("install", "uninstall"):
        complete = True
        lines = uninstall(cell, root, dry_run) if action == "uninstall" else install(cell, root, executable, dry_run)
    else:
        raise ConfigError(f"no action {action!r}; expected: armident service install, status or uninstall CELL")
    print(*lines, sep="\n")
    return 0 if complete else FOUND


def recover(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings that were not finished.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print the results as JSON.")] = False,
) -> None:
    """Add index and summary to truncated recordings, so that every MCAP reader opens them; print the missing parts.

    Complete recordings are not touched. A file that is being written is refused.

    Example: armident recover recordings/*.mcap
    """
    import json

    from armident.daq.recording import recover_recording

    results = [recover_recording(path) for path in recordings]
    if as_json:
        print(
            json.dumps(
                [
                    {"path": str(r.path), "missing": r.missing, "original": r.original and str(r.original)}
                    for r in results
                ]
            )
        )
        return
    for result in results:
        kept = "" if result.original is None else f"; damaged file kept as {result.original}"
        print(f"{result.path}: " + ("complete" if result.missing is None else f"recovered: {result.missing}{kept}"))
