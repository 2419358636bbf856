"""Arrays of ``struct mmsghdr`` for batches of CAN frames (``recvmmsg``, ``sendmmsg``; linux/socket.h, 64 bits)."""

import numpy as np

from armident.drivers.can.frames import FD_FLAG, FD_FRAME, FRAME, Frames

_MESSAGE = np.dtype(
    {
        "names": ["iov", "iovlen", "control", "controllen", "flags", "length"],
        "formats": ["<u8", "<u8", "<u8", "<u8", "<i4", "<u4"],
        "offsets": [16, 24, 32, 40, 48, 56],
        "itemsize": 64,
    }
)
_IOVEC = np.dtype([("base", "<u8"), ("length", "<u8")])
# The kernel writes the time stamp first, followed by the drop counter once frames were dropped.
STAMP_CONTROL = np.dtype(
    {
        "names": ["seconds", "nanoseconds", "drops"],
        "formats": ["<i8", "<i8", "<u4"],
        "offsets": [16, 24, 48],
        "itemsize": 56,
    }
)
"""Control messages of SO_TIMESTAMPNS and SO_RXQ_OVFL."""
HARDWARE_CONTROL = np.dtype(
    {
        "names": ["seconds", "nanoseconds", "hardware_seconds", "hardware_nanoseconds", "drops"],
        "formats": ["<i8", "<i8", "<i8", "<i8", "<u4"],
        "offsets": [16, 24, 48, 56, 80],
        "itemsize": 88,
    }
)
"""Control messages of SO_TIMESTAMPING (software, unused, raw hardware time) and SO_RXQ_OVFL."""
DROP_CONTROL_BYTES = 24
"""Size of the drop counter in the control messages of a frame, bytes."""

CLASSIC_MTU, FD_MTU = FRAME.itemsize - 8, FD_FRAME.itemsize - 8
"""Sizes of ``struct can_frame`` and ``struct canfd_frame``, bytes."""


class Messages:
    """Preallocated ``struct mmsghdr`` for at most ``n`` frames; ``body`` (n, 16) or (n, 72) has their bytes.

    ``control`` adds space for software time stamps and drop counters, ``hardware`` for hardware time stamps.
    """

    def __init__(self, n: int, control: bool = True, fd: bool = False, hardware: bool = False) -> None:
        size = FD_MTU if fd else CLASSIC_MTU
        self.body = np.zeros((n, size), dtype=np.uint8)
        self.iovec = np.zeros(n, dtype=_IOVEC)
        self.iovec["base"] = self.body.ctypes.data + size * np.arange(n, dtype=np.uint64)
        self.iovec["length"] = size
        self.header = np.zeros(n, dtype=_MESSAGE)
        self.header["iov"] = self.iovec.ctypes.data + _IOVEC.itemsize * np.arange(n, dtype=np.uint64)
        self.header["iovlen"] = 1
        layout = HARDWARE_CONTROL if hardware else STAMP_CONTROL
        self.control = np.zeros(n if control else 0, dtype=layout)
        if control:
            self.header["control"] = self.control.ctypes.data + layout.itemsize * np.arange(n, dtype=np.uint64)
            self.header["controllen"] = layout.itemsize
        self.address: int = self.header.ctypes.data

    def load(self, frames: Frames) -> None:
        """Copy at most ``n`` frames to send; those with ``FD_FLAG`` go as CAN FD, others as classic frames."""
        octets = frame_bytes(frames)[:, 8:]
        width = min(octets.shape[1], self.body.shape[1])
        self.body[: frames.size, :width] = octets[:, :width]
        if self.body.shape[1] == FD_MTU:
            fd = (frames["flags"] & FD_FLAG) != 0
            self.iovec["length"][: frames.size] = np.where(fd, FD_MTU, CLASSIC_MTU)

    def unload(self, batch: Frames) -> None:
        """Copy the bodies of received frames into ``batch`` (N,), all but the times."""
        got = batch.size
        frame_bytes(batch)[:, 8:] = self.body[:got]
        if self.body.shape[1] == FD_MTU:
            batch["flags"][self.header["length"][:got] == FD_MTU] |= FD_FLAG


def frame_bytes(batch: Frames) -> "np.ndarray[tuple[int, ...], np.dtype[np.uint8]]":
    """View of a contiguous array of frames (N,) as bytes, (N, 24) or (N, 80); ValueError if it is not contiguous."""
    if not batch.flags.c_contiguous:
        raise ValueError("frames must lie contiguously in memory")
    return batch.view(np.uint8).reshape(batch.size, batch.dtype.itemsize)
