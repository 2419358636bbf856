"""Command ``python -m tests.reproduction``: compute the chosen tables and check the claims."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from armident.configs import ConfigError
from armident.identify.cli.progress import Report, progress
from armident.identify.documents.files import write_atomically
from tests.reproduction import chapter4, chapter5, chapter6
from tests.reproduction.cached_estimates import Laboratory
from tests.reproduction.claims import Claim, judged
from tests.reproduction.context import SIMULATIONS, SIMULATIONS_QUICK, Bench, TableFunction
from tests.reproduction.recordings import EMPS_SESSION, measured_emps, measured_recording, virtual_recording
from tests.reproduction.render import document, markdown
from tests.reproduction.tables import Table

TABLES: dict[str, TableFunction] = {**chapter4.TABLES, **chapter5.TABLES, **chapter6.TABLES}
SLOW = ("4.1", "4.2", "4.3")
"""Tables skipped by ``--quick``: output errors without decimation, hundreds of simulations at 5 kHz."""


def reproduce(
    tables: Annotated[str | None, typer.Option(help="Table numbers, for example 5.2,6.7. [default: all]")] = None,
    measured: Annotated[Path | None, typer.Option(help="Folder of the measured data of TX40 and EMPS.")] = None,
    out: Annotated[Path, typer.Option("--out", help="Folder for the results and recordings.")] = Path("reproduction"),
    quick: Annotated[bool, typer.Option("--quick", help="Skip tables 4.1 to 4.3 and run fewer simulations.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print only the result document on stdout.")] = False,
) -> None:
    """Compute the tables of the thesis beside the published values, and check its claims.

    Example: python -m tests.reproduction --tables 5.2,6.7
    """
    numbers = chosen_tables(tables, quick=quick)
    bench = make_bench(out, measured, quick=quick)
    with progress("reproduce") as report:
        found, claims = computed(bench, numbers, report)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be created: {error.strerror}") from error
    text = document(found, claims, quick=quick)
    write_atomically(out / "reproduce.json", text)
    page = markdown(found, claims)
    write_atomically(out / "reproduce.md", page)
    if json:
        sys.stdout.write(text)
        return
    print(f"{page}\nresult: {out / 'reproduce.json'}\nreport: {out / 'reproduce.md'}")


def chosen_tables(tables: str | None, *, quick: bool) -> list[str]:
    """Return the chosen table numbers in the order of the thesis.

    ``tables``: numbers separated by commas; ``None``: all. ``quick``: without the slow tables, if all are chosen.
    Raises ConfigError if there is no such table.
    """
    if tables is None:
        return [number for number in TABLES if not (quick and number in SLOW)]
    asked = [number.strip() for number in tables.split(",") if number.strip()]
    unknown = [number for number in asked if number not in TABLES]
    if unknown or not asked:
        raise ConfigError(f"--tables: no table {', '.join(unknown) or 'named'}; there are {', '.join(TABLES)}")
    return [number for number in TABLES if number in asked]


def make_bench(folder: Path, measured: Path | None = None, *, quick: bool = False) -> Bench:
    """Return the arms of the tables; recordings are made when they are needed, measured files are read at once.

    ``folder``: folder of the virtual recordings; ``measured``: folder of measured data, or ``None``; ``quick``: fewer
    simulations.
    """
    real = None
    if measured is not None:
        recorded = measured_recording(measured)
        real = Laboratory(lambda: recorded)
    return Bench(
        virtual=Laboratory(lambda: virtual_recording(folder / "recordings")),
        feedback=Laboratory(lambda: virtual_recording(folder / "recordings", velocity_feedback=True)),
        measured=real,
        emps=None if measured is None else measured_emps(measured),
        simulations=SIMULATIONS_QUICK if quick else SIMULATIONS,
        axis=Laboratory(lambda: virtual_recording(folder / "recordings", velocity_feedback=True, session=EMPS_SESSION)),
    )


def computed(
    bench: Bench, numbers: list[str], report: Report = lambda stage, share: None
) -> tuple[list[Table], list[Claim]]:
    """Return the tables of the given numbers, and the claims that depend only on them.

    ``bench``: arms with their cached estimates; ``report``: called with a stage and the share done.
    """
    found = []
    for k, number in enumerate(numbers):
        report(f"table {number}", k / len(numbers))
        found.append(TABLES[number](bench))
    report("claims", 1.0)
    return found, judged(bench, numbers)
