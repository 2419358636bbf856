"""Reception of a SocketCAN bus through a ring in shared memory: no system call and no copy by the kernel per frame.

An ``AF_PACKET`` socket with a memory-mapped receive ring of version ``TPACKET_V2`` (Linux, packet_mmap.rst). The kernel
writes each frame and its time stamp to the next slot of the ring, and compiled code copies them to arrays of frames.
The socket needs the capability CAP_NET_RAW, and it only receives.
"""

import errno
import functools
import logging
import mmap
import select
import socket
import struct
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from armident.configs.schema.session import Bus
from armident.drivers.can import interface
from armident.drivers.can.frames import (
    ERROR_FLAG,
    FD_FLAG,
    STANDARD_ID_MASK,
    BusDown,
    Filter,
    Frames,
    FrameSource,
    frames,
)
from armident.drivers.can.mmsg import CLASSIC_MTU, FD_MTU, frame_bytes
from armident.drivers.can.timestamps import SO_TIMESTAMPNS, has_hardware_timestamps
from armident.drivers.can.udp import open_bus

log = logging.getLogger(__name__)

SLOTS = 1 << 18
"""Default number of frames in the ring: 7 s of 36 000 frames/s. The kernel allocates the ring when the bus opens."""
BLOCK_BYTES = 15 * mmap.PAGESIZE
"""Size of one contiguous allocation of the kernel, bytes: a multiple of both slot sizes, just below 16 pages."""
HEADER_BYTES = 80
"""Offset of the frame in its slot, bytes: ``TPACKET2_HDRLEN`` and 16 bytes for a link header, aligned to 16."""

SOL_PACKET = 263
PACKET_RX_RING, PACKET_STATISTICS, PACKET_VERSION, PACKET_IGNORE_OUTGOING = 5, 6, 10, 23
TPACKET_V2 = 1
ETH_P_ALL, ETH_P_CAN = 0x0003, 0x000C
"""Protocols of packet sockets (linux/if_ether.h): all frames, or classic CAN frames only."""
STATUS_USER, STATUS_LOSING = 1 << 0, 1 << 2
"""Bits of ``tp_status`` (linux/if_packet.h): slot filled by the kernel; frames were dropped before this one."""
_CLASSIC_BYTES, _FD_BYTES = CLASSIC_MTU, FD_MTU
_FD_BIT = FD_FLAG << 40


@njit(cache=True, nogil=True)
def filled(slots: Any, first: Any, most: Any) -> Any:
    """Number of consecutive slots that the kernel has filled.

    Parameters
    ----------
    slots
        The ring as numbers of 8 bytes, int64, shape (N, 12) or (N, 20).
    first
        Number of the first slot.
    most
        Maximum result; never more than the ring has slots.
    """
    k = first
    most = min(most, slots.shape[0])
    for count in range(most):
        if slots[k, 0] & STATUS_USER == 0:
            return count
        k = k + 1 if k + 1 < slots.shape[0] else 0
    return most


@njit(cache=True, nogil=True)
def copy_frames(slots: Any, first: Any, count: Any, accept: Any, errors: Any, into: Any) -> Any:
    """Copy the frames of filled slots.

    Parameters
    ----------
    slots, first
        As for `filled`.
    count
        Number of slots.
    accept
        ``True`` for each 11-bit identifier that is received, shape (2048,).
    errors
        ``True`` to receive error frames.
    into
        Frames as numbers of 8 bytes, int64, shape (M, 3) or (M, 10), M >= count.

    Returns
    -------
    written : int
        Number of frames written to ``into``.
    losing : bool
        ``True`` if the kernel dropped frames before one of the slots.
    """
    words = into.shape[1] - 1
    written = 0
    losing = False
    following = first
    for _ in range(count):
        k = following
        following = k + 1 if k + 1 < slots.shape[0] else 0
        losing |= slots[k, 0] & STATUS_LOSING != 0
        # tp_snaplen, and tp_mac: the offset of the frame.
        length = slots[k, 1] & 0xFFFFFFFF
        if (length != _CLASSIC_BYTES and length != _FD_BYTES) or length > 8 * words:
            continue
        start = ((slots[k, 1] >> 32) & 0xFFFF) // 8
        can_id = slots[k, start] & 0xFFFFFFFF
        if can_id & ERROR_FLAG:
            if not errors:
                continue
        elif not accept[can_id & STANDARD_ID_MASK]:
            continue
        # tp_sec and tp_nsec
        stamp = slots[k, 2]
        into[written, 0] = (stamp & 0xFFFFFFFF) * 1_000_000_000 + ((stamp >> 32) & 0xFFFFFFFF)
        for w in range(words):
            into[written, 1 + w] = slots[k, start + w] if 8 * w < length else 0
        if length == _FD_BYTES:
            into[written, 1] |= _FD_BIT
        written += 1
    return written, losing


