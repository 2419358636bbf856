"""One bus as canopen sees it: SDO, NMT and heartbeats of its drives, and nothing of the hot path.

Filters in the kernel keep TPDO and SYNC away from canopen's socket: it costs tens of microseconds per frame.
"""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress

import can
import canopen
from canopen.network import MessageListener

from armident.configs.errors import ArmidentError, ConfigError
from armident.configs.schema.session import Bus, DriveNode
from armident.drivers.can.filtered_socket import SideSocket
from armident.drivers.can.frames import STANDARD_ID_MASK, BusDown
from armident.drivers.can.socketcan import RawSocket
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.emcy import Emergency, read_emergencies
from armident.drivers.canopen.heartbeat_monitor import HeartbeatSocket
from armident.drivers.canopen.objects import NmtCommand

REOPEN_S = 0.25
"""How often a bus that is down is tried again."""

log = logging.getLogger(__name__)


class _QuietListener(MessageListener):
    """Keeps a failing bus from printing a traceback in canopen's thread; ``check`` raises the error."""

    def on_error(self, exc: Exception) -> None:
        """Take the exception as handled; python-can keeps it for :meth:`canopen.Network.check`."""


class NodeNetwork:
    """The nodes of one bus.

    Parameters
    ----------
    bus
        The bus.
    drives
        The drives that are on it.

    Raises
    ------
    ConfigError
        If there is no such bus.
    BusDown
        If the bus is down.
    """

    def __init__(self, bus: Bus, drives: tuple[DriveNode, ...]) -> None:
        self.bus, self._nodes = bus, [drive.node_id for drive in drives]
        self.down = False
        self._tried = 0.0
        first = self._open()
        with ExitStack() as opened:
            opened.callback(first.shutdown)
            self.heartbeats = HeartbeatSocket(bus, self._nodes)
            opened.callback(self.heartbeats.close)
            self._requests = SideSocket(bus, [od.COB_SDO_REQUEST + node for node in self._nodes])
            opened.callback(self._requests.close)
            self._emergencies = SideSocket(bus, [od.COB_EMCY + node for node in self._nodes])
            opened.pop_all()
        self._network = canopen.Network(bus=first)
        self._network.NOTIFIER_CYCLE = 0.05
        self._network.listeners = [_QuietListener(self._network)]
        self._network.connect()

    def _open(self) -> can.BusABC:
        bus = self.bus
        filters = [
            {"can_id": base + node, "can_mask": STANDARD_ID_MASK, "extended": False}
            for node in self._nodes
            for base in (od.COB_SDO_RESPONSE, od.COB_SDO_REQUEST, od.COB_HEARTBEAT)
        ]
        if bus.interface == "socketcan":
            # Says what is wrong with the interface, and what to do about it.
            RawSocket(bus.channel, filters=(), receive_buffer=4096).close()
        try:
            return can.Bus(bus.channel, interface=bus.interface, can_filters=filters)
        except (can.CanError, OSError) as error:
            raise ConfigError(f"bus {bus.channel}: {error.__cause__ or error}") from error

    def add(self, drive: DriveNode) -> canopen.RemoteNode:
        """Add a drive.

        Raises
        ------
        ConfigError
            If its EDS cannot be read.
        """
        try:
            return self._network.add_node(drive.node_id, str(drive.eds))
        except Exception as error:
            raise ConfigError(f"{drive.eds}: not a valid EDS file: {error}") from error

    def overhear(self, node_id: int, told: Callable[[int, int], None]) -> None:
        """Have ``told`` called with object index and time (ns, UTC) of what others write to a drive over SDO.

        Our own requests do not come back to the socket that sent them.
        """

        def heard(_: int, data: bytearray, timestamp: float) -> None:
            if len(data) == 8 and data[0] >> 5 == od.SDO_DOWNLOAD:
                told(int.from_bytes(data[1:3], "little"), round(timestamp * 1e9))

        self._network.subscribe(od.COB_SDO_REQUEST + node_id, heard)

    def written(self) -> Iterator[tuple[int, int, int]]:
        """Node, object index and time (ns, UTC) of what anybody, we too, has written over SDO since the last call.

        Unlike ``overhear`` it waits for no thread.
        """
        for batch in self._requests.read():
            downloads = batch[(batch["length"] == 8) & (batch["data"][:, 0] >> 5 == od.SDO_DOWNLOAD)]
            index = downloads["data"][:, 1].astype(int) + 256 * downloads["data"][:, 2].astype(int)
            nodes = downloads["can_id"].astype(int) - od.COB_SDO_REQUEST
            yield from zip(nodes.tolist(), index.tolist(), downloads["t_ns"].tolist(), strict=True)

    def emergencies(self) -> Iterator[Emergency]:
        """The emergency messages since the last call, however busy canopen's thread is."""
        for batch in self._emergencies.read():
            yield from read_emergencies(batch)

    def command(self, command: NmtCommand, node_id: int) -> None:
        """Send an NMT command to one node.

        Raises
        ------
        BusDown
            If the bus is down.
        """
        try:
            self._network.send_message(od.COB_NMT, bytes([command, node_id]))
        except (can.CanError, OSError, RuntimeError) as error:
            raise self._bus_down(error) from error

    def check(self) -> None:
        """Raise what ended the reading of the bus, if something did.

        Raises
        ------
        BusDown
            If the bus went down.
        """
        try:
            self._network.check()
        except Exception as error:
            raise self._bus_down(error) from error

    def revive(self) -> bool:
        """Whether the bus can be used; one that went down is opened anew as soon as it is back."""
        if not self.down:
            try:
                self.check()
            except BusDown as error:
                log.debug("%s", error)
                self.down = True
        if self.down and time.monotonic() - self._tried >= REOPEN_S:
            self._tried = time.monotonic()
            try:
                fresh = self._open()
            except ArmidentError:
                return False
            with suppress(Exception):  # canopen raises here again what ended its receive thread
                self._network.disconnect()
            self._network.bus = fresh
            self._network.connect()
            self.down = False
        return not self.down

    def _bus_down(self, error: Exception) -> BusDown:
        return BusDown(f"bus {self.bus.channel}: {error}")

    def close(self) -> None:
        """Leave the bus."""
        self.heartbeats.close()
        self._requests.close()
        self._emergencies.close()
        try:
            self._network.disconnect()
        except Exception as error:  # canopen raises here again what ended its receive thread
            log.debug("disconnect: %s", error)
