"""CAN frames in NumPy arrays, and the protocol of a bus that sends and receives them."""

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
"""Received frame: kernel time (ns, UTC), then the 16 bytes of the kernel's ``struct can_frame``."""

FD_FRAME = np.dtype([(name, FRAME[name]) for name in (FRAME.names or ())[:-1]] + [("data", "u1", (64,))], align=True)
"""Received frame of a bus with CAN FD: kernel time (ns, UTC), then the 72 bytes of ``struct canfd_frame``."""

FD_FLAG, BIT_RATE_SWITCH = 0x04, 0x01
"""Bits of ``flags``: CAN FD frame, and data phase at the data bit rate (linux/can.h); a classic frame has neither."""

FD_LENGTHS: tuple[int, ...] = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Possible numbers of data bytes of a CAN FD frame (ISO 11898-1)."""

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
    """Interface of a bus that moves frames in batches."""

    channel: str
    dropped: int
    fd: bool

    @property
    def timestamp_source(self) -> str:
        """Clock of the time stamps: ``hardware`` or ``software``."""
        ...

    @property
    def up(self) -> bool:
        """``True`` if the bus can send and receive."""
        ...

    @property
    def bound(self) -> bool:
        """``True`` if the socket becomes usable again when the bus is back up."""
        ...

    def receive(self, batch: Frames) -> int:
        """Write received frames to the beginning of ``batch`` (N,); return their number, 0 if none."""
        ...

    def poll(self, timeout: float) -> bool:
        """Return True if a frame arrives within the timeout. ``timeout``: longest wait, s."""
        ...

    def send(self, frames: Frames) -> int:
        """Send all frames in order; return their number. ``frames``: array of ``FRAME`` or ``FD_FRAME``, shape (N,)."""
        ...

    def drops(self) -> int:
        """Number of frames dropped by the kernel so far, including those after the last received one."""
        ...

    def close(self) -> None:
        """Release the bus; further calls have no effect."""
        ...

    def __enter__(self) -> Self:
        """Use the bus in a ``with`` block."""
        ...

    def __exit__(self, *_: object) -> None:
        """Close the bus."""
        ...


def frames(n: int, fd: bool = False) -> Frames:
    """Array of empty frames. ``fd``: ``True`` for ``FD_FRAME``, else ``FRAME``."""
    return np.zeros(n, dtype=FD_FRAME if fd else FRAME)


def counts_by_length(received: Frames) -> NDArray[np.int64]:
    """Numbers of classic and of CAN FD frames by their number of data bytes, shape (2, 65)."""
    width = FD_LENGTHS[-1] + 1
    kinds = received["length"] + width * ((received["flags"] & FD_FLAG) != 0)
    return np.bincount(kinds, minlength=2 * width).reshape(2, width)


def fd_length(size: int) -> int:
    """Number of data bytes of the smallest CAN FD frame that carries a payload; ValueError if none does."""
    if size > FD_LENGTHS[-1]:
        raise ValueError(f"{size} bytes do not fit into the {FD_LENGTHS[-1]} of a CAN FD frame")
    return next(length for length in FD_LENGTHS if length >= size)


def frame(can_id: int, data: bytes = b"") -> Frames:
    """Array with one classic frame to send, shape (1,). ``data``: data bytes, at most 8."""
    one = frames(1)
    one["can_id"] = can_id
    one["length"] = len(data)
    one["data"][0, : len(data)] = np.frombuffer(data, dtype=np.uint8)
    return one
