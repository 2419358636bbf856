"""Tables of a suite: by effect and strength, healthy arms, effects outside the catalogue, and figures with aims."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from scipy import stats

from tests.evaluation.cases import SEEN, UNSEEN, Case, Kind
from tests.evaluation.schema import LEVELS
from tests.evaluation.score import LOW_CONFIDENCE, Score

Scored = tuple[Case, Score]
CLOSED = 0.9
"""Aim for the closed share of the injected gap."""
AIMED_AT = ("typical", "obvious", SEEN)
"""Levels with aims; just detectable effects may be missed."""
ORDER = ("", *LEVELS, SEEN, UNSEEN)
FATES = ("unexplained", "low_confidence", "named", "unseen", "absent")


@dataclass(frozen=True)
class Row:
    """One effect at one level; shares are fractions of 1, ``None`` without cases.

    Parameters
    ----------
    n, failed
        Number of cases with a diagnosis, and of cases that failed.
    first, second
        Share of cases with the right effect and joint as first finding, or named at all; without the cases below the
        detection limit.
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
    """Healthy arms of one kind: alarms, with two-sided 95 % confidence limits of their rate (`clopper_pearson`)."""

    label: str
    n: int
    failed: int
    alarms: int
    low: float
    high: float


@dataclass(frozen=True)
class Outside:
    """One effect outside the catalogue at one level; shares are fractions of 1, ``None`` without cases.

    Parameters
    ----------
    n, failed
        Number of cases with a diagnosis, and of cases that failed.
    unexplained
        Share of cases without a finding and with an unexplained rest: the right result.
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
    """One figure with an aim, fractions of 1, of n cases or parameters; ``value`` is ``None`` without any."""

    what: str
    value: float | None
    aim: float
    n: int

    @property
    def reached(self) -> bool | None:
        """``True`` if the value is at least the aim; ``None`` without cases."""
        return None if self.value is None else self.value >= self.aim


@dataclass(frozen=True)
class Tables:
    """All tables of a suite: single effects, pairs, mistakes of the set-up, healthy arms, outside effects, aims."""

    effects: tuple[Row, ...]
    pairs: tuple[Row, ...]
    setup: tuple[Row, ...]
    healthy: tuple[Healthy, ...]
    outside: tuple[Outside, ...]
    aims: tuple[Aim, ...]


def tables(scored: Sequence[Scored], failed: Sequence[Case]) -> Tables:
    """Return the tables of cases with scores and of cases that failed."""

    def rows(kind: Kind) -> tuple[Row, ...]:
        return _rows([s for s in scored if s[0].kind == kind], [c for c in failed if c.kind == kind])

    return Tables(
        effects=rows("effect"),
        pairs=rows("pair"),
        setup=rows("setup"),
        healthy=tuple(_healthy(scored, failed)),
        outside=tuple(_outside(scored, failed)),
        aims=aims(scored, failed),
    )


def clopper_pearson(k: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """Two-sided limits of the probability of k events in n trials (Clopper and Pearson, Biometrika 26, 1934)."""
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
    return dict(sorted(groups.items(), key=lambda g: (g[0][0], ORDER.index(g[0][1]))))


def _rows(scored: Sequence[Scored], failed: Sequence[Case]) -> tuple[Row, ...]:
    rows = [
        _row(label, level, [s for _, s in mine], lost)
        for (label, level), (mine, lost) in _groups(scored, failed).items()
    ]
    if len(rows) > 1:
        for level in ORDER:
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


def calm(case: Case, score: Score) -> bool:
    """``True`` if a healthy arm raises no alarm; a name that needs no gap is one on a random arm."""
    return score.verdict == "no_gap" and not (case.random and score.named)


def _healthy(scored: Sequence[Scored], failed: Sequence[Case]) -> Iterable[Healthy]:
    clean = [s for s in scored if not s[0].parts]
    lost = [c for c in failed if not c.parts]
    robots = sorted({c.robot for c, _ in clean} | {c.robot for c in lost})
    kinds = sorted({c.kind for c, _ in clean} | {c.kind for c in lost})
    for kind in kinds:
        for robot in [*robots, None]:
            mine = [s for s in clean if s[0].kind == kind and robot in (None, s[0].robot)]
            gone = sum(c.kind == kind and robot in (None, c.robot) for c in lost)
            if mine or gone:
                alarms = sum(not calm(*s) for s in mine)
                low, high = clopper_pearson(alarms, len(mine)) if mine else (0.0, 1.0)
                title = kind.replace("_", " against ")
                yield Healthy(f"{title}, {robot or 'all'}", len(mine), gone, alarms, low, high)


def _outside(scored: Sequence[Scored], failed: Sequence[Case]) -> Iterable[Outside]:
    mine = [s for s in scored if s[0].kind == "outside"]
    for (label, level), (cases, lost) in _groups(mine, [c for c in failed if c.kind == "outside"]).items():
        fates = [fate(s) for _, s in cases]
        names = Counter(s.named[0] for _, s in cases if fate(s) == "named")
        shares = {of: share(f == of for f in fates) for of in FATES}
        most_often = names.most_common(1)[0][0] if names else None
        yield Outside(label, level, len(cases), lost, **shares, most_often=most_often)


SEEN_UNNAMED = ("unexplained", "low_confidence")
"""Fates of an outside effect that are right: the verdict is not `no_gap`, and no cause is named with confidence."""


def fate(score: Score) -> str:
    """Return the column of `Outside` for an effect outside the catalogue."""
    if score.confidence >= LOW_CONFIDENCE:
        return "named"
    if score.confidence > 0:
        return "low_confidence"
    if score.verdict != "no_gap":
        return "unexplained"
    return "unseen" if score.shown else "absent"


def is_right(case: Case, score: Score) -> bool:
    """``True``: right name first; a healthy arm called healthy; an outside effect seen and not named."""
    if not case.parts:
        return calm(case, score)
    return fate(score) in SEEN_UNNAMED if case.kind == "outside" else score.first is True


def aims(scored: Sequence[Scored], failed: Sequence[Case]) -> tuple[Aim, ...]:
    """Figures with aims, of healthy arms and of the levels with aims; failed random arms count as wrong."""
    mine = [(c, s) for c, s in scored if not c.parts or c.level in AIMED_AT]
    single = [s for c, s in mine if c.kind == "effect"]
    closed = [s.closed for s in single if s.closed is not None and s.first and not s.invisible]

    def aim(what: str, hits: Sequence[float], wanted: float) -> Aim:
        return Aim(what, share(hits), wanted, len(hits))

    if any(case.random for case in (*(c for c, _ in scored), *failed)):
        lost = [c for c in failed if not c.parts or c.level in AIMED_AT]

        def right(what: str, kind: Kind, wanted: float) -> Aim:
            hits = [is_right(c, s) for c, s in mine if c.kind == kind]
            return aim(what, hits + [False for c in lost if c.kind == kind], wanted)

        gaps = [s.closed >= CLOSED for _, s in mine if s.closed is not None]
        return (
            right("visible effects named first", "effect", 0.95),
            right("healthy arms called healthy", "clean", 0.99),
            right("visible effects outside the catalogue seen and not named", "outside", 0.95),
            right("set-up mistakes named first", "setup", 0.98),
            aim(f"gap closed by {CLOSED:.0%} or more", gaps, 0.9),
        )
    pairs = [s for c, s in mine if c.kind == "pair"]
    outside = [f for c, s in mine if c.kind == "outside" and (f := fate(s)) != "absent"]
    return (
        aim("effect and joint correct", [s.first is True for s in single if not s.invisible], 0.95),
        aim(
            "effect and joint correct, first or second choice",
            [s.second is True for s in single if not s.invisible],
            0.99,
        ),
        aim("pairs: both effects and joints correct", [s.first is True for s in pairs if not s.invisible], 0.95),
        aim(
            "effect and joint correct, with the cases below the detection limit",
            [s.first is True for s in single],
            0.95,
        ),
        aim(
            "first or second choice, with the cases below the detection limit", [s.second is True for s in single], 0.99
        ),
        aim("pairs, with the cases below the detection limit", [s.first is True for s in pairs], 0.95),
        aim("healthy arms with verdict no_gap", [calm(c, s) for c, s in mine if not c.parts], 0.99),
        aim(
            "outside the catalogue, gap in the data: unexplained or low confidence",
            [f in SEEN_UNNAMED for f in outside],
            0.90,
        ),
        # A share above 1 does not compensate for another case.
        aim("mean closed share of the injected gap where the effect is correct", [min(c, 1.0) for c in closed], 0.90),
        aim(f"cases with at least {CLOSED:.0%} of the gap closed", [c >= CLOSED for c in closed], 0.90),
        aim(
            "parameters within three standard deviations",
            [ok for s in single if not s.invisible for ok in s.within],
            0.90,
        ),
    )


def share(values: Iterable[float]) -> float | None:
    """Return the mean of values, or the fraction of ``True``; ``None`` without elements."""
    counted = list(values)
    return sum(counted) / len(counted) if counted else None


def percent(value: float | None) -> str:
    """Return a share in percent as text; ``None`` becomes ``-``."""
    return "-" if value is None else f"{100 * value:.0f}"


Columns = tuple[tuple[str, Callable[[Any], str]], ...]
_HEAD: Columns = (
    ("effect", lambda r: r.label),
    ("level", lambda r: r.level),
    ("n", lambda r: str(r.n)),
    ("failed", lambda r: str(r.failed or "")),
)
COLUMNS: Columns = (
    *_HEAD,
    ("top-1 %", lambda r: percent(r.first)),
    ("top-2 %", lambda r: percent(r.second)),
    ("missed %", lambda r: percent(r.missed)),
    ("below limit %", lambda r: percent(r.invisible)),
    ("extra %", lambda r: percent(r.extra)),
    ("closed %", lambda r: percent(r.closed)),
    (">= 90 %", lambda r: percent(r.closed_enough)),
    ("3 sigma %", lambda r: percent(r.within)),
)
HEALTHY_COLUMNS: Columns = (
    ("healthy arms", lambda r: r.label),
    ("n", lambda r: str(r.n)),
    ("failed", lambda r: str(r.failed or "")),
    ("false alarms", lambda r: str(r.alarms)),
    ("95 % limits, %", lambda r: f"{100 * r.low:.1f} to {100 * r.high:.1f}"),
)
OUTSIDE_COLUMNS: Columns = (
    *_HEAD,
    ("unexplained %", lambda r: percent(r.unexplained)),
    ("low confidence %", lambda r: percent(r.low_confidence)),
    ("named %", lambda r: percent(r.named)),
    ("not detected %", lambda r: percent(r.unseen)),
    ("gap not in the data %", lambda r: percent(r.absent)),
    ("most frequent finding", lambda r: r.most_often or ""),
)
AIM_COLUMNS: Columns = (
    ("figure", lambda r: r.what),
    ("n", lambda r: str(r.n)),
    ("%", lambda r: "-" if r.value is None else f"{100 * r.value:.1f}"),
    ("aim %", lambda r: f"{100 * r.aim:.0f}"),
    ("reached", lambda r: {True: "yes", False: "no", None: "-"}[r.reached]),
)
