"""Command ``armident reproduce``: compute the chosen tables and check the claims."""

import sys
from pathlib import Path

from armident.configs import ConfigError
from armident.identify.cli_tables import Report, progress
from armident.identify.documents.files import write_atomically
from armident.identify.thesis import chapter4, chapter5, chapter6
from armident.identify.thesis.cached_estimates import Laboratory
from armident.identify.thesis.claims import Claim, judged
from armident.identify.thesis.context import SIMULATIONS, SIMULATIONS_QUICK, Bench, TableFunction
from armident.identify.thesis.recordings import EMPS_SESSION, measured_emps, measured_recording, virtual_recording
from armident.identify.thesis.render import document, markdown, print_tables
from armident.identify.thesis.tables import Table

TABLES: dict[str, TableFunction] = {**chapter4.TABLES, **chapter5.TABLES, **chapter6.TABLES}
SLOW = ("4.1", "4.2", "4.3")
"""Tables skipped by ``--quick``: output errors without decimation, hundreds of simulations at 5 kHz."""
FOLDER = Path("reproduction")
"""Default folder of the results."""


def reproduce_command(
    tables: str | None = None,
    measured: Path | None = None,
    out: Path | None = None,
    quick: bool = False,
    as_json: bool = False,
) -> None:
    """Carry out ``armident reproduce``.

    Raises ConfigError if there is no such table, or the folder cannot be written; DataError if the measured recording
    cannot be used.

    Parameters
    ----------
    tables
        Table numbers separated by commas; ``None``: all, with ``quick`` all but the slow ones.
    measured
        Folder of measured data: the TX40 for additional columns, and the EMPS for claim 5; see ``measured_recording``
        and ``measured_emps``.
    out
        Folder for ``reproduce.json``, ``reproduce.md`` and the recordings; ``None``: ``reproduction``.
    quick
        Fewer simulations, without the slow tables.
    as_json
        Print only the JSON document.
    """
    numbers = chosen_tables(tables, quick=quick)
    folder = out or FOLDER
    bench = make_bench(folder, measured, quick=quick)
    with progress("reproduce") as report:
        found, claims = reproduce(bench, numbers, report)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be created: {error.strerror}") from error
    text = document(found, claims, quick=quick)
    write_atomically(folder / "reproduce.json", text)
    write_atomically(folder / "reproduce.md", markdown(found, claims))
    if as_json:
        sys.stdout.write(text)
        return
    print_tables(found, claims)
    print(f"result: {folder / 'reproduce.json'}\nreport: {folder / 'reproduce.md'}")


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


def reproduce(
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
