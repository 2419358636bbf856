"""Tables in text files: header, quotes, comments, decimal commas, dates, and lines that are damaged."""

import csv
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError
from armident.daq.interchange.column_units import SCALES, plain_unit
from armident.daq.interchange.text_files import encoding_of, excerpt

_COMMENTS = ("#", "%", "//")
_DELIMITERS = (";", "\t", "|", ",")
_MOST_BAD_SHARE = 0.05
"""Share of lines with damaged values above which a file is refused; a single line is always left out."""
_LONGEST_HEAD = 100
"""Lines before the first line of values."""
_TAIL = 50
"""Lines whose last value is compared with that of a last line without an end."""
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?$")
_OTHER_DATE = re.compile(r"\d{1,4}[./-]\d{1,2}[./-]\d{1,4}|\d{1,2}:\d\d:\d\d")
_UNIT = re.compile(
    r"[\[(]?\s*(?:s|sec|ms|us|ns|µs|rad|deg|°|m|mm|n\.?\s?m|nm|a|ma|v|-|rad/s|m/s)\s*[\])]?$", re.IGNORECASE
)

_UNITS_WORD = re.compile(r"(?:units?|einheit(?:en)?)\s*[:=]\s*", re.IGNORECASE)


@dataclass(frozen=True)
class CsvTable:
    """Values (N, columns) of a table in a text file; NaN where a cell is empty, and in the whole row of a damaged line.

    ``header``: ``None`` if there is none. ``units``: from the line below it, or empty. ``lines`` (N,): of each row.
    ``words``: first cell of each column of text.
    """

    header: list[str] | None
    units: list[str]
    values: NDArray[np.float64]
    lines: NDArray[np.int64]
    notes: tuple[str, ...] = ()
    words: Mapping[str, str] = field(default_factory=dict)


@dataclass
class _Head:
    """Beginning of a file: the columns, those of text among them, and the first line of values and its cells."""

    delimiter: str | None
    columns: int
    first: int
    text: frozenset[int] = frozenset()
    header: list[str] | None = None
    units: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    cells: Sequence[str] = ()


def read_csv(path: Path) -> CsvTable:
    """Return the table of a text file; DataError if it is no table of numbers, or too many of its lines are damaged.

    Columns are separated by commas, semicolons, tabs or spaces; decimal commas are read where they are not the
    separator. Lines with another number of columns, or a cell that is no number, are damaged; columns of text are NaN.
    The first column, and those named after time, may hold dates (ISO 8601).
    """
    try:
        encoding = encoding_of(path)
        with path.open(encoding=encoding, errors="replace", newline="") as file:
            head = _head(path, file)
        names = len(head.header or ())
        if head.header is not None and names != head.columns:
            hint = _commas_hint(head.columns, head)
            raise DataError(f"{path}: {names} names in the header, {head.columns} columns of values{hint}")
        return _fast(path, encoding, head) or _slow(path, encoding, head)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or 'an error of the file system'}") from error


def cells_of(line: str, delimiter: str | None) -> list[str]:
    """Return the cells of a line without quotes and spaces around them; delimiter ``None``: spaces."""
    text = line.strip("\r\n\0")
    if delimiter is None:
        words = text.replace('"', "").split()
    elif '"' in text:
        try:
            words = next(csv.reader([text], delimiter=delimiter, skipinitialspace=True), [])
        except csv.Error:
            words = text.split(delimiter)
    else:
        words = text.split(delimiter)
    return [word.strip().strip("'") for word in words]


def seconds_of_date(text: str) -> float | None:
    """Return the seconds since 1970 of a date with time of day (ISO 8601; UTC if it has no zone), or ``None``."""
    text = text.removesuffix(" UTC")
    if len(text) < 10 or text[4:5] != "-":
        return None
    # Python reads six digits of a second; the others are added.
    found = re.fullmatch(r"(.*:\d\d)[.,](\d+)(.*)", text)
    whole, digits, zone = found.groups() if found else (text, "", "")
    try:
        moment = datetime.fromisoformat(whole + zone)
        moment = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
        return moment.timestamp() + (float(f"0.{digits}") if digits else 0.0)
    except (ValueError, OverflowError):
        return None


