"""Commands of this package: identification, checks, diagnosis, use of models, history, trajectories."""

from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from armident.identify.command_options import with_options
from armident.identify.diagnosis.diagnosis_options import DiagnosisOptions
from armident.identify.excitation.trajectory_options import TrajectoryOptions
from armident.identify.identification.options import Options

Json = Annotated[bool, typer.Option("--json", help="Print only the result document on stdout.")]
OutDirectory = Annotated[
    Path | None, typer.Option("--out", help="Folder for the results. [default: RECORDING without .mcap, plus a suffix]")
]
Robot = Annotated[
    Path | None, typer.Option("--config", help="Robot configuration. [default: the one inside the recording]")
]


@with_options
def identify(
    recording: Annotated[Path, typer.Argument(help="Recording (.mcap), or the URL of one (s3://BUCKET/run.mcap).")],
    options: Options,
    config: Robot = None,
    out: OutDirectory = None,
    json: Json = False,
) -> int:
    """Identify the dynamic model of a robot from a recording, and judge the result.

    Exit code 3 if the verdict is unusable: the reasons stand in the result.

    Example: armident identify tx40.mcap --out results
    """
    from armident.identify.cli.result_commands import identify_command

    return identify_command(recording, config, options, out, as_json=json)


def check(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings (.mcap) of one robot at one sampling rate.")],
    config: Robot = None,
    json: Json = False,
) -> int:
    """Check the set-up in seconds: signs, order of joints, units, gear ratios, gravity, clocks, clipping, standstill.

    Prints what is wrong, how sure that is, and the line of configuration that corrects it. Exit code 0 if the set-up
    is right, 3 if results would be unusable.

    Example: armident check tx40.mcap --config configs/tx40.yaml
    """
    from armident.identify.cli.result_commands import check_command

    return check_command(recordings, config, as_json=json)


def worker(
    config: Annotated[Path, typer.Option("--config", help="Session configuration.")],
    once: Annotated[bool, typer.Option("--once", help="End after one experiment with its exit code.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the results. [default: the session's recording directory]")
    ] = None,
    since: Annotated[datetime | None, typer.Option(help="Pass over files that were changed before.")] = None,
) -> int:
    """Identify every experiment of a cell when its recording ends, and publish the results.

    The newest recording comes first. `armident queue` lists what waits, failed, or was passed over.

    Example: armident worker --config configs/tx40_cell.yaml
    """
    from armident.identify.monitoring.worker.worker import run_worker

    return run_worker(config, once=once, out=out, since=since)


def queue(
    action: Annotated[str, typer.Argument(help="list, retry or ignore.")],
    names: Annotated[
        list[str] | None, typer.Argument(help="Recordings without .mcap, or patterns such as 'tx40-2025*'.")
    ] = None,
    config: Annotated[Path | None, typer.Option("--config", help="Session of the worker.")] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder of its results, instead of --config.")] = None,
    json: Json = False,
) -> None:
    """List the recordings of a worker with their states, try those again that have no result, or leave them out.

    States: waiting, done, failed, passed (over, with the reason), ignored. A running worker takes changes over.

    Example: armident queue retry tx40-20261101T101500-000Z --config cell.yaml
    """
    from armident.identify.monitoring.worker.queue_command import queue_command

    queue_command(action, names or [], config, out, as_json=json)


def verify(
    files: Annotated[list[Path], typer.Argument(help="Result documents (.json).")],
    keys: Annotated[
        Path | None, typer.Option("--keys", help="Folder with authority.pem. [default: keys of the plant]")
    ] = None,
    json: Json = False,
) -> int:
    """Check who signed result documents, in which role and when, and that nobody has changed them since.

    Exit code 1 if a document is not signed, was changed, or its signer is not of this plant.

    Example: armident verify recordings/*.identification/identification.json
    """
    from armident.identify.documents.signing import verify_command

    return verify_command(files, keys, as_json=json)


@with_options
def diagnose(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings to fit.")],
    options: DiagnosisOptions,
    config: Robot = None,
    validate: Annotated[
        Path | None, typer.Option(help="Held-out recording. [default: the last part of the data]")
    ] = None,
    baseline: Annotated[
        Path | None, typer.Option(help="identification.json whose parameters are tested for change.")
    ] = None,
    out: OutDirectory = None,
    json: Json = False,
) -> int:
    """Find the effects that a model lacks, their size and confidence, and the residual that stays unexplained.

    Exit code 4 if there are findings or an unexplained residual. `armident effects` lists the candidates.

    Example: armident diagnose monday.mcap --validate tuesday.mcap
    """
    from armident.identify.cli.result_commands import diagnose_command

    return diagnose_command(recordings, config, validate, baseline, options, out, as_json=json)


def predict(
    recordings: Annotated[
        list[Path], typer.Argument(help="Recordings (.mcap), best ones that the model has not seen.")
    ],
    model: Annotated[Path, typer.Option("--model", help="identification.json, diagnosis.json, or the folder of one.")],
    config: Annotated[
        Path | None, typer.Option("--config", help="Robot configuration. [default: that of the model]")
    ] = None,
    out: OutDirectory = None,
    json: Json = False,
) -> int:
    """Predict the torques of recordings with an identified model, and report its error in total and by joint.

    Says if a recording is held out, or one that the model was identified from. Writes prediction.json, torques.csv and
    report.html. Of several recordings, a table shows the worst. Exit code 4 if the model explains the torques of one no
    better than none.

    Example: armident predict tuesday.mcap --model monday.identification
    """
    from armident.identify.cli.result_commands import predict_command

    return predict_command(recordings, model, config, out, as_json=json)


