"""The fast path to a SocketCAN bus: whole batches of frames in one system call, in arrays.

The kernel writes a batch straight into preallocated arrays (``recvmmsg``), stamps every frame in
nanoseconds and counts what it had to drop; no Python object per frame exists.
"""

import ctypes
import errno
import select
import socket
import struct
import time
from collections.abc import Sequence
from typing import Self

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
    has_hardware_stamps,
)

__all__ = ["ERROR_FLAG", "FRAME", "BusDown", "Messages", "RawSocket", "frame", "frames"]

RECEIVE_BUFFER = 128 << 20
"""Bytes of kernel buffer asked for, and given twice over: eight seconds of 36 000 frames/s at 900 bytes each. They are
taken while nobody reads."""

BATCH = 4096
"""Most frames that one system call moves."""

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


class RawSocket:
    """A raw socket on one CAN interface that moves batches of frames.

    Parameters
    ----------
    channel
        Name of the interface, ``vcan0``.
    filters
        What the kernel lets through; ``None``: everything, empty: nothing (a socket that only sends).
    errors
        Whether error frames of the controller are received (``can_id & ERROR_FLAG``).
    own
        Whether frames sent through this socket are received on it as well.
    loopback
        Whether other sockets of this machine see what is sent here.
    receive_buffer
        Bytes of kernel buffer to ask for; forced beyond the system's limit where we have the right.
    fd
        Whether frames of CAN FD are moved too; batches are then arrays of ``FD_FRAME``.
    hardware
        Whether frames get the interface's own time stamps where it has some, put into the machine's time.

    Raises
    ------
    ConfigError
        If the kernel has no SocketCAN or no such interface, or it carries no CAN FD; says which command an
        administrator has to run.
    BusDown
        If the interface is there but down.
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
        self._clock = InterfaceClock() if hardware and has_hardware_stamps(channel) else None
        self.dropped = 0
        """Frames the kernel had to drop because the receive buffer was full, since the socket was opened.

        As the last frame received says, which does not know of those dropped behind it."""
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
            raise interface.missing(self.channel, error.strerror) from error
        if not self.up:
            raise interface.down(self.channel, "is down")
        if self.fd:
            interface.check_fd(self.channel)

    @property
    def stamps(self) -> str:
        """Whose clock stamps the frames: ``hardware`` (the interface's) or ``software`` (the kernel's)."""
        return "software" if self._clock is None else "hardware"

    @property
    def bound(self) -> bool:
        """Whether the socket still has its interface; it has lost it for good when that was removed."""
        return bool(self._socket.getsockname()[0])

    @property
    def up(self) -> bool:
        """Whether the interface is administratively up."""
        return interface.is_up(self.channel)

    @property
    def receive_buffer(self) -> int:
        """Bytes of kernel buffer really granted."""
        return self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)

    def fileno(self) -> int:
        """Descriptor of the socket, for ``select`` and for compiled loops."""
        return self._socket.fileno()

    def receive(self, batch: Frames, wait: bool = False) -> int:
        """Fill the beginning of ``batch`` with the frames that have arrived.

        Parameters
        ----------
        batch
            Array of ``FRAME`` (``FD_FRAME`` with ``fd``), shape (N,), written in place.
        wait
            Wait up to ``RECEIVE_TIMEOUT`` for the first of them, without a system call more.

        Returns
        -------
        int
            Number of frames, 0 if none had arrived; at most ``min(N, BATCH)``.

        Raises
        ------
        BusDown
            If the interface went down or away.
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
            # The counter is 32 bits wide, ours is not.
            self.dropped += (int(control["drops"][-1]) - self.dropped) & 0xFFFFFFFF
        lengths[:] = messages.control.itemsize
        return int(got)

    def drops(self) -> int:
        """Frames the kernel dropped until now, those behind the last one received among them."""
        info = self._socket.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, 4 * (MEMINFO_DROPS + 1))
        (now,) = struct.unpack_from("I", info, 4 * MEMINFO_DROPS)
        return self.dropped + ((int(now) - self.dropped) & 0xFFFFFFFF)

    def poll(self, timeout: float) -> bool:
        """Whether a frame arrived within ``timeout`` seconds.

        Raises
        ------
        BusDown
            If the interface went down or away.
        """
        for _, event in self._poll.poll(max(0.0, timeout) * 1000):
            if event & (select.POLLERR | select.POLLHUP | select.POLLNVAL):
                self._failed(self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR), (0,))
            return bool(event & select.POLLIN)
        return False

    def send(self, frames: Frames) -> int:
        """Send frames in order, waiting for room in the transmit queue where it is full.

        Parameters
        ----------
        frames
            Array of ``FRAME`` or ``FD_FRAME``, shape (N,); ``t_ns`` is not looked at.

        Returns
        -------
        int
            Number of frames sent: all of them.

        Raises
        ------
        BusDown
            If the interface went down or away, or nothing could be sent for half a second
            (a physical bus without another node acknowledges nothing).
        """
        if self._out is None:
            self._out = Messages(BATCH, control=False, fd=self.fd)
        messages, sent = self._out, 0
        # The clock is read only when the queue is full: where system calls are dear, that is half the cost.
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
                raise BusDown(f"bus {self.channel}: the transmit queue does not drain; is another node on the bus?")
            time.sleep(1e-3)
        return sent

    def _failed(self, code: int, harmless: tuple[int, ...]) -> None:
        if code in harmless:
            return
        if code in (errno.ENETDOWN, errno.ENODEV, errno.ENXIO):
            raise interface.down(self.channel, "went down" if code == errno.ENETDOWN else "was removed")
        raise BusDown(f"bus {self.channel}: {OSError(code, errno.errorcode.get(code, str(code)))}")

    def close(self) -> None:
        """Release the socket; nothing happens the second time."""
        self._socket.close()

    def __enter__(self) -> Self:
        """Use the socket in a ``with`` block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the socket."""
        self.close()
