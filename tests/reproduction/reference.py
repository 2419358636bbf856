"""Published figures of the thesis."""

from functools import cache
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from armident.configs.loading import parse
from armident.configs.schema.base import FrozenModel
from tests.reproduction.tables import Cell, Column

FILE = Path(__file__).with_name("thesis_tables.yaml")
"""File with the published tables."""

REFERENCE = "B.4"
"""Table of the essential parameters, which all other tables list."""


class ReferenceTable(FrozenModel):
    """One table: estimates (value and relative standard deviation in percent per column), figures, or text."""

    title: str
    columns: tuple[str, ...]
    estimates: dict[str, tuple[float, ...]] = Field(default_factory=dict)
    figures: dict[str, tuple[float | None, ...]] = Field(default_factory=dict)
    words: dict[str, tuple[str, ...]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _rows_fit(self) -> Self:
        for label, row in self.estimates.items():
            if len(row) != 2 * len(self.columns):
                raise ValueError(f"{label}: expected a value and a percentage for each of {len(self.columns)} columns")
        for label, figures in self.figures.items():
            if len(figures) != len(self.columns):
                raise ValueError(f"{label}: expected {len(self.columns)} figures")
        for label, words in self.words.items():
            if len(words) != len(self.columns):
                raise ValueError(f"{label}: expected words for {len(self.columns)} columns")
        return self

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the rows."""
        return (*self.estimates, *self.figures, *self.words)

    def printed(self) -> tuple[Column, ...]:
        """Return the columns as published."""
        columns = []
        for k, name in enumerate(self.columns):
            cells = {label: Cell(row[2 * k], row[2 * k + 1]) for label, row in self.estimates.items()}
            cells |= {label: Cell(row[k]) for label, row in self.figures.items()}
            cells |= {label: Cell(None, text=row[k]) for label, row in self.words.items()}
            columns.append(Column("thesis", name, cells))
        return tuple(columns)


class ReferenceTables(FrozenModel):
    """All published tables by number."""

    schema_: Literal["armident/reference/1"] = Field(alias="schema")
    tables: dict[str, ReferenceTable]


@cache
def reference_tables() -> dict[str, ReferenceTable]:
    """Return the published tables by number, in the order of the thesis."""
    return parse(FILE.read_text(encoding="utf-8"), ReferenceTables, str(FILE)).tables


def essential_names() -> tuple[str, ...]:
    """Return the 28 essential base parameters of the TX40 (table B.4)."""
    return tuple(reference_tables()[REFERENCE].estimates)