@njit(cache=True, nogil=True)
def release(slots: Any, first: Any, count: Any) -> None:
    """Return slots to the kernel.

    Parameters
    ----------
    slots
        The ring as numbers of 8 bytes, int64, shape (N, 12) or (N, 20); changed in place.
    first
        Number of the first slot.
    count
        Number of slots.
    """
    k = first
    for _ in range(count):
        slots[k, 0] = 0
        k = k + 1 if k + 1 < slots.shape[0] else 0


# mypy types compiled functions by their Python signatures, which do not contain the types that numba accepts.
_filled: Any = filled
_copy_frames: Any = copy_frames
_release: Any = release


class PacketRing:
    """Receives all frames of one CAN interface through a memory-mapped ring.

    Parameters
    ----------
    channel
        Name of the interface, ``vcan0``.
    filters
        Filters of 11-bit identifiers; ``None``: all frames.
    errors
        ``True`` to receive error frames of the controller.
    fd
        ``True`` to receive CAN FD frames as well; batches are then arrays of ``FD_FRAME``.
    slots
        Minimum number of frames in the ring.

    Raises
    ------
    PermissionError
        If the process lacks CAP_NET_RAW.
    OSError
        If the kernel has no packet sockets or no memory for the ring.
    ValueError
        If a filter's mask exceeds 11 bits.
    ConfigError
        If there is no such CAN interface, or it carries no CAN FD.
    BusDown
        If the interface is down.
    """

    timestamp_source = "software"

    def __init__(
        self,
        channel: str,
        *,
        filters: Sequence[Filter] | None = None,
        errors: bool = False,
        fd: bool = False,
        slots: int = SLOTS,
    ) -> None:
        self.channel = channel
        self.fd = fd
        self.dropped = 0
        """Number of frames dropped by the kernel before the last received one, since the ring was opened."""
        self._known = 0
        """Number of dropped frames that the kernel has reported so far."""
        self._ahead = 0
        """Number of slots that were filled before frames were dropped, without a mark on the frames behind."""
        self._next = 0
        """Number of the slot that the kernel fills next, or of the first filled one."""
        self._errors = errors
        self._accept = np.ones(STANDARD_ID_MASK + 1, np.bool_)
        if filters is not None:
            identifiers = np.arange(STANDARD_ID_MASK + 1)
            self._accept[:] = False
            for can_id, mask in filters:
                if mask > STANDARD_ID_MASK:
                    raise ValueError(f"filter mask {mask:#x} exceeds 11 bits")
                self._accept |= (identifiers & mask) == (can_id & mask)
        # Protocol 0: nothing is received before the interface is chosen.
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
        try:
            self._slots = self._map(slots)
            # Compiled before the first frame.
            self._take(frames(1, fd), 0)
            self._bind()
        except BaseException:
            self._socket.close()
            raise
        self._poll = select.poll()
        self._poll.register(self._socket, select.POLLIN)

    def _map(self, slots: int) -> NDArray[np.int64]:
        size = HEADER_BYTES + -(-(FD_MTU if self.fd else CLASSIC_MTU) // 16) * 16
        blocks = -(-slots * size // BLOCK_BYTES)
        count = blocks * BLOCK_BYTES // size
        self._socket.setsockopt(SOL_PACKET, PACKET_VERSION, TPACKET_V2)
        self._socket.setsockopt(SOL_PACKET, PACKET_RX_RING, struct.pack("=4I", BLOCK_BYTES, blocks, size, count))
        # Frames are stamped on arrival, as for a raw CAN socket, not when they are copied to the ring.
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        ring = np.frombuffer(mmap.mmap(self._socket.fileno(), blocks * BLOCK_BYTES), np.int64).reshape(count, size // 8)
        # The first write to a page faults, at 30 us in a guest kernel: not while frames arrive.
        ring[:, 0] = 0
        return ring

    def _bind(self) -> None:
        if not interface.is_can(self.channel):
            raise interface.missing(self.channel, "not a CAN interface")
        if not self.up:
            raise interface.down(self.channel, "is down")
        protocol = ETH_P_CAN
        if self.fd:
            interface.check_fd(self.channel)
            protocol = ETH_P_ALL
            self._socket.setsockopt(SOL_PACKET, PACKET_IGNORE_OUTGOING, 1)
        try:
            self._socket.bind((self.channel, protocol))
        except OSError as error:
            if error.errno == errno.ENODEV:
                raise interface.missing(self.channel, error.strerror) from error
            raise

    @property
    def bound(self) -> bool:
        """``True`` while the socket has its interface; after a removal of the interface the socket is unusable."""
        return bool(self._socket.getsockname()[0])

    @property
    def up(self) -> bool:
        """``True`` if the interface is administratively up."""
        return interface.is_up(self.channel)

    def receive(self, batch: Frames) -> int:
        """Write received frames to the beginning of ``batch``.

        Parameters
        ----------
        batch
            Contiguous array of ``FRAME`` (``FD_FRAME`` with ``fd``), shape (N,), written in place.

        Returns
        -------
        int
            Number of frames, 0 if none had arrived.

        Raises
        ------
        BusDown
            If the interface went down or was removed.
        """
        while True:
            count = _filled(self._slots, self._next, batch.size)
            if count == 0:
                self._check()
                return 0
            written, losing = self._take(batch, count)
            self._assign_drops(count, losing, count < batch.size)
            if written:
                return written

    def _take(self, batch: Frames, count: int) -> tuple[int, bool]:
        """Copy filled slots to a batch and release them; return the number of frames, and True if some were dropped."""
        # Separate calls, so that no compiler moves reads of a slot before its status or behind its release.
        into = frame_bytes(batch).view(np.int64)
        written, losing = _copy_frames(self._slots, self._next, count, self._accept, self._errors, into)
        _release(self._slots, self._next, count)
        self._next = (self._next + count) % len(self._slots)
        return int(written), bool(losing)

    def _assign_drops(self, count: int, losing: bool, emptied: bool) -> None:
        """Add the frames that were lost before the taken slots to `dropped`."""
        if losing:
            self._read_drops()
            # Only the sum of several losses is known: one frame for each batch, the rest with the last one.
            self.dropped = self._known if emptied else min(self.dropped + 1, self._known)
        elif self._ahead < count:
            self.dropped = self._known
        self._ahead = max(0, self._ahead - count)

    def _read_drops(self) -> int:
        """Read and reset the kernel's counter; return the number of frames dropped since the last call."""
        _, dropped = struct.unpack("=2I", self._socket.getsockopt(SOL_PACKET, PACKET_STATISTICS, 8))
        self._known += dropped
        return int(dropped)

    def _check(self) -> None:
        code = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if code == 0:
            return
        if code in (errno.ENETDOWN, errno.ENODEV, errno.ENXIO):
            raise interface.down(self.channel, "went down" if self.bound else "was removed")
        raise BusDown(f"bus {self.channel}: {OSError(code, errno.errorcode.get(code, str(code)))}")

    def drops(self) -> int:
        """Number of frames dropped by the kernel so far, including those after the last received one."""
        if self._read_drops():
            # Frames behind this loss are not marked any more: it follows the slots that are filled now.
            self._ahead = int(_filled(self._slots, self._next, len(self._slots)))
        return self._known

    def poll(self, timeout: float) -> bool:
        """Return True if a frame arrives within the timeout.

        Parameters
        ----------
        timeout
            Longest wait, s.

        Raises
        ------
        BusDown
            If the interface went down or was removed.
        """
        for _, event in self._poll.poll(max(0.0, timeout) * 1000):
            if event & (select.POLLERR | select.POLLHUP | select.POLLNVAL):
                self._check()
            return bool(event & select.POLLIN)
        return False

    def close(self) -> None:
        """Release the socket and the ring; further calls have no effect."""
        # The memory is unmapped with the last reference to it.
        self._slots = np.zeros((1, self._slots.shape[1]), np.int64)
        self._socket.close()

    def __enter__(self) -> Self:
        """Use the ring in a ``with`` block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release the ring."""
        self.close()


def open_source(
    bus: Bus, *, filters: Sequence[Filter] | None = None, errors: bool = False, hardware: bool = False
) -> FrameSource:
    """Open a bus of a session that is only received from: by a packet ring where possible, else as `open_bus` does.

    Parameters
    ----------
    bus
        The bus.
    filters
        Frames to receive; ``None``: all.
    errors
        ``True`` to receive error frames, if the bus has them.
    hardware
        ``True`` to use hardware time stamps, if the interface has them; the ring has none.

    Raises
    ------
    ConfigError
        If the bus does not exist.
    BusDown
        If the bus is down.
    """
    if bus.interface == "socketcan" and not (hardware and has_hardware_timestamps(bus.channel)):
        try:
            return PacketRing(bus.channel, filters=filters, errors=errors, fd=bus.fd)
        except (OSError, ValueError) as error:
            _log_fallback(str(error))
    return open_bus(bus, filters=filters, errors=errors, hardware=hardware)


@functools.cache
def _log_fallback(reason: str) -> None:
    """Log once per process why no packet ring is used."""
    log.info(
        "frames are received by system calls, which takes more CPU time: no packet ring (%s). "
        "The capability CAP_NET_RAW allows it.",
        reason,
    )
