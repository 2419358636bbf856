"""Command ``armident watch``."""

from pathlib import Path
from typing import Annotated

import typer


def watch(
    recordings: Annotated[
        list[Path] | None, typer.Argument(help="Recordings to replay, in the order of time. [default: the live stream]")
    ] = None,
    reference: Annotated[Path, typer.Option("--reference", help="identification.json of the healthy arm.")] = Path(
        "identification.json"
    ),
    config: Annotated[
        Path | None,
        typer.Option("--config", help="Session configuration of the cell; with recordings: a robot configuration."),
    ] = None,
    state: Annotated[
        Path | None, typer.Option("--state", help="File in which the state is kept, to continue from it later.")
    ] = None,
    duration: Annotated[
        float | None, typer.Option(min=0.0, help="Duration of a live watch, s. [default: until Ctrl-C]")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON document per line, every second.")] = False,
) -> int:
    """Track the friction of every joint while the arm runs, and report a change within a minute.

    Shows excitation, friction and state by joint, live or in replay, and publishes them. Exit code 4 after an alarm.

    Example: armident watch --config tx40_cell.yaml --reference healthy.identification/identification.json

    Replay: armident watch today.mcap --reference healthy.identification/identification.json --json
    """
    from armident.configs import ConfigError
    from armident.identify.monitoring.recursive.watch import WatchOptions, watch_cell, watch_recordings

    options = WatchOptions(reference, state, json, duration)
    if recordings:
        if duration is not None:
            raise ConfigError("--duration: a replay ends with its recordings")
        return watch_recordings(recordings, config, options)
    return watch_cell(config, options)
