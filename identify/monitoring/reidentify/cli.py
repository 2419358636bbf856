"""Command ``armident reidentify``."""

from typing import Annotated

import typer

from armident.identify.command_options import with_options
from armident.identify.monitoring.reidentify.reidentify_options import ReidentifyOptions


@with_options
def reidentify(
    options: ReidentifyOptions,
    json: Annotated[bool, typer.Option("--json", help="Print only the result document on stdout.")] = False,
) -> int:
    """Move an arm along its exciting trajectory, identify it, and test for a change since its baseline.

    Plays the set points of the session within the limits of the robot, with a guard that stops the drives. Records,
    identifies, compares, stores the result in the history and publishes it. The first run becomes the baseline unless
    one is given. If the arm has changed, the exit code is 4 and a diagnosis follows. Timers: see configs/systemd.

    Example: armident reidentify --config cell.yaml --store sqlite:///history.sqlite
    """
    if options.recordings is None:
        from armident.identify.monitoring.reidentify.run import reidentify_command

        return reidentify_command(options, as_json=json)
    from armident.identify.monitoring.reidentify.fleet import fleet_command

    return fleet_command(options.recordings, options, as_json=json)
