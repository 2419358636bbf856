"""What an arm is compared with: a file, or the first run of it that the history knows."""

from dataclasses import dataclass
from pathlib import Path

from armident.configs import ConfigError, DataError
from armident.identify.document import IdentificationDocument, load_document, to_json, write_atomically
from armident.identify.monitoring.history import History


@dataclass(frozen=True)
class Baseline:
    """A baseline and how it is called; without ``document`` the run to come is to be it, as ``file`` if given."""

    document: IdentificationDocument | None
    name: str
    file: Path | None = None

    def become(self, document: IdentificationDocument) -> str:
        """Make a run the baseline; what was done, in words."""
        if self.file is None:
            return f"first run of {document.robot}: it is the baseline from now on"
        write_atomically(self.file, to_json(document))
        return f"first run of {document.robot}: it is the baseline from now on, kept as {self.file}"


def baseline_of(file: Path | None, history: History, robot: str, cell: str) -> Baseline:
    """The baseline of the robot in a cell.

    Raises
    ------
    ConfigError
        If ``file`` is missing although the history knows runs of this arm: a name misspelt, and not a first run.
    DataError
        If it is of another robot.
    """
    first = history.first(robot, cell)
    if file is None:
        if first is None:
            return Baseline(None, "none yet")
        return Baseline(first.document, f"first run of {first.recorded:%Y-%m-%d %H:%M} UTC")
    if file.exists():
        document = load_document(file, IdentificationDocument)
        if document.robot != robot:
            raise DataError(f"{file}: the baseline is of robot {document.robot!r}, the arm is {robot!r}")
        return Baseline(document, str(file))
    if first is not None:
        raise ConfigError(
            f"--baseline {file}: no such file, and this is not the first run: the history has one of "
            f"{first.recorded:%Y-%m-%d} UTC; leave --baseline out to compare with that"
        )
    return Baseline(None, "none yet", file)
