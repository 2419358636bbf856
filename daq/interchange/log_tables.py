"""Bus logs with headings: CSV of SavvyCAN, python-can and others, whose columns have names, and logs of BUSMASTER."""

import re
from base64 import b64decode
from decimal import Decimal, InvalidOperation

from armident.daq.interchange.column_units import time_unit
from armident.daq.interchange.csv_files import cells_of, delimiter_of, seconds_of_date
from armident.daq.interchange.log_frames import LATEST_NS, nanoseconds
from armident.daq.interchange.log_lines import MOST_BYTES, FrameLine, LineKind, date_ns, octets_of

_NAMES = {
    "time": ("timestamp", "time", "timestampepoch", "abstime", "t"),
    "id": ("id", "arbitrationid", "canid", "identifier", "messageid", "msgid", "cobid"),
    "length": ("datalength", "len", "length", "dlc"),
    "data": ("data", "databytes", "payload"),
    "bus": ("bus", "channel", "buschannel", "chn"),
    "extended": ("extended", "ide", "isextended", "isextendedid"),
    "remote": ("remote", "rtr", "isremote", "isremoteframe"),
    "error": ("error", "iserror", "iserrorframe"),
    "fd": ("edl", "fd", "fdf", "isfd"),
}
"""Names of columns: their letters and digits, in lower case."""
_BYTE = re.compile(r"(?:d|b|byte|data|databyte)(\d{1,2})")
_UNIT = re.compile(r"[\[(]\s*([^\])]*)[\])]|_(ms|us|ns|s)$", re.IGNORECASE)
_HEX = re.compile(r"(?:0x)?([0-9a-f]{1,8})h?", re.IGNORECASE)
_WORD = re.compile(r"[^\W_]+")
_OF_DAY = re.compile(r"'?(\d{1,2}):(\d\d):(\d\d)(?:[.,](\d+))?")
_YES = frozenset({"1", "true", "yes", "y", "x", "ext"})
_EXPONENTS = {"s": 9, "ms": 6, "us": 3, "ns": 0}
"""Powers of ten from a unit of times to ns."""
_SINCE_1970 = {12: "ms", 15: "us", 18: "ns"}
"""Unit of times since 1970 by the power of ten of their first digit, where no name states it."""
_LARGEST = 20
"""Power of ten above which a number is no time."""


class CsvLines:
    """Lines of a bus log in CSV, with columns for time, identifier and data in any order.

    Times are in the unit of their name; else whole numbers are us if every byte has a column (SavvyCAN), those since
    1970 in the unit of their size, and others s. Identifier and data are hexadecimal, or decimal where the name of the
    first says so (``ID (dec)``); data are Base64 beside a column ``arbitration_id`` (python-can).
    """

    name = "CSV"

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.added_up: bool | None = None
        self._delimiter: str | None = None
        self._columns: dict[str, int] = {}
        self._bytes: list[int] = []
        self._unit = ""
        self._base64 = False
        self._base = 16

    def parse(self, line: str) -> FrameLine | LineKind:
        """Return the frame of a line, or the kind of the line. ``line``: without spaces at its ends."""
        if self._is_heading(line):
            return LineKind.HEADING
        if not line or not self._columns:
            return LineKind.COMMENT
        cells = cells_of(line, self._delimiter)
        if max(self._columns.values()) >= len(cells):
            return LineKind.MALFORMED
        own = {name: cells[column] for name, column in self._columns.items()}
        if any(own.get(flag, "").lower() in _YES for flag in ("extended", "remote", "error", "fd")):
            return LineKind.FOREIGN
        t_ns, found = self._time_ns(own["time"]), _HEX.fullmatch(own["id"])
        length = own.get("length")
        if t_ns is None or found is None or not (length is None or length.isdecimal()):
            return LineKind.MALFORMED
        if self._base == 10 and not found[1].isdecimal():
            return LineKind.MALFORMED
        can_id, count = int(found[1], self._base), None if length is None else int(length[:3])
        if can_id > 0x7FF or (count or 0) > MOST_BYTES:
            return LineKind.FOREIGN
        data = self._data(own.get("data", ""), [cells[k] for k in self._bytes if k < len(cells)], count)
        if data is None or len(data) > MOST_BYTES or count not in (None, len(data)):
            return LineKind.MALFORMED
        return t_ns, can_id, data, own.get("bus", "0")

    def _is_heading(self, line: str) -> bool:
        """Take the columns of a line that names time, identifier and data; return ``True`` for such a line."""
        line = line.lstrip("#% ")
        if not line.lstrip('"')[:1].isalpha():
            return False
        delimiter = delimiter_of(line)
        cells = cells_of(line, delimiter)
        plain = [re.sub(r"[\W_]", "", _UNIT.sub("", cell)).lower() for cell in cells]
        columns = {
            name: plain.index(word)
            for name, words in _NAMES.items()
            if (word := next(filter(plain.__contains__, words), ""))
        }
        numbered = sorted((int(found[1]), k) for k, word in enumerate(plain) if (found := _BYTE.fullmatch(word)))
        if not {"time", "id"} <= columns.keys() or not ("data" in columns or numbered):
            return False
        unit = _UNIT.search(cells[columns["time"]])
        self._delimiter, self._columns, self._bytes = delimiter, columns, [k for _, k in numbered]
        self._unit = time_unit(unit[1] or unit[2]) if unit else ""
        self._base64 = plain[columns["id"]] == "arbitrationid"
        self._base = 10 if re.search(r"\bdec", cells[columns["id"]], re.IGNORECASE) else 16
        return True

    def _time_ns(self, text: str) -> int | None:
        try:
            number = Decimal(text.replace(",", "."))
        except InvalidOperation:
            if found := _OF_DAY.fullmatch(text):
                return nanoseconds(str((int(found[1]) * 60 + int(found[2])) * 60 + int(found[3])), found[4])
            seconds = seconds_of_date(text)
            return None if seconds is None else int(seconds * 1e9)
        if not number.is_finite() or number.adjusted() > _LARGEST:
            return None
        whole_us = self._bytes and text.lstrip("-").isdecimal()
        unit = self._unit or ("us" if whole_us else _SINCE_1970.get(number.adjusted(), "s"))
        t_ns = int(number.scaleb(_EXPONENTS.get(unit, 9)))
        return t_ns if abs(t_ns) < LATEST_NS else None

    def _data(self, text: str, cells: list[str], count: int | None) -> bytes | None:
        try:
            if self._base64 and not self._bytes:
                return b64decode(text, validate=True)
            words = [word.removeprefix("0x") for word in (filter(None, cells) if self._bytes else _WORD.findall(text))]
            if len(words) > 1 or self._base == 10 or self._bytes:
                return octets_of(words, len(words) if count is None else count, self._base)
            return bytes.fromhex("".join(words))
        except ValueError:
            return None


