"""Options of ``armident reidentify``."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ReidentifyOptions:
    """Options of the command, as given.

    Parameters
    ----------
    config
        Session configuration; with recordings an optional robot configuration.
    baseline
        Identification to compare with; ``None``: the first run in the history.
    store
        SQLAlchemy URL of the history.
    out
        Folder of recordings and results; ``None``: that of the session or recording.
    false_alarms
        Probability of a false alarm per run.
    scheduler, workers
        Address of a Dask scheduler, or number of processes on this machine, for recordings.
    material
        Least change of a joint's torque by a finding of the diagnosis, percent; ``None``: its default.
    time_limit_s
        Time after which the diagnosis ends its search, s; ``None``: none.
    """

    config: Path | None
    baseline: Path | None
    store: str
    out: Path | None
    false_alarms: float
    scheduler: str | None = None
    workers: int | None = None
    material: float | None = None
    time_limit_s: float | None = None
