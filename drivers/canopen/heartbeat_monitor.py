"""Monitoring of heartbeats (CiA 301, section 7.2.8.3.2) by the kernel's time stamps."""

import time
from collections.abc import Iterable, Sequence

import numpy as np

from armident.configs.schema.session import Bus
from armident.drivers.can.filtered_socket import FilteredSocket
from armident.drivers.can.frames import STANDARD_ID_MASK
from armident.drivers.canopen.objects import COB_HEARTBEAT

DELAYED_S = 0.1
"""Interval of updates (s) above which the consumer counts as delayed."""


class HeartbeatSocket:
    """Socket for the heartbeats and boot-up messages on one bus."""

    def __init__(self, bus: Bus, nodes: Sequence[int]) -> None:
        self._socket = FilteredSocket(bus, [COB_HEARTBEAT + node for node in nodes])

    def read(self) -> list[tuple[int, float]]:
        """Node id and time (s, monotonic clock) of the received heartbeats; none while the bus is down or removed."""
        found: list[tuple[int, float]] = []
        for batch in self._socket.read():
            # Remote frames are requests of node guarding, and not answers to them.
            batch = batch[batch["can_id"] <= STANDARD_ID_MASK]
            # Stamps are wall-clock times, which may be stepped: only their age is used.
            ages = (time.time_ns() - batch["t_ns"]) * 1e-9
            received = time.monotonic() - np.maximum(ages, 0.0)
            found += zip((batch["can_id"] - COB_HEARTBEAT).tolist(), received.tolist(), strict=True)
        return found

    def close(self) -> None:
        """Release the socket."""
        self._socket.close()


class HeartbeatMonitor:
    """Time without heartbeat of each drive, s of the monotonic clock.

    A delayed machine stamps frames late or loses them. If the consumer was delayed, the longest pause of all drives in
    that time does not count as silence. Each silence is shortened in this way only once.
    """

    def __init__(self, drives: Iterable[str], now: float) -> None:
        self._last = dict.fromkeys(drives, now)
        self._ended = dict.fromkeys(self._last, 0.0)
        self._shortened: set[str] = set()
        self.updated = now
        """Time of the last update, s, monotonic clock."""

    def update(self, heartbeats: Iterable[tuple[str, float]], now: float) -> None:
        """Process the heartbeats (drive, time in s) since the last update."""
        self._ended = dict.fromkeys(self._last, 0.0)
        before, self.updated = self.updated, now
        ordered = sorted(heartbeats, key=lambda beat: beat[1])
        times = [before, *(min(max(at, before), now) for _, at in ordered), now]
        k = max(range(len(times) - 1), key=lambda i: times[i + 1] - times[i])
        pause = times[k + 1] - times[k]
        delayed = now - before > DELAYED_S and pause > DELAYED_S
        self._take(ordered[:k])
        for drive in self._last if delayed else ():
            if drive not in self._shortened:
                self._shortened.add(drive)
                self._last[drive] += pause
        self._take(ordered[k:])

    def _take(self, heartbeats: Iterable[tuple[str, float]]) -> None:
        for drive, at in heartbeats:
            self._ended[drive] = max(self._ended[drive], at - self._last[drive])
            self._last[drive] = max(self._last[drive], at)
            self._shortened.discard(drive)

    def silence(self, drive: str) -> float:
        """Time since the last heartbeat of a drive at the last update, s."""
        return self.updated - self._last[drive]

    def ended_silence(self, drive: str) -> float:
        """Longest silence of a drive that ended with a heartbeat of the last update, s; 0 if there was none."""
        return self._ended[drive]
