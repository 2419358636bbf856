"""SYNC producer in the kernel: the broadcast manager (CAN_BCM) sends SYNC with all counter values cyclically."""

import socket
import struct
from typing import Self

from armident.configs.errors import ConfigError
from armident.configs.schema.session import Bus
from armident.drivers.can.frames import BusDown
from armident.drivers.can.socketcan import RawSocket
from armident.drivers.canopen.objects import COB_SYNC

TX_SETUP = 1
SETTIMER, STARTTIMER = 0x1, 0x2
_HEAD = "=IIIxxxxqqqqII"
"""``struct bcm_msg_head`` of linux/can/bcm.h: opcode, flags, count, two intervals, identifier, number of frames."""
_FRAME = "=IBBBB8s"


def setup_message(period_us: int, counter: int) -> bytes:
    """Message that makes the kernel send SYNC cyclically, with counter 1 to ``counter`` (1019h) unless that is 0."""
    contents = [bytes([k]) for k in range(1, counter + 1)] or [b""]
    head = struct.pack(
        _HEAD, TX_SETUP, SETTIMER | STARTTIMER, 0, 0, 0, *divmod(period_us, 1_000_000), COB_SYNC, len(contents)
    )
    return head + b"".join(struct.pack(_FRAME, COB_SYNC, len(data), 0, 0, 0, data) for data in contents)


class KernelSync:
    """SYNC producer in the kernel: sends SYNC k = 0, 1, 2, ... with counter ``k % counter + 1`` on one bus.

    Its timer is punctual on a busy machine too. Each period starts at the end of the last, lengthened by the timer's
    latency: clocks of several buses would drift apart. Set points cannot follow SYNC directly.
    """

    sent: int | None = None
    """Number of SYNCs sent: unknown, only a receiver can count them."""

    def __init__(self, bus: Bus, period_us: int, counter: int) -> None:
        self._channel, self._message = bus.channel, setup_message(period_us, counter)
        self._socket: socket.socket | None = None

    def start(self) -> None:
        """Send the first SYNC one period from now; ConfigError if the kernel has no CAN_BCM."""
        # Raises an error that names the administrator's command if the interface is not usable.
        RawSocket(self._channel, filters=(), receive_buffer=4096).close()
        try:
            self._socket = socket.socket(socket.AF_CAN, socket.SOCK_DGRAM, socket.CAN_BCM)
        except OSError as error:
            raise ConfigError(
                f"bus {self._channel}: this kernel has no CAN_BCM for sync.source: kernel "
                "(an administrator may try: sudo modprobe can_bcm)"
            ) from error
        try:
            self._socket.connect((self._channel,))
            self._socket.send(self._message)
        except OSError as error:
            self.stop()
            raise BusDown(f"bus {self._channel}: the kernel does not take SYNC: {error.strerror}") from error

    def stop(self) -> None:
        """Stop SYNC: the kernel's timer ends with the socket. Further calls have no effect."""
        if self._socket is not None:
            self._socket.close()

    def check(self) -> None:
        """Do nothing: the kernel continues by itself, and receivers detect a bus that is down."""

    def __enter__(self) -> Self:
        """Start SYNC."""
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop SYNC."""
        self.stop()
