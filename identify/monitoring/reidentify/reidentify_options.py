"""Options of ``armident reidentify``."""

from dataclasses import dataclass, fields
from pathlib import Path

from armident.identify.command_options import option
from armident.identify.diagnosis.diagnosis_options import DiagnosisOptions

_DIAGNOSIS = {one.name: one.metadata for one in fields(DiagnosisOptions)}


@dataclass(frozen=True)
class ReidentifyOptions:
    """Options of the command."""

    config: Path | None = option("Session configuration; with --recordings an optional robot configuration.", None)
    baseline: Path | None = option(
        "identification.json to compare with. [default: the first run of this robot in the store]", None
    )
    store: str = option("SQLAlchemy URL of the history.", "sqlite:///history.sqlite", envvar="ARMIDENT_HISTORY")
    out: Path | None = option("Folder of recordings and results. [default: that of the session or recording]", None)
    false_alarms: float = option("Probability of a false alarm per run.", 1e-4, min=1e-12, max=0.5)
    recordings: str | None = option(
        "Identify these recordings instead of moving an arm: a quoted pattern of files, or of objects as s3://B/*.mcap.",
        None,
    )
    scheduler: str | None = option("Dask scheduler for --recordings, as tcp://HOST:8786.", None)
    workers: int | None = option("With --recordings and no scheduler: number of local processes.", None, min=1)
    results: Path | None = option("With --recordings: folder of a table of the results (Parquet).", None)
    material: float | None = option(
        "Least change of a joint's torque by a finding of the diagnosis, percent. [default: that of diagnose]",
        None,
        **_DIAGNOSIS["material"]["typer"],
    )
    time_limit_s: float | None = option(
        "End the search of the diagnosis after this time, s.",
        None,
        flag=_DIAGNOSIS["time_limit_s"]["flag"],
        **_DIAGNOSIS["time_limit_s"]["typer"],
    )
    metrics: Path | None = option(
        "File of metrics (NAME.prom) for the textfile collector of Prometheus' node_exporter.", None
    )
    investigate: bool = option(
        "If the arm has changed, move it along further motions that tell what has changed, without asking.", False
    )
    experiments: int = option("With --investigate: most motions.", 3, min=1)
    minutes: float = option("With --investigate: longest motion of all together, min.", 3.0, min=0.01)
