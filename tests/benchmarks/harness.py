"""What a benchmark is: a figure of ours beside that of a named alternative, measured in the same run."""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Parameters
    ----------
    name
        What is measured, and against what.
    ours, alternative
        The two figures in ``unit``; ``alternative`` is ``None`` where there is nothing to compare with.
    ratio
        How many times better ours is (> 1 is better), ``None`` without an alternative.
    unit
        Unit of both figures.
    note
        Conditions and proof that both computed the same.
    low, high
        Smallest and largest ratio of the rounds, where there are several.
    fastest, slowest
        Smallest and largest figure of ours over several runs, where there were several.
    """

    name: str
    ours: float
    alternative: float | None
    ratio: float | None
    unit: str
    note: str = ""
    low: float | None = None
    high: float | None = None
    fastest: float | None = None
    slowest: float | None = None


def best_of(function: Callable[[], object], repeat: int = 3) -> float:
    """Shortest of ``repeat`` wall times of ``function`` (s): the one least disturbed by the machine."""
    times: list[float] = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def ratio_of_medians(ours: Sequence[float], alternative: Sequence[float]) -> tuple[float, float, float]:
    """Compare two figures over several interleaved rounds.

    ``ours``, ``alternative``: figures of the rounds, one each, in the same unit; smaller is better. Returns the ratio
    of the medians (> 1: ours is better), and the smallest and the largest ratio within a round.
    """
    ratios = [theirs / mine for mine, theirs in zip(ours, alternative, strict=True)]
    return statistics.median(alternative) / statistics.median(ours), min(ratios), max(ratios)


def median_of_runs(runs: Sequence[Sequence[Row]]) -> list[Row]:
    """Combine the rows of several runs of the same benchmarks.

    Returns a row for each name of the first run: medians, the range of our figure, and the range of the ratio.
    """
    combined = []
    for first in runs[0]:
        rows = [row for run in runs for row in run if row.name == first.name]
        ours, ratios = [row.ours for row in rows], [row.ratio for row in rows if row.ratio is not None]
        others = [row.alternative for row in rows if row.alternative is not None]
        combined.append(
            replace(
                first,
                ours=statistics.median(ours),
                alternative=statistics.median(others) if others else None,
                ratio=statistics.median(ratios) if ratios else None,
                low=min(ratios, default=None),
                high=max(ratios, default=None),
                fastest=min(ours),
                slowest=max(ours),
            )
        )
    return combined
