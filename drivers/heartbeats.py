"""The heartbeats of the drives on one bus, by the kernel's stamps: who has been silent, and for how long."""

import time
from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from configs.errors import ArmidentError
from configs.session import Bus
from drivers.frames import BusDown, FrameBus, frames
from drivers.objects import COB_HEARTBEAT, COB_MASK
from drivers.udp import open_bus

BATCH = 256


class Heartbeats:
    """Heartbeat consumer (CiA 301, section 7.2.8.3.2) with a socket of its own.

    When a heartbeat came says the kernel, not when somebody found the time to look at it: what waits in the
    socket is read before any drive is judged. Boot-up messages count, too.

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
        self._config, self._nodes = bus, tuple(nodes)
        self._bus = self._open()
        self._batch = frames(BATCH)
        self._last = dict.fromkeys(self._nodes, time.monotonic())
        self._ended = dict.fromkeys(self._nodes, 0.0)

    def _open(self) -> FrameBus:
        classic = self._config.model_copy(update={"fd": False, "data_bitrate": None})
        return open_bus(classic, filters=[(COB_HEARTBEAT + node, COB_MASK) for node in self._nodes])

    def begin(self) -> None:
        """Wait for all drives from now on."""
        self.read()
        self._last = dict.fromkeys(self._nodes, time.monotonic())

    def read(self) -> None:
        """Take what has come; a bus that is down, or was removed, has nothing until it is back."""
        self._ended = dict.fromkeys(self._nodes, 0.0)
        if not self._bus.bound:
            with suppress(ArmidentError):
                fresh = self._open()
                self._bus.close()
                self._bus = fresh
        with suppress(BusDown):
            while (got := self._bus.receive(self._batch)) > 0:
                self._take(got)

    def _take(self, got: int) -> None:
        # Stamps are wall clock time, which may be set: only their age at this moment is used.
        ages = (time.time_ns() - self._batch["t_ns"][:got]) * 1e-9
        came = time.monotonic() - np.maximum(ages, 0.0)
        for node, at in zip((self._batch["can_id"][:got] - COB_HEARTBEAT).tolist(), came.tolist(), strict=True):
            self._ended[node] = max(self._ended[node], at - self._last[node])
            self._last[node] = max(self._last[node], at)

    def silent(self, node: int) -> float:
        """How long ago a drive's last heartbeat came, s."""
        return time.monotonic() - self._last[node]

    def ended(self, node: int) -> float:
        """The longest silence of a drive that ended with a heartbeat taken by the last :meth:`read`, s; 0: none did."""
        return self._ended[node]

    def close(self) -> None:
        """Release the socket."""
        self._bus.close()
