"""What a reproduced table is."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Source = Literal["thesis", "virtual", "measured", "arm"]
"""Printed by the thesis; computed from the virtual arm; from a measured one; the virtual arm's own parameters."""


@dataclass(frozen=True)
class Cell:
    """A figure, and its relative standard deviation in percent where it is an estimate; ``None``: not there.

    ``text`` is what a table says in words in place of a figure.
    """

    value: float | None
    std_pct: float | None = None
    text: str = ""


@dataclass(frozen=True)
class Column:
    """Figures of one method from one source, by the label of their row."""

    source: Source
    name: str
    cells: Mapping[str, Cell]


@dataclass(frozen=True)
class Table:
    """A table of the thesis, its columns and ours.

    Parameters
    ----------
    number, title
        The thesis's number; what the table shows.
    labels
        Rows, in order.
    columns
        Columns of the thesis first.
    notes
        What a reader must know to compare them, one line each.
    """

    number: str
    title: str
    labels: tuple[str, ...]
    columns: tuple[Column, ...]
    notes: tuple[str, ...] = ()
