"""What a benchmark is: a figure of ours beside that of a named alternative, measured in the same run."""

import time
from collections.abc import Callable
from dataclasses import dataclass


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
    """

    name: str
    ours: float
    alternative: float | None
    ratio: float | None
    unit: str
    note: str = ""


def best_of(function: Callable[[], object], repeat: int = 3) -> float:
    """Shortest of ``repeat`` wall times of ``function`` (s): the one least disturbed by the machine."""
    times: list[float] = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)
