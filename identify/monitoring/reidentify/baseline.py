"""Baseline of an arm: a file, or its first run in the history."""

from dataclasses import dataclass
from pathlib import Path

from armident.configs import ConfigError, DataError
from armident.identify.documents.files import load_document, to_json, write_atomically
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.change.history import History


@dataclass(frozen=True)
class Baseline:
    """Baseline with its name; without ``document`` the next run becomes the baseline, saved as ``file`` if given."""

    document: IdentificationDocument | None
    name: str
    file: Path | None = None

    def become(self, document: IdentificationDocument) -> str:
        """Make a run the baseline and return a message that says so, and whether it is fit to be one."""
        saved = ""
        if self.file is not None:
            write_atomically(self.file, to_json(document))
            saved = f", saved as {self.file}"
        return f"first run of {document.robot}: it is now the baseline{saved}{doubt_of(document)}"


def doubt_of(document: IdentificationDocument) -> str:
    """Words on a baseline whose verdict is doubtful, empty otherwise."""
    if document.verdict != "doubtful":
        return ""
    first = document.reasons[0]
    return (
        f"; its verdict is doubtful: {first.message}. Later runs are compared with it all the same, with standard "
        f"deviations that may be too small. Next: {first.next_step} Then renew it: --baseline FILE"
    )


def baseline_of(file: Path | None, history: History | None, robot: str, cell: str) -> Baseline:
    """Baseline of the robot in a cell: the file, else the first run in the history."""
    first = None if history is None else history.first(robot, cell)
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
