"""Elements of a URDF: the only one of a name, the links of a joint, and numbers as they are written."""

import xml.etree.ElementTree as ET
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Literal

from armident.configs.errors import ConfigError
from armident.configs.urdf_file import expand

LARGEST = 1e9
"""Largest magnitude of a coordinate in a URDF, SI units; larger ones are refused."""


def only(file: Path, element: ET.Element, tag: str, of: ET.Element | None = None) -> ET.Element | None:
    """Return the child element of a name, or ``None``; ConfigError if two differ. ``of``: its joint or link."""
    found = element.findall(tag)
    contents = {tuple((part.tag, *sorted(part.items())) for part in each.iter()) for each in found}
    if len(contents) > 1:
        owner = element if of is None else of
        where = f"{file}: {owner.tag} {owner.get('name')!r}" + (f": {element.tag}" if of is not None else "")
        raise ConfigError(f"{where}: there are {len(found)} elements {tag}, expected one")
    return found[0] if found else None


def end_link(element: ET.Element, end: Literal["parent", "child"]) -> str:
    """Name of the ``parent`` or ``child`` link of a joint; empty if it has none."""
    found = element.find(end)
    return "" if found is None else found.get("link", "")


def words(
    file: Path, element: ET.Element, child: ET.Element, key: str, *, count: int = 3, default: str | None = "0 0 0"
) -> list[str]:
    """Finite numbers of an attribute, as written; raises ConfigError if there are not ``count`` of them."""
    text = child.get(key, default)
    words = (text or "").split()
    if len(words) != count or not all(_is_finite(word) for word in words):
        expected = "a number" if count == 1 else f"{count} numbers"
        hint = f"; {expand(file)}" if "$" in (text or "") else ""
        where = f"{file}: {element.tag} {element.get('name')!r}: {child.tag} {key}"
        raise ConfigError(f"{where}: expected {expected}, found {text!r:.80}{hint}")
    return words


def _is_finite(word: str) -> bool:
    # Python also reads underscores and the digits of other scripts; readers of URDF do not.
    if "_" in word or not word.isascii():
        return False
    try:
        return abs(Decimal(word)) <= LARGEST
    except InvalidOperation:
        return False
