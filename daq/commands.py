"""The commands of this room, as the command line sees them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from armident.daq.recording import Recording


def capture(
    config: Annotated[str, typer.Option("--config", help="Session configuration.")] = "tx40_cell.yaml",
    out: Annotated[Path | None, typer.Option("--out", help="Directory of recordings; default: the session's.")] = None,
    duration: Annotated[float | None, typer.Option("--duration", help="Stop after so many seconds.", min=0.001)] = None,
    listen_only: Annotated[bool, typer.Option("--listen-only", help="Send nothing at all to the bus.")] = False,
    sniff: Annotated[
        float | None,
        typer.Option("--sniff", min=0.1, help="With --listen-only: find out in so many seconds what drives send."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print path and counters as JSON.")] = False,
) -> None:
    """Record the drives of a session to an MCAP file and publish them on Zenoh.

    Starts and supervises the drives, plays the session's trajectory if it has one, and ends when that is over, after
    --duration, or on Ctrl-C or SIGTERM; the file is finished in every case. With --listen-only nothing is sent, not
    even to configure the drives: what they send is what the session says, or with --sniff what is heard.

    Example: armident capture --config tx40_cell.yaml --out recordings
    """
    from armident.daq.capture.capture import run_capture

    run_capture(config, out, duration, listen_only, as_json, sniff)


def command(
    name: Annotated[str, typer.Argument(help="save, mark, reload or stop.")],
    text: Annotated[str, typer.Argument(help="What a mark says.")] = "",
    config: Annotated[str, typer.Option("--config", help="Session configuration of the capture.")] = "tx40_cell.yaml",
) -> None:
    """Ask a running capture for something: save what was just recorded, set a mark, reload its session, or stop.

    The session of the capture has to allow it (zenoh.commands: true). `save` is for sessions with recording.trigger,
    which keep only what happens around events; `systemctl kill -s USR1` asks for the same without Zenoh.
    `reload` reads the session again, as `systemctl reload` does: what can change without losing a sample does.

    Example: armident command mark "gripper changed" --config cell.yaml
    """
    from armident.configs import ConfigError, load_robot, load_session
    from armident.daq.capture.remote_commands import COMMANDS, Command, send_command

    known = next((each for each in COMMANDS if each == name), None)
    if known is None:
        raise ConfigError(f"no command {name!r}; there are {', '.join(COMMANDS)}")
    session = load_session(config)
    send_command(session, load_robot(session.robot).name, Command(known, text))
    print(f"{name}: accepted")


def import_(
    file: Annotated[Path, typer.Argument(help="CSV, MAT, NPZ, Parquet, rosbag2's MCAP, or the log of a bus.")],
    config: Annotated[str, typer.Option("--config", help="Robot configuration; of a bus log the session's.")],
    out: Annotated[Path, typer.Option("--out", help="The recording to write.")],
    effort: Annotated[Path | None, typer.Option("--effort", help="Second CSV with one effort per joint.")] = None,
    motor_side: Annotated[bool, typer.Option("--motor-side", help="Values are the motors', not the joints'.")] = False,
    rate: Annotated[
        float | None, typer.Option("--rate", help="Sampling rate, Hz; default: column t.", min=0.001)
    ] = None,
    names: Annotated[
        str, typer.Option("--map", help="Names in the file: position=qm,voltage=vir,...; demand=- leaves it out.")
    ] = "",
    polled: Annotated[
        bool, typer.Option("--polled", help="Rows were read without waiting: put them on the clock of --rate.")
    ] = False,
) -> None:
    """Make a recording of measurements that other tools wrote.

    CSV columns: t (s), q1..qn, tau1..taun or current1..currentn, optionally the reference qr1..qrn; SI units. MAT, NPZ
    and Parquet: the same names, or positions, torques, times. ROS 2 bags (.mcap): sensor_msgs/msg/JointState. Logs of
    a bus (candump -l, .asc, .blf, .trc): SYNC and TPDOs, as the session configuration maps them.

    Example: armident import DATA_EMPS.mat --config emps.yaml --out emps.mcap
    """
    from armident.configs import ConfigError, load_robot, load_session
    from armident.daq.interchange.bus_log import SUFFIXES, recording_from_log
    from armident.daq.interchange.importing import import_recording
    from armident.daq.recording import write_recording

    if file.suffix.lower() in SUFFIXES:
        if effort is not None or motor_side or rate is not None or names or polled:
            raise ConfigError(f"{file}: what is in the log of a bus is said by --config alone")
        session = load_session(config)
        logged = recording_from_log(file, session, load_robot(session.robot))
        write_recording(logged, out)
        rows, gaps = logged.counters["samples.rows"], logged.counters["samples.in_gaps"]
        print(f"{out}: {rows} samples at {logged.sample_rate_hz:g} Hz, {gaps} in gaps, {_fields(logged)}")
        return

    pairs = [pair.partition("=") for pair in names.split(",") if pair]
    for key, equals, value in pairs:
        if not (key and equals and value):
            raise ConfigError(f"--map: expected QUANTITY=NAME,..., found {key + equals + value!r}")
    recording = import_recording(
        file,
        load_robot(config),
        effort=effort,
        motor_side=motor_side,
        rate_hz=rate,
        names={key: value for key, _, value in pairs},
        polled=polled,
    )
    write_recording(recording, out)
    rows, fields = recording.samples.sync.size, _fields(recording)
    print(f"{out}: {rows} samples at {recording.sample_rate_hz:g} Hz, {fields}")


def _fields(recording: "Recording") -> str:
    """What a recording holds, in words."""
    return ", ".join(name for stream in recording.streams.values() for name in stream.fields)


def export(
    recording: Annotated[Path, typer.Argument(help="The recording.")],
    out: Annotated[
        Path,
        typer.Option("--out", help="File to write: .csv, .npz, .mat, .parquet, .mcap (ROS 2), .log, .asc, .blf, .trc."),
    ],
) -> None:
    """Write a recording for other tools, in SI units at the joints.

    .mcap is a rosbag2 file with sensor_msgs/msg/JointState; .log (candump -l), .asc, .blf and .trc hold the SYNCs and
    TPDOs that it was recorded from.

    Example: armident export tx40.mcap --out tx40.csv
    """
    from armident.daq.interchange.exporting import export_recording
    from armident.daq.recording import read_recording

    read = read_recording(recording)
    if read.missing is not None:
        typer.echo(f"armident: warning: {recording}: {read.missing}", err=True)
    export_recording(read, out)
    print(out)


def doctor(
    config: Annotated[str, typer.Option("--config", help="Session configuration.")] = "tx40_cell.yaml",
    as_json: Annotated[bool, typer.Option("--json", help="Print the checks as JSON.")] = False,
) -> None:
    """Check a session and this machine before a capture: configuration, bus, clock, disk, Zenoh.

    Nothing is sent to the bus. Exit code 2 if a capture would not run; warnings alone are exit code 0.

    Example: armident doctor --config cell.yaml
    """
    from armident.daq.doctor import doctor as examine

    examine(config, print, as_json)


def heal(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings that were not finished.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print what became of them as JSON.")] = False,
) -> None:
    """Give torn recordings their index and summary, so that every MCAP reader opens them, and say what they lack.

    Complete ones are left alone. A file that is being written is refused.

    Example: armident heal recordings/*.mcap
    """
    import json

    from armident.daq.recording import recover_recording

    healed = [recover_recording(path) for path in recordings]
    if as_json:
        print(
            json.dumps(
                [
                    {"path": str(h.path), "missing": h.missing, "original": h.original and str(h.original)}
                    for h in healed
                ]
            )
        )
        return
    for found in healed:
        kept = "" if found.original is None else f"; as it was: {found.original}"
        print(f"{found.path}: " + ("complete" if found.missing is None else f"healed: {found.missing}{kept}"))
