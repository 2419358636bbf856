"""Report of the suite as Markdown: targets, tables, and every case with a shortcoming."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from tests.evaluation.tables import (
    AIM_COLUMNS,
    AIMED_AT,
    CLOSED,
    COLUMNS,
    HEALTHY_COLUMNS,
    OUTSIDE_COLUMNS,
    Scored,
    Tables,
    fate,
)


def _share_closed(scored: Scored) -> float:
    """Closed share of the injected gap; 1 without a gap."""
    closed = scored[1].closed
    return 1.0 if closed is None else closed


SHORTFALLS: tuple[tuple[str, Callable[[Scored], bool]], ...] = (
    ("false alarm", lambda s: not s[0].parts and s[1].verdict != "no_gap"),
    ("named although outside the catalogue", lambda s: s[0].kind == "outside" and fate(s[1]) == "named"),
    ("not detected", lambda s: s[0].kind == "outside" and fate(s[1]) == "unseen"),
    ("below the detection limit", lambda s: s[1].invisible),
    ("not among the first two", lambda s: s[1].second is False and not s[1].invisible),
    ("second choice", lambda s: s[1].first is False and s[1].second is True),
    (f"closed by less than {CLOSED:.0%}", lambda s: s[1].first is True and _share_closed(s) < CLOSED),
    ("a parameter off by over 3 sigma", lambda s: not all(s[1].within)),
)  # fmt: skip
"""Shortcomings of a case, with the condition of each."""


def report(result: Tables, scored: Sequence[Scored], total: int, versions: Mapping[str, int], core_hours: float) -> str:
    """Return the report as one Markdown document.

    ``scored``: cases with a result, and their scores; ``total``: number of selected cases; ``versions``: number of
    cases by version of the code; ``core_hours``: computing time of all cases, h.
    """
    code = ", ".join(f"{version} ({count} cases)" for version, count in versions.items())
    head = (
        f"{len(scored)} of {total} cases, {core_hours:.1f} core-hours, code {code}. "
        f"The targets apply to {' and '.join(AIMED_AT)} strengths; the last table lists the cases with shortcomings."
    )
    parts = ["# Detection of simulated effects by the diagnosis", head]
    tables: tuple[tuple[str, Sequence[tuple[str, Callable[[Any], str]]], Sequence[Any]], ...] = (
        ("Targets", AIM_COLUMNS, result.aims),
        ("Simulated effects", COLUMNS, result.effects),
        ("Pairs of effects", COLUMNS, result.pairs),
        ("Healthy arms", HEALTHY_COLUMNS, result.healthy),
        ("Effects outside the catalogue", OUTSIDE_COLUMNS, result.outside),
        ("Cases with shortcomings", SHORTFALL_COLUMNS, shortfalls(scored)),
    )
    for title, columns, rows in tables:
        if rows:
            parts += [f"## {title}", _table(columns, rows)]
    return "\n\n".join(parts) + "\n"


def shortfalls(scored: Sequence[Scored]) -> list[tuple[str, str, str]]:
    """List the cases with shortcomings, of healthy arms and of the strengths with targets.

    ``scored``: cases with a result, and their scores. Returns the name of the case, shortcomings, and short form of the
    diagnosis.
    """
    found = []
    for case, score in scored:
        lacks = [name for name, holds in SHORTFALLS if holds((case, score))]
        if lacks and (case.level in AIMED_AT or not case.parts):
            closed = "" if score.closed is None else f", {score.closed:.0%} closed"
            diagnosis = score.verdict.replace("_", " ") + (f": {score.named}" if score.named else "") + closed
            found.append((case.name, "; ".join(lacks), diagnosis))
    return sorted(found, key=lambda row: row[0])


SHORTFALL_COLUMNS: tuple[tuple[str, Callable[[Any], str]], ...] = (
    ("case", lambda row: row[0]),
    ("shortcomings", lambda row: row[1]),
    ("diagnosis", lambda row: row[2]),
)


def _table(columns: Sequence[tuple[str, Callable[[Any], str]]], rows: Sequence[Any]) -> str:
    lines = [[title for title, _ in columns], ["---"] * len(columns)]
    lines += [[value(row).replace("|", "\\|") for _, value in columns] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
