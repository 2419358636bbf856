"""The tables of a suite: by effect and strength, healthy arms, and effects outside the catalogue."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from scipy import stats

from armident.configs.schema.suite import LEVELS
from armident.identify.evaluation.cases import Case
from armident.identify.evaluation.score import LOW_CONFIDENCE, Score

Scored = tuple[Case, Score]
CLOSED = 0.9
"""Share of the injected gap that is to close."""
AIMED_AT = ("typical", "obvious")
"""Strengths for which the aims are meant; what is just detectable may be missed."""


@dataclass(frozen=True)
class Row:
    """One effect at one strength; shares are of 1, ``None`` where nothing can be counted.

    Parameters
    ----------
    n, failed
        Cases judged, and cases without a diagnosis.
    first, second
        Right name and place: as the first finding, or as that or its closest rival; of what is not called invisible.
    missed, invisible
        Nothing found; and called invisible in this motion.
    extra
        Cases with findings beside what is hidden.
    closed
        Median share of the injected gap closed.
    closed_enough
        Cases in which at least 90 % of it closed.
    within
        Parameters within three standard deviations.
    """

    label: str
    level: str
    n: int
    failed: int
    first: float | None
    second: float | None
    missed: float | None
    invisible: float | None
    extra: float | None
    closed: float | None
    closed_enough: float | None
    within: float | None


@dataclass(frozen=True)
class Healthy:
    """Healthy arms of one kind: how many were called otherwise, and the two-sided 95 % bounds (Clopper, Pearson)."""

    label: str
    n: int
    failed: int
    alarms: int
    low: float
    high: float


@dataclass(frozen=True)
class Outside:
    """An effect without a name: left unexplained, named with low confidence, named, not seen, or not in the data."""

    label: str
    level: str
    n: int
    failed: int
    unexplained: float | None
    low_confidence: float | None
    named: float | None
    unseen: float | None
    absent: float | None
    most_often: str | None


@dataclass(frozen=True)
class Aim:
    """One figure of the suite's aims."""

    what: str
    value: float | None
    aim: float
    n: int

    @property
    def reached(self) -> bool | None:
        """``None`` without cases."""
        return None if self.value is None else self.value >= self.aim


@dataclass(frozen=True)
class Tables:
    """All of it."""

    effects: tuple[Row, ...]
    pairs: tuple[Row, ...]
    healthy: tuple[Healthy, ...]
    outside: tuple[Outside, ...]
    aims: tuple[Aim, ...]


def tables(scored: Sequence[Scored], failed: Sequence[Case]) -> Tables:
    """Count what the cases of a suite came to."""
    singles = [s for s in scored if s[0].kind == "effect"]
    pairs = [s for s in scored if s[0].kind == "pair"]
    return Tables(
        effects=_rows(singles, [c for c in failed if c.kind == "effect"]),
        pairs=_rows(pairs, [c for c in failed if c.kind == "pair"]),
        healthy=tuple(_healthy(scored, failed)),
        outside=tuple(_outside(scored, failed)),
        aims=_aims(scored),
    )


