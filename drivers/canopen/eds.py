"""Object dictionary of a drive from its electronic data sheet (EDS or DCF, CiA 306).

canopen reads files that follow CiA 306 to the letter. Here files of many makers get that form: byte order marks,
Windows-1252, capitals, leading zeros, missing key words, compact arrays.
"""

import io
import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import canopen
from canopen.objectdictionary import datatypes

from armident.configs import ConfigError
from armident.drivers.canopen.eds_text import (
    Remarks,
    Section,
    label,
    object_of,
    parse_number,
    read_text,
    rendered,
    section_of,
    sections_of,
)

VARIABLE, DOMAIN_OBJECT, ARRAY, RECORD = 7, 2, 8, 9
"""Object codes of CiA 301 that describe data; types of data (5, 6) are no objects of a drive."""

FIRST_OBJECT = 0x1000
"""Lowest index of an object with data (CiA 301); below are definitions of data types."""

DOMAIN_TYPE = 0x000F
UNSIGNED8 = 0x0005
LARGEST_STANDARD_TYPE = 0x001B
"""Largest data type of CiA 301 that is not defined by the drive's maker."""

_TEXT_TYPES = (
    datatypes.VISIBLE_STRING,
    datatypes.OCTET_STRING,
    datatypes.UNICODE_STRING,
    datatypes.DOMAIN,
    *datatypes.FLOAT_TYPES,
)
_VARIABLE_KEYS = (
    "ParameterName",
    "ObjectType",
    "DataType",
    "AccessType",
    "DefaultValue",
    "ParameterValue",
    "PDOMapping",
    "LowLimit",
    "HighLimit",
    "StorageLocation",
    "Factor",
    "Description",
    "Unit",
)
NO_TYPE = "objects without DataType, left out"
"""Remark on objects whose size is therefore unknown."""

LACKING = "objects that the lists of the file name, but that it does not describe (is it cut off?)"
"""Remark on objects of ``[MandatoryObjects]`` and the like (CiA 306) without any section."""

_LISTS = ("mandatoryobjects", "optionalobjects", "manufacturerobjects")
_ACCESS = {"ro", "wo", "rw", "rwr", "rww", "const"}
_WORDS = {"true": 1, "yes": 1, "false": 0, "no": 0}
_NODE_ID = re.compile(r"\$NODEID", re.IGNORECASE)

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DataSheet:
    """Objects of an EDS for one node id; remarks on deviations from CiA 306 that leave something out or open."""

    objects: canopen.ObjectDictionary
    remarks: tuple[str, ...]


def read_eds(file: Path, node_id: int) -> DataSheet:
    """Read the EDS or DCF of a drive, with the values for its node id; an EPF is read by canopen as it is."""
    if file.suffix.lower() == ".epf":
        return DataSheet(_imported(file, str(file), node_id), ())
    remarks = Remarks()
    sections = sections_of(read_text(file), remarks)
    objects = list(_Cleaner(sections, remarks, file.suffix.lower() == ".dcf").objects())
    if not objects:
        raise ConfigError(f"{file}: not an EDS file: no object in it, expected sections such as [1000]")
    for index in _lacking(sections):
        remarks.add(LACKING, label(index))
    about = [("DeviceInfo", _device(sections)), ("DummyUsage", _dummies(sections))]
    source = io.StringIO(rendered([*about, *objects]))
    source.name = "clean.eds"
    return DataSheet(_imported(file, source, node_id), remarks.lines())


def read_objects(file: Path, node_id: int) -> canopen.ObjectDictionary:
    """Read the object dictionary of a drive; what its data sheet leaves out or undecided is logged once per file."""
    sheet = read_eds(file, node_id)
    for remark in sheet.remarks:
        _warn_once(f"{file}: {remark}")
    return sheet.objects


@cache
def _warn_once(message: str) -> None:
    log.warning(message)


def _imported(file: Path, source: Any, node_id: int) -> canopen.ObjectDictionary:
    try:
        return canopen.import_od(source, node_id)
    except Exception as error:
        raise ConfigError(
            f"{file}: not an EDS file that canopen can read; ask the drive's maker for another"
        ) from error


def _device(sections: dict[str, Section]) -> Section:
    """Values of DeviceInfo, without numbers that are none."""
    texts = ("VendorName", "ProductName", "OrderCode")
    found = sections.get("DeviceInfo", {})
    return {k: v for k, v in found.items() if k in texts} | {
        key: str(_flag(value)) for key, value in found.items() if key not in texts and _flag(value) is not None
    }


def _dummies(sections: dict[str, Section]) -> Section:
    found = sections.get("DummyUsage", {})
    return {f"Dummy{k:04d}": str(_flag(found.get(f"Dummy{k:04d}")) or 0) for k in range(1, 8)}


def _lacking(sections: dict[str, Section]) -> list[int]:
    """Indices that the lists of objects name, without a section, in ascending order."""
    listed = {
        index
        for name in _LISTS
        for key, value in sections.get(name, {}).items()
        if key.isdecimal() and (index := parse_number(value)) is not None and index >= FIRST_OBJECT
    }
    return sorted(listed - {place[0] for place in map(object_of, sections) if place is not None})


def _flag(text: str | None) -> int | None:
    """Number, or the number of a word such as TRUE."""
    return _WORDS.get((text or "").strip().lower(), parse_number(text))


