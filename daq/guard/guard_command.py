"""The command ``armident guard``."""

from typing import Annotated

import typer


def guard(
    config: Annotated[str, typer.Option("--config", help="Session configuration.")] = "tx40_cell.yaml",
    following_s: Annotated[
        float,
        typer.Option(
            "--following", min=0.001, help="Largest following error, in seconds of motion at the velocity limit."
        ),
    ] = 0.1,
) -> None:
    """Monitor a moving arm on its bus, and stop its drives within one cycle when a limit is violated.

    The guard commands a quick stop (CiA 402) when a joint exceeds its limits of position, velocity, torque or following
    error. It does so on EMCY, a lost heartbeat, a drive that leaves the state operational, missing SYNC during the
    motion, Ctrl-C and SIGTERM. `armident reidentify` runs a guard beside every capture.

    Example: armident guard --config tx40_cell.yaml
    """
    from armident.daq.guard.guard_loop import guard as run

    run(config, following_s)
