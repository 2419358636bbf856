"""Recordings that enter the ledger of a worker: files in folders, announced files, and streams without a file."""

import logging
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from armident.configs import ArmidentError, DataError
from armident.configs.reasons import reason_of
from armident.daq.recording import Recording
from armident.identify.monitoring.worker.ledger import Ledger
from armident.identify.monitoring.worker.recorded import Captured, captured_as, is_of, result_of
from armident.identify.monitoring.worker.stream_buffer import Assembly, StreamBuffer, drop_oldest

log = logging.getLogger(__name__)


class Intake:
    """Enters recordings that have ended in the ledger, each once; ``refused`` takes streams that cannot be used."""

    def __init__(
        self,
        cell: str,
        robot: str,
        folder_of: Callable[[str], Path],
        buffer: StreamBuffer,
        lock: threading.Lock,
        refused: Callable[[str, str, int], None],
    ) -> None:
        self._cell, self._robot, self._folder_of = cell, robot, folder_of
        self._buffer, self._lock, self._refused = buffer, lock, refused
        self._known: dict[Path, str] = {}
        self.streams: dict[str, Recording] = {}
        """Streams without a file that wait for their identification, by the hash of the recording."""

    def take_stream(self, ledger: Ledger, assembly: Assembly) -> None:
        """Enter the files of a capture that has ended; without them the stream itself."""
        found = captured_as(assembly.files)
        if any(not captured.finished for captured in found):
            with self._lock:
                self._buffer.keep(assembly)
                self._buffer.refuse("early", f"capture {assembly.capture}: its file is being written, its end is not")
            return
        try:
            streamed = None
            if not found or (assembly.complete and not assembly.too_long and not assembly.triggered):
                streamed = assembly.recording()
                if not found and not is_of(streamed, None, self._robot):
                    raise DataError(f"capture {assembly.capture}: of robot {streamed.robot.name}, not {self._robot}")
        except DataError as error:
            if not found:
                self._refuse(assembly, error)
                return
            log.warning("%s", error)
        if found:
            self.add_files(ledger, found, None if streamed is None else streamed.sha256, announced=True)
        elif streamed is not None:
            digest = streamed.sha256
            self.streams[digest] = streamed
            drop_oldest(self.streams)
            name = assembly.capture if streamed.path is None else streamed.path.name.removesuffix(".mcap")
            ledger.add(digest, name, ())

    def add_files(
        self, ledger: Ledger, found: Sequence[Captured], streamed: str | None = None, *, announced: bool = False
    ) -> None:
        """Enter finished recordings of this cell that the ledger does not know; ``streamed``: hash of their stream."""
        for captured in found:
            try:
                stamp = captured.stamp
            except OSError:
                continue
            first = captured.paths[0]
            if (self._known.get(first) == stamp and not announced) or not captured.finished:
                continue
            known = ledger.file_hash(first, stamp)
            if announced and known == (None,):
                known = None
            try:
                digest = known[0] if known else self._read_and_enter(ledger, captured, announced)
            except OSError as error:
                # Other recordings are not held up; this one is tried again.
                with self._lock:
                    self._buffer.refuse("files", f"{first}: cannot be read: {reason_of(error)}; trying again")
                continue
            self._known[first] = stamp
            if known is None:
                ledger.enter_file(first, stamp, digest)
            if streamed is not None and digest is not None and streamed != digest:
                log.warning("%s: the stream has other samples than the file, which counts", first)

    def _read_and_enter(self, ledger: Ledger, captured: Captured, announced: bool) -> str | None:
        """Return the hash of a recording after entering it; ``None`` if it is not one of this cell."""
        try:
            recording = captured.read()
            if not is_of(recording, None if announced else self._cell, self._robot):
                return None
        except ArmidentError as error:
            log.warning("%s", error)
            return None
        except OSError:
            raise
        except Exception as error:
            log.warning("%s: internal error (%s); it is not identified", captured.paths[0], type(error).__name__)
            log.debug("internal error", exc_info=True)
            return None
        digest = recording.sha256
        found = result_of(digest, self._folder_of(captured.name))
        if found is not None and ledger.entry(digest) is None:
            ledger.adopt(digest, captured.name, captured.paths, found[0], found[1].verdict or "")
        elif ledger.add(digest, captured.name, captured.paths):
            log.debug("found %s", captured.name)
        return digest

    def _refuse(self, assembly: Assembly, error: DataError) -> None:
        paths = [str(path) for path in (assembly.end or {}).get("paths", ())]
        where = f"its file {paths[0]} is not here" if paths else "it was not written to a file"
        message = f"{error}, and {where}"
        log.error("%s", message)
        self._refused(assembly.capture, message, error.exit_code)
