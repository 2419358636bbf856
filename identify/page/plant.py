"""The cells of a plant with all that is known of them, read again by threads in the background."""

import logging
import threading
import time
from collections.abc import Callable, Sequence

from armident.configs import ArmidentError
from armident.identify.page.attention import ORDER, CellView
from armident.identify.page.cells import Cell, CellFiles, Drift, read_drift, read_files
from armident.identify.page.live import Listener

log = logging.getLogger(__name__)

FILES_S, SESSIONS_S, HISTORIES_S = 5.0, 5.0, 60.0
"""Intervals at which folders are read, Zenoh sessions are tried again, and histories are read, s."""
LEAVE_S = 20.0
"""Longest wait for a thread at the end, s: a database that hangs is left after 15 s."""


class Plant:
    """Cells with their files, changes and messages; a request reads no disk and waits for no database.

    ``progress`` is called after each round of reading, for a watchdog. ``listens``: False without the messages.
    """

    def __init__(
        self, cells: Sequence[Cell], progress: Callable[[], None] = lambda: None, *, listens: bool = True
    ) -> None:
        self.cells = {cell.name: cell for cell in cells}
        self.listener = Listener(cells)
        self._progress = progress
        self._files: dict[str, CellFiles] = {}
        self._drifts: dict[str, Drift | str | None] = {}
        self._stopped = threading.Event()
        rounds = [(self.read_files, FILES_S), (self.read_histories, HISTORIES_S)]
        rounds += [(self.listener.check, SESSIONS_S)] if listens else []
        self._threads = [threading.Thread(target=self._repeat, args=each, daemon=True) for each in rounds]

    def __enter__(self) -> "Plant":
        """Read the folders once, listen, and begin to read all of it again and again."""
        self.read_files()
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End the threads, and close the Zenoh sessions."""
        self._stopped.set()
        self.listener.close()
        # An interpreter that ends beside a thread in compiled code aborts.
        for thread in self._threads:
            thread.join(LEAVE_S)

    def read_files(self) -> None:
        """Read the folders of all cells."""
        for cell in self.cells.values():
            if self._stopped.is_set():
                return
            try:
                self._files[cell.name] = read_files(cell)
            except Exception as error:
                # One cell must not hide the others.
                log.debug("internal error", exc_info=True)
                problem = {"results": f"{type(error).__name__} while the folders are read"}
                self._files[cell.name] = CellFiles(problem, None, (), (), None)
        self._progress()

    def read_histories(self) -> None:
        """Read the histories of all cells; a database that is silent delays the rest of the round only."""
        for cell in self.cells.values():
            if self._stopped.is_set():
                return
            try:
                self._drifts[cell.name] = read_drift(cell)
            except ArmidentError as error:
                self._drifts[cell.name] = str(error)
            except Exception as error:
                log.debug("internal error", exc_info=True)
                self._drifts[cell.name] = f"{type(error).__name__} while it is read"

    def view(self, name: str) -> CellView:
        """Return a cell with what is known of it now; KeyError if there is none."""
        cell = self.cells[name]
        return CellView(cell, self._files[name], self._drifts.get(name), self.listener.live[name], time.monotonic())

    def views(self) -> list[CellView]:
        """Return all cells, those that need somebody first."""
        return sorted(map(self.view, self.cells), key=lambda view: (ORDER.index(view.level), view.cell.title))

    def _repeat(self, action: Callable[[], None], interval_s: float) -> None:
        while True:
            action()
            if self._stopped.wait(interval_s):
                return
