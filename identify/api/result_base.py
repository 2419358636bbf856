"""Base class of the results of public functions."""

from abc import ABC, abstractmethod
from html import escape
from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import BaseModel

from armident.identify.api.result_tables import Table
from armident.identify.documents.files import to_json, write_atomically
from armident.identify.documents.signing import write_document


class Result(ABC):
    """Result that prints itself, shows itself in a notebook, and writes its document and its report.

    Parameters
    ----------
    document
        Everything that the JSON file holds.
    """

    document: BaseModel
    file: ClassVar[str]
    """Name of the JSON file."""

    def to_dict(self) -> dict[str, Any]:
        """Return the document as JSON types."""
        return self.document.model_dump(mode="json", by_alias=True)

    def to_json(self) -> str:
        """Return the document as JSON text, as the command line prints it with ``--json``."""
        return to_json(self.document)

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

    def save(self, folder: str | Path) -> tuple[Path, ...]:
        """Write the document, ``report.html``, and ``torques.csv`` of a prediction or ``model.yaml`` of a diagnosis.

        Parameters
        ----------
        folder
            Folder of the files; made if it does not exist.

        Returns
        -------
        tuple of Path
            The document, the report, and the third file if there is one: a model that has new effects, or torques.
        """
        document = Path(folder) / self.file
        result, further = self._for_folder(Path(folder))
        for file, text in further.items():
            write_atomically(file, text)
        write_document(document, result.document)
        return document, result.report(Path(folder) / "report.html"), *further

    def __repr__(self) -> str:
        table = self._table()
        return self._summary() if table is None else f"{self._summary()}\n{table}"

    def _repr_html_(self) -> str:
        table = self._table()
        return f"<p>{escape(self._summary())}</p>{'' if table is None else table._repr_html_()}"

    def _for_folder(self, folder: Path) -> tuple[Self, dict[Path, str]]:
        """Return the result as a folder shall hold it, and its further files with their text."""
        return self, {}

    @abstractmethod
    def _html(self) -> str:
        """Return the report."""

    @abstractmethod
    def _summary(self) -> str:
        """Return one line of text."""

    def _table(self) -> Table | None:
        """Return the table below the line, if there is one."""
        return None
