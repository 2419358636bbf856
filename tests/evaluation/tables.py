"""Tables of a suite: by effect and strength, healthy arms, and effects outside the catalogue."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from scipy import stats

from tests.evaluation.cases import Case
from tests.evaluation.schema import LEVELS
from tests.evaluation.score import LOW_CONFIDENCE, Score

Scored = tuple[Case, Score]
CLOSED = 0.9
"""Target for the closed share of the injected gap."""
AIMED_AT = ("typical", "obvious")
"""Strengths with targets; just detectable effects may be missed."""


@dataclass(frozen=True)
class Row:
    """One effect at one strength; shares are fractions of 1, ``None`` without cases.

    Parameters
    ----------
    n, failed
        Number of cases with a diagnosis, and of cases that failed.
    first, second
        Share of cases with the correct effect and joint as first finding, or as its closest alternative too; without
        the cases below the detection limit.
    missed, invisible
        Share of cases without a finding, and of cases below the detection limit that the diagnosis states.
    extra
        Share of cases with findings besides the simulated effects.
    closed
        Median closed share of the injected gap.
    closed_enough
        Share of cases with at least `CLOSED` of the gap closed.
    within
        Share of parameters within three standard deviations of the truth.
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
    """Healthy arms of one kind.

    ``label``: kind and robot; ``n``, ``failed``: number of cases with a diagnosis, and of cases that failed;
    ``alarms``: number of verdicts other than ``no_gap``; ``low``, ``high``: two-sided 95 % confidence limits of the
    false alarm rate, see `clopper_pearson`.
    """

    label: str
    n: int
    failed: int
    alarms: int
    low: float
    high: float


@dataclass(frozen=True)
class Outside:
    """One effect outside the catalogue at one strength; shares are fractions of 1, ``None`` without cases.

    Parameters
    ----------
    n, failed
        Number of cases with a diagnosis, and of cases that failed.
    unexplained
        Share of cases without a finding and with an unexplained rest: the correct result.
    low_confidence, named
        Share of cases with findings, all with confidence below `LOW_CONFIDENCE`, or not.
    unseen
        Share of cases with verdict ``no_gap`` although the held-out data contain the gap.
    absent
        Share of cases with verdict ``no_gap`` whose held-out data do not contain the gap.
    most_often
        Most frequent first finding of the ``named`` cases.
    """

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
    """One figure with a target.

    ``what``: description of the figure. ``value``: reached value, a fraction of 1; ``None`` without cases. ``aim``:
    target, a fraction of 1. ``n``: number of cases or parameters.
    """

    what: str
    value: float | None
    aim: float
    n: int

    @property
    def reached(self) -> bool | None:
        """``True`` if the value is at least the target; ``None`` without cases."""
        return None if self.value is None else self.value >= self.aim


@dataclass(frozen=True)
class Tables:
    """All tables of a suite.

    ``effects``, ``pairs``: single effects and pairs of effects, by strength; ``healthy``: healthy arms; ``outside``:
    effects outside the catalogue; ``aims``: figures with targets.
    """

    effects: tuple[Row, ...]
    pairs: tuple[Row, ...]
    healthy: tuple[Healthy, ...]
    outside: tuple[Outside, ...]
    aims: tuple[Aim, ...]


def tables(scored: Sequence[Scored], failed: Sequence[Case]) -> Tables:
    """Return the tables of a suite. ``scored``: cases with a result, and their scores."""
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
    """Return the two-sided confidence limits of a probability (Clopper and Pearson, Biometrika 26, 1934).

    ``k``: number of events; ``n``: number of trials.
    """
    interval = stats.binomtest(k, n).proportion_ci(level, "exact")
    return float(interval.low), float(interval.high)


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
    """Return the column of `Outside` for an effect outside the catalogue. ``score``: score of the case."""
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
        aim("effect and joint correct", [s.first is True for s in named], 0.95),
        aim("effect and joint correct, first or second choice", [s.second is True for s in named], 0.99),
        aim("pairs: both effects and joints correct", [s.first is True for s in pairs], 0.95),
        aim(
            "effect and joint correct, with the cases below the detection limit",
            [s.first is True for s in single],
            0.95,
        ),
        aim(
            "first or second choice, with the cases below the detection limit", [s.second is True for s in single], 0.99
        ),
        aim("pairs, with the cases below the detection limit", [s.first is True for s in both], 0.95),
        aim("healthy arms with verdict no_gap", [s.verdict == "no_gap" for s in clean], 0.99),
        aim(
            "outside the catalogue, gap in the data: unexplained or low confidence",
            [f in ("unexplained", "low_confidence") for f in there],
            0.90,
        ),
        Aim("mean closed share of the injected gap where the effect is correct", _mean(closed), 0.90, len(closed)),
        aim(f"cases with at least {CLOSED:.0%} of the gap closed", [c >= CLOSED for c in closed], 0.90),
        aim("parameters within three standard deviations", parameters, 0.90),
    )


def _mean(closed: Sequence[float]) -> float | None:
    """Mean closed share, each limited to 1: a share above 1 does not compensate for another case."""
    return sum(min(c, 1.0) for c in closed) / len(closed) if closed else None


def share(hits: Iterable[bool]) -> float | None:
    """Return the fraction of ``True``; ``None`` without elements."""
    counted = list(hits)
    return sum(counted) / len(counted) if counted else None


def percent(value: float | None) -> str:
    """Return a share in percent as text. ``value``: the share, a fraction of 1; ``None`` becomes ``-``."""
    return "-" if value is None else f"{100 * value:.0f}"


COLUMNS: tuple[tuple[str, Callable[[Any], str]], ...] = (
    ("effect", lambda r: r.label),
    ("strength", lambda r: r.level),
    ("n", lambda r: str(r.n)),
    ("failed", lambda r: str(r.failed or "")),
    ("top-1 %", lambda r: percent(r.first)),
    ("top-2 %", lambda r: percent(r.second)),
    ("missed %", lambda r: percent(r.missed)),
    ("below limit %", lambda r: percent(r.invisible)),
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
    ("95 % limits, %", lambda r: f"{100 * r.low:.1f} to {100 * r.high:.1f}"),
)
OUTSIDE_COLUMNS: tuple[tuple[str, Callable[[Any], str]], ...] = (
    ("outside the catalogue", lambda r: r.label),
    ("strength", lambda r: r.level),
    ("n", lambda r: str(r.n)),
    ("failed", lambda r: str(r.failed or "")),
    ("unexplained %", lambda r: percent(r.unexplained)),
    ("low confidence %", lambda r: percent(r.low_confidence)),
    ("named %", lambda r: percent(r.named)),
    ("not detected %", lambda r: percent(r.unseen)),
    ("gap not in the data %", lambda r: percent(r.absent)),
    ("most frequent finding", lambda r: r.most_often or ""),
)
AIM_COLUMNS: tuple[tuple[str, Callable[[Any], str]], ...] = (
    ("figure, typical and obvious strengths", lambda r: r.what),
    ("n", lambda r: str(r.n)),
    ("%", lambda r: "-" if r.value is None else f"{100 * r.value:.1f}"),
    ("target %", lambda r: f"{100 * r.aim:.0f}"),
    ("reached", lambda r: {True: "yes", False: "no", None: "-"}[r.reached]),
)