def _head(path: Path, lines: Iterator[str]) -> _Head:
    """Find the first line of values and the header before it."""
    before: list[tuple[int, str, bool]] = []
    mixed: _Head | None = None
    for number, line in enumerate(lines, start=1):
        text = line.strip().strip("\0")
        if number > _LONGEST_HEAD or len(text) > 1_000_000:
            break
        if not text or text.lower().startswith("sep="):
            continue
        comment = text.startswith(_COMMENTS)
        delimiter = delimiter_of(text)
        cells = cells_of(text, delimiter)
        words = None if comment else _text_columns(cells)
        if (head := _after_words(mixed, cells, words)) is not None:
            return _with_header(head, before[:-1])
        if words is None or words:
            own_names = any(len(cells_of(each, delimiter)) == len(cells) for _, each, _ in before)
            mixed = _Head(delimiter, len(cells), number, words, cells=cells) if words and own_names else None
            before.append((number, _UNITS_WORD.sub("", text.lstrip("#%/ ") if comment else text), comment))
            continue
        return _with_header(_Head(delimiter, len(cells), number), before, ends_empty=not cells[-1])
    raise DataError(f"{path}: no values in it{_no_values(before)}")


def _after_words(line: _Head | None, cells: Sequence[str], words: frozenset[int] | None) -> _Head | None:
    """Return the beginning at a line with words if the next one continues it: ``None`` if it does not.

    Two lines with words have columns of text; a line of numbers alone follows a damaged one.
    """
    if line is None or words is None or len(cells) != line.columns or not words <= line.text:
        return None
    return replace(line, text=words) if all(cells[k][0].isalpha() or cells[k][0] in "[(" for k in words) else None


def _no_values(before: Sequence[tuple[int, str, bool]]) -> str:
    """Return the first line that may be one of values, and the cell of it that is no number, for messages."""
    if not before:
        return ""
    if len(before) == 1:
        return f": only line {before[0][0]}, {excerpt(before[0][1])}"
    number, text, _ = before[1]
    odd = next((cell for cell in cells_of(text, delimiter_of(text)) if cell and _number(cell) is None), text)
    dates = "; dates are read in the form 2026-03-25T10:00:00.5" if _OTHER_DATE.search(text) else ""
    return f": line {number} has {excerpt(odd)}, expected numbers{dates}"


def _with_header(head: _Head, before: Sequence[tuple[int, str, bool]], *, ends_empty: bool = False) -> _Head:
    """Find header and units among the lines before the values: those with as many cells.

    Where the first line ``ends_empty`` and no header names a last column, lines end in a separator.
    """
    lengths = [len(cells_of(text, head.delimiter)) for _, text, _ in before]
    if ends_empty and head.columns > 1 and head.columns not in lengths:
        head.columns -= 1
    widths = head.columns, head.columns + 1  # A header may end with a separator.
    fits = [cells for _, text, _ in before if len(cells := cells_of(text, head.delimiter)) in widths]
    if not fits and before and not before[-1][2]:
        # A header that does not fit the values is named by the caller.
        fits = [cells_of(before[-1][1], head.delimiter)]
    fits = [cells[: head.columns] if not any(cells[head.columns :]) else cells for cells in fits]
    units = [c for c in fits if 2 * sum(map(_is_unit, c)) > sum(map(bool, c))]
    named = [cells for cells in fits if cells not in units]
    if len(named) > 1 and _repeats(named[-1]) and not _repeats(named[-2]):
        # Names of columns differ, units below them do not.
        named.pop()
    if head.columns > 1 or (fits and not before[-1][2]):
        if named:
            head.header = named[-1]
            below = fits[fits.index(named[-1]) + 1 :]
            head.units = next((c for c in (*below, *units[::-1]) if len(c) == head.columns), [])
        elif fits:
            head.header = fits[-1]
    return head


