"""The command ``armident guard``."""

from typing import Annotated

import typer


def guard(
    config: Annotated[str, typer.Option("--config", help="Session configuration.")] = "tx40_cell.yaml",
    following_s: Annotated[
        float,
        typer.Option(
            "--following", min=0.001, help="Following error allowed: seconds of motion at the velocity limit."
        ),
    ] = 0.1,
) -> None:
    """Watch a moving arm on its bus, and stop its drives within one cycle when something is wrong.

    A quick stop (CiA 402) is ordered when a joint leaves its limits of position, velocity or torque, or lags too far
    behind its set points; on EMCY, a lost heartbeat, a drive that leaves operational, SYNC that fails in the middle of
    the motion, and on Ctrl-C or SIGTERM. `armident reidentify` runs one beside every capture.

    Example: armident guard --config tx40_cell.yaml
    """
    from armident.daq.guard.run import guard as run

    run(config, following_s)
