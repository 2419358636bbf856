"""CAN frames in arrays: the one form in which they travel between the buses and the rest."""

from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from armident.configs.errors import ArmidentError

FRAME = np.dtype(
    [
        ("t_ns", "<i8"), ("can_id", "<u4"), ("length", "u1"),
        ("flags", "u1"), ("reserved", "u1", (2,)), ("data", "u1", (8,)),
    ], align=True,
)  # fmt: skip
"""A received frame: kernel time (ns, UTC), then the 16 bytes of the kernel's ``struct can_frame`` as they are."""

FD_FRAME = np.dtype([(name, FRAME[name]) for name in (FRAME.names or ())[:-1]] + [("data", "u1", (64,))], align=True)
"""The same of a bus with CAN FD: kernel time, then the 72 bytes of ``struct canfd_frame``."""

FD_FLAG, BIT_RATE_SWITCH = 0x04, 0x01
"""Bits of ``flags``: a CAN FD frame, whose data go at the data bit rate (linux/can.h); a frame without is classic."""

FD_LENGTHS: tuple[int, ...] = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""How many data bytes a CAN FD frame can have (ISO 11898-1)."""

STANDARD_ID_MASK = 0x7FF
"""Bits of an 11-bit identifier."""

ERROR_FLAG = 0x2000_0000
"""Bit of ``can_id`` that marks an error frame of the controller (linux/can.h)."""

Filter = tuple[int, int]
"""Identifier and mask: frames with ``can_id & mask == identifier & mask`` pass."""

Frames = NDArray[Any]
"""An array of ``FRAME`` or ``FD_FRAME`` of shape (N,)."""


class BusDown(ArmidentError):
    """The bus went down, or its interface was removed, while it was in use."""


class FrameBus(Protocol):
    """What capture, drives and SYNC producer need of a bus."""

    channel: str
    dropped: int
    fd: bool

    @property
    def stamps(self) -> str:
        """Whose clock stamps the frames: ``hardware`` or ``software``."""
        ...

    @property
    def up(self) -> bool:
        """Whether frames can come and go."""
        ...

    @property
    def bound(self) -> bool:
        """Whether the bus can still come back, when it is down."""
        ...

    def receive(self, batch: Frames) -> int:
        """Fill the beginning of ``batch`` with what has arrived; the number of frames, 0 if none."""
        ...

    def poll(self, timeout: float) -> bool:
        """Whether a frame arrived within ``timeout`` seconds."""
        ...

    def send(self, frames: Frames) -> int:
        """Send all frames in order; the number of frames sent."""
        ...

    def drops(self) -> int:
        """Frames that were dropped so far, those behind the last one received among them."""
        ...

    def close(self) -> None:
        """Release the bus; nothing happens the second time."""
        ...

    def __enter__(self) -> Self:
        """Use the bus in a ``with`` block."""
        ...

    def __exit__(self, *_: object) -> None:
        """Close the bus."""
        ...


def frames(n: int, fd: bool = False) -> Frames:
    """An array of ``n`` empty frames; with ``fd`` with room for those of CAN FD."""
    return np.zeros(n, dtype=FD_FRAME if fd else FRAME)


def fd_length(size: int) -> int:
    """The length of the CAN FD frame that carries ``size`` bytes: the rest is padding.

    Raises
    ------
    ValueError
        If no frame carries as many.
    """
    if size > FD_LENGTHS[-1]:
        raise ValueError(f"{size} bytes do not fit into the {FD_LENGTHS[-1]} of a CAN FD frame")
    return next(length for length in FD_LENGTHS if length >= size)


def frame(can_id: int, data: bytes = b"") -> Frames:
    """An array with one classic frame to send."""
    one = frames(1)
    one["can_id"] = can_id
    one["length"] = len(data)
    one["data"][0, : len(data)] = np.frombuffer(data, dtype=np.uint8)
    return one
