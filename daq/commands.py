"""The commands of this room, as the command line sees them."""

from pathlib import Path
from typing import Annotated

import typer


def capture(
    config: Annotated[str, typer.Option("--config", help="Session configuration.")] = "tx40_cell.yaml",
    out: Annotated[Path | None, typer.Option("--out", help="Directory of recordings; default: the session's.")] = None,
    duration: Annotated[float | None, typer.Option("--duration", help="Stop after so many seconds.", min=0.001)] = None,
    listen_only: Annotated[bool, typer.Option("--listen-only", help="Send nothing at all to the bus.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print path and counters as JSON.")] = False,
) -> None:
    """Record the drives of a session to an MCAP file and publish them on Zenoh.

    Starts and supervises the drives, plays the session's trajectory if it has one, and ends when that is over, after
    --duration, or on Ctrl-C or SIGTERM; the file is finished in every case.

    Example: armident capture --config tx40_cell.yaml --out recordings
    """
    from daq.capture import run_capture

    run_capture(config, out, duration, listen_only, as_json)


def import_(
    file: Annotated[Path, typer.Argument(help="CSV, MAT or NPZ.")],
    config: Annotated[str, typer.Option("--config", help="Robot configuration.")],
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

    CSV columns: t (s), q1..qn, tau1..taun or current1..currentn, optionally the reference qr1..qrn; SI units. MAT and
    NPZ: the same names, or positions, torques, times.

    Example: armident import DATA_EMPS.mat --config emps.yaml --out emps.mcap
    """
    from configs import ConfigError, load_robot
    from daq.importing import import_recording
    from daq.recording import write_recording

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
    samples = recording.samples
    print(f"{out}: {samples.sync.size} samples at {recording.sample_rate_hz:g} Hz, {', '.join(samples.fields)}")


def export(
    recording: Annotated[Path, typer.Argument(help="The recording.")],
    out: Annotated[Path, typer.Option("--out", help="File to write: .csv, .npz or .parquet.")],
) -> None:
    """Write a recording for other tools, in SI units at the joints.

    Example: armident export tx40.mcap --out tx40.csv
    """
    from daq.exporting import export_recording
    from daq.recording import read_recording

    read = read_recording(recording)
    if read.missing is not None:
        typer.echo(f"armident: warning: {recording}: {read.missing}", err=True)
    export_recording(read, out)
    print(out)


def demo(
    out: Annotated[Path, typer.Option("--out", help="Directory of recordings, results and the report.")] = Path("demo"),
    keep_going: Annotated[
        bool, typer.Option("--keep-going", help="Leave the virtual cell running at the end.")
    ] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Only the first chapter.")] = False,
) -> None:
    """Show the whole story on this machine without hardware, and write a report.

    A virtual arm on a virtual bus is captured and identified; then one with a hidden effect is diagnosed.

    Example: armident demo --out demo
    """
    from daq.demo import demo as run_demo

    run_demo(out=out, keep_going=keep_going, quick=quick)
