"""Text of an electronic data sheet (EDS, CiA 306): encoding, sections and key words of the tools of many makers."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from armident.configs import ConfigError

LARGEST_FILE = 16 << 20
"""Largest size of an EDS in bytes; those of servo drives have about 0.1 to 1 MB."""

_QUOTED = 40
"""Maximum number of characters of a line that a message quotes."""

_SHOWN = 3
"""Number of places that a remark lists."""

_OBJECT_KEYS = (
    "ParameterName ObjectType DataType AccessType DefaultValue ParameterValue PDOMapping LowLimit HighLimit SubNumber "
    "CompactSubObj StorageLocation Factor Description Unit NrOfEntries"
)
_DEVICE_KEYS = (
    "VendorName VendorNumber ProductName ProductNumber RevisionNumber OrderCode SimpleBootUpMaster SimpleBootUpSlave "
    "Granularity DynamicChannelsSupported GroupMessaging NrOfRXPDO NrOfTXPDO LSS_Supported"
)
_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)
KEYS = {
    word.lower(): word
    for word in (
        *_OBJECT_KEYS.split(),
        *_DEVICE_KEYS.split(),
        *(f"BaudRate_{rate}" for rate in _RATES),
        *(f"Dummy{k:04d}" for k in range(1, 8)),
    )
}
"""Key words that are read, by their lower-case form."""

_OBJECT = re.compile(r"(?:0x)?([0-9a-f]{1,4})h?(?:sub(?:0x)?([0-9a-f]{1,2})h?|(name|value))?", re.IGNORECASE)

Section = dict[str, str]


@dataclass
class Remarks:
    """Deviations of a file from CiA 306, by kind. ``places``: places of each kind, in the order of the file."""

    places: dict[str, list[str]] = field(default_factory=dict)

    def add(self, kind: str, place: str) -> None:
        """Note a deviation: ``kind`` says what was found and done, ``place`` is line, section or object."""
        self.places.setdefault(kind, []).append(place)

    def lines(self) -> tuple[str, ...]:
        """Return one line per kind, with the first places and the number of the others."""
        return tuple(f"{kind}: {_listed(places)}" for kind, places in self.places.items())


def _listed(places: list[str]) -> str:
    more = len(places) - _SHOWN
    return ", ".join(places[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


def read_text(file: Path) -> str:
    """Return the text of a file in UTF-8, UTF-16 with byte order mark, or Windows-1252; ConfigError if it is binary."""
    try:
        with file.open("rb") as opened:
            content = opened.read(LARGEST_FILE + 1)
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror or 'input error'}") from error
    if len(content) > LARGEST_FILE:
        raise ConfigError(f"{file}: not an EDS file: larger than {LARGEST_FILE >> 20} MB")
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = content.decode("utf-16", errors="replace")
    else:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("cp1252", errors="replace")
    if "\0" in text:
        raise ConfigError(f"{file}: not an EDS file: it is binary, expected text with sections such as [1000]")
    if text.lstrip().startswith("<"):
        raise ConfigError(f"{file}: not an EDS file: this is XML (XDD or ESI?); expected an EDS or DCF")
    return text


def sections_of(text: str, remarks: Remarks) -> dict[str, Section]:
    """Return the values of an EDS by section (``DeviceInfo``, ``1018``, ``1018sub1``, ``1003Name``) and key word.

    Both are matched without regard to case; the first value of a key counts. ``remarks`` receives other lines, and
    sections whose second copy differs.
    """
    found: dict[str, Section] = {}
    section: Section = {}
    name, repeated = "", False
    for number, line in _lines(text):
        if line.startswith("["):
            name = _section_name(line[1:].partition("]")[0])
            repeated = name in found
            section = found.setdefault(name, {})
            continue
        key, separator, value = line.partition("=")
        if not separator:
            key, separator, value = line.partition(":")
            separator = separator if key.strip().lower() in KEYS else ""
        if not separator:
            remarks.add("lines that are neither section nor key, ignored", f"line {number} {line[:_QUOTED]!r}")
            continue
        word, value = _key(key), _value(value)
        if section.setdefault(word, value) != value:
            kind = "duplicate sections that differ" if repeated else "duplicate keys that differ"
            place = f"[{name}] {word}"
            remarks.add(f"{kind}, the first value counts", place)
    return found


def _lines(text: str) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip().strip("\ufeff\x1a")
        if stripped and not stripped.startswith((";", "#")):
            yield number, stripped


def _key(text: str) -> str:
    word = text.strip()
    number = parse_number(word)
    return str(number) if number is not None else KEYS.get(word.lower(), word)


def _value(text: str) -> str:
    """Value without a comment behind it."""
    return re.split(r"\s(?:;|//)", f" {text}", maxsplit=1)[0].strip()


def _section_name(text: str) -> str:
    word = "".join(text.split())
    match = _OBJECT.fullmatch(word)
    if match is None:
        return {"deviceinfo": "DeviceInfo", "dummyusage": "DummyUsage"}.get(word.lower(), word.lower())
    index, sub, more = match.groups()
    return section_of(int(index, 16), None if sub is None else int(sub, 16)) + (more or "").capitalize()


def section_of(index: int, subindex: int | None = None) -> str:
    """Name of the section of an object."""
    return f"{index:04X}" if subindex is None else f"{index:04X}sub{subindex:X}"


def object_of(section: str) -> tuple[int, int | None] | None:
    """Index and subindex of the object of a section with this canonical name; ``None`` if it describes no object."""
    match = _OBJECT.fullmatch(section)
    if match is None or match[3] is not None:
        return None
    return int(match[1], 16), None if match[2] is None else int(match[2], 16)


def label(index: int, subindex: int | None = None) -> str:
    """Index and subindex of an object as in the CiA documents, for messages."""
    return f"{index:04X}h" if subindex is None else f"{index:04X}h:{subindex:02X}"


def parse_number(text: str | None) -> int | None:
    """Integer of an EDS: decimal, also with leading zeros, or hexadecimal with 0x; ``None`` if it is none."""
    word = (text or "").strip()
    if re.fullmatch(r"[-+]?0[xX][0-9a-fA-F]{1,16}", word):
        return int(word, 16)
    if re.fullmatch(r"[0-9a-fA-F]{1,16}[hH]", word):
        return int(word[:-1], 16)
    return int(word) if re.fullmatch(r"[-+]?[0-9]{1,20}", word, re.ASCII) else None


def rendered(sections: Iterable[tuple[str, Section]]) -> str:
    """Text of sections, in their order."""
    lines: list[str] = []
    for name, values in sections:
        lines += [f"[{name}]", *(f"{key}={value}" for key, value in values.items())]
    return "\n".join(lines) + "\n"