def clopper_pearson(k: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """Two-sided bounds of a probability after ``k`` of ``n`` (Clopper, Pearson 1934)."""
    tail = (1 - level) / 2
    low = 0.0 if k == 0 else float(stats.beta.ppf(tail, k, n - k + 1))
    high = 1.0 if k == n else float(stats.beta.ppf(1 - tail, k + 1, n - k))
    return low, high


def _groups(scored: Iterable[Scored], failed: Iterable[Case]) -> dict[tuple[str, str], tuple[list[Scored], int]]:
    groups: dict[tuple[str, str], tuple[list[Scored], int]] = {}
    for item in scored:
        key = item[0].label, item[0].level or ""
        groups.setdefault(key, ([], 0))[0].append(item)
    for case in failed:
        key = case.label, case.level or ""
        mine, count = groups.get(key, ([], 0))
        groups[key] = mine, count + 1
    order: dict[str, int] = {level: k for k, level in enumerate(LEVELS)}
    return dict(sorted(groups.items(), key=lambda g: (g[0][0], order.get(g[0][1], -1))))


def _rows(scored: Sequence[Scored], failed: Sequence[Case]) -> tuple[Row, ...]:
    rows = [
        _row(label, level, [s for _, s in mine], lost)
        for (label, level), (mine, lost) in _groups(scored, failed).items()
    ]
    if len(rows) > 1:
        for level in LEVELS:
            mine = [s for c, s in scored if c.level == level]
            lost = sum(c.level == level for c in failed)
            if mine or lost:
                rows.append(_row("all", level, mine, lost))
    return tuple(rows)


def _row(label: str, level: str, scores: Sequence[Score], failed: int) -> Row:
    shown = [s for s in scores if not s.invisible]
    closed = [s.closed for s in shown if s.closed is not None]
    return Row(
        label=label,
        level=level,
        n=len(scores),
        failed=failed,
        first=share(s.first is True for s in shown),
        second=share(s.second is True for s in shown),
        missed=share(s.missed and not s.invisible for s in scores),
        invisible=share(s.invisible for s in scores),
        extra=share(s.extra > 0 for s in scores),
        closed=median(closed) if closed else None,
        closed_enough=share(c >= CLOSED for c in closed),
        within=share(ok for s in scores for ok in s.within),
    )


def _healthy(scored: Sequence[Scored], failed: Sequence[Case]) -> Iterable[Healthy]:
    clean = [s for s in scored if not s[0].parts]
    lost = [c for c in failed if not c.parts]
    robots = sorted({c.robot for c, _ in clean} | {c.robot for c in lost})
    kinds = sorted({c.kind for c, _ in clean} | {c.kind for c in lost})
    for kind in kinds:
        for robot in [*robots, None]:

            def mine(case: Case, robot: str | None = robot, kind: str = kind) -> bool:
                return case.kind == kind and robot in (None, case.robot)

            scores = [s for c, s in clean if mine(c)]
            gone = sum(mine(c) for c in lost)
            if scores or gone:
                alarms = sum(s.verdict != "no_gap" for s in scores)
                low, high = clopper_pearson(alarms, len(scores)) if scores else (0.0, 1.0)
                title = kind.replace("_", " against ")
                yield Healthy(f"{title}, {robot or 'all'}", len(scores), gone, alarms, low, high)


def _outside(scored: Sequence[Scored], failed: Sequence[Case]) -> Iterable[Outside]:
    mine = [s for s in scored if s[0].kind == "outside"]
    for (label, level), (cases, lost) in _groups(mine, [c for c in failed if c.kind == "outside"]).items():
        fates = Counter(fate(s) for _, s in cases)
        names = Counter(s.named for _, s in cases if fate(s) == "named")
        n = len(cases)

        def part(of: str, fates: Counter[str] = fates, n: int = n) -> float | None:
            return fates[of] / n if n else None

        yield Outside(
            label, level, n, lost, part("unexplained"), part("low_confidence"), part("named"), part("unseen"),
            part("absent"),
            names.most_common(1)[0][0] if names else None,
        )  # fmt: skip


def fate(score: Score) -> str:
    """What became of an effect without a name: see `Outside`."""
    if score.confidence >= LOW_CONFIDENCE:
        return "named"
    if score.confidence > 0:
        return "low_confidence"
    if score.verdict != "no_gap":
        return "unexplained"
    return "unseen" if score.shown else "absent"


def _aims(scored: Sequence[Scored]) -> tuple[Aim, ...]:
    single = [s for c, s in scored if c.kind == "effect" and c.level in AIMED_AT]
    named = [s for s in single if not s.invisible]
    both = [s for c, s in scored if c.kind == "pair" and c.level in AIMED_AT]
    pairs = [s for s in both if not s.invisible]
    clean = [s for c, s in scored if not c.parts]
    outside = [fate(s) for c, s in scored if c.kind == "outside" and c.level in AIMED_AT]
    there = [f for f in outside if f != "absent"]
    closed = [s.closed for s in named if s.closed is not None and s.first]
    parameters = [ok for s in named for ok in s.within]

    def aim(what: str, hits: Sequence[bool], wanted: float) -> Aim:
        return Aim(what, share(hits), wanted, len(hits))

    return (
        aim("name and place right", [s.first is True for s in named], 0.95),
        aim("name and place right, or second", [s.second is True for s in named], 0.99),
        aim("pairs: both names and places right", [s.first is True for s in pairs], 0.95),
        aim("name and place right, what it says could hide counted too", [s.first is True for s in single], 0.95),
        aim("right, or second, what it says could hide counted too", [s.second is True for s in single], 0.99),
        aim("pairs, what it says could hide counted too", [s.first is True for s in both], 0.95),
        aim("healthy arms called healthy", [s.verdict == "no_gap" for s in clean], 0.99),
        aim(
            "outside the catalogue, in the data: unexplained, or named with low confidence",
            [f in ("unexplained", "low_confidence") for f in there],
            0.90,
        ),
        Aim("share of the injected gap closed, mean where named", _mean(closed), 0.90, len(closed)),
        aim(f"cases with at least {CLOSED:.0%} of it closed", [c >= CLOSED for c in closed], 0.90),
        aim("parameters within three standard deviations", parameters, 0.90),
    )


def _mean(closed: Sequence[float]) -> float | None:
    """What one case closes beyond its gap makes up for no other."""
    return sum(min(c, 1.0) for c in closed) / len(closed) if closed else None


def share(hits: Iterable[bool]) -> float | None:
    """Share of true ones, ``None`` of nothing."""
    counted = list(hits)
    return sum(counted) / len(counted) if counted else None


def percent(value: float | None) -> str:
    """A share as a reader wants it."""
    return "-" if value is None else f"{100 * value:.0f}"


COLUMNS: tuple[tuple[str, Callable[[Any], str]], ...] = (
    ("effect", lambda r: r.label),
    ("strength", lambda r: r.level),
    ("n", lambda r: str(r.n)),
    ("failed", lambda r: str(r.failed or "")),
    ("top-1 %", lambda r: percent(r.first)),
    ("top-2 %", lambda r: percent(r.second)),
    ("missed %", lambda r: percent(r.missed)),
    ("unseeable %", lambda r: percent(r.invisible)),
    ("extra %", lambda r: percent(r.extra)),
    ("closed %", lambda r: percent(r.closed)),
    (">= 90 %", lambda r: percent(r.closed_enough)),
    ("3 sigma %", lambda r: percent(r.within)),
)
HEALTHY_COLUMNS: tuple[tuple[str, Callable[[Any], str]], ...] = (
    ("healthy arms", lambda r: r.label),
    ("n", lambda r: str(r.n)),
    ("failed", lambda r: str(r.failed or "")),
    ("false alarms", lambda r: str(r.alarms)),
    ("95 % bounds, %", lambda r: f"{100 * r.low:.1f} to {100 * r.high:.1f}"),
)
OUTSIDE_COLUMNS: tuple[tuple[str, Callable[[Any], str]], ...] = (
    ("outside the catalogue", lambda r: r.label),
    ("strength", lambda r: r.level),
    ("n", lambda r: str(r.n)),
    ("failed", lambda r: str(r.failed or "")),
    ("unexplained %", lambda r: percent(r.unexplained)),
    ("low confidence %", lambda r: percent(r.low_confidence)),
    ("named %", lambda r: percent(r.named)),
    ("unseen %", lambda r: percent(r.unseen)),
    ("not in the data %", lambda r: percent(r.absent)),
    ("most often", lambda r: r.most_often or ""),
)
AIM_COLUMNS: tuple[tuple[str, Callable[[Any], str]], ...] = (
    ("aim, typical and obvious strengths", lambda r: r.what),
    ("n", lambda r: str(r.n)),
    ("%", lambda r: "-" if r.value is None else f"{100 * r.value:.1f}"),
    ("aim %", lambda r: f"{100 * r.aim:.0f}"),
    ("reached", lambda r: {True: "yes", False: "no", None: "-"}[r.reached]),
)
