"""Thread priorities are raised if permitted, and only for the requesting thread."""

import os
import threading

from armident.drivers.can.scheduling import HIGHEST, raised_priority, set_realtime_priority


def niceness(thread: int) -> int:
    return os.getpriority(os.PRIO_PROCESS, thread)


def may_rise() -> bool:
    """True if this process may lower its nice value: root, or ``CAP_SYS_NICE`` (bit 23)."""
    with open("/proc/self/status", encoding="ascii") as status:
        effective = next(line for line in status if line.startswith("CapEff"))
    return bool(int(effective.split()[1], 16) >> 23 & 1)


def test_priority_is_raised_for_one_thread_and_restored() -> None:
    done, other = threading.Event(), threading.Thread(target=lambda: done.wait())
    other.start()
    try:
        me, before = threading.get_native_id(), niceness(threading.get_native_id())
        assert other.native_id is not None
        with raised_priority(7):
            assert niceness(me) == (max(HIGHEST, before - 7) if may_rise() else before)
            assert niceness(other.native_id) == before
        assert niceness(me) == before
    finally:
        done.set()
        other.join()


def test_real_time_priority_applies_to_one_thread_and_is_reported() -> None:
    said: list[tuple[bool, int]] = []

    def run() -> None:
        granted = set_realtime_priority(3)
        said.append((granted, os.sched_getscheduler(0)))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    ((granted, policy),) = said
    assert (policy == os.SCHED_FIFO) == granted
    assert os.sched_getscheduler(0) != os.SCHED_FIFO
