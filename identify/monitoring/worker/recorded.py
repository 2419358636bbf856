"""Recordings of a cell in folders: the files of each capture, whether they are finished, and earlier results."""

import glob
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from armident.configs import ArmidentError, DataError
from armident.daq.recording import Recording, is_recording, join_parts, read_recording
from armident.daq.recording.retention import is_being_written
from armident.identify.documents.files import load_document
from armident.identify.documents.identification import IdentificationDocument

_PART = re.compile(r"(?P<name>.+?)(?:\.\d{4,})?\.mcap")


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
    def stamp(self) -> str:
        """Sizes and times of change of the files, to notice a change; raises OSError if a file has vanished."""
        stats = [path.stat() for path in self.paths]
        return ";".join(f"{path.name}:{s.st_size}:{s.st_mtime_ns}" for path, s in zip(self.paths, stats, strict=True))

    def read(self) -> Recording:
        """Return the recording, joined of its files. Raises ArmidentError if a file cannot be read."""
        return join_parts([read_recording(path) for path in self.paths])


def captured_in(folders: Sequence[Path], robot: str) -> list[Captured]:
    """Captures of a robot in existing folders, without their subfolders, in the order of their names."""
    found: dict[tuple[Path, str], list[Path]] = {}
    for folder in {folder.resolve(): None for folder in folders}:
        for path in folder.glob(f"{robot}-*.mcap") if folder.is_dir() else ():
            match = _PART.fullmatch(path.name)
            if match is not None and is_recording(path):
                found.setdefault((folder, match["name"]), []).append(path)
    ordered = sorted(found.items(), key=lambda each: each[0][1])
    return [Captured(name, tuple(sorted(paths))) for (_, name), paths in ordered]


def captured_as(paths: Sequence[Path]) -> list[Captured]:
    """Return the captures of these files, which are parts of one capture or of one event each."""
    found: dict[str, list[Path]] = {}
    for path in paths:
        match = _PART.fullmatch(path.name)
        if match is not None and is_recording(path):
            found.setdefault(match["name"], []).append(path.resolve())
    return [Captured(name, tuple(sorted(files))) for name, files in found.items()]


def is_of(recording: Recording, cell: str | None, robot: str) -> bool:
    """True if a recording is of a robot in a cell (``None``: any); raises DataError if it is, and empty."""
    session = None if recording.session is None else recording.session.cell
    found = recording.metadata.get("cell", session)
    if recording.robot.name != robot or (cell is not None and found != cell):
        return False
    if recording.samples.sync.size == 0:
        raise DataError(f"{recording.path}: it holds no samples")
    return True


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
