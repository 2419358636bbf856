"""SYNC producer: SYNC with counter on an absolute time grid on all buses, and position set points after it.

A compiled loop without the interpreter's lock sleeps to each deadline (``clock_nanosleep``) and sends by one system
call. After a late SYNC the next ones return to the grid, at least half a period apart: this leaves time to other
threads. Beyond ``MAX_LATE_PERIODS`` the grid moves by whole periods; no SYNC number is left out.
"""

import errno
import os
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from armident.configs.schema.session import Bus
from armident.drivers.can.frames import BusDown, FrameBus, frames
from armident.drivers.can.scheduling import set_realtime_priority
from armident.drivers.can.socketcan import RawSocket
from armident.drivers.can.udp import open_bus
from armident.drivers.canopen.objects import COB_SYNC
from armident.drivers.canopen.setpoints import SetpointPlan
from armident.drivers.canopen.sync_loop import (
    BIN_NS,
    BINS,
    ERROR,
    FIRST,
    LATE_MAX,
    OVERRUNS,
    RETURN,
    ROW,
    SENT,
    SKIPPED,
    STATE_SIZE,
    STOP,
    TIMES,
    WANTED,
    Loop,
    is_knot,
)

__all__ = ["SetpointPlan", "SyncProducer", "SyncStats"]

REALTIME_PRIORITY = 10
"""Priority of ``SCHED_FIFO`` of the producer's thread."""


@dataclass(frozen=True)
class SyncStats:
    """Punctuality of the SYNCs; the delay counts from the grid until all buses took the SYNC.

    ``overruns``: SYNCs late by more than a period. ``skipped``: periods by which the grid moved. ``unsent``: refused,
    by bus.
    """

    sent: int
    late_p50_us: float
    late_p99_us: float
    late_max_us: float
    overruns: int
    skipped: int
    unsent: tuple[int, ...] = ()


