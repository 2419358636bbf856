"""Reasons of errors of the operating system and of SQLite, in words that name the next step."""

import errno
import os
import sqlite3

_STEPS = {
    errno.ENOSPC: "free space on the disk, or choose another folder",
    errno.EDQUOT: "free space on the disk, or choose another folder",
    errno.EROFS: "choose another folder",
    errno.EACCES: "check its permissions, or choose another folder",
    errno.ENOTDIR: "choose another folder",
}
"""Next steps after a refused file operation."""
_OF_SQLITE = {
    "locked": "locked by another process for more than {busy:g} s; try again when that has ended",
    "malformed": "damaged ({text})",
    "not a database": "damaged ({text})",
    "readonly": "it may not be written (read-only); check the folder and its permissions",
    "unable to open": "the file cannot be opened; check the folder and its permissions",
    "is full": "the disk is full; free space",
    "disk I/O error": "the disk failed ({text}); check that it is neither full nor damaged",
}
"""Reasons by a part of SQLite's message (its documentation, Result and Error Codes)."""


def reason_of(error: OSError | sqlite3.Error, busy_s: float = 0.0, *, named: bool = True, step: bool = False) -> str:
    """File, reason and next step of an error in one line; ``busy_s``: time a locked database was waited for, s."""
    if isinstance(error, OSError):
        where = f"{os.fspath(error.filename)!s}: " if named and error.filename else ""
        more = f"; {_STEPS[error.errno]}" if step and error.errno in _STEPS else ""
        return f"{where}{error.strerror or str(error) or type(error).__name__}{more}"
    text = " ".join(str(error).split())
    found = next((reason for part, reason in _OF_SQLITE.items() if part in text), "{text}")
    return found.format(text=text, busy=busy_s)
