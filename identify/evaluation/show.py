"""What the suite shows on a terminal."""

import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from armident.identify.evaluation.cases import Case
from armident.identify.evaluation.store import Record
from armident.identify.evaluation.tables import AIM_COLUMNS, COLUMNS, HEALTHY_COLUMNS, OUTSIDE_COLUMNS, Tables
from armident.identify.evaluation.workers import Done

PLAIN_EVERY_S = 30.0
"""Between two lines of progress where stderr is no terminal."""
LEAST_WIDTH = 120
"""Columns of text that the widest table needs."""


@contextmanager
def progress(total: int) -> Iterator[Done]:
    """Count cases: a bar where stderr is a terminal, otherwise a plain line now and then; failures at once."""
    lock, begin = threading.Lock(), time.monotonic()
    finished, said = 0, begin
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
        task = bar.add_task("diagnose-suite", total=total)
        bar.start()

    def done(case: Case, record: Record) -> None:
        nonlocal finished, said
        with lock:
            finished += 1
            if "error" in record:
                print(f"diagnose-suite: failed: {case.name}: {record['error']}", file=sys.stderr, flush=True)
            now = time.monotonic()
            if bar is not None:
                bar.update(task, advance=1, description=case.name[:60])
            elif now - said >= PLAIN_EVERY_S or finished == total:
                said = now
                left = (now - begin) / finished * (total - finished)
                print(
                    f"diagnose-suite: {finished} of {total}, {now - begin:.0f} s, about {left:.0f} s left",
                    file=sys.stderr,
                    flush=True,
                )

    try:
        yield done
    finally:
        if bar is not None:
            bar.stop()


def show(result: Tables, run: int, total: int) -> None:
    """Print the tables, and of how many cases they are."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=LEAST_WIDTH)
    for title, columns, rows in (
        ("hidden effects", COLUMNS, result.effects),
        ("pairs of effects", COLUMNS, result.pairs),
        ("nothing hidden", HEALTHY_COLUMNS, result.healthy),
        ("effects without a name", OUTSIDE_COLUMNS, result.outside),
        ("aims", AIM_COLUMNS, result.aims),
    ):
        if rows:
            console.print(_table(title, columns, rows))
    console.print(f"{run} of {total} cases have been run", highlight=False)
    if run < total:
        console.print("they are a sample of all kinds; the same command goes on with the others", highlight=False)


def _table(title: str, columns: Sequence[tuple[str, Callable[[Any], str]]], rows: Sequence[Any]) -> Table:
    table = Table(title=title, title_justify="left")
    for k, (heading, _) in enumerate(columns):
        left = not k or heading in ("strength", "most often")
        table.add_column(heading, justify="left" if left else "right", no_wrap=left)
    for row in rows:
        table.add_row(*(value(row) for _, value in columns))
    return table