def _is_unit(cell: str) -> bool:
    return bool(_UNIT.match(cell)) or plain_unit(cell) in SCALES


def _repeats(cells: Sequence[str]) -> bool:
    return len(set(cells)) < len(cells)


def delimiter_of(text: str) -> str | None:
    """Return the separator of the cells of a line; ``None``: spaces."""
    return next((each for each in _DELIMITERS if each in text), None)


def _text_columns(cells: Sequence[str]) -> frozenset[int] | None:
    """Return the columns whose cells are no numbers, dates or empty; ``None`` if most of a line is such text."""
    text = frozenset(k for k, cell in enumerate(cells) if cell and _number(cell) is None)
    numbers = sum(1 for cell in cells if cell) - len(text)
    return text if numbers > len(text) else None


def _number(cell: str) -> float | None:
    try:
        return float(cell) if "_" not in cell else None
    except ValueError:
        if _DECIMAL_COMMA.match(cell):
            return float(cell.replace(",", "."))
        return seconds_of_date(cell)


def _fast(path: Path, encoding: str, head: _Head) -> CsvTable | None:
    """Return a table of numbers alone; ``None`` if it holds anything else."""
    try:
        with path.open(encoding=encoding, newline="") as file:
            lines = file.readlines()
        if not lines[-1].endswith(("\n", "\r")) or "\0" in lines[-1]:
            return None
        rows = lines[head.first - 1 :]
        values = np.loadtxt(rows, delimiter=head.delimiter, ndmin=2, comments=None, quotechar='"')
    except (ValueError, IndexError):
        return None
    numbers = np.arange(head.first, head.first + len(rows))
    if len(values) != len(rows):
        numbers = numbers[[bool(row.strip()) for row in rows]]
    if len(values) != len(numbers) or values.shape[1] != head.columns:
        return None
    return CsvTable(head.header, head.units, values, numbers, tuple(head.notes))


@dataclass
class _Bad:
    """Damaged lines: their number, and the first of them."""

    count: int = 0
    first: str = ""

    def add(self, text: str) -> None:
        self.count += 1
        self.first = self.first or text


@dataclass
class _DecimalSigns:
    """Decimal signs of each column: both in one are a sign of thousands, or two tools."""

    clash: str = ""
    _first: dict[tuple[int, str], tuple[int, str]] = field(default_factory=dict)

    def add(self, number: int, cells: Sequence[str]) -> bool:
        """Take the cells of a line; return ``True`` if one has a decimal comma."""
        found = False
        for k, cell in enumerate(cells, start=1):
            sign = "," if _DECIMAL_COMMA.match(cell) else "." if "." in cell and ":" not in cell else ""
            found = found or sign == ","
            if not sign:
                continue
            self._first.setdefault((k, sign), (number, cell))
            other = self._first.get((k, "." if sign == "," else ","))
            if other is not None and not self.clash:
                self.clash = (
                    f"column {k} has {excerpt(other[1])} in line {other[0]} and {excerpt(cell)} in line {number}: "
                    "decimal commas and points; write numbers with one decimal sign, and none for thousands"
                )
        return found


