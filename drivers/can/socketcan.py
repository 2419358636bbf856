"""Fast access to a SocketCAN bus: batches of frames in one system call, in arrays.

The kernel writes batches into preallocated arrays (``recvmmsg``), stamps each frame in ns and counts dropped frames.
"""

import ctypes
import errno
import select
import socket
import struct
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager

from armident.configs.errors import ConfigError
from armident.drivers.can import interface
from armident.drivers.can.frames import ERROR_FLAG, FRAME, BusDown, Filter, Frames, frame, frames
from armident.drivers.can.mmsg import DROP_CONTROL_BYTES, Messages
from armident.drivers.can.timestamps import (
    RAW_HARDWARE,
    RX_HARDWARE,
    RX_SOFTWARE,
    SO_TIMESTAMPING,
    SO_TIMESTAMPNS,
    SOFTWARE,
    InterfaceClock,
    has_hardware_timestamps,
)

__all__ = ["ERROR_FLAG", "FRAME", "BusDown", "Messages", "RawSocket", "frame", "frames"]

RECEIVE_BUFFER = 128 << 20
"""Requested size of the kernel's receive buffer, bytes; the kernel doubles it. It holds eight seconds of 36 000
frames/s at 900 bytes each. Memory is used only while frames wait."""

BATCH = 4096
"""Maximum number of frames per system call."""

RECEIVE_TIMEOUT = 0.05
"""Longest wait of a receive call that waits, s."""

SEND_TIMEOUT = 0.5
"""Longest wait for a full transmit queue to drain, s."""

SO_RCVBUFFORCE = 33
SO_RCVTIMEO = 20
MSG_WAITFORONE = 0x10000
SO_RXQ_OVFL = 40
SO_MEMINFO, MEMINFO_DROPS = 55, 8
CAN_RAW_ERR_FILTER = 2
CAN_RAW_FD_FRAMES = 5
CAN_RAW_FILTER_MAX = 512

_libc = ctypes.CDLL(None, use_errno=True)
_recvmmsg = _libc.recvmmsg
_recvmmsg.argtypes = [ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p]
_sendmmsg = _libc.sendmmsg
_sendmmsg.argtypes = [ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int]


