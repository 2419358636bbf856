"""Report of a suite as Markdown: aims, tables, and every case with a shortcoming; progress on stderr."""

import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from typing import Any

import numpy as np

from tests.evaluation.cases import Case, revealed
from tests.evaluation.store import CaseResult
from tests.evaluation.tables import (
    AIM_COLUMNS,
    AIMED_AT,
    CLOSED,
    COLUMNS,
    HEALTHY_COLUMNS,
    OUTSIDE_COLUMNS,
    Aim,
    Columns,
    Scored,
    Tables,
    calm,
    fate,
)
from tests.tools.markdown import table

EVERY_S = 30.0
"""Time between two lines of progress, s."""


def _share_closed(scored: Scored) -> float:
    """Closed share of the injected gap; 1 without a gap."""
    closed = scored[1].closed
    return 1.0 if closed is None else closed


SHORTFALLS: tuple[tuple[str, Callable[[Scored], bool]], ...] = (
    ("false alarm", lambda s: not s[0].parts and not calm(*s)),
    ("named although outside the catalogue", lambda s: s[0].kind == "outside" and fate(s[1]) == "named"),
    ("not detected", lambda s: s[0].kind == "outside" and not s[0].random and fate(s[1]) == "unseen"),
    ("below the detection limit", lambda s: s[1].invisible),
    ("not named", lambda s: s[1].second is False and not s[1].invisible),
    ("second choice", lambda s: s[1].first is False and s[1].second is True),
    (f"closed by less than {CLOSED:.0%}", lambda s: s[1].first is True and _share_closed(s) < CLOSED),
    ("a parameter off by over 3 sigma", lambda s: not all(s[1].within)),
    ("error not reduced", lambda s: s[1].worse),
)
"""Shortcomings of a case, with the condition of each."""
SHORTFALL_COLUMNS: Columns = (("case", itemgetter(0)), ("shortcomings", itemgetter(1)), ("diagnosis", itemgetter(2)))


def report(
    title: str,
    result: Tables,
    scored: Sequence[Scored],
    failed: Sequence[tuple[Case, str]],
    total: int,
    results: Sequence[CaseResult],
    versions: Mapping[str, int],
    *,
    names: bool,
) -> str:
    """Return the report of a run of ``total`` selected cases as one Markdown document.

    ``failed`` are cases with their errors, ``results`` those of the scored cases. Without ``names``, no case is named.
    """
    run, worse = len(scored) + len(failed), sum(s.worse for _, s in scored)
    times = [r.seconds["diagnose"] for r in results] or [0.0]
    hours = sum(sum(r.seconds.values()) for r in results) / 3600.0
    code = ", ".join(f"{version} ({count} cases)" for version, count in versions.items())
    head = (
        f"{run} of {total} cases, {len(failed)} failed, {hours:.1f} core-hours, code {code}. In {worse} the findings "
        f"do not reduce the reported error. Diagnosis: median {np.median(times):.1f} s, 95 % "
        f"{np.percentile(times, 95.0):.1f} s, longest {max(times):.1f} s. Aims are of healthy arms and of effects that "
        f"are {', '.join(AIMED_AT[:-1])} or {AIMED_AT[-1]}."
    )
    if run < total:
        head += " The cases are a sample of all kinds; the same command runs the others."
    parts = [f"# {title}", head]
    lacking = [*shortfalls(scored), *((c.name, "failed", error) for c, error in failed)] if names else []
    tables: tuple[tuple[str, Columns, Sequence[Any]], ...] = (
        ("Aims", AIM_COLUMNS, result.aims),
        ("Simulated effects", COLUMNS, result.effects),
        ("Pairs of effects", COLUMNS, result.pairs),
        ("Mistakes of the set-up", COLUMNS, result.setup),
        ("Healthy arms", HEALTHY_COLUMNS, result.healthy),
        ("Effects outside the catalogue", OUTSIDE_COLUMNS, result.outside),
        ("Cases with shortcomings", SHORTFALL_COLUMNS, lacking),
    )
    for heading, columns, rows in tables:
        if rows:
            parts += [f"## {heading}", _table(columns, rows)]
    return "\n\n".join(parts) + "\n"


def shortfalls(scored: Sequence[Scored]) -> list[tuple[str, str, str]]:
    """Name, shortcomings and short form of the diagnosis of cases, of healthy arms and of the levels with aims."""
    found = []
    for case, score in scored:
        lacks = [name for name, holds in SHORTFALLS if holds((case, score))]
        if lacks and (case.level in AIMED_AT or not case.parts):
            closed = "" if score.closed is None else f", {score.closed:.0%} closed"
            names = "; ".join(score.named if case.random else score.named[:1])
            diagnosis = score.verdict.replace("_", " ") + (f": {names}" if names else "") + closed
            found.append((case.name, "; ".join(lacks), diagnosis))
    return sorted(found, key=lambda row: row[0])


def results_row(aims: Sequence[Aim], suite: str, run: int, failed: int, date: str, commit: str) -> str:
    """Heading and row of a run for ``docs/results.md``."""
    columns = {"date": date, "commit": commit, "suite": suite, "cases": str(run)}
    for aim in aims:
        columns[f"{aim.what} %"] = "-" if aim.value is None else f"{100 * aim.value:.1f} (of {aim.n})"
    columns["failed"] = str(failed)
    return table(list(columns), [list(columns.values())])


def _table(columns: Columns, rows: Sequence[Any]) -> str:
    return table([title for title, _ in columns], ([value(row) for _, value in columns] for row in rows))


class Progress:
    """Prints on stderr the number of cases every 30 s, and failures at once; without names where none may be known."""

    def __init__(self, total: int, *, names: bool) -> None:
        self._total, self._names, self._lock, self._done = total, names, threading.Lock(), 0
        self._begin = self._shown = time.monotonic()

    def __call__(self, case: Case, result: CaseResult) -> None:
        with self._lock:
            self._done += 1
            if result.error is not None and self._names:
                print(
                    f"suite: failed: {revealed(case, result.hidden).name}: {result.error}", file=sys.stderr, flush=True
                )
            now = time.monotonic()
            if now - self._shown >= EVERY_S or self._done == self._total:
                self._shown, past = now, now - self._begin
                left = past / self._done * (self._total - self._done)
                counted = f"{self._done} of {self._total}, {past:.0f} s, about {left:.0f} s left"
                print(f"suite: {counted}", file=sys.stderr, flush=True)
