"""State of the system clock (adjtimex(2)): offset, error and synchronisation."""

import ctypes
import os
from dataclasses import dataclass

_TIME_ERROR = 5
"""Return value of adjtimex(2) if the clock is not synchronised."""
_UNSYNCHRONISED, _NANOSECONDS = 0x0040, 0x2000
"""Bits of ``status``: STA_UNSYNC, and STA_NANO (the offset is in ns instead of us)."""


class _Timex(ctypes.Structure):
    """First members of ``struct timex``, padded to its size."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * 256),
    )


@dataclass(frozen=True)
class ClockState:
    """State of the system clock, as chrony or ntpd states it; ``offset_us`` is still to be corrected."""

    offset_us: float
    error_us: float
    largest_error_us: float
    synchronised: bool


def clock_state() -> ClockState:
    """Return the state of the system clock; nothing is changed. Raises OSError if the kernel refuses the call."""
    timex = _Timex()
    state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    if state < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    unit = 1e-3 if timex.status & _NANOSECONDS else 1.0
    synchronised = state != _TIME_ERROR and not timex.status & _UNSYNCHRONISED
    return ClockState(timex.offset * unit, float(timex.esterror), float(timex.maxerror), synchronised)


def clock_is_right() -> bool:
    """Return True if the clock is known to be synchronised: one that is ahead makes everything old."""
    try:
        return clock_state().synchronised
    except OSError:
        return False
