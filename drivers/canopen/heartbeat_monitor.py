"""Heartbeats (CiA 301, section 7.2.8.3.2) by the kernel's stamps: which drive has been silent, and for how long."""

import time
from collections.abc import Iterable, Sequence

import numpy as np

from armident.configs.schema.session import Bus
from armident.drivers.can.filtered_socket import SideSocket
from armident.drivers.canopen.objects import COB_HEARTBEAT

HELD_UP_S = 0.1
"""Whoever looks less often than this was held up."""


class HeartbeatSocket:
    """The heartbeats on one bus, boot-up messages among them, in a socket of their own.

    Parameters
    ----------
    bus
        The bus.
    nodes
        The drives on it.

    Raises
    ------
    ConfigError
        If there is no such bus.
    BusDown
        If the bus is down.
    """

    def __init__(self, bus: Bus, nodes: Sequence[int]) -> None:
        self._socket = SideSocket(bus, [COB_HEARTBEAT + node for node in nodes])

    def read(self) -> list[tuple[int, float]]:
        """Node and time (s, of the monotonic clock) of what has come; nothing while the bus is down or removed."""
        found: list[tuple[int, float]] = []
        for batch in self._socket.read():
            # Stamps are wall clock time, which may be set: only their age at this moment is used.
            ages = (time.time_ns() - batch["t_ns"]) * 1e-9
            came = time.monotonic() - np.maximum(ages, 0.0)
            found += zip((batch["can_id"] - COB_HEARTBEAT).tolist(), came.tolist(), strict=True)
        return found

    def close(self) -> None:
        """Release the socket."""
        self._socket.close()


class HeartbeatMonitor:
    """How long each drive has been silent, and was until its last heartbeat.

    A machine that was held up as a whole stamps late what came meanwhile, or has lost it. So where the consumer was
    held up, the stretch of that time in which no drive at all was heard is nobody's silence, once for each silence.

    Parameters
    ----------
    drives
        Who is waited for.
    now
        From when on, s.
    """

    def __init__(self, drives: Iterable[str], now: float) -> None:
        self._last = dict.fromkeys(drives, now)
        self._ended = dict.fromkeys(self._last, 0.0)
        self._excused: set[str] = set()
        self.looked = now
        """When this was asked last, s."""

    def look(self, heartbeats: Iterable[tuple[str, float]], now: float) -> None:
        """Take the heartbeats (drive, time in s) that have come since the last look."""
        self._ended = dict.fromkeys(self._last, 0.0)
        before, self.looked = self.looked, now
        ordered = sorted(heartbeats, key=lambda beat: beat[1])
        times = [before, *(min(max(at, before), now) for _, at in ordered), now]
        k = max(range(len(times) - 1), key=lambda i: times[i + 1] - times[i])
        pause = times[k + 1] - times[k]
        held_up = now - before > HELD_UP_S and pause > HELD_UP_S
        self._take(ordered[:k])
        for drive in self._last if held_up else ():
            if drive not in self._excused:
                self._excused.add(drive)
                self._last[drive] += pause
        self._take(ordered[k:])

    def _take(self, heartbeats: Iterable[tuple[str, float]]) -> None:
        for drive, at in heartbeats:
            self._ended[drive] = max(self._ended[drive], at - self._last[drive])
            self._last[drive] = max(self._last[drive], at)
            self._excused.discard(drive)

    def lasts(self, drive: str) -> float:
        """How long the drive has been silent by the last look, s."""
        return self.looked - self._last[drive]

    def ended(self, drive: str) -> float:
        """The longest silence of the drive that ended with a heartbeat of the last look, s; 0: none did."""
        return self._ended[drive]
