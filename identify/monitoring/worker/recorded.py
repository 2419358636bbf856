"""Recordings of a cell in folders: the files of each capture, whether they are finished, and earlier results."""

import glob
import os
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from armident.configs import ArmidentError, DataError
from armident.daq.recording import Recording, is_recording, join_parts, read_recording
from armident.daq.recording.names import in_order
from armident.daq.recording.reader import unpacked_bytes
from armident.daq.recording.retention import is_being_written
from armident.identify.documents.files import load_document
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.worker.ledger import FoundFiles

MOST_BYTES = 3_500_000_000
"""Largest size of a recording that is read, bytes of its unpacked records: an hour of six axes at 5 kHz (190 bytes a
row), which is identified in less than 4 GB."""

_PART = re.compile(r"(?P<name>.+?)(?:\.\d{4,})?\.mcap", re.DOTALL)
_UNNAMEABLE = re.compile("[\x00-\x1f\x7f\ud800-\udfff]")
"""Letters that ledgers, messages and logs cannot have in a path: bytes that are not UTF-8, and control characters."""


@dataclass(frozen=True)
class Captured:
    """Files of one capture in order; ``name``: without suffix and number of the part."""

    name: str
    paths: tuple[Path, ...]

    @property
    def finished(self) -> bool:
        """True if no capture writes one of the files or has begun another part."""
        if any(map(is_being_written, self.paths)):
            return False
        # A capture begins a part before it ends the one before: parts that are new by now belong to it.
        pattern = f"{glob.escape(self.name)}.*mcap"
        names = {path.name for path in self.paths[0].parent.glob(pattern)}
        return {name for name in names if _PART.fullmatch(name)} <= {path.name for path in self.paths}

    @property
    def stamps(self) -> tuple[str, ...]:
        """Sizes and times of change of the files, to notice a change."""
        return tuple(map(stamp_of, self.paths))

    def found(self, *, any_cell: bool = False) -> FoundFiles:
        """Return the files as the ledger takes them; raises OSError if a file has vanished."""
        made = max(path.stat().st_mtime for path in self.paths)
        return FoundFiles(self.name, self.paths, self.stamps, made, any_cell)

    def parts(self) -> "list[Captured]":
        """Return each file as a capture of its own."""
        return [Captured(path.name.removesuffix(".mcap"), (path,)) for path in self.paths]

    @property
    def nbytes(self) -> int:
        """Size of the unpacked records of its files, bytes; raises OSError if one cannot be read."""
        return sum(map(unpacked_bytes, self.paths))

    def check_size(self) -> None:
        """Raise DataError if the recording is larger than `MOST_BYTES`."""
        size = 0
        with suppress(OSError):
            # Reading it says why.
            size = self.nbytes
        if size > MOST_BYTES:
            raise DataError(
                f"{self.paths[0]}: it unpacks to {size / 1e9:.1f} GB, a worker reads {MOST_BYTES / 1e9:.1f} GB; "
                "let captures begin new files (recording.rotate_minutes), or run armident identify on this one"
            )

    def read(self) -> Recording:
        """Return the recording, joined of its files. Raises ArmidentError if a file cannot be read."""
        return join_parts([read_recording(path) for path in self.paths])


def shown(path: Path) -> str:
    """Return a path for a message, with escapes for letters that it cannot have."""
    return _UNNAMEABLE.sub(lambda letter: repr(letter[0])[1:-1], str(path))


def fault_of_name(path: Path) -> str | None:
    """Return why a file cannot be entered under its name; ``None`` if it can."""
    if _UNNAMEABLE.search(str(path)):
        return "its name is not UTF-8, or has control characters; rename it, or its folder"
    if len(os.fsencode(path.name)) > 230:  # The name of its result is longer, and has at most 255.
        return "its name has more than 230 bytes; rename it"
    return None


def stamp_of(path: Path) -> str:
    """Return size and time of change of a file; an empty text if it has vanished."""
    try:
        found = path.stat()
    except OSError:
        return ""
    return f"{path.name}:{found.st_size}:{found.st_mtime_ns}"


def captured_in(folders: Sequence[Path], robot: str) -> list[Captured]:
    """Captures of a robot in existing folders, without their subfolders, in the order of their names."""
    found: dict[tuple[Path, str], list[Path]] = {}
    for folder in {folder.resolve(): None for folder in folders}:
        for path in folder.glob(f"{robot}-*.mcap") if folder.is_dir() else ():
            match = _PART.fullmatch(path.name)
            if match is not None:
                found.setdefault((folder, match["name"]), []).append(path)
    ordered = sorted(found.items(), key=lambda each: each[0][1])
    return [Captured(name, tuple(sorted(paths, key=in_order))) for (_, name), paths in ordered]


def captured_as(paths: Iterable[Path]) -> list[Captured]:
    """Return the captures of these files, which are parts of one capture or of one event each."""
    found: dict[str, list[Path]] = {}
    for path in paths:
        match = _PART.fullmatch(path.name)
        if match is not None and fault_of_name(path.resolve()) is None and is_recording(path):
            found.setdefault(match["name"], []).append(path.resolve())
    return [Captured(name, tuple(sorted(files, key=in_order))) for name, files in found.items()]


def check_origin(recording: Recording, cell: str | None, robot: str) -> None:
    """Raise DataError if a recording is none of a robot in a cell (``None``: any cell), or is empty."""
    session = None if recording.session is None else recording.session.cell
    found = recording.metadata.get("cell", session)
    where = recording.path or "the stream"
    if recording.robot.name != robot:
        raise DataError(f"{where}: of robot {recording.robot.name}, not {robot}")
    if cell is not None and found != cell:
        raise DataError(f"{where}: of {'no cell' if found is None else f'cell {found}'}, not {cell}")
    if recording.samples.sync.size == 0:
        raise DataError(f"{where}: it holds no samples")


def result_of(sha256: str, folder: Path) -> tuple[Path, IdentificationDocument] | None:
    """Result of a recording in a folder, ``None`` if there is none or it is of another recording."""
    path = folder / "identification.json"
    if not path.is_file():
        return None
    try:
        document = load_document(path, IdentificationDocument)
    except ArmidentError:
        return None
    return (path, document) if document.recording.sha256 == sha256 else None
