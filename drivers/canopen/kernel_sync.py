"""SYNC from the kernel: the broadcast manager (CAN_BCM) sends SYNC 1 to its counter's overflow over and over."""

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
    """What tells the kernel to send SYNC with a counter of 1 to ``counter`` every ``period_us``."""
    head = struct.pack(
        _HEAD, TX_SETUP, SETTIMER | STARTTIMER, 0, 0, 0, *divmod(period_us, 1_000_000), COB_SYNC, counter
    )
    return head + b"".join(struct.pack(_FRAME, COB_SYNC, 1, 0, 0, 0, bytes([k])) for k in range(1, counter + 1))


class KernelSync:
    """Has the kernel send SYNC k = 0, 1, 2, ... with counter ``k % counter + 1`` on one bus.

    The kernel's timer needs no wake-up of ours, so SYNC is punctual on a busy machine too. It counts each period from
    the end of the last one: the period comes out longer by what a timer is late, which is why the clock of
    several buses would drift apart, and nothing can be sent right behind SYNC.

    Parameters
    ----------
    bus, period_us, counter
        Where, how often, and the overflow of the counter.
    """

    sent: int | None = None
    """Only who receives them knows how many SYNC were sent."""

    def __init__(self, bus: Bus, period_us: int, counter: int) -> None:
        self._channel, self._message = bus.channel, setup_message(period_us, counter)
        self._socket: socket.socket | None = None

    def start(self) -> None:
        """Send the first SYNC one period from now.

        Raises
        ------
        ConfigError
            If there is no such bus, or the kernel has no CAN_BCM.
        BusDown
            If the bus is down.
        """
        # Says what is wrong with the interface, and what to do about it.
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
        """Send no further SYNC: the kernel's timer ends with the socket. Nothing happens the second time."""
        if self._socket is not None:
            self._socket.close()

    def check(self) -> None:
        """Nothing to tell: the kernel goes on by itself, and a bus that is down is seen by those who receive."""

    def __enter__(self) -> Self:
        """Start SYNC."""
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop SYNC."""
        self.stop()
