"""Data of a reproduced table."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Source = Literal["thesis", "virtual", "measured", "arm"]
"""Origin of a column: thesis, virtual arm, measured arm, or the true parameters of the virtual arm."""


@dataclass(frozen=True)
class Cell:
    """A figure, with its relative standard deviation in percent if it is an estimate; ``None``: absent.

    ``text`` replaces a figure.
    """

    value: float | None
    std_pct: float | None = None
    text: str = ""


@dataclass(frozen=True)
class Column:
    """Figures of one method from one source, by row label."""

    source: Source
    name: str
    cells: Mapping[str, Cell]


@dataclass(frozen=True)
class Table:
    """A table with the columns of the thesis and ours.

    ``labels``: rows, in order; ``columns``: columns of the thesis first; ``notes``: conditions of the comparison, one
    line each.
    """

    number: str
    title: str
    labels: tuple[str, ...]
    columns: tuple[Column, ...]
    notes: tuple[str, ...] = ()
