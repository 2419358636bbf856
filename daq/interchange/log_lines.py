"""Lines of text logs: candump (log and screen format), Vector ASC and PEAK TRC."""

import re
from datetime import UTC, datetime, timedelta
from enum import Enum
from typing import Protocol

from armident.daq.interchange.log_frames import LATEST_NS, nanoseconds

FrameLine = tuple[int, int, bytes, str]
"""Time, ns; identifier; data; name of the bus."""


class LineKind(Enum):
    """Kind of a line without a classic data frame with an 11-bit identifier."""

    COMMENT = "comment, heading or event"
    HEADING = "a heading that only this format has"
    FOREIGN = "another frame"
    MALFORMED = "not a line of this format"
    WITHOUT_TIME = "a frame without a time"


class LineParser(Protocol):
    """Parser of the lines of one format; it keeps what headings say."""

    name: str
    notes: list[str]
    added_up: bool | None

    def parse(self, line: str) -> FrameLine | LineKind:
        """Return the frame of a line, or the kind of the line."""
        ...


_DIGITS = r"(-?\d+)(?:\.(\d+))?"
_DATE = r"(\d{4})-(\d\d)-(\d\d)[ T](\d\d):(\d\d):(\d\d)(?:\.(\d+))?"
_STAMP = re.compile(_DIGITS + "$")
_STAMP_WITH_DATE = re.compile(_DATE + "$")
_LOG_LINE = re.compile(r"\(([^()]*)\)\s+(\S+)\s+([0-9A-Fa-f]+)(##?)(\S*)(?:\s+[RTrt])?\s*$")
_SCREEN_LINE = re.compile(
    r"(?:\(([^()]*)\)\s+)?(\S+)\s+(?:[RT]X\s+[-B]\s+[-E]\s+)?([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})"
    r"\s+(?:\[(\d{1,2})\]|\{([0-9A-Fa-f])\})\s*(.*)$"
)
MOST_BYTES = 8


def _stamp(text: str) -> int | None:
    """Return the time of candump in ns: seconds, or date and time of day (``-tA``) in the zone of this computer."""
    if found := _STAMP.match(text.strip()):
        return nanoseconds(found[1], found[2])
    if found := _STAMP_WITH_DATE.match(text.strip()):
        return date_ns([int(part) for part in found.groups()[:6]], found[7])
    return None


def date_ns(parts: list[int], fraction: str | None) -> int | None:
    """Return year, month, day, hour, minute and second in this computer's zone in ns; ``None`` if they are no date."""
    try:
        year, month, day, hour, minute, second = parts
        seconds = int(datetime(year, month, day, hour, minute, second).timestamp())
    except (ValueError, OverflowError, OSError):
        return None
    return nanoseconds(str(seconds), fraction) if seconds >= 0 else None


def octets_of(words: list[str], count: int, base: int = 16) -> bytes | None:
    """Return the first ``count`` data bytes; ``None`` if there are fewer, or one is no byte."""
    if len(words) < count:
        return None
    try:
        values = [int(word, base) for word in words[:count]]
    except ValueError:
        return None
    complete = all(len(word) == 2 for word in words[:count]) if base == 16 else True
    return bytes(values) if complete and all(0 <= value < 256 for value in values) else None