@dataclass(frozen=True)
class _Cleaner:
    """Makes sections that canopen reads from those of a file; ``configured``: a DCF, with the values of one drive."""

    sections: dict[str, Section]
    remarks: Remarks
    configured: bool

    def objects(self) -> Iterator[tuple[str, Section]]:
        """Sections of objects by ascending index, each behind its parent."""
        members: dict[int, dict[int, Section]] = {}
        for name, values in self.sections.items():
            place = object_of(name)
            if place is not None and place[0] >= FIRST_OBJECT:
                subs = members.setdefault(place[0], {})
                if place[1] is not None:
                    subs[place[1]] = values
        for index, subs in sorted(members.items()):
            parent = self.sections.get(section_of(index), {})
            kind = parse_number(parent.get("ObjectType"))
            if kind is None:
                kind = RECORD if subs or "SubNumber" in parent else VARIABLE
            if kind in (VARIABLE, DOMAIN_OBJECT):
                yield from self._variable(parent | {"ObjectType": str(kind)}, index, None)
            elif kind in (ARRAY, RECORD):
                yield from self._members(index, parent | {"ObjectType": str(kind)}, subs)

    def _members(self, index: int, parent: Section, subs: dict[int, Section]) -> Iterator[tuple[str, Section]]:
        """Section of an array or record (``parent``), and those of its entries, of which ``subs`` are in the file."""
        name = parent.get("ParameterName") or label(index)
        count = parse_number(parent.get("CompactSubObj")) or 0
        if count > 0 and parse_number(parent.get("DataType")) is not None:
            subs = self._expanded(index, min(count, 254), parent | {"ParameterName": name}) | subs
        elif count > 0 and not subs:
            self.remarks.add(NO_TYPE, label(index))
            return
        yield section_of(index), {"ParameterName": name, "ObjectType": parent["ObjectType"]}
        for subindex, values in sorted(subs.items()):
            yield from self._variable(values, index, subindex)

    def _expanded(self, index: int, count: int, parent: Section) -> dict[int, Section]:
        """Entries of an array with CompactSubObj: as their parent, with names and values of sections of their own."""
        names, values = (self.sections.get(f"{section_of(index)}{more}", {}) for more in ("Name", "Value"))
        first = {"ParameterName": "Number of entries", "DataType": str(UNSIGNED8), "AccessType": "ro"}
        entries = {0: first | {"DefaultValue": str(count)}}
        for k in range(1, count + 1):
            entries[k] = parent | {"ParameterName": names.get(str(k)) or f"{parent['ParameterName']}_{k}"}
            entries[k]["ObjectType"] = str(VARIABLE)
            if str(k) in values:
                entries[k]["ParameterValue" if self.configured else "DefaultValue"] = values[str(k)]
        return entries

    def _variable(self, values: Section, index: int, subindex: int | None) -> Iterator[tuple[str, Section]]:
        """Section of a variable with all key words that canopen needs; none if its data type is unknown."""
        kind = parse_number(values.get("DataType"))
        if kind is None and parse_number(values.get("ObjectType")) == DOMAIN_OBJECT:
            kind = DOMAIN_TYPE
        if kind is None:
            self.remarks.add(NO_TYPE, label(index, subindex))
            return
        kind = kind if kind <= LARGEST_STANDARD_TYPE else self._standard_type(kind)
        access = values.get("AccessType", "").lower()
        clean = {key: values[key] for key in _VARIABLE_KEYS if values.get(key)} | {
            "ParameterName": values.get("ParameterName") or label(index, subindex),
            "ObjectType": str(parse_number(values.get("ObjectType")) or VARIABLE),
            "DataType": str(kind),
            "AccessType": access if access in _ACCESS else "rw",
            "PDOMapping": str(_flag(values.get("PDOMapping")) or 0),
        }
        if kind not in _TEXT_TYPES:
            for key in ("DefaultValue", "ParameterValue", "LowLimit", "HighLimit"):
                number = self._integer(clean.pop(key, ""), f"{label(index, subindex)} {key}")
                clean |= {key: number} if number is not None else {}
        yield section_of(index, subindex), clean

    def _standard_type(self, kind: int) -> int:
        """Data type of CiA 301 behind one that the file defines in a section of its own; without one DOMAIN."""
        found = parse_number(self.sections.get(section_of(kind, 1), {}).get("DefaultValue"))
        return found if found is not None and 0 < found <= LARGEST_STANDARD_TYPE else DOMAIN_TYPE

    def _integer(self, text: str, place: str) -> str | None:
        """Integer value as canopen reads it, ``$NODEID`` included; ``None`` if it is none."""
        if not text:
            return None
        word = _NODE_ID.sub("", text).replace(" ", "").strip("(){}\"'")
        relative = _NODE_ID.search(text) is not None
        number = _flag(word.strip("+") or "0") if relative else _flag(word)
        if number is None:
            self.remarks.add("values that are no integers, left out", f"{place}={text[:40]}")
            return None
        if re.fullmatch("0[0-7]+", word) and int(word, 8) != number:
            self.remarks.add("numbers with a leading zero, read as decimal", f"{place}={text[:40]}")
        return f"$NODEID+{number}" if relative else str(number)
