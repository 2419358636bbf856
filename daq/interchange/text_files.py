"""Text files of other tools: their encoding, and parts of them in messages."""

import codecs
import hashlib
from collections.abc import Sequence
from pathlib import Path

NOTES = "source_remarks"
"""Key of the metadata of a recording with everything that an import left out or assumed."""
_HEAD = 65536
"""Bytes at the beginning of a file that decide its encoding."""
_ZEROS_OF_UTF16 = 0.9
"""Share of zeros among every second byte of a text of mostly Latin letters and digits in UTF-16."""
_LONGEST = 60
"""Longest part of a file in a message, characters."""
_LISTED = 40
"""Number of names in a message; further ones are counted."""


def encoding_of(path: Path) -> str:
    """Return the encoding of a text file: UTF-8, UTF-16 by its mark or its zeros, or Windows-1252."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    for first, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):
        zeros = head[first::2].count(0)
        if zeros > _ZEROS_OF_UTF16 * len(head) / 2 and zeros > 2 * head[1 - first :: 2].count(0):
            return encoding
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def sha256_of(*files: Path) -> str:
    """Return the SHA-256 of files, one after the other."""
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as opened:
            hashlib.file_digest(opened, lambda: digest)
    return digest.hexdigest()


def excerpt(text: str) -> str:
    """Return the beginning of a text in quotes, for messages of one line."""
    return f"'{shortened(text)}'"


def shortened(text: str) -> str:
    """Return a text in one line of limited length, for messages."""
    shown = printable(text)
    return shown if len(shown) <= _LONGEST else f"{shown[:_LONGEST]}..."


def printable(text: str) -> str:
    """Return a text in one line, without characters that are not printable."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def listed(names: Sequence[str]) -> str:
    """Return names for a message. ``names``: any number of names; the first ones are listed."""
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(map(shortened, names[:_LISTED])) + more
