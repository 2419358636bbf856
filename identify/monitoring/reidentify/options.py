"""Options of ``armident reidentify``."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ReidentifyOptions:
    """The options of the command, as given.

    Parameters
    ----------
    config
        Session configuration; with recordings a robot configuration, if any.
    baseline
        Identification to compare with, if not the first run in the store.
    store
        SQLAlchemy URL of the history.
    out
        Folder of recordings and results, if not the usual one.
    false_alarms
        Chance of calling an unchanged arm changed, per run.
    scheduler, workers
        Address of a Dask scheduler, or number of processes on this machine, for recordings.
    """

    config: Path | None
    baseline: Path | None
    store: str
    out: Path | None
    false_alarms: float
    scheduler: str | None = None
    workers: int | None = None