def compare(
    baseline: Annotated[Path, typer.Argument(help="The earlier identification.json, or its folder.")],
    now: Annotated[Path, typer.Argument(help="The later identification.json, or its folder.")],
    common: Annotated[
        bool, typer.Option("--common", help="Compare the parameters that both have, if their models differ.")
    ] = False,
    false_alarms: Annotated[
        float, typer.Option(min=1e-12, max=0.5, help="Probability of the verdict changed without a change.")
    ] = 1e-4,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the results. [default: comparison, beside the later one]")
    ] = None,
    json: Json = False,
) -> int:
    """Compare two identified models of a robot joint by joint, with intervals, and test for a change.

    Writes comparison.json and report.html with a plot. Exit code 4 if they differ significantly, 3 if they cannot be
    compared.

    Example: armident compare monday.identification tuesday.identification
    """
    from armident.identify.cli.result_commands import compare_command

    return compare_command(baseline, now, out, false_alarms, common=common, as_json=json)


def effects(
    name: Annotated[str | None, typer.Argument(help="One effect. [default: all]")] = None,
    json: Json = False,
) -> None:
    """List the effects that a model can have and a diagnosis looks for, with their parameters.

    Example: armident effects stribeck_friction
    """
    from armident.identify.effects.listing import effects_command

    effects_command(name, as_json=json)


def history(
    documents: Annotated[
        list[Path] | None,
        typer.Argument(help="identification.json files to add, or backup FILE, or restore FILE. [default: list]"),
    ] = None,
    database: Annotated[
        str, typer.Option(help="SQLAlchemy URL.", envvar="ARMIDENT_HISTORY")
    ] = "sqlite:///history.sqlite",
    robot: Annotated[str | None, typer.Option(help="Robot. [default: that of the results, or the only one]")] = None,
    cell: Annotated[
        str | None, typer.Option(help="Cell of the robot. [default: that of the results, or the only one]")
    ] = None,
    parameter: Annotated[list[str] | None, typer.Option(help="Parameter to show; can be repeated.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Plot parameters over time (.png, .svg, .pdf).")] = None,
    false_alarms: Annotated[
        float, typer.Option(min=1e-12, max=0.5, help="Probability of a false alarm per run.")
    ] = 1e-4,
    json: Json = False,
) -> int:
    """Keep results in a database, list them, and test for a change of the arm since the first one.

    Exit code 4 if the last run differs significantly from the first, in one parameter or in all together. backup FILE
    writes a copy of the whole database to a file (SQLite); restore FILE adds what a database lacks of such a copy.

    Example: armident history recordings/*.identification/identification.json --plot history.png
    """
    from armident.identify.monitoring.change.history_cli import history_command

    return history_command(documents or [], database, robot, cell, parameter or [], plot, false_alarms, as_json=json)


_Sessions = Annotated[
    list[Path] | None,
    typer.Option(
        "--config", help="Session of a cell, or a folder of sessions; can be repeated. [default: /etc/armident]"
    ),
]
_Results = Annotated[
    Path | None,
    typer.Option(
        "--out",
        help="Folder with the results of each session in a folder of its name, as services have them. "
        "[default: recording.directory of each session]",
    ),
]
_HistoryOfAll = Annotated[
    str | None,
    typer.Option(
        help="SQLAlchemy URL of the history of all cells. [default: history.sqlite beside the results of each]",
        envvar="ARMIDENT_HISTORY",
    ),
]
_Listen = Annotated[str, typer.Option(help="Address and port.")]
_Keys = Annotated[Path | None, typer.Option(help="Folder of the plant's keys: needed if other machines may connect.")]


def page(
    config: _Sessions = None,
    out: _Results = None,
    database: _HistoryOfAll = None,
    listen: _Listen = "127.0.0.1:8484",
    keys: _Keys = None,
) -> None:
    """Show the cells of a plant as a web page: captures, results, changes, and what to do. It changes nothing.

    Sessions are read at the start; all else is read again every few seconds.

    Example: armident page --config configs/emps_cell.yaml
    """
    from armident.extras import require

    require("armident page", "identify", "page")
    from armident.identify.page.serve import run_page

    run_page(config or [Path("/etc/armident")], out, database, listen, keys)


def opcua(
    config: _Sessions = None,
    out: _Results = None,
    database: _HistoryOfAll = None,
    listen: _Listen = "127.0.0.1:4840",
    keys: _Keys = None,
) -> None:
    """Serve the health of each axis over OPC UA: verdict, effect, size and drift, with an alarm. It changes nothing.

    Sessions are read at the start; results are read again every few seconds.

    Example: armident opcua --config configs/emps_cell.yaml
    """
    from armident.extras import require

    require("armident opcua", "identify", "opcua")
    from armident.identify.opcua.serve import run_opcua

    run_opcua(config or [Path("/etc/armident")], out, database, listen, keys)


@with_options
def trajectory(
    options: TrajectoryOptions,
    report: Annotated[Path | None, typer.Option(help="Report (.html). [default: beside the trajectory]")] = None,
) -> None:
    """Design an exciting trajectory inside the limits of a robot, for the base parameters or for one effect.

    Keeps the bodies of collision in the robot configuration apart. Plots positions, velocities, accelerations and
    torques against their limits, prints the predicted standard deviation of every base parameter, and lists what was
    checked and what was not.

    Example: armident trajectory --config configs/tx40.yaml --out excitation.yaml --known identification.json
    """
    from armident.identify.documents.files import write_atomically
    from armident.identify.excitation.trajectory_command import trajectory_command
    from armident.identify.report.trajectory_report import trajectory_report

    found = trajectory_command(options)
    page = report or (found.path or Path(f"{found.robot.name}_trajectory")).with_suffix(".html")
    write_atomically(page, trajectory_report(found))
    print(f"report: {page}")
    found.refuse_excess()
