"""The command ``armident reidentify``."""

from pathlib import Path
from typing import Annotated

import typer

from armident.identify.monitoring.reidentify.options import ReidentifyOptions


def reidentify(
    config: Annotated[
        Path | None,
        typer.Option("--config", help="Session configuration; with --recordings a robot configuration, if any."),
    ] = None,
    baseline: Annotated[
        Path | None,
        typer.Option(help="identification.json to compare with. [default: the first run of this robot in the store]"),
    ] = None,
    store: Annotated[
        str, typer.Option(help="SQLAlchemy URL of the history.", envvar="ARMIDENT_HISTORY")
    ] = "sqlite:///history.sqlite",
    out: Annotated[
        Path | None, typer.Option(help="Folder of recordings and results. [default: the session's, or RECORDING's]")
    ] = None,
    false_alarms: Annotated[
        float, typer.Option(min=1e-12, max=0.5, help="Chance of calling an unchanged arm changed, per run.")
    ] = 1e-4,
    recordings: Annotated[
        str | None, typer.Option(help="Identify these recordings (a pattern, in quotes) instead of moving an arm.")
    ] = None,
    scheduler: Annotated[str | None, typer.Option(help="Dask scheduler for --recordings, as tcp://HOST:8786.")] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="With --recordings and no scheduler: so many processes on this machine.")
    ] = None,
    json: Annotated[
        bool, typer.Option("--json", help="Print the result document on stdout, and nothing else there.")
    ] = False,
) -> None:
    """Move an arm along its exciting trajectory, identify it, and say whether it has changed since its baseline.

    Plays the set points of the session under the limits of the robot, with a guard that stops the drives, records,
    identifies, compares, keeps the result in the history and publishes it. Without a baseline the first run becomes
    it. Where the arm has changed the exit code is 4, and a diagnosis says what. For a timer: see configs/systemd.

    Example: armident reidentify --config cell.yaml --store sqlite:///history.sqlite
    """
    asked = ReidentifyOptions(config, baseline, store, out, false_alarms, scheduler, workers)
    if recordings is None:
        from armident.identify.monitoring.reidentify.run import reidentify_command

        code = reidentify_command(asked, as_json=json)
    else:
        from armident.identify.monitoring.reidentify.fleet import fleet_command

        code = fleet_command(recordings, asked, as_json=json)
    if code:
        raise typer.Exit(code)