class CandumpLines:
    """Lines of ``candump -l`` and ``-L``, and those that candump shows on the screen."""

    name = "candump"

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.added_up: bool | None = None

    def parse(self, line: str) -> FrameLine | LineKind:
        """Return the frame of a line, or the kind of the line. ``line``: without spaces at its ends."""
        if not line or line[0] in "#;/":
            return LineKind.COMMENT
        if found := _LOG_LINE.match(line):
            time, channel, identifier, mark, digits = found.groups()
            return self._frame(time, channel, identifier, mark == "##", self._log_data(digits))
        if found := _SCREEN_LINE.match(line):
            time, channel, identifier, length, _, rest = found.groups()
            fd = length is not None and len(length) == 2
            count = min(MOST_BYTES, int(length)) if length is not None else MOST_BYTES
            data: bytes | LineKind | None = octets_of(rest.split(), count)
            if rest.startswith("remote"):
                data = LineKind.FOREIGN
            return self._frame(time, channel, identifier, fd, data)
        return LineKind.MALFORMED

    @staticmethod
    def _log_data(digits: str) -> bytes | LineKind | None:
        if digits[:1] in ("R", "r"):
            return LineKind.FOREIGN
        data, underscore, raw = digits.partition("_")
        # A classic frame with a DLC of 9 to 15 has eight bytes (ISO 11898-1); candump adds this DLC.
        if underscore and not (len(data) == 2 * MOST_BYTES and re.fullmatch("[9A-Fa-f]", raw)):
            return None
        try:
            octets = bytes.fromhex(data.replace(".", ""))
        except ValueError:
            return None
        return octets if len(octets) <= MOST_BYTES else None

    @staticmethod
    def _frame(
        time: str | None, channel: str, identifier: str, fd: bool, data: bytes | LineKind | None
    ) -> FrameLine | LineKind:
        if time is None:
            return LineKind.WITHOUT_TIME
        t_ns = _stamp(time)
        if t_ns is None or len(identifier) not in (3, 8):
            return LineKind.MALFORMED
        if fd or len(identifier) == 8 or data is LineKind.FOREIGN:
            return LineKind.FOREIGN
        if not isinstance(data, bytes) or int(identifier, 16) > 0x7FF:
            return LineKind.MALFORMED
        return t_ns, int(identifier, 16), data, channel


_MONTHS = {
    name: number
    for number, names in enumerate(
        (
            "jan janv ene gen", "feb fév fev", "mar mär mrz", "apr avr abr", "may mai mag maj", "jun juin giu",
            "jul juil lug", "aug aoû aou ago", "sep set", "oct okt ott out", "nov", "dec dez déc dic",
        ),
        start=1,
    )
    for name in names.split()
}  # fmt: skip
"""Beginnings of the names of months: English, German, French, Spanish, Italian, Portuguese."""
_ASC_EVENT = re.compile(r"(-?\d+)(?:[.,](\d+))?\s+(\S+)\s*(.*)$")
_ASC_CLOCK = re.compile(r"(\d{1,2}):(\d\d):(\d\d)(?:[.,:](\d+))?(?:\s*([ap])\.?m\.?\b)?", re.IGNORECASE)
_EDL, _RTR = 0x1000, 0x10
"""Flags of frames of a CAN FD channel: extended data length, which classic frames lack, and remote frame."""
_ASC_BASE = re.compile(r"base\s+(hex|dec)(?:\s+timestamps\s+(absolute|relative))?", re.IGNORECASE)


def _month(word: str) -> int | None:
    word = word.strip(".,").lower()
    return next((_MONTHS[word[:size]] for size in (4, 3) if word[:size] in _MONTHS), None)


def asc_date_ns(text: str) -> int | None:
    """Return the time of a date line of an ASC log, ns, in this computer's zone, any language; ``None`` if unknown."""
    clock = _ASC_CLOCK.search(text)
    if clock is None:
        return None
    words = re.split(r"[\s./,-]+", text[: clock.start()] + " " + text[clock.end() :])
    year = next((int(word) for word in words if re.fullmatch(r"(19|20)\d\d", word)), None)
    numbers = [int(word) for word in words if re.fullmatch(r"\d{1,2}", word)]
    # The name of the day comes before that of the month, and may look like one (Mar: martes, martedi).
    month = next((number for word in reversed(words) if (number := _month(word)) is not None), None)
    day = numbers[0] if numbers else None
    if month is None and len(numbers) > 1:
        # Day before month, but for the order of ISO 8601, and where only the first number can be a month.
        year_first = re.match(r"\D*(19|20)\d\d\D", text) is not None
        day, month = (numbers[1], numbers[0]) if year_first or numbers[1] > 12 else (numbers[0], numbers[1])
    if year is None or month is None or day is None:
        return None
    hour = int(clock[1])
    if clock[5]:
        hour = hour % 12 + (12 if clock[5].lower() == "p" else 0)
    return date_ns([year, month, day, hour, int(clock[2]), int(clock[3])], clock[4])


