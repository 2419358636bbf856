"""Entry of a run in the history, which may be locked, full or damaged: the run does not depend on it."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from armident.configs import ConfigError
from armident.daq.recording import Recording
from armident.identify.diagnosis.change_test import ParameterChangeTest
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.change.history import History
from armident.identify.monitoring.change.history_schema import wait_and_try
from armident.identify.monitoring.reidentify.record_run import Say

RETRY_S = 60.0
"""Time for which a refused entry is tried again, s."""


def history_or_reason(store: str, needed: bool) -> tuple[History | None, str | None]:
    """Return the history, or ``None`` and the reason; raises ConfigError if it is needed and cannot be opened."""
    try:
        return History(store), None
    except ConfigError as error:
        if needed:
            raise
        return None, str(error)


@dataclass(frozen=True)
class HistoryEntry:
    """A run and its comparison, if there was a baseline, to be entered in the history (SQLAlchemy URL)."""

    store: str
    recording: Recording
    document: IdentificationDocument
    path: Path
    baseline: IdentificationDocument | None = None
    drift: ParameterChangeTest | None = None

    def write(self) -> None:
        """Write the entry unless the history has it; raises ConfigError if the database cannot be written."""
        history = History(self.store)
        facts = History.facts(self.recording)
        history.describe(facts)
        history.add(self.document, History.began(facts, self.document, self.path))
        if self.drift is not None and self.baseline is not None:
            history.judge(self.document, self.baseline, self.drift)


@contextmanager
def recorded_in_history(entry: HistoryEntry, say: Say) -> Iterator[None]:
    """Write an entry after the block, which publishes the results, also if it ends with an error."""
    try:
        yield
    finally:
        if not wait_and_try(entry.write, RETRY_S, say):
            say(f"warning: the history lacks this run; add it with: armident history {entry.path} --database URL")
