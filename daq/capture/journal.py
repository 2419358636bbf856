"""What a service says: lines on stderr, or entries with fields in the journal of systemd where that listens.

The journal's own protocol (systemd.io/JOURNAL_NATIVE_PROTOCOL): one datagram of fields per entry.
"""

import os
import socket
import struct
import sys
from collections.abc import Mapping
from pathlib import Path

SOCKET = Path("/run/systemd/journal/socket")
_LONGEST = 8000
"""Most bytes of a field."""
_PRIORITY = {"warning": 4, "error": 3}
_INFORMATION = 6


class Line(str):
    """A line with what it is about: ``Line("no heartbeat", event="heartbeat_lost", axis="joint_2", sync=17)``.

    Whoever takes text takes it as text; the journal gets ``ARMIDENT_EVENT``, ``ARMIDENT_AXIS`` and so on besides.
    """

    __slots__ = ("fields",)
    fields: Mapping[str, object]

    def __new__(cls, text: str, **fields: object) -> "Line":
        """A text and what it is about."""
        line = super().__new__(cls, text)
        line.fields = fields
        return line


class Voice:
    """Says lines on stderr, or to the journal where that is what stderr is.

    Parameters
    ----------
    fields
        Of every entry: cell and robot.
    place
        Where the journal listens.
    """

    def __init__(self, fields: Mapping[str, object], place: Path = SOCKET) -> None:
        self.fields = dict(fields)
        self._place = str(place)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) if in_journal() else None

    def __call__(self, text: str) -> None:
        """Say a line."""
        if self._socket is not None:
            try:
                # A journal that is full would hold up the capture: then the line goes the other way.
                self._socket.sendto(entry(text, self.fields), socket.MSG_DONTWAIT, self._place)
                return
            except OSError:
                pass
        print(text, file=sys.stderr, flush=True)

    def close(self) -> None:
        """Say no more to the journal."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def in_journal() -> bool:
    """Whether stderr is a stream of the journal (systemd.exec(5), ``$JOURNAL_STREAM``)."""
    device, _, inode = os.environ.get("JOURNAL_STREAM", "").partition(":")
    if not (device.isdigit() and inode.isdigit()):
        return False
    try:
        found = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError, AttributeError):
        return False
    return (found.st_dev, found.st_ino) == (int(device), int(inode))


def entry(text: str, fields: Mapping[str, object]) -> bytes:
    """The datagram of one entry."""
    level = text.partition(":")[0]
    own = text.fields if isinstance(text, Line) else {}
    entries: dict[str, object] = {
        "MESSAGE": text,
        "PRIORITY": _PRIORITY.get(level, _INFORMATION),
        "SYSLOG_IDENTIFIER": "armident",
    }
    entries |= {f"ARMIDENT_{key.upper()}": value for key, value in {**fields, **own}.items() if value is not None}
    return b"".join(_field(key, str(value).encode(errors="replace")[:_LONGEST]) for key, value in entries.items())


def _field(key: str, value: bytes) -> bytes:
    if b"\n" in value:
        return key.encode() + b"\n" + struct.pack("<Q", len(value)) + value + b"\n"
    return key.encode() + b"=" + value + b"\n"