class AscLines:
    """Lines of a Vector ASC log. Its times are those since its start, or since the event before."""

    name = "Vector ASC"

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.added_up: bool | None = False
        self._base, self._relative = 16, False
        self._start_ns, self._now_ns = 0, 0
        self._trigger = False

    def parse(self, line: str) -> FrameLine | LineKind:
        """Return the frame of a line, or the kind of the line. ``line``: without spaces at its ends."""
        found = _ASC_EVENT.match(line)
        if found is None:
            return self._heading(line)
        seconds, fraction, what, rest = found.groups()
        # Times before the trigger are negative, and those since an event of another bus.
        t_ns = nanoseconds(seconds, fraction)
        if t_ns is None:
            return LineKind.MALFORMED
        if self._relative:
            self._now_ns = t_ns = max(0, min(self._now_ns + t_ns, LATEST_NS - self._start_ns))
        if what.upper() == "CANFD":
            return self._of_fd_channel(self._start_ns + t_ns, rest.split())
        return self._frame(self._start_ns + t_ns, what, rest) if what.isdecimal() else LineKind.COMMENT

    def _heading(self, line: str) -> LineKind:
        words = line.lower()
        if base := _ASC_BASE.match(line):
            self._base = 16 if base[1].lower() == "hex" else 10
            self._relative = (base[2] or "").lower() == "relative"
            if self._relative:
                self.notes.append("times are those since the event before (timestamps relative): added up")
            return LineKind.COMMENT
        trigger = words.startswith("begin trigger")
        if words.startswith("date") or trigger:
            if self._trigger:
                return LineKind.COMMENT
            start = asc_date_ns(line)
            if start is not None:
                self._start_ns = start
            elif trigger and not self._start_ns:
                self.notes.append("unknown date format: times begin at zero")
            self._trigger = trigger
            return LineKind.COMMENT
        known = ("//", "internal events", "no internal events", "end trigger", "previous log", "", ";")
        return (
            LineKind.COMMENT if any(words == k if not k else words.startswith(k) for k in known) else LineKind.MALFORMED
        )

    def _frame(self, t_ns: int, channel: str, rest: str) -> FrameLine | LineKind:
        words = rest.split()
        if not words:
            return LineKind.MALFORMED
        if words[0].lower().startswith("errorframe"):
            return LineKind.FOREIGN
        if words[0].endswith(":"):
            return LineKind.COMMENT
        if len(words) < 4 or words[1].lower() not in ("rx", "tx", "txrq"):
            return LineKind.MALFORMED
        extended = words[0][-1] in "xX"
        try:
            can_id = int(words[0][:-1] if extended else words[0], self._base)
            length = int(words[3], 16)
        except ValueError:
            return LineKind.FOREIGN if words[2].lower() == "r" and not extended else LineKind.MALFORMED
        if extended or words[2].lower() == "r":
            return LineKind.FOREIGN
        data = octets_of(words[4:], min(MOST_BYTES, length), self._base)
        if data is None or words[2].lower() != "d" or not 0 <= can_id <= 0x7FF:
            return LineKind.MALFORMED
        return t_ns, can_id, data, str(int(channel[:9]) - 1)

    def _of_fd_channel(self, t_ns: int, words: list[str]) -> FrameLine | LineKind:
        """Return a classic frame of a CAN FD channel, or the kind of another line.

        Words: channel, direction, identifier, perhaps a name, BRS, ESI, DLC, length, data, duration, bits and flags.
        """
        if len(words) > 3 and not words[3].isdecimal():
            del words[3]
        try:
            channel, identifier, length = int(words[0][:9]) - 1, words[2], int(words[6][:2])
            flags, can_id = int(words[9 + length], 16), int(identifier, self._base)
            dlc = int(words[5], 16)
        except (ValueError, IndexError):
            return LineKind.FOREIGN
        data = octets_of(words[7:], length, self._base)
        if flags & (_EDL | _RTR) or can_id > 0x7FF or data is None or length != min(MOST_BYTES, dlc):
            return LineKind.FOREIGN
        return t_ns, can_id, data, str(channel)