class SyncProducer:
    """Sends SYNC k = 0, 1, 2, ... with counter ``k % counter + 1`` in a separate thread, by sockets of its own.

    A knot is a SYNC whose counter is a multiple of ``every``. A row is sent directly after the SYNC before its knot and
    becomes the target at the knot. With row 0 at SYNC ``first``, row m becomes the target at ``first + m every``, and
    the interpolated demand reaches it ``every`` SYNCs later. The drives hold the last row.
    """

    def __init__(
        self, buses: Bus | Sequence[Bus], period_us: int, counter: int, setpoints: SetpointPlan | None = None
    ) -> None:
        self._configured = (buses,) if isinstance(buses, Bus) else tuple(buses)
        self._period_ns = period_us * 1000
        self._counter = counter
        self._plan = setpoints
        self._pending: SetpointPlan | None = None
        self._taken = threading.Event()
        self._state = np.zeros(STATE_SIZE, dtype=np.int64)
        self._state[FIRST] = -1
        self._state[WANTED] = np.iinfo(np.int64).max
        self._late = np.zeros(BINS, dtype=np.int64)
        self._errors = np.zeros(len(self._configured), dtype=np.int64)
        self._unsent = np.zeros(len(self._configured), dtype=np.int64)
        self._times = np.zeros(TIMES, dtype=np.int64)
        self._thread: threading.Thread | None = None
        self._buses: list[FrameBus] = []
        self._loop: Loop | None = None

    def start(self) -> None:
        """Open the buses and send the first SYNC one period from now."""
        with ExitStack() as opened:
            for bus in self._configured:
                # SYNC and set points are classic frames on every bus.
                classic = bus.model_copy(update={"fd": False, "data_bitrate": None})
                self._buses.append(opened.enter_context(open_bus(classic, filters=())))
            opened.pop_all()
        sockets = [bus.fileno() for bus in self._buses if isinstance(bus, RawSocket)]
        if len(sockets) == len(self._buses):
            fixed = np.array(sockets, np.int64), self._period_ns, self._counter
            self._loop = Loop(*fixed, self._state, self._late, self._errors, self._unsent, self._times)
        run = self._run_interpreted if self._loop is None else self._run_compiled
        self._thread = threading.Thread(target=run, name="sync", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop SYNC and wait for the end of the thread; further calls have no effect."""
        self._state[STOP] = 1
        if self._thread is not None:
            self._thread.join()
        for bus in self._buses:
            bus.close()

    def stop_after(self, count: int) -> None:
        """Limit the total number of SYNCs, those sent already included; :meth:`stop` is still required."""
        self._state[WANTED] = count

    def play(self, plan: SetpointPlan) -> int:
        """Play set points from the next possible knot on, and return the SYNC at which row 0 becomes the target."""
        self._taken.clear()
        self._pending = plan
        self._state[RETURN] = 1
        while not self._taken.wait(0.05):
            self.check()
            if self._thread is None or not self._thread.is_alive():
                raise BusDown(f"bus {self._names}: the SYNC producer is not running")
        return int(self._state[FIRST])

    def check(self) -> None:
        """Raise an error if SYNC cannot be sent. Raises BusDown if no bus takes SYNC."""
        code = int(self._state[ERROR])
        if code:
            raise BusDown(f"bus {self._names}: SYNC cannot be sent: {os.strerror(code)}")

    @property
    def _names(self) -> str:
        return ", ".join(bus.channel for bus in self._configured)

    @property
    def sent(self) -> int:
        """Number of SYNCs sent, which is the number k of the next one."""
        return int(self._state[SENT])

    def sent_at(self, first: int) -> tuple[int, NDArray[np.int64]]:
        """First SYNC from ``first`` on whose time is kept (``TIMES``), and times just after sending, ns UTC, (N,)."""
        sent = self.sent
        first = min(max(first, sent - TIMES + 1, 0), sent)
        return first, self._times[np.arange(first, sent) % TIMES]

    @property
    def _over(self) -> bool:
        return bool(self._state[STOP] or self._state[SENT] >= self._state[WANTED])

    def stats(self) -> SyncStats:
        """Punctuality since the start."""
        total = np.cumsum(self._late)
        p50, p99 = (float(np.searchsorted(total, share * total[-1]) + 0.5) * BIN_NS / 1000 for share in (0.5, 0.99))
        state = self._state
        return SyncStats(
            sent=self.sent,
            late_p50_us=p50 if total[-1] else 0.0,
            late_p99_us=p99 if total[-1] else 0.0,
            late_max_us=float(state[LATE_MAX]) / 1000,
            overruns=int(state[OVERRUNS]),
            skipped=int(state[SKIPPED]),
            unsent=tuple(int(n) for n in self._unsent),
        )

    def __enter__(self) -> Self:
        """Start the producer."""
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the producer."""
        self.stop()

    def _run_compiled(self) -> None:
        assert self._loop is not None
        set_realtime_priority(REALTIME_PRIORITY)
        while not self._over:
            self._take_plan()
            rows, cob_ids, every = self._rows()
            plan = self._plan
            bus_of = plan.bus_of if plan is not None and plan.bus_of else (0,) * cob_ids.size
            self._loop(rows, cob_ids, np.array(bus_of, np.int64), every)

    def _run_interpreted(self) -> None:
        """Run the loop in Python for a bus without socket descriptor; for low rates."""
        (bus,) = self._buses
        state, period = self._state, self._period_ns * 1e-9
        base = time.monotonic() + period
        while not self._over:
            self._take_plan()
            rows, cob_ids, every = self._rows()
            k = int(state[SENT])
            time.sleep(max(0.0, base + k * period - time.monotonic()))
            late = time.monotonic() - base - k * period
            if late > period:
                state[OVERRUNS] += 1
                state[SKIPPED] += int(late / period)
                base += int(late / period) * period
            self._late[min(BINS - 1, int(late * 1e9) // BIN_NS)] += 1
            state[LATE_MAX] = max(int(state[LATE_MAX]), int(late * 1e9))
            row = int(state[ROW])
            due = row < len(rows) and is_knot(k + 1, every)
            batch = frames(1 + (len(cob_ids) if due else 0))
            batch["can_id"][0] = COB_SYNC
            if self._counter:
                batch["length"][0], batch["data"][0, 0] = 1, k % self._counter + 1
            if due:
                batch["can_id"][1:], batch["length"][1:] = cob_ids, 4
                batch["data"][1:, :4] = rows[row].astype("<i4").view(np.uint8).reshape(-1, 4)
                state[ROW] += 1
            try:
                bus.send(batch)
            except BusDown:
                state[ERROR] = errno.ENETDOWN
                return
            self._times[k % TIMES] = time.time_ns()
            state[SENT] += 1

    def _rows(self) -> tuple[NDArray[np.int32], NDArray[np.uint32], int]:
        if self._plan is None:
            return np.zeros((0, 0), dtype=np.int32), np.zeros(0, dtype=np.uint32), 1
        return np.ascontiguousarray(self._plan.rows), np.array(self._plan.cob_ids, dtype=np.uint32), self._plan.every

    def _take_plan(self) -> None:
        """Start a new plan with row 0 at the first knot whose row can still be sent in time."""
        self._state[RETURN] = 0
        if self._pending is not None:
            self._plan, self._pending = self._pending, None
            self._state[FIRST] = -1
        if self._plan is not None and self._state[FIRST] < 0:
            knot = int(self._state[SENT]) + 1
            while not is_knot(knot, self._plan.every):
                knot += 1
            self._state[ROW] = 0
            self._state[FIRST] = knot
            self._taken.set()