_EVENT = re.compile(r"(\d+):(\d+):(\d+):(\d+)\s+(?:[RT]x\w*)\s+(\S+)\s+(\S+)\s+(\w+)\s+(\d+)\s*(.*)$", re.IGNORECASE)
_START = re.compile(r"\*{3}START DATE AND TIME (\d+):(\d+):(\d+) (\d+):(\d+):(\d+)")
_DAY_NS = 86_400_000_000_000


class BusmasterLines:
    """Lines of a log of BUSMASTER: times of the day, since the start, or since the frame before, to 0.1 ms."""

    name = "BUSMASTER"

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.added_up: bool | None = False
        self._base = 16
        self._mode = ""
        self._start: list[int] = []
        self._now_ns = 0

    def parse(self, line: str) -> FrameLine | LineKind:
        """Return the frame of a line, or the kind of the line. ``line``: without spaces at its ends."""
        if not line or line.startswith("***"):
            self._heading(line)
            return LineKind.HEADING if line.startswith("***BUSMASTER") else LineKind.COMMENT
        found = _EVENT.match(line)
        if found is None:
            return LineKind.MALFORMED
        hour, minute, second, fraction, channel, identifier, kind, length, rest = found.groups()
        t_ns = nanoseconds(str(int(hour[:6]) * 3600 + int(minute[:2]) * 60 + int(second[:2])), fraction)
        if t_ns is None:
            return LineKind.MALFORMED
        t_ns = self._later(t_ns)
        if kind.lower() != "s":
            return LineKind.FOREIGN
        try:
            can_id = int(identifier.removesuffix("h"), self._base)
        except ValueError:
            return LineKind.MALFORMED
        data = octets_of(rest.split(), min(MOST_BYTES, int(length[:3])), self._base)
        if data is None or not 0 <= can_id <= 0x7FF or t_ns >= LATEST_NS:
            return LineKind.MALFORMED
        return t_ns, can_id, data, channel

    def _heading(self, line: str) -> None:
        if start := _START.match(line):
            day, month, year, *clock = (int(part[:4]) for part in start.groups())
            self._start, self._now_ns = [year, month, day, *clock], 0
        elif line in ("***HEX***", "***DEC***"):
            self._base = 16 if line == "***HEX***" else 10
        elif line.endswith(" MODE***"):
            self._mode = line.strip("*").split()[0]
            if self._mode == "RELATIVE":
                self.notes.append("times are those since the frame before (relative mode): added up")

    def _later(self, t_ns: int) -> int:
        """Return the time of a frame, ns, since 1970 if the log has its date."""
        of_day = self._mode == "SYSTEM"
        if self._mode == "RELATIVE":
            t_ns += self._now_ns
        elif of_day and t_ns < self._now_ns - _DAY_NS // 2:
            # Midnight has passed.
            t_ns += -(-(self._now_ns - t_ns) // _DAY_NS) * _DAY_NS
        self._now_ns = t_ns
        start = date_ns([*self._start[:3], 0, 0, 0] if of_day else self._start, None) if self._start else None
        return t_ns + (start or 0)
