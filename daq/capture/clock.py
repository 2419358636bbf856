"""What the kernel knows of its clock (adjtimex(2)): how far it is off, how sure that is, and whether it is set."""

import ctypes
import os
from dataclasses import dataclass

_TIME_ERROR = 5
_UNSYNCHRONISED, _NANOSECONDS = 0x0040, 0x2000
"""Bits of the status: nothing disciplines the clock; the offset is in ns instead of us."""


class _Timex(ctypes.Structure):
    """The beginning of ``struct timex``, and room for the rest."""

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
    """The state of the system clock.

    Parameters
    ----------
    offset_us
        What is still to be corrected, us.
    error_us, largest_error_us
        What whoever sets the clock estimates its error to be, and what it is at most, us.
    synchronised
        Whether anybody sets it.
    """

    offset_us: float
    error_us: float
    largest_error_us: float
    synchronised: bool


def clock_state() -> ClockState:
    """Ask the kernel; nothing is changed.

    Raises
    ------
    OSError
        If the kernel does not tell.
    """
    timex = _Timex()
    state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    if state < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    unit = 1e-3 if timex.status & _NANOSECONDS else 1.0
    synchronised = state != _TIME_ERROR and not timex.status & _UNSYNCHRONISED
    return ClockState(timex.offset * unit, float(timex.esterror), float(timex.maxerror), synchronised)
