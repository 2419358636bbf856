"""Progress and tables of the suite on a terminal."""

import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from armident.identify.cli.print_table import print_table
from tests.evaluation.cases import Case
from tests.evaluation.store import CaseResult
from tests.evaluation.tables import AIM_COLUMNS, COLUMNS, HEALTHY_COLUMNS, OUTSIDE_COLUMNS, Tables
from tests.evaluation.workers import OnResult

PLAIN_EVERY_S = 30.0
"""Time between two lines of progress if stderr is not a terminal, s."""
LEAST_WIDTH = 120
"""Width of the widest table, characters."""


@contextmanager
def progress(total: int) -> Iterator[OnResult]:
    """Show progress on stderr: a bar on a terminal, otherwise a line every 30 s; failures at once.

    ``total``: number of cases.
    """
    lock, begin = threading.Lock(), time.monotonic()
    finished, shown = 0, begin
    bar = None
    if sys.stderr.isatty():
        bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
        )
        task = bar.add_task("suite", total=total)
        bar.start()

    def on_result(case: Case, result: CaseResult) -> None:
        nonlocal finished, shown
        with lock:
            finished += 1
            if result.error is not None:
                print(f"suite: failed: {case.name}: {result.error}", file=sys.stderr, flush=True)
            now = time.monotonic()
            if bar is not None:
                bar.update(task, advance=1, description=case.name[:60])
            elif now - shown >= PLAIN_EVERY_S or finished == total:
                shown = now
                left = (now - begin) / finished * (total - finished)
                print(
                    f"suite: {finished} of {total}, {now - begin:.0f} s, about {left:.0f} s left",
                    file=sys.stderr,
                    flush=True,
                )

    try:
        yield on_result
    finally:
        if bar is not None:
            bar.stop()


def show(result: Tables, run: int, total: int) -> None:
    """Print the tables and the number of cases in them.

    ``run``: number of cases with a result or an error; ``total``: number of selected cases.
    """
    console = Console()
    if not console.is_terminal:
        console = Console(width=LEAST_WIDTH)
    for title, columns, rows in (
        ("simulated effects", COLUMNS, result.effects),
        ("pairs of effects", COLUMNS, result.pairs),
        ("healthy arms", HEALTHY_COLUMNS, result.healthy),
        ("effects outside the catalogue", OUTSIDE_COLUMNS, result.outside),
        ("targets", AIM_COLUMNS, result.aims),
    ):
        if rows:
            print_table(_table(title, columns, rows), console)
    console.print(f"{run} of {total} cases have been run", highlight=False)
    if run < total:
        console.print("they are a sample of all kinds; the same command runs the others", highlight=False)


def _table(title: str, columns: Sequence[tuple[str, Callable[[Any], str]]], rows: Sequence[Any]) -> Table:
    table = Table(title=title, title_justify="left")
    for k, (heading, _) in enumerate(columns):
        left = not k or heading in ("strength", "most frequent finding")
        table.add_column(heading, justify="left" if left else "right", no_wrap=left)
    for row in rows:
        table.add_row(*(value(row) for _, value in columns))
    return table
