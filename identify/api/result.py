"""Base class of the results of public functions."""

from abc import ABC, abstractmethod
from html import escape
from pathlib import Path

from armident.identify.documents.files import write_atomically
from armident.identify.tables import Table


class Result(ABC):
    """Result that prints itself, shows itself in a notebook and writes a report."""

    def report(self, path: str | Path) -> Path:
        """Write the report, one HTML file that needs nothing else.

        Parameters
        ----------
        path
            The file to write; its folder is made.

        Returns
        -------
        Path
            The file.
        """
        file = Path(path)
        write_atomically(file, self._html())
        return file

    def __repr__(self) -> str:
        table = self._table()
        return self._summary() if table is None else f"{self._summary()}\n{table}"

    def _repr_html_(self) -> str:
        table = self._table()
        return f"<p>{escape(self._summary())}</p>{'' if table is None else table._repr_html_()}"

    @abstractmethod
    def _html(self) -> str:
        """Return the report."""

    @abstractmethod
    def _summary(self) -> str:
        """Return one line of text."""

    @abstractmethod
    def _table(self) -> Table | None:
        """Return the table below the line, if there is one."""
