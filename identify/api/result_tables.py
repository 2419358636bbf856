"""Tables of results: they print, show themselves in notebooks and convert to pandas."""

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

from armident.configs import ConfigError
from armident.identify.documents.identification import Parameter
from armident.identify.documents.rounding import alike
from armident.identify.effects.effect import Effect

if TYPE_CHECKING:
    import pandas as pd


class Table(Sequence[Mapping[str, Any]]):
    """Rows with named columns that print, show themselves in a notebook and convert to pandas.

    ``rows``: one tuple of values per row, as long as ``columns``; ``title``: heading, may be empty.
    """

    def __init__(self, columns: Sequence[str], rows: Sequence[Sequence[Any]], title: str = "") -> None:
        self.columns = tuple(columns)
        self.rows = [tuple(row) for row in rows]
        self.title = title

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, key: Any) -> Any:
        """Return row ``key`` as a mapping if it is a number, else the column of that name as a list."""
        if isinstance(key, str):
            column = self.columns.index(key)
            return [row[column] for row in self.rows]
        if isinstance(key, slice):
            return [dict(zip(self.columns, row, strict=True)) for row in self.rows[key]]
        return dict(zip(self.columns, self.rows[key], strict=True))

    def to_pandas(self) -> "pd.DataFrame":
        """Return the table as a pandas DataFrame, indexed by its first column.

        Raises ConfigError if pandas is not installed.
        """
        try:
            import pandas
        except ImportError as error:
            raise ConfigError("a table as DataFrame needs the package pandas (pip install pandas)") from error
        return pandas.DataFrame(self.rows, columns=list(self.columns)).set_index(self.columns[0])

    def __str__(self) -> str:
        cells = [self.columns, *map(self._texts, self.rows)]
        widths = [max(len(row[k]) for row in cells) for k in range(len(self.columns))]
        numbers = [any(isinstance(row[k], float) for row in self.rows) for k in range(len(self.columns))]
        lines = [
            "  ".join(
                text.rjust(width) if number else text.ljust(width)
                for text, width, number in zip(row, widths, numbers, strict=True)
            ).rstrip()
            for row in cells
        ]
        return "\n".join([self.title, *lines] if self.title else lines)

    def _texts(self, row: Sequence[Any]) -> Sequence[str]:
        """Return the cells of a row as text; a value has the last digit of its standard deviation."""
        texts = dict(zip(self.columns, map(_text, row), strict=True))
        if {"value", "std"} <= texts.keys():
            values = dict(zip(self.columns, row, strict=True))
            texts["value"], texts["std"] = alike(values["value"], values["std"])
        return tuple(texts.values())

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        head = "".join(f"<th>{escape(name)}</th>" for name in self.columns)
        body = "".join(
            "<tr>" + "".join(f"<td>{escape(text)}</td>" for text in self._texts(row)) + "</tr>" for row in self.rows
        )
        caption = f"<caption>{escape(self.title)}</caption>" if self.title else ""
        return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


class ParameterTable(Table):
    """Estimated base parameters: a table that is also indexed by the name of a parameter.

    ``parameters``: in the order of ``theta``.
    """

    def __init__(self, parameters: Sequence[Parameter], title: str = "") -> None:
        columns = ("name", "value", "std", "relative_std_pct", "unit", "essential", "formula")
        super().__init__(columns, [[getattr(p, column) for column in columns] for p in parameters], title)
        self._by_name = {p.name: p for p in parameters}

    def __getitem__(self, key: Any) -> Any:
        """Return the parameter of that name, else a column or a row as `Table` does."""
        if isinstance(key, str) and key in self._by_name:
            return self._by_name[key]
        if isinstance(key, str) and key not in self.columns:
            known = ", ".join(self._by_name)
            raise KeyError(f"{key!r} is no base parameter and no column; parameters: {known}")
        return super().__getitem__(key)


class EffectTable(Table):
    """The effects of the catalogue: a table that is also indexed by the name of an effect."""

    def __init__(self, found: Mapping[str, Effect]) -> None:
        columns = ("name", "title", "scope", "parameters", "required_motion", "reference")
        rows = [
            (
                effect.name,
                effect.title,
                effect.scope,
                ", ".join(effect.units),
                effect.required_motion,
                effect.reference,
            )
            for effect in found.values()
        ]
        super().__init__(columns, rows)
        self._by_name = dict(found)

    def __getitem__(self, key: Any) -> Any:
        """Return the effect of that name, else a column or a row as `Table` does."""
        if isinstance(key, str) and key in self._by_name:
            return self._by_name[key]
        if isinstance(key, str) and key not in self.columns:
            raise KeyError(f"{key!r} is no effect and no column; effects: {', '.join(self._by_name)}")
        return super().__getitem__(key)

    def effects(self) -> Iterator[Effect]:
        """Iterate over the effects, in the order of the table."""
        return iter(self._by_name.values())


def _text(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)
