"""Reasons why SQLite cannot use a file, in words that name the next step."""

import sqlite3

_REASONS = {
    "locked": "locked by another process for more than {busy:g} s; try again when that has ended",
    "malformed": "damaged ({text})",
    "not a database": "damaged ({text})",
    "readonly": "it may not be written (read-only); check the folder and its permissions",
    "unable to open": "the file cannot be opened; check the folder and its permissions",
    "is full": "the disk is full; free space",
    "disk I/O error": "the disk failed ({text}); check that it is neither full nor damaged",
}
"""Reasons by a part of SQLite's message (its documentation, Result and Error Codes)."""


def sqlite_reason(error: sqlite3.Error, busy_s: float) -> str:
    """Return one line that says why a file cannot be used.

    ``busy_s``: time for which a locked file was waited for, s.
    """
    text = " ".join(str(error).split())
    found = next((reason for part, reason in _REASONS.items() if part in text), "{text}")
    return found.format(text=text, busy=busy_s)
