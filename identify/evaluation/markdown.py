"""The suite's report as Markdown: aims, tables, and every case that fell short."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from armident.identify.evaluation.tables import (
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
    """Of the injected gap; all of it where there is none."""
    closed = scored[1].closed
    return 1.0 if closed is None else closed


SHORTFALLS: tuple[tuple[str, Callable[[Scored], bool]], ...] = (
    ("a false alarm", lambda s: not s[0].parts and s[1].verdict != "no_gap"),
    ("named", lambda s: s[0].kind == "outside" and fate(s[1]) == "named"),
    ("not seen", lambda s: s[0].kind == "outside" and fate(s[1]) == "unseen"),
    ("could hide, it says", lambda s: s[1].invisible),
    ("not among the first two", lambda s: s[1].second is False and not s[1].invisible),
    ("second", lambda s: s[1].first is False and s[1].second is True),
    (f"closed by less than {CLOSED:.0%}", lambda s: s[1].first is True and _share_closed(s) < CLOSED),
    ("a parameter beyond three standard deviations", lambda s: not all(s[1].within)),
)  # fmt: skip
"""What a case can lack, and how to tell."""


def report(result: Tables, scored: Sequence[Scored], total: int, versions: Mapping[str, int], core_hours: float) -> str:
    """The report, one Markdown document.

    Parameters
    ----------
    scored
        Every case that has been run, with its score.
    total
        Cases of the suite.
    versions
        Of the code that decides the results, and how many cases are of each.
    core_hours
        Time that simulating and diagnosing took, summed over the cases, h.
    """
    code = ", ".join(f"{version} ({count} cases)" for version, count in versions.items())
    head = (
        f"{len(scored)} of {total} cases, {core_hours:.1f} core-hours, code {code}. "
        f"The aims are for {' and '.join(AIMED_AT)} strengths; a case fell short where the last table says so."
    )
    parts = ["# What a diagnosis finds of what is hidden", head]
    tables: tuple[tuple[str, Sequence[tuple[str, Callable[[Any], str]]], Sequence[Any]], ...] = (
        ("Aims", AIM_COLUMNS, result.aims),
        ("Hidden effects", COLUMNS, result.effects),
        ("Pairs of effects", COLUMNS, result.pairs),
        ("Nothing hidden", HEALTHY_COLUMNS, result.healthy),
        ("Effects without a name", OUTSIDE_COLUMNS, result.outside),
        ("Cases that fell short", SHORTFALL_COLUMNS, shortfalls(scored)),
    )
    for title, columns, rows in tables:
        if rows:
            parts += [f"## {title}", _table(columns, rows)]
    return "\n\n".join(parts) + "\n"


def shortfalls(scored: Sequence[Scored]) -> list[tuple[str, str, str]]:
    """Cases of the strengths that are aimed at, and healthy arms, that lack something: which, what, what was said."""
    found = []
    for case, score in scored:
        lacks = [what for what, told in SHORTFALLS if told((case, score))]
        if lacks and (case.level in AIMED_AT or not case.parts):
            closed = "" if score.closed is None else f", {score.closed:.0%} closed"
            said = score.verdict.replace("_", " ") + (f": {score.named}" if score.named else "") + closed
            found.append((case.name, "; ".join(lacks), said))
    return sorted(found, key=lambda row: row[0])


SHORTFALL_COLUMNS: tuple[tuple[str, Callable[[Any], str]], ...] = (
    ("case", lambda row: row[0]),
    ("lacks", lambda row: row[1]),
    ("diagnosis", lambda row: row[2]),
)


def _table(columns: Sequence[tuple[str, Callable[[Any], str]]], rows: Sequence[Any]) -> str:
    lines = [[title for title, _ in columns], ["---"] * len(columns)]
    lines += [[value(row).replace("|", "\\|") for _, value in columns] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
