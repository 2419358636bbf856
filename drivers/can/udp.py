"""Bus without SocketCAN by ``udp_multicast`` of python-can; loses frames above some thousand per second: for trials."""

import os
import socket
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any

import can
import numpy as np

from armident.configs.errors import ConfigError
from armident.configs.schema.session import Bus
from armident.drivers.can.frames import ERROR_FLAG, BusDown, Filter, FrameBus, Frames
from armident.drivers.can.socketcan import RawSocket

UDP_WARNING = "udp_multicast carries the bus over UDP and may lose frames: use it for trials, not for measurements"
"""Warning of programs that run on this bus."""

EXTENDED_FLAG = 0x8000_0000
"""Bit of ``can_id`` that marks a 29-bit identifier (linux/can.h)."""

RECEIVE_BUFFER = 4 << 20
"""Receive buffer that the kernel is asked for, bytes; it gives ``net.core.rmem_max`` at most."""

MULTICAST_ALL = {socket.AF_INET: (socket.IPPROTO_IP, 49), socket.AF_INET6: (socket.IPPROTO_IPV6, 29)}
"""Option ``MULTICAST_ALL`` by address family (linux/in.h, linux/in6.h): receive also the groups of other sockets."""


class UdpBus(AbstractContextManager["UdpBus", None]):
    """Bus over UDP multicast (``239.74.163.2``) like :class:`RawSocket`; receives the frames that it sends itself."""

    fd = False
    timestamp_source = "software"
    up = bound = True

    def __init__(self, channel: str, *, filters: Sequence[Filter] | None = None) -> None:
        self.channel = channel
        self.dropped = 0
        """Always 0: UDP does not count lost frames."""
        self._filters = filters
        try:
            self._bus = open_python_can(Bus(interface="udp_multicast", channel=channel))
        except (can.CanError, OSError, ValueError) as error:
            cause = error.__cause__ or error
            raise ConfigError(f"bus {channel}: cannot join the multicast group: {cause}") from error
        self._ahead: can.Message | None = None

    def receive(self, batch: Frames) -> int:
        """Write received frames to the beginning of ``batch`` (N,) without waiting; return their number."""
        n = 0
        while n < batch.size and (message := self._next(0.0)) is not None:
            if not self._passes(message.arbitration_id):
                continue
            into = batch[n]
            into["t_ns"] = round(message.timestamp * 1e9)
            into["can_id"] = (
                message.arbitration_id
                | (EXTENDED_FLAG if message.is_extended_id else 0)
                | (ERROR_FLAG if message.is_error_frame else 0)
            )
            into["length"] = message.dlc
            into["data"] = 0
            into["data"][: message.dlc] = np.frombuffer(message.data, dtype=np.uint8)
            n += 1
        return n

    def poll(self, timeout: float) -> bool:
        """Return True if a frame arrives within the timeout, s; raises BusDown if the network went down."""
        deadline = time.monotonic() + timeout
        while self._ahead is None:
            message = self._next(max(0.0, deadline - time.monotonic()))
            if message is None:
                return False
            if self._passes(message.arbitration_id):
                self._ahead = message
        return True

    def send(self, frames: Frames) -> int:
        """Send all frames (N,) in order and return N; raises BusDown if the network refuses one."""
        for one in frames:
            can_id = int(one["can_id"])
            message = can.Message(
                arbitration_id=can_id & ~EXTENDED_FLAG,
                is_extended_id=bool(can_id & EXTENDED_FLAG),
                data=one["data"][: one["length"]].tobytes(),
            )
            try:
                self._bus.send(message)
            except can.CanError as error:
                raise BusDown(f"bus {self.channel}: {error}") from error
        return int(frames.size)

    def drops(self) -> int:
        """Always 0."""
        return self.dropped

    def _next(self, timeout: float) -> can.Message | None:
        if self._ahead is not None:
            message, self._ahead = self._ahead, None
            return message
        try:
            return self._bus.recv(timeout)
        except can.CanError as error:
            raise BusDown(f"bus {self.channel}: {error}") from error

    def _passes(self, can_id: int) -> bool:
        return self._filters is None or any(can_id & mask == wanted & mask for wanted, mask in self._filters)

    def close(self) -> None:
        """Release the sockets; further calls have no effect."""
        self._bus.shutdown()

    def __exit__(self, *_: object) -> None:
        """Close the bus."""
        self.close()


def open_python_can(bus: Bus, filters: Sequence[dict[str, Any]] | None = None) -> can.BusABC:
    """Open a bus of a session with python-can; a multicast group receives the frames of no other group."""
    opened = can.Bus(bus.channel, interface=bus.interface, can_filters=filters)
    if bus.interface == "udp_multicast":
        with socket.socket(fileno=os.dup(opened.fileno())) as same:
            same.setsockopt(*MULTICAST_ALL[same.family], 0)
            same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
    return opened


def open_bus(
    bus: Bus, *, filters: Sequence[Filter] | None = None, errors: bool = False, hardware: bool = False
) -> FrameBus:
    """Open a bus of a session; ``errors`` and ``hardware`` (time stamps) have an effect where the bus has them."""
    if bus.interface == "udp_multicast":
        return UdpBus(bus.channel, filters=filters)
    return RawSocket(bus.channel, filters=filters, errors=errors, fd=bus.fd, hardware=hardware)
