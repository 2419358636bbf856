"""Messages of type sensor_msgs/msg/JointState of one topic, decoded into one table for each list of joint names.

The encodings are CDR, that of ROS 2, and that of ROS 1, as in bags that were converted to MCAP.
"""

import struct
from array import array
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray

from armident.configs import DataError
from armident.daq.interchange.text_files import listed

MESSAGE_TYPE = "sensor_msgs/msg/JointState"
DEFINITION = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_NS = 1_000_000_000
CDR, ROS1 = "cdr", "ros1"
"""Encodings of messages in MCAP."""
_Message = tuple[int, tuple[str, ...], Sequence[float], Sequence[float]]
"""Stamp, ns; names; positions; efforts."""
_MOST_NS = 2**63 - 1
"""Last time that 64 bits hold, ns."""


@dataclass(frozen=True, eq=False)
class MessageTable:
    """M messages of equal names and quantities, positions and efforts (M, m); ``number`` from 1; times in ns."""

    names: tuple[str, ...]
    number: NDArray[np.int64]
    stamp: NDArray[np.int64]
    logged: NDArray[np.int64]
    q: NDArray[np.float64] | None
    tau: NDArray[np.float64] | None


@dataclass
class _Rows:
    """Values of messages of one kind as they come."""

    times: "array[int]" = field(default_factory=lambda: array("q"))
    q: "array[float]" = field(default_factory=lambda: array("d"))
    tau: "array[float]" = field(default_factory=lambda: array("d"))


class TopicMessages:
    """Collects the messages of a topic; ``count`` includes unusable ones."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.count = 0
        self._decode = _decoder()
        self._rows: dict[tuple[tuple[str, ...], bool, bool], _Rows] = {}
        self._odd: Counter[str] = Counter()
        self._first_odd: dict[str, int] = {}

    def add(self, logged_ns: int, data: bytes, encoding: str = CDR) -> None:
        """Add a message in CDR or ``ros1``, recorded at ``logged_ns``; one that cannot be used is counted."""
        self.count += 1
        try:
            stamp, names, q, tau = _of_ros_1(data) if encoding == ROS1 else self._of_ros_2(data)
        except (ValueError, struct.error, EOFError, IndexError, MemoryError, OverflowError):
            self._refuse("is damaged")
            return
        if not names:
            names = tuple(f"(unnamed {k + 1})" for k in range(max(len(q), len(tau))))
        for values, what in ((q, "positions"), (tau, "efforts")):
            if len(values) not in (0, len(names)):
                self._refuse(f"has {len(values)} {what} of {len(names)} joints")
                return
        if len(set(names)) < len(names):
            self._refuse(f"has a duplicate joint: {listed(names)}")
            return
        if not (len(q) or len(tau)):
            self._refuse("has neither positions nor efforts")
            return
        if not -_MOST_NS <= logged_ns <= _MOST_NS:
            self._refuse(f"has a time of {logged_ns / _NS:.3g} s")
            return
        rows = self._rows.setdefault((names, len(q) > 0, len(tau) > 0), _Rows())
        rows.times.extend((self.count, stamp, logged_ns))
        rows.q.extend(q)
        rows.tau.extend(tau)

    def _of_ros_2(self, data: bytes) -> "_Message":
        message = self._decode(data)
        stamp = message.header.stamp.sec * _NS + message.header.stamp.nanosec
        return stamp, tuple(message.name), message.position, message.effort

    def names(self) -> list[str]:
        """Return the names of all joints so far, in the order in which they came first."""
        return list(dict.fromkeys(name for names, _, _ in self._rows for name in names))

    def tables(self) -> list[MessageTable]:
        """Return the usable messages."""
        found = []
        for (names, has_q, has_tau), rows in self._rows.items():
            number, stamp, logged = np.array(rows.times, dtype=np.int64).reshape(-1, 3).T
            q, tau = (np.array(values, dtype=np.float64).reshape(-1, len(names)) for values in (rows.q, rows.tau))
            found.append(MessageTable(names, number, stamp, logged, q if has_q else None, tau if has_tau else None))
        return found

    def remarks(self) -> list[str]:
        """Return descriptions of the messages that cannot be used."""
        return [
            f"message {self._first_odd[reason]} on {self.topic} {reason}" + (f", and {n - 1} more" if n > 1 else "")
            for reason, n in self._odd.items()
        ]

    def refuse_unusable(self) -> None:
        """Raise if no message can be used. Raises DataError with the reasons."""
        if not self._rows:
            raise DataError("; ".join(self.remarks()))

    def _refuse(self, reason: str) -> None:
        self._odd[reason] += 1
        self._first_odd.setdefault(reason, self.count)


def _decoder() -> Callable[[bytes], Any]:
    """Return the decoder of joint states; their definition is the same in all bags, and absent from some."""
    schema = Schema(id=1, name=MESSAGE_TYPE, encoding="ros2msg", data=DEFINITION.encode())
    decode = DecoderFactory().decoder_for("cdr", schema)
    assert decode is not None
    return decode


def _of_ros_1(data: bytes) -> _Message:
    """Return a message of ROS 1: little endian, lengths before texts and arrays, without alignment."""
    at = 12

    def length() -> int:
        nonlocal at
        at += 4
        return int(struct.unpack_from("<I", data, at - 4)[0])

    def text() -> str:
        nonlocal at
        size = length()
        at += size
        return data[at - size : at].decode()

    def numbers() -> tuple[float, ...]:
        nonlocal at
        count = length()
        at += 8 * count
        return struct.unpack_from(f"<{count}d", data, at - 8 * count)

    _, seconds, nanoseconds = struct.unpack_from("<3I", data)
    text()
    names = tuple(text() for _ in range(length()))
    positions, _, efforts = numbers(), numbers(), numbers()
    if at != len(data):
        raise ValueError("another length than that of its arrays")
    return seconds * _NS + nanoseconds, names, positions, efforts
