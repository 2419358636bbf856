"""Virtual drives on one bus: PDO exchange in batches, and SDO, NMT and EMCY by the canopen library."""

import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import can
import canopen
import numpy as np

from armident.configs import ConfigError
from armident.configs.schema.session import Bus
from armident.drivers.can.frames import STANDARD_ID_MASK, BusDown, frames
from armident.drivers.can.socketcan import RECEIVE_TIMEOUT, RawSocket
from armident.drivers.can.udp import open_bus, open_python_can
from armident.drivers.canopen.objects import COB_HEARTBEAT, COB_NMT, COB_SDO_REQUEST, COB_SYNC
from armident.virtual_robot.arm import DriveBackend
from armident.virtual_robot.node import Drive
from armident.virtual_robot.pdo_exchange import Exchange

PDO_FILTERS = ((0x180, 0x780), (0x200, 0x700), (0x300, 0x700), (0x400, 0x700), (0x500, 0x780))
"""Filters for the identifiers of PDOs, 180h to 57Fh; a socket does not receive its own frames."""
BATCH = 1024
"""Maximum number of frames per batch."""
NOTIFIER_CYCLE_S = 0.1
"""Longest time for which canopen's thread waits for a frame, and so delays the end of the drives, s."""
REOPEN_S = 0.02
"""Interval at which a bus that is down is checked, s."""


class GuardingListener(can.Listener):
    """Receives the requests of node guarding (CiA 301), which are remote frames, for the drives of a bus."""

    def __init__(self, drives: Sequence[Drive]) -> None:
        self._drives = {COB_HEARTBEAT + drive.node_id: drive for drive in drives}

    def on_message_received(self, msg: can.Message) -> None:
        """Let a drive answer a request. ``msg``: the received frame."""
        if msg.is_remote_frame and msg.arbitration_id in self._drives:
            self._drives[msg.arbitration_id].nmt.answer_guarding()

    def on_error(self, exc: Exception) -> None:
        """Accept the error of a bus that is down."""


class DriveBus:
    """Virtual drives on one bus, as of :class:`Exchange`; raises ConfigError if the bus does not exist."""

    def __init__(self, bus: Bus, drives: Sequence[Drive], motion: DriveBackend, period: float) -> None:
        self.config, self.drives = bus, drives
        self.bus = open_bus(bus, filters=((COB_SYNC, STANDARD_ID_MASK), *PDO_FILTERS))
        try:
            self._network = self._connected(canopen.Network())
        except BaseException:
            self.bus.close()
            raise
        self.exchange = Exchange(drives, motion, period)
        self.batch = frames(BATCH, fd=self.bus.fd)
        self._columns = self.batch["can_id"], self.batch["length"], self.batch["data"]
        self.down = False
        self._count = self._at = 0
        self._syncs: list[tuple[int, int]] = []
        """Counter and time stamp of the unanswered SYNCs in ``batch``, the next one last."""
        self._outbox, self._queued = frames(BATCH, fd=self.bus.fd), 0
        self._tried = 0.0
        # Compile before the first SYNC.
        self.take(0, 0, 1)

    def _connected(self, network: Any) -> Any:
        """Connect canopen to the bus with a filter for NMT commands, SDO requests and node guarding."""
        nodes = [drive.node_id for drive in self.drives]
        wanted = [COB_NMT, *(COB_SDO_REQUEST + node for node in nodes), *(COB_HEARTBEAT + node for node in nodes)]
        filters = [{"can_id": can_id, "can_mask": STANDARD_ID_MASK, "extended": False} for can_id in wanted]

        # Clearing the error keeps canopen's receive thread alive: its socket and the kernel's heartbeats work again
        # when the bus is back. A kept error would end every later SDO transfer.
        def clear(error: Exception) -> None:
            network.notifier.exception = None

        network.listeners[0].on_error = clear
        network.NOTIFIER_CYCLE = NOTIFIER_CYCLE_S
        network.listeners.append(GuardingListener(self.drives))
        try:
            network.bus = open_python_can(self.config, filters)
            network.connect()
        except (OSError, can.CanError) as error:
            raise ConfigError(f"bus {self.config.channel}: cannot be opened: {error}") from error
        return network

    def boot(self) -> None:
        """Boot all drives: boot-up message, pre-operational, heartbeat."""
        for drive in self.drives:
            self._network.add_node(drive)
            drive.nmt.boot()
            for oddity in drive.oddities:
                oddity.begin(self.config)

    def take(self, start: int, stop: int, sequence: int) -> int:
        """Process the frames of ``batch`` up to the next SYNC, as :meth:`Exchange.take`."""
        return self.exchange.take(*self._columns, start, stop, sequence)

    def receive(self, wait: bool) -> int:
        """Receive frames into ``batch``, waiting up to ``RECEIVE_TIMEOUT``; raises BusDown if the bus is down."""
        # One system call if possible, because they are slow in a guest kernel.
        if isinstance(self.bus, RawSocket):
            return self.bus.receive(self.batch, wait=wait)
        return self.bus.receive(self.batch) if not wait or self.bus.poll(RECEIVE_TIMEOUT) else 0

    def next_sync(self) -> tuple[int, int] | None:
        """Counter (0: none) and time, ns, of the next SYNC; ``None`` if there is none. Reopens a bus that is back."""
        if not self._syncs:
            self.flush()
            if self._at < self._count:
                # Set points after the last SYNC.
                self._at = self.take(self._at, self._count, 1)
            if self.down and not self._is_back():
                return None
            try:
                self._at, self._count = 0, self.receive(wait=False)
            except BusDown:
                self._lose()
            at = np.flatnonzero(self.batch["can_id"][: self._count] == COB_SYNC)
            counters = np.where(self.batch["length"][at] > 0, self.batch["data"][at, 0], 0)
            stamps = self.batch["t_ns"][at]
            self._syncs = list(zip(counters.tolist(), stamps.tolist(), strict=True))[::-1]
        return self._syncs[-1] if self._syncs else None

    def answer(self, sequence: int) -> None:
        """Queue the answers to the next SYNC and apply set points; ``sequence`` counts a SYNC without a counter."""
        self._syncs.pop()
        at = self.take(self._at, self._count, sequence)
        self._at = at + 1
        out = self.exchange.out
        if self._queued + out.size > self._outbox.size:
            self.flush()
        self._outbox[self._queued : self._queued + out.size] = out
        self._queued += out.size
        self.exchange.act()

    def flush(self) -> None:
        """Send the queued answers in one system call; they are dropped if the bus is down."""
        if self._queued:
            try:
                self.bus.send(self._outbox[: self._queued])
            except BusDown:
                self._lose()
            self._queued = 0

    def _lose(self) -> None:
        """Handle a bus that went down: earlier SYNCs are not answered, as by real drives."""
        self._syncs, self._at, self._count = [], 0, 0
        # The error is raised once more if sending detected it.
        for _ in range(2):
            with suppress(BusDown):
                while self.receive(wait=False) == BATCH:
                    pass
        self.down, self._tried = not self.bus.up, time.monotonic()

    def _is_back(self) -> bool:
        if time.monotonic() - self._tried < REOPEN_S:
            return False
        self._tried = time.monotonic()
        self.down = not self.bus.up
        return not self.down

    def close(self) -> None:
        """Stop the drives and release the bus."""
        for drive in self.drives:
            for oddity in drive.oddities:
                oddity.end()
            drive.nmt.halt()
        with suppress(can.CanError, OSError):
            self._network.disconnect()
        self.bus.close()
