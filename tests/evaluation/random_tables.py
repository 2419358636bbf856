"""Totals and the table by effect of the suite of random arms."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from tests.evaluation.random_score import VISIBLE, RandomScore
from tests.evaluation.tables import CLOSED, percent, share

ORDER = ("healthy", "effect", "setup", "outside")
"""Families in the order of the table."""


@dataclass(frozen=True)
class Total:
    """One aim of the suite.

    ``n``, ``hits``: number of cases, and of those that reach it; ``aim``: share aimed at, 0 to 1.
    """

    label: str
    n: int
    hits: int
    aim: float

    @property
    def reached(self) -> bool | None:
        """``True`` if the aim is met; ``None`` without cases."""
        return None if not self.n else self.hits >= self.aim * self.n


@dataclass(frozen=True)
class KindRow:
    """Cases of one kind; the shares are of those that count, fractions of 1, ``None`` without any.

    Parameters
    ----------
    n
        Cases that count: visible, and not failed.
    invisible
        Cases with a visibility below `VISIBLE`.
    failed
        Cases that ended in an exception, at the time limit or with the end of the process.
    right
        Share with the right answer: the right name first, a healthy arm called healthy, an outside effect not named.
    among
        Share with the right name among all names.
    silent
        Share with the verdict ``no_gap``.
    closed
        Share with at least `CLOSED` of the gap closed.
    invisible_named_wrong
        Cases below `VISIBLE` with a wrong name.
    """

    family: str
    kind: str
    n: int
    invisible: int
    failed: int
    right: float | None
    among: float | None
    silent: float | None
    closed: float | None
    invisible_named_wrong: int


@dataclass(frozen=True)
class RandomTables:
    """Totals and rows of a run.

    ``cases``, ``failed``, ``worse``: number of cases, of failures, and of cases whose findings do not reduce the
    reported error; ``seconds_median``, ``seconds_p95``, ``seconds_longest``: time of a diagnosis, s.
    """

    totals: tuple[Total, ...]
    rows: tuple[KindRow, ...]
    cases: int
    failed: int
    worse: int
    seconds_median: float
    seconds_p95: float
    seconds_longest: float


def is_correct(score: RandomScore) -> bool:
    """``True`` if the answer is right for the family of the case."""
    if score.truth.family == "healthy":
        return bool(score.clean)
    if score.truth.family == "outside":
        return not score.named
    return bool(score.first)


def random_tables(scores: Sequence[RandomScore]) -> RandomTables:
    """Return totals and rows; a failed case counts as a wrong answer in the totals."""
    times = [score.seconds for score in scores if not score.error] or [0.0]
    return RandomTables(
        _totals(scores),
        tuple(_rows(scores)),
        len(scores),
        sum(bool(score.error) for score in scores),
        sum(score.worse for score in scores),
        median(times),
        float(np.percentile(times, 95.0)),
        max(times),
    )


def _totals(scores: Sequence[RandomScore]) -> tuple[Total, ...]:
    def total(label: str, family: str, aim: float) -> Total:
        mine = [s for s in scores if s.truth.family == family and s.truth.visible]
        return Total(label, len(mine), sum(is_correct(s) and not s.error for s in mine), aim)

    gaps = [s.closed for s in scores if s.closed is not None]
    return (
        total("visible effects named first", "effect", 0.95),
        total("healthy arms called healthy", "healthy", 0.99),
        total("visible effects outside the catalogue not named", "outside", 0.95),
        total("set-up mistakes named first", "setup", 0.98),
        Total(f"gap closed by {CLOSED:.0%} or more", len(gaps), sum(gap >= CLOSED for gap in gaps), 0.9),
    )


def _rows(scores: Sequence[RandomScore]) -> Iterable[KindRow]:
    kinds = {(ORDER.index(s.truth.family), s.truth.kind) for s in scores}
    for family, kind in sorted(kinds):
        every = [s for s in scores if s.truth.kind == kind]
        mine = [s for s in every if s.truth.visible and not s.error]
        hidden = [s for s in every if not s.truth.visible]
        gaps = [s.closed for s in mine if s.closed is not None]
        yield KindRow(
            ORDER[family],
            kind,
            len(mine),
            len(hidden),
            sum(bool(s.error) for s in every),
            share(is_correct(s) for s in mine),
            share(bool(s.among) for s in mine) if ORDER[family] in ("effect", "setup") else None,
            share(s.verdict == "no_gap" for s in mine),
            share(gap >= CLOSED for gap in gaps) if gaps else None,
            sum(bool(s.claims) and not s.first for s in hidden),
        )


def markdown(tables: RandomTables, title: str) -> str:
    """Return the totals and the table by effect as Markdown. ``tables``: totals and rows."""
    lines = [
        f"# {title}",
        "",
        f"{tables.cases} cases, {tables.failed} failed; in {tables.worse} the findings do not reduce the reported "
        f"error. Diagnosis: median {tables.seconds_median:.1f} s, 95 % {tables.seconds_p95:.1f} s, "
        f"longest {tables.seconds_longest:.1f} s.",
        "",
        "| aim | cases | % | aim % | reached |",
        "| --- | --- | --- | --- | --- |",
    ]
    for total in tables.totals:
        reached = {True: "yes", False: "no", None: "-"}[total.reached]
        rate = f"{100.0 * total.hits / total.n:.1f}" if total.n else "-"
        lines.append(f"| {total.label} | {total.n} | {rate} | {100.0 * total.aim:.0f} | {reached} |")
    lines += [
        "",
        f"Right: the right name first, a healthy arm called healthy, an effect outside the catalogue not named. "
        f"Cases below a visibility of {VISIBLE} stand apart and count nowhere.",
        "",
        "| family | hidden | cases | failed | right % | among % | no gap % "
        f"| closed by {CLOSED:.0%} % | below {VISIBLE} | of these named wrong |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in tables.rows:
        shares = " | ".join(percent(value) for value in (row.right, row.among, row.silent, row.closed))
        lines.append(
            f"| {row.family} | {row.kind} | {row.n} | {row.failed or ''} | {shares} | {row.invisible or ''} "
            f"| {row.invisible_named_wrong or ''} |"
        )
    return "\n".join(lines) + "\n"


def results_line(tables: RandomTables, half: str, commit: str, date: str) -> str:
    """Return a row of the table of runs in ``docs/results.md``.

    ``tables``: totals and rows; ``half``: half of the suite.
    """
    totals = " | ".join(f"{100.0 * t.hits / t.n:.1f} ({t.hits}/{t.n})" if t.n else "-" for t in tables.totals)
    times = f"{tables.seconds_median:.1f} / {tables.seconds_p95:.1f}"
    return f"| {date} | {commit} | {half} | {tables.cases} | {totals} | {tables.failed} | {tables.worse} | {times} |"


RESULTS_HEADING = (
    "| date | commit | half | cases | named first % | healthy % | outside not named % | set-up % "
    f"| closed by {CLOSED:.0%} % | failed | not smaller | s, median / 95 % |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)
"""Heading of the table of runs in ``docs/results.md``."""
