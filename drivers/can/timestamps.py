"""Hardware time stamps of CAN interfaces and their conversion to the machine's clock."""

import array
import fcntl
import socket
import struct

import numpy as np
from numpy.typing import NDArray

SO_TIMESTAMPNS = 35
SO_TIMESTAMPING = 37
RX_HARDWARE, RX_SOFTWARE, SOFTWARE, RAW_HARDWARE = 1 << 2, 1 << 3, 1 << 4, 1 << 6
"""Flags of SO_TIMESTAMPING (linux/net_tstamp.h)."""
_SIOCETHTOOL, _ETHTOOL_GET_TS_INFO = 0x8946, 0x41
_TS_INFO_BYTES = 44

LARGEST_DRIFT = 1e-4
"""Largest expected relative difference in rate of the interface's clock and the machine's."""
_CLOCK_STEP_NS = 50_000_000
"""Smallest change of the clocks' offset (ns) that is taken as a step of one of the clocks."""


def has_hardware_timestamps(channel: str) -> bool:
    """Return True if the interface stamps received frames with its own clock; False if the query is not supported."""
    request = array.array("B", struct.pack("=I", _ETHTOOL_GET_TS_INFO).ljust(_TS_INFO_BYTES, b"\0"))
    address, _ = request.buffer_info()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        try:
            fcntl.ioctl(any_socket, _SIOCETHTOOL, struct.pack("16sP16x", channel.encode(), address))
        except OSError:
            return False
    (flags,) = struct.unpack_from("=I", request, 4)
    return bool(flags & (RX_HARDWARE | RAW_HARDWARE) == RX_HARDWARE | RAW_HARDWARE)


class InterfaceClock:
    """Conversion of one interface's clock to the machine's clock.

    Software stamp = hardware stamp + offset of the clocks + interrupt latency, which is never negative: the offset is
    the smallest difference, which may grow at the drift rate. The even spacing of the hardware stamps is kept.
    """

    def __init__(self) -> None:
        self._origin: int | None = None
        self._least = 0

    def to_utc(self, software_ns: NDArray[np.int64], hardware_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Convert hardware stamps (N,), ns, to ns UTC; where it is 0 (none), the software stamp (N,), ns UTC, stays."""
        times = software_ns.copy()
        stamped = hardware_ns != 0
        software, hardware = software_ns[stamped], hardware_ns[stamped]
        if software.size == 0:
            return times
        if (
            self._origin is None
            or abs(int(software[0] - hardware[0]) - self._offset(int(hardware[0]))) > _CLOCK_STEP_NS
        ):
            self._origin, self._least = int(hardware[0]), int(software[0] - hardware[0])
        drift = ((hardware - self._origin) * LARGEST_DRIFT).astype(np.int64)
        least = np.minimum.accumulate(np.minimum(software - hardware - drift, self._least))
        self._least = int(least[-1])
        times[stamped] = hardware + least + drift
        return times

    def _offset(self, hardware_ns: int) -> int:
        assert self._origin is not None
        return self._least + int((hardware_ns - self._origin) * LARGEST_DRIFT)
