"""Reading of bus logs: whole lines and objects are kept, others are counted and named."""

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn

from armident.configs import ConfigError, DataError
from armident.configs.yaml_loader import is_file
from armident.daq.interchange.blf import read_blf
from armident.daq.interchange.log_frames import FrameCollector, LogFrames
from armident.daq.interchange.log_lines import AscLines, CandumpLines, LineKind, LineParser, TrcLines
from armident.daq.interchange.log_tables import BusmasterLines, CsvLines
from armident.daq.interchange.text_files import encoding_of, excerpt

_SHOW_EVERY = 4096
_HEAD = 60
"""Lines that tell the format of a log."""
_LONGEST_LINE = 4096
"""Lines of text logs have some hundred characters; longer ones are no lines of a log."""


_BY_SUFFIX: Mapping[str, type[LineParser]] = {".asc": AscLines, ".trc": TrcLines}
_PARSERS: tuple[type[LineParser], ...] = (CsvLines, BusmasterLines, CandumpLines, AscLines, TrcLines)


def is_text_log(path: Path) -> bool:
    """Return ``True`` if a text file, whatever its suffix, begins like a bus log."""
    try:
        return _parser_of(path) is not None
    except OSError:
        return False


def _parser_of(path: Path) -> type[LineParser] | None:
    """Return the parser that finds a frame, or a heading of its own, in the first lines of a file."""
    with path.open(encoding=encoding_of(path), errors="replace", newline="\n") as file:
        lines = [file.readline(_LONGEST_LINE).strip() for _ in range(_HEAD)]
    for each in _PARSERS:
        parser = each()
        kinds = [parser.parse(line) for line in lines]
        if any(isinstance(kind, tuple) or kind in (LineKind.WITHOUT_TIME, LineKind.HEADING) for kind in kinds):
            return each
    return None


def read_log(path: Path) -> LogFrames:
    """Return the frames of a bus log, by its suffix or contents; DataError if it is no such log or has no frames."""
    if not is_file(path):
        raise ConfigError(f"{path}: no such file")
    frames = FrameCollector()
    suffix = path.suffix.lower()
    try:
        if suffix == ".blf":
            read_blf(path, frames)
            return frames.finish(path, added_up=False)
        parser = (_BY_SUFFIX.get(suffix) or _parser_of(path) or CandumpLines)()
        _read_lines(path, parser, frames)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or 'an error of the file system'}") from error
    frames.notes[:0] = parser.notes
    return frames.finish(path, parser.added_up)


def _read_lines(path: Path, parser: LineParser, frames: FrameCollector) -> None:
    malformed: list[tuple[int, str]] = []
    bad = without_time = number = 0
    line = ""
    kind: object = LineKind.COMMENT
    with path.open(encoding=encoding_of(path), errors="replace", newline="\n") as file, _progress(path) as advance:
        while line := file.readline(_LONGEST_LINE):
            number += 1
            frames.line = number
            kind = parser.parse(line.strip())
            if isinstance(kind, tuple):
                frames.add(*kind)
            elif kind is LineKind.FOREIGN:
                frames.foreign += 1
            elif kind is LineKind.MALFORMED:
                bad += 1
                malformed = malformed or [(number, line)]
            without_time += kind is LineKind.WITHOUT_TIME
            if number % _SHOW_EVERY == 0:
                advance(frames.count)
            last = line
    if number and not last.endswith("\n"):
        bad -= _cut(frames, kind, number)
        malformed = malformed if bad else []
    _check_lines(path, parser, frames, malformed, bad, without_time)


def _cut(frames: FrameCollector, kind: object, number: int) -> int:
    """Leave out the last line if it is cut off; return 1 if it was counted as malformed."""
    if kind is LineKind.MALFORMED:
        frames.skipped += 1
        frames.notes.append(f"the last line ({number}) is cut off and left out")
        return 1
    last = frames.last() if isinstance(kind, tuple) else None
    if last is not None and frames.length_of(last[0]) not in (None, last[1]):
        frames.drop_last()
        frames.skipped += 1
        frames.notes.append(f"the last line ({number}) is cut off and left out")
    return 0


def _check_lines(
    path: Path, parser: LineParser, frames: FrameCollector, malformed: list[tuple[int, str]], bad: int, untimed: int
) -> None:
    version = getattr(parser, "unknown_version", None)
    if version is not None and (bad > frames.count or not frames.count):
        raise DataError(f"{path}: FILEVERSION={excerpt(version)} is not read; versions 1.0 to 2.1 are")
    if untimed > frames.count:
        raise DataError(
            f"{path}: its frames have no times, as candump shows them on the screen; "
            "`candump -l` or `candump -L` writes the format that is read"
        )
    if bad > frames.count + frames.foreign:
        number, line = malformed[0]
        hint = {
            "candump": "; `candump -l` or `candump -L` writes the format that is read",
            "CSV": "; times are in s or the unit of their name, 'time [us]'; data have two hexadecimal digits for each "
            "byte, or are decimal beside a column 'ID (dec)'",
        }.get(parser.name, "")
        raise DataError(f"{path}: not a {parser.name} log: line {number} is {excerpt(line)}{hint}")
    if bad or untimed:
        frames.skipped += bad + untimed
    if bad:
        number, line = malformed[0]
        which = f"line {number} is" if bad == 1 else f"{bad} lines, the first of which is line {number}, are"
        frames.notes.append(f"{which} not a line of a {parser.name} log and left out: {excerpt(line)}")
    if untimed:
        frames.notes.append(f"{untimed} lines without a time left out")


@contextmanager
def _progress(path: Path) -> Iterator[Callable[[int], None]]:
    """Show the number of frames read, on a terminal."""
    columns = SpinnerColumn(), TextColumn("{task.description}: {task.completed:.0f} frames")
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task(path.name, total=None)
        yield lambda done: progress.update(task, completed=done)
