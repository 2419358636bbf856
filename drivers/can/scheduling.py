"""Scheduling priority of threads; without the right to it a thread keeps its normal priority."""

import ctypes
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

PR_SET_TIMERSLACK = 29
HIGHEST = -20
"""Nice value of the highest priority."""


def set_realtime_priority(priority: int) -> bool:
    """Request exact timers and ``SCHED_FIFO`` of ``priority`` 1 to 99 for the calling thread; True if granted."""
    ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        return False
    return True


@contextmanager
def raised_priority(steps: int) -> Iterator[None]:
    """Lower the nice value by ``steps`` in a ``with`` block; threads started in the block inherit the priority."""
    thread = threading.get_native_id()
    before = os.getpriority(os.PRIO_PROCESS, thread)
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, thread, max(HIGHEST, before - steps))
    try:
        yield
    finally:
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, thread, before)