_TRC_1 = re.compile(
    r"\d+\)\s+" + _DIGITS + r"\s+(?:(\d{1,2})\s+)?(?:([A-Z][a-z]+)\s+)?([0-9A-Fa-f]{8}|[0-9A-Fa-f]{4})"
    r"\s+(?:-\s+)?(\d{1,2})(?:\s+(.*))?$"
)
_TRC_EVENT = re.compile(r"\d+\)\s+" + _DIGITS + r"\s+(?:\d{1,2}\s+)?(Warng|Error|Event)\b")
_TRC_ORIGIN = datetime(1899, 12, 30, tzinfo=UTC)
"""Day zero of the start time of a TRC log."""
_TRC_VERSIONS = ("1.0", "1.1", "1.2", "1.3", "2.0", "2.1")


class TrcLines:
    """Lines of a PEAK TRC log, versions 1.0 to 2.1. Its times are milliseconds since its start."""

    name = "PEAK TRC"

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.added_up: bool | None = False
        self.unknown_version: str | None = None
        self._start_ns = 0
        self._columns: list[str] = []

    def parse(self, line: str) -> FrameLine | LineKind:
        """Return the frame of a line, or the kind of the line. ``line``: without spaces at its ends."""
        if not line:
            return LineKind.COMMENT
        if line.startswith(";"):
            self._heading(line)
            return LineKind.COMMENT
        if self._columns:
            return self._by_columns(line)
        if _TRC_EVENT.match(line):
            return LineKind.COMMENT
        found = _TRC_1.match(line)
        if found is None:
            return LineKind.MALFORMED
        whole, fraction, bus, kind, identifier, length, data = found.groups()
        if kind not in (None, "Rx", "Tx"):
            return LineKind.COMMENT
        return self._frame(whole, fraction, bus or "1", identifier, length, data or "")

    def _heading(self, line: str) -> None:
        key, _, value = line[1:].partition("=")
        key, value = key.strip().upper(), value.strip()
        if key == "$FILEVERSION":
            self.unknown_version = None if value in _TRC_VERSIONS else value
            if value.startswith("2."):
                self._columns = ["N", "O", "T", "I", "d", "l", "D"]
        elif key == "$COLUMNS":
            self._columns = [column.strip() for column in value.split(",")]
        elif key == "$STARTTIME":
            try:
                start = _TRC_ORIGIN + timedelta(days=float(value))
                self._start_ns = max(0, int(start.timestamp() * 1000)) * 1_000_000
            except (ValueError, OverflowError):
                self.notes.append("invalid start time: times begin at zero")

    def _by_columns(self, line: str) -> FrameLine | LineKind:
        words = line.split(None, len(self._columns) - 1)
        column = dict(zip(self._columns, words, strict=False))
        kind = column.get("T", "DT")
        if kind in ("FD", "FB", "FE", "BI", "RR"):
            return LineKind.FOREIGN
        if kind in ("ST", "EC", "ER", "EV"):
            return LineKind.COMMENT
        time = _STAMP.match(column.get("O", ""))
        length = column.get("l", column.get("L", ""))
        identifier = column.get("I", "")
        if kind != "DT" or time is None or not length.isdecimal() or not re.fullmatch("[0-9A-Fa-f]{4,8}", identifier):
            return LineKind.MALFORMED
        return self._frame(time[1], time[2], column.get("B", "1"), identifier, length, column.get("D", ""))

    def _frame(
        self, whole: str, fraction: str | None, bus: str, identifier: str, length: str, data: str
    ) -> FrameLine | LineKind:
        if len(identifier) > 4 or data.startswith("RTR"):
            return LineKind.FOREIGN
        octets = octets_of(data.split(), min(MOST_BYTES, int(length[:3])))
        t_ns = nanoseconds(whole, fraction)
        if octets is None or t_ns is None or int(identifier, 16) > 0x7FF:
            return LineKind.MALFORMED
        return self._start_ns + t_ns // 1000, int(identifier, 16), octets, bus
