"""Logging to the journal of systemd, with a field per attribute of a record (systemd.io/JOURNAL_NATIVE_PROTOCOL)."""

import logging
import os
import socket
import struct
import sys
from collections.abc import Mapping
from pathlib import Path

from armident.daq.logs import StderrHandler

SOCKET = Path("/run/systemd/journal/socket")
_LONGEST = 8000
"""Largest size of a field, bytes: an entry has to fit into one datagram."""
_PRIORITIES = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (logging.NOTSET, 7))
"""Levels of syslog(3), by the lowest level of logging."""
_STANDARD = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}
"""Attributes that every record has; all others come from ``extra``."""


class JournalHandler(StderrHandler):
    """Sends records to the journal where stderr is a stream of it, and writes lines to stderr elsewhere.

    ``log.info("no heartbeat", extra={"event": "heartbeat_lost", "axis": "joint_2"})`` gets the fields
    ``ARMIDENT_EVENT`` and ``ARMIDENT_AXIS``. ``fields`` are those of every entry; they may be exchanged at any time.
    """

    def __init__(self, fields: Mapping[str, object] | None = None, address: Path = SOCKET) -> None:
        super().__init__()
        self.fields: Mapping[str, object] = fields or {}
        self._address = str(address)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) if in_journal() else None

    def emit(self, record: logging.LogRecord) -> None:
        """Send one record."""
        if self._socket is not None:
            try:
                # Waiting for a journal whose buffer is full would delay the capture: stderr receives the line then.
                datagram = journal_entry(record, self.format(record), self.fields)
                self._socket.sendto(datagram, socket.MSG_DONTWAIT, self._address)
                return
            except OSError:
                pass
        super().emit(record)

    def close(self) -> None:
        """Close the socket; records that still come go to stderr."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        super().close()


def in_journal() -> bool:
    """Return True if stderr is a stream of the journal (systemd.exec(5), ``$JOURNAL_STREAM``)."""
    device, _, inode = os.environ.get("JOURNAL_STREAM", "").partition(":")
    if not (device.isdecimal() and inode.isdecimal()):
        return False
    try:
        found = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError, AttributeError):
        return False
    return (found.st_dev, found.st_ino) == (int(device), int(inode))


def journal_entry(record: logging.LogRecord, message: str, fields: Mapping[str, object]) -> bytes:
    """Return the datagram of one entry; ``extra`` attributes that are not ``None`` take precedence over ``fields``."""
    own = {key: value for key, value in vars(record).items() if key not in _STANDARD}
    entries: dict[str, object] = {
        "MESSAGE": message,
        "PRIORITY": next(priority for level, priority in _PRIORITIES if record.levelno >= level),
        "SYSLOG_IDENTIFIER": "armident",
    }
    entries |= {f"ARMIDENT_{key.upper()}": value for key, value in {**fields, **own}.items() if value is not None}
    return b"".join(_field(key, str(value).encode(errors="replace")[:_LONGEST]) for key, value in entries.items())


def _field(key: str, value: bytes) -> bytes:
    if b"\n" in value:
        return key.encode() + b"\n" + struct.pack("<Q", len(value)) + value + b"\n"
    return key.encode() + b"=" + value + b"\n"
