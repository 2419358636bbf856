"""Log output of the commands: a line per record on stderr; the logger ``armident`` by itself has none."""

import contextlib
import logging
import sys
from collections.abc import Iterator

LOGGER = logging.getLogger("armident")


class LineFormatter(logging.Formatter):
    """Formats a record as its message, and from WARNING on with its level in front: ``warning: the disk is slow``."""

    def __init__(self, program: str | None = None) -> None:
        super().__init__()
        self._program = "" if program is None else f"{program}: "

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of a record."""
        text = super().format(record)
        if record.levelno < logging.WARNING:
            return text
        return f"{self._program}{record.levelname.lower()}: {text}"


class StderrHandler(logging.Handler):
    """Writes records as lines to the present ``sys.stderr``. ``program``: name in front of warnings and errors."""

    def __init__(self, program: str | None = None) -> None:
        super().__init__()
        self.setFormatter(LineFormatter(program))

    def emit(self, record: logging.LogRecord) -> None:
        """Write one record."""
        try:
            print(self.format(record), file=sys.stderr, flush=True)
        except Exception:
            self.handleError(record)


@contextlib.contextmanager
def log_to(handler: logging.Handler, level: int | None = None) -> Iterator[None]:
    """Send armident's records to a handler while the block runs; ``level``: default is the one set, else INFO."""
    replaced = [other for other in LOGGER.handlers if isinstance(other, StderrHandler)]
    level_before = LOGGER.level
    for other in replaced:
        LOGGER.removeHandler(other)
    LOGGER.addHandler(handler)
    LOGGER.setLevel(level or level_before or logging.INFO)
    try:
        yield
    finally:
        LOGGER.setLevel(level_before)
        LOGGER.removeHandler(handler)
        handler.close()
        for other in replaced:
            LOGGER.addHandler(other)
