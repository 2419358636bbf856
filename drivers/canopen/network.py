"""Access to the nodes of one bus: SDO and NMT by the canopen library, heartbeats and EMCY by sockets of their own.

Kernel filters keep TPDO and SYNC away from canopen's socket, because it takes tens of microseconds per frame.
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
from armident.drivers.can.filtered_socket import FilteredSocket
from armident.drivers.can.frames import STANDARD_ID_MASK, BusDown
from armident.drivers.can.socketcan import RawSocket
from armident.drivers.can.udp import open_python_can
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.eds import read_objects
from armident.drivers.canopen.emcy import Emergency, read_emergencies
from armident.drivers.canopen.heartbeat_monitor import HeartbeatSocket
from armident.drivers.canopen.objects import NmtCommand
from armident.drivers.canopen.sdo_client import SdoNode

REOPEN_S = 0.25
"""Interval at which a bus that is down is tried, s."""

log = logging.getLogger(__name__)


class _QuietListener(MessageListener):
    """Suppresses the traceback of a failing bus in canopen's thread; ``check`` raises the error."""

    def on_error(self, exc: Exception) -> None:
        """Accept the exception as handled; python-can keeps it for :meth:`canopen.Network.check`."""


class NodeNetwork:
    """Nodes of one bus. Raises ConfigError if the bus does not exist; BusDown if the bus is down."""

    def __init__(self, bus: Bus, drives: tuple[DriveNode, ...]) -> None:
        self.bus, self._nodes = bus, [drive.node_id for drive in drives]
        self.down = False
        self._tried = 0.0
        first = self._open()
        with ExitStack() as opened:
            opened.callback(first.shutdown)
            self.heartbeats = HeartbeatSocket(bus, self._nodes)
            opened.callback(self.heartbeats.close)
            self._requests = FilteredSocket(bus, [od.COB_SDO_REQUEST + node for node in self._nodes])
            opened.callback(self._requests.close)
            self._emergencies = FilteredSocket(bus, [od.COB_EMCY + node for node in self._nodes])
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
            # Raises an error that names the administrator's command if the interface is not usable.
            RawSocket(bus.channel, filters=(), receive_buffer=4096).close()
        try:
            return open_python_can(bus, filters)
        except (can.CanError, OSError) as error:
            raise ConfigError(f"bus {bus.channel}: {error.__cause__ or error}") from error

    def add(self, drive: DriveNode) -> canopen.RemoteNode:
        """Add a drive and return its canopen node. Raises ConfigError if its EDS cannot be read."""
        return self._network.add_node(SdoNode(drive.node_id, read_objects(drive.eds, drive.node_id)))

    def on_sdo_write(self, node_id: int, callback: Callable[[int, int], None]) -> None:
        """Call a function of object index and time (ns UTC) in canopen's thread, at foreign SDO writes to a node."""

        def on_request(_: int, data: bytearray, timestamp: float) -> None:
            if len(data) == 8 and data[0] >> 5 == od.SDO_DOWNLOAD:
                callback(int.from_bytes(data[1:3], "little"), round(timestamp * 1e9))

        self._network.subscribe(od.COB_SDO_REQUEST + node_id, on_request)

    def sdo_writes(self) -> Iterator[tuple[int, int, int]]:
        """Yield node id, object index and time (ns UTC) of SDO writes since the last call, without canopen's thread."""
        for batch in self._requests.read():
            downloads = batch[(batch["length"] == 8) & (batch["data"][:, 0] >> 5 == od.SDO_DOWNLOAD)]
            index = downloads["data"][:, 1].astype(int) + 256 * downloads["data"][:, 2].astype(int)
            nodes = downloads["can_id"].astype(int) - od.COB_SDO_REQUEST
            yield from zip(nodes.tolist(), index.tolist(), downloads["t_ns"].tolist(), strict=True)

    def emergencies(self) -> Iterator[Emergency]:
        """Yield the emergency messages since the last call, independently of canopen's thread."""
        for batch in self._emergencies.read():
            yield from read_emergencies(batch)

    def command(self, command: NmtCommand, node_id: int) -> None:
        """Send an NMT command to one node. ``node_id``: node id of the drive. Raises BusDown if the bus is down."""
        try:
            self._network.send_message(od.COB_NMT, bytes([command, node_id]))
        except (can.CanError, OSError, RuntimeError) as error:
            raise self._bus_down(error) from error

    def guard(self, node_id: int) -> None:
        """Ask a node for its NMT state (node guarding, CiA 301): a remote frame, which it answers as a heartbeat."""
        request = can.Message(
            arbitration_id=od.COB_HEARTBEAT + node_id, is_extended_id=False, is_remote_frame=True, dlc=1
        )
        bus = self._network.bus
        if bus is None:
            raise BusDown(f"bus {self.bus.channel}: closed")
        try:
            with self._network.send_lock:
                bus.send(request)
        except (can.CanError, OSError) as error:
            raise self._bus_down(error) from error

    def check(self) -> None:
        """Raise the error that ended canopen's receive thread, if any. Raises BusDown if the bus went down."""
        try:
            self._network.check()
        except Exception as error:
            raise self._bus_down(error) from error

    def reopen(self) -> bool:
        """Reopen a bus that went down and is back; return True if the bus is usable."""
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
            with suppress(Exception):  # canopen raises the error of its receive thread again
                self._network.disconnect()
            self._network.bus = fresh
            self._network.connect()
            self.down = False
        return not self.down

    def _bus_down(self, error: Exception) -> BusDown:
        return BusDown(f"bus {self.bus.channel}: {error}")

    def close(self) -> None:
        """Release the bus."""
        self.heartbeats.close()
        self._requests.close()
        self._emergencies.close()
        try:
            self._network.disconnect()
        except Exception as error:  # canopen raises the error of its receive thread again
            log.debug("disconnect: %s", error)