def _slow(path: Path, encoding: str, head: _Head) -> CsvTable:
    """Return the table of a file with empty cells, dates, decimal commas, comments or damaged lines."""
    rows: list[list[float]] = []
    numbers: list[int] = []
    bad = _Bad()
    signs = _DecimalSigns()
    commas = repeated = 0
    worded: set[int] = set()
    cells: list[str] = []
    ends: list[int] = []
    line = ""
    with path.open(encoding=encoding, errors="replace", newline="") as file:
        for number, line in enumerate(file, start=1):
            text = line.strip().strip("\0")
            if number < head.first or not text or text.startswith(_COMMENTS):
                continue
            cells = cells_of(text, head.delimiter)
            if cells == head.header:
                repeated += 1
                continue
            _refuse_other_header(path, number, cells, head)
            row, problem = _row(cells, head)
            if not problem:
                commas += signs.add(number, cells)
            if problem:
                bad.add(f"line {number}{problem}")
                worded.update(k for k, cell in enumerate(cells) if cell[:1].isalpha() and _number(cell) is None)
            rows.append(row)
            numbers.append(number)
            ends = [*ends[-_TAIL:], len(cells[-1])]
    if not rows:
        raise DataError(f"{path}: no values in it")
    notes = list(head.notes)
    damaged = all(map(math.isnan, rows[-1]))
    shorter = ends[-1] < min(ends[:-1], default=0)
    if line and not line.endswith(("\n", "\r")) and len(rows) > 1 and (damaged or shorter):
        if damaged and bad.count:
            bad.count -= 1
        notes.append(f"the last line ({numbers[-1]}) is cut off and left out")
        rows.pop()
        numbers.pop()
    values = np.array(rows, dtype=np.float64)
    if bad.count > max(1, _MOST_BAD_SHARE * len(rows)) or (bad.count and len(rows) == 1):
        of_text = frozenset(k for k in worded if k < head.columns and np.isnan(values[:, k]).all()) - head.text
        if of_text and not np.isnan(values).all():
            return _slow(path, encoding, replace(head, text=head.text | of_text))
        others = f" (and {bad.count - 1} more of {len(rows)} lines)" if bad.count > 1 else ""
        raise DataError(f"{path}: {bad.first}{others}{_commas_hint(len(cells), head)}")
    if bad.count:
        one = f"1 line of {len(rows)} is" if bad.count == 1 else f"{bad.count} of {len(rows)} lines are"
        notes.append(f"{one} damaged and left out{', the first' if bad.count > 1 else ''}: {bad.first}")
    if signs.clash:
        raise DataError(f"{path}: {signs.clash}")
    if commas:
        notes.append(f"decimal commas are read as decimal points ({commas} lines)")
    if repeated:
        notes.append(f"repeated header ignored: {repeated} times")
    words = {head.header[k]: head.cells[k] for k in sorted(head.text) if head.header and k < len(head.cells)}
    return CsvTable(head.header, head.units, values, np.array(numbers), tuple(notes), words)


def _refuse_other_header(path: Path, number: int, cells: Sequence[str], head: _Head) -> None:
    """Refuse a line with the names of the header in another order, or with some of them: its rows are others."""
    names = set(head.header or ())
    if len(names & set(cells)) > max(1, len(names) // 2):
        raise DataError(
            f"{path}: line {number} is another header than that of the file, {excerpt(','.join(cells))} after "
            f"{excerpt(','.join(head.header or ()))}: write one file for each"
        )


def _row(cells: list[str], head: _Head) -> tuple[list[float], str]:
    """Return the values of a line, and the problem with it as the end of a sentence."""
    if len(cells) == head.columns + 1 and not cells[-1]:
        cells = cells[:-1]
    if len(cells) != head.columns:
        return [math.nan] * head.columns, f" has {len(cells)} columns, expected {head.columns}"
    values: list[float] = []
    for k, cell in enumerate(cells, start=1):
        value = _number(cell) if cell and k - 1 not in head.text else math.nan
        if value is None:
            return [math.nan] * head.columns, f", column {k}: expected a number, found {excerpt(cell)}"
        values.append(value)
    return values, ""


def _commas_hint(columns: int, head: _Head) -> str:
    names = len(head.header or ())
    if columns == names + 1 > 2:
        return "; a column without a name, such as an index: name it in the header"
    if head.delimiter == "," and names < columns <= 2 * names:
        return "; decimal commas in a table with commas between columns: write it with semicolons"
    return ""