class RawSocket(AbstractContextManager["RawSocket", None]):
    """Raw socket on one CAN interface that moves batches of frames; a ConfigError has the command for an administrator.

    ``filters``: frames to receive (``None``: all; empty: none, to send only). ``errors``: receive error frames too.
    ``own``, ``loopback``: give sent frames to this socket, and to others. ``receive_buffer``: bytes. ``fd``: batches
    are arrays of ``FD_FRAME``. ``hardware``: use the interface's time stamps, converted to the machine's time.
    """

    def __init__(
        self,
        channel: str,
        *,
        filters: Sequence[Filter] | None = None,
        errors: bool = False,
        own: bool = False,
        loopback: bool = True,
        receive_buffer: int = RECEIVE_BUFFER,
        fd: bool = False,
        hardware: bool = False,
    ) -> None:
        self.channel = channel
        self.fd = fd
        self._clock = InterfaceClock() if hardware and has_hardware_timestamps(channel) else None
        self.dropped = 0
        """Number of frames dropped by the kernel because the receive buffer was full, up to the last received frame."""
        try:
            self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except OSError as error:
            raise ConfigError(
                f"bus {channel}: this kernel has no SocketCAN (an administrator may try: sudo modprobe can_raw)"
            ) from error
        try:
            self._configure(filters, errors, own, loopback, receive_buffer)
        except BaseException:
            self._socket.close()
            raise
        self._poll = select.poll()
        self._poll.register(self._socket, select.POLLIN)
        self._in: Messages | None = None
        self._out: Messages | None = None

    def _configure(
        self, filters: Sequence[Filter] | None, errors: bool, own: bool, loopback: bool, receive_buffer: int
    ) -> None:
        raw = socket.SOL_CAN_RAW
        if filters is not None:
            if len(filters) > CAN_RAW_FILTER_MAX:
                raise ValueError(f"{len(filters)} filters, the kernel takes {CAN_RAW_FILTER_MAX}")
            packed = b"".join(struct.pack("=II", can_id, mask) for can_id, mask in filters)
            self._socket.setsockopt(raw, socket.CAN_RAW_FILTER, packed)
        self._socket.setsockopt(raw, CAN_RAW_ERR_FILTER, 0x1FFFFFFF if errors else 0)
        self._socket.setsockopt(raw, socket.CAN_RAW_LOOPBACK, int(loopback))
        self._socket.setsockopt(raw, socket.CAN_RAW_RECV_OWN_MSGS, int(own))
        if self._clock is None:
            self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        else:
            stamps = RX_HARDWARE | RX_SOFTWARE | SOFTWARE | RAW_HARDWARE
            self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPING, stamps)
        if self.fd:
            self._socket.setsockopt(raw, CAN_RAW_FD_FRAMES, 1)
        timeout = struct.pack("ll", 0, round(RECEIVE_TIMEOUT * 1e6))
        self._socket.setsockopt(socket.SOL_SOCKET, SO_RCVTIMEO, timeout)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, receive_buffer)
        except OSError:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        try:
            self._socket.bind((self.channel,))
        except OSError as error:
            raise interface.no_interface(self.channel, error.strerror) from error
        if not self.up:
            raise interface.down(self.channel, "is down")
        if self.fd:
            interface.check_fd(self.channel)

    @property
    def timestamp_source(self) -> str:
        """Clock of the time stamps: ``hardware`` (the interface's) or ``software`` (the kernel's)."""
        return "software" if self._clock is None else "hardware"

    @property
    def bound(self) -> bool:
        """``True`` while the socket has its interface; after a removal of the interface the socket is unusable."""
        return bool(self._socket.getsockname()[0])

    @property
    def up(self) -> bool:
        """``True`` if the interface is administratively up."""
        return interface.is_up(self.channel)

    @property
    def receive_buffer(self) -> int:
        """Size of the kernel's receive buffer as granted, bytes."""
        return self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)

    def fileno(self) -> int:
        """Descriptor of the socket, for ``select`` and for compiled loops."""
        return self._socket.fileno()

    def receive(self, batch: Frames, wait: bool = False) -> int:
        """Write received frames to the beginning of ``batch`` (N,); return their number, at most ``min(N, BATCH)``.

        With ``wait`` it waits up to ``RECEIVE_TIMEOUT`` for the first frame, in the same system call.
        """
        if self._in is None:
            self._in = Messages(BATCH, fd=self.fd, hardware=self._clock is not None)
        messages = self._in
        flags = MSG_WAITFORONE if wait else socket.MSG_DONTWAIT
        got = _recvmmsg(self._socket.fileno(), messages.address, min(batch.size, BATCH), flags, None)
        if got <= 0:
            if got < 0:
                self._failed(ctypes.get_errno(), (errno.EAGAIN, errno.EINTR))
            return 0
        control = messages.control[:got]
        filled = batch[:got]
        stamps = control["seconds"] * 1_000_000_000 + control["nanoseconds"]
        if self._clock is not None:
            own = control["hardware_seconds"] * 1_000_000_000 + control["hardware_nanoseconds"]
            stamps = self._clock.to_utc(stamps, own)
        filled["t_ns"] = stamps
        messages.unload(filled)
        lengths = messages.header["controllen"][:got]
        if lengths[-1] > messages.control.itemsize - DROP_CONTROL_BYTES:
            # The kernel's counter is 32 bits wide.
            self.dropped += (int(control["drops"][-1]) - self.dropped) & 0xFFFFFFFF
        lengths[:] = messages.control.itemsize
        return int(got)

    def drops(self) -> int:
        """Number of frames dropped by the kernel so far, including those after the last received one."""
        info = self._socket.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, 4 * (MEMINFO_DROPS + 1))
        (now,) = struct.unpack_from("I", info, 4 * MEMINFO_DROPS)
        return self.dropped + ((int(now) - self.dropped) & 0xFFFFFFFF)

    def poll(self, timeout: float) -> bool:
        """Return True if a frame arrives within the timeout, s; raises BusDown if the interface is down."""
        for _, event in self._poll.poll(max(0.0, timeout) * 1000):
            if event & (select.POLLERR | select.POLLHUP | select.POLLNVAL):
                self._failed(self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR), (0,))
            return bool(event & select.POLLIN)
        return False

    def send(self, frames: Frames) -> int:
        """Send frames (N,) in order, wait for space in the transmit queue, and return N.

        Raises BusDown if the interface is down, or nothing could be sent for half a second: a physical bus without
        another node acknowledges nothing.
        """
        if self._out is None:
            self._out = Messages(BATCH, control=False, fd=self.fd)
        messages, sent = self._out, 0
        # The clock is read only when the queue is full: in a guest kernel its system call is half the cost.
        deadline: float | None = None
        while sent < frames.size:
            chunk = frames[sent : sent + BATCH]
            messages.load(chunk)
            done = _sendmmsg(self._socket.fileno(), messages.address, chunk.size, socket.MSG_DONTWAIT)
            if done > 0:
                sent += done
                deadline = None
                continue
            self._failed(ctypes.get_errno(), (errno.EAGAIN, errno.ENOBUFS, errno.EINTR))
            if deadline is None:
                deadline = time.monotonic() + SEND_TIMEOUT
            elif time.monotonic() > deadline:
                raise BusDown(
                    f"bus {self.channel}: the transmit queue does not drain; check that another node is on the bus"
                )
            time.sleep(1e-3)
        return sent

    def _failed(self, code: int, harmless: tuple[int, ...]) -> None:
        if code in harmless:
            return
        if code in (errno.ENETDOWN, errno.ENODEV, errno.ENXIO):
            raise interface.down(self.channel, "went down" if code == errno.ENETDOWN else "was removed")
        raise BusDown(f"bus {self.channel}: {OSError(code, errno.errorcode.get(code, str(code)))}")

    def close(self) -> None:
        """Release the socket; further calls have no effect."""
        self._socket.close()

    def __exit__(self, *_: object) -> None:
        """Close the socket."""
        self.close()
