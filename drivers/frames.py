"""CAN frames in arrays: the one form in which they travel between the buses and the rest."""

from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from configs.errors import ArmidentError

FRAME = np.dtype(
    [("t_ns", "<i8"), ("can_id", "<u4"), ("length", "u1"), ("reserved", "u1", (3,)), ("data", "u1", (8,))], align=True
)
"""A received frame: kernel time (ns, UTC), then the 16 bytes of the kernel's ``struct can_frame`` as they are."""

ERROR_FLAG = 0x2000_0000
"""Bit of ``can_id`` that marks an error frame of the controller (linux/can.h)."""

Filter = tuple[int, int]
"""Identifier and mask: frames with ``can_id & mask == identifier & mask`` pass."""

Frames = NDArray[Any]
"""An array of ``FRAME`` of shape (N,)."""


class BusDown(ArmidentError):
    """The bus went down, or its interface was removed, while it was in use."""


class FrameBus(Protocol):
    """What capture, drives and SYNC producer need of a bus."""

    channel: str
    dropped: int

    def receive(self, batch: Frames) -> int:
        """Fill the beginning of ``batch`` with what has arrived; the number of frames, 0 if none."""
        ...

    def poll(self, timeout: float) -> bool:
        """Whether a frame arrived within ``timeout`` seconds."""
        ...

    def send(self, frames: Frames) -> int:
        """Send all frames in order; the number of frames sent."""
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


def frames(n: int) -> Frames:
    """An array of ``n`` empty frames."""
    return np.zeros(n, dtype=FRAME)


def frame(can_id: int, data: bytes = b"") -> Frames:
    """An array with one frame to send."""
    one = frames(1)
    one["can_id"] = can_id
    one["length"] = len(data)
    one["data"][0, : len(data)] = np.frombuffer(data, dtype=np.uint8)
    return one
