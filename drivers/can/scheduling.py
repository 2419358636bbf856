"""What a thread asks of the scheduler so that it is in time; without the right to it, it runs as everybody else."""

import ctypes
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

PR_SET_TIMERSLACK = 29
HIGHEST = -20
"""Niceness that comes before all others."""


def be_punctual(priority: int) -> bool:
    """Ask for exact wake-ups and a real-time priority for this thread.

    Parameters
    ----------
    priority
        Of ``SCHED_FIFO``, 1 to 99.

    Returns
    -------
    bool
        Whether the priority was granted.
    """
    ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        return False
    return True


@contextmanager
def ahead(steps: int) -> Iterator[None]:
    """Let this thread come before the others of its process, where a processor is short.

    Parameters
    ----------
    steps
        Of niceness; threads that are started meanwhile come before the others, too.
    """
    thread = threading.get_native_id()
    before = os.getpriority(os.PRIO_PROCESS, thread)
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, thread, max(HIGHEST, before - steps))
    try:
        yield
    finally:
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, thread, before)
