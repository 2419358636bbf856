"""Command ``armident reidentify``."""

from pathlib import Path
from typing import Annotated

import typer

from armident.identify.monitoring.reidentify.options import ReidentifyOptions


def reidentify(
    config: Annotated[
        Path | None,
        typer.Option("--config", help="Session configuration; with --recordings an optional robot configuration."),
    ] = None,
    baseline: Annotated[
        Path | None,
        typer.Option(help="identification.json to compare with. [default: the first run of this robot in the store]"),
    ] = None,
    store: Annotated[
        str, typer.Option(help="SQLAlchemy URL of the history.", envvar="ARMIDENT_HISTORY")
    ] = "sqlite:///history.sqlite",
    out: Annotated[
        Path | None, typer.Option(help="Folder of recordings and results. [default: that of the session or recording]")
    ] = None,
    false_alarms: Annotated[
        float, typer.Option(min=1e-12, max=0.5, help="Probability of a false alarm per run.")
    ] = 1e-4,
    recordings: Annotated[
        str | None, typer.Option(help="Identify these recordings (a quoted pattern) instead of moving an arm.")
    ] = None,
    scheduler: Annotated[str | None, typer.Option(help="Dask scheduler for --recordings, as tcp://HOST:8786.")] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="With --recordings and no scheduler: number of local processes.")
    ] = None,
    material: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=100.0,
            metavar="PCT",
            help="Least change of a joint's torque by a finding of the diagnosis, percent. [default: that of diagnose]",
        ),
    ] = None,
    time_limit: Annotated[
        float | None,
        typer.Option(min=0.0, metavar="S", help="End the search of the diagnosis after this time, s."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print only the result document on stdout.")] = False,
) -> None:
    """Move an arm along its exciting trajectory, identify it, and test for a change since its baseline.

    Plays the set points of the session within the limits of the robot, with a guard that stops the drives. Records,
    identifies, compares, stores the result in the history and publishes it. The first run becomes the baseline unless
    one is given. If the arm has changed, the exit code is 4 and a diagnosis follows. Timers: see configs/systemd.

    Example: armident reidentify --config cell.yaml --store sqlite:///history.sqlite
    """
    asked = ReidentifyOptions(config, baseline, store, out, false_alarms, scheduler, workers, material, time_limit)
    if recordings is None:
        from armident.identify.monitoring.reidentify.run import reidentify_command

        code = reidentify_command(asked, as_json=json)
    else:
        from armident.identify.monitoring.reidentify.fleet import fleet_command

        code = fleet_command(recordings, asked, as_json=json)
    if code:
        raise typer.Exit(code)
