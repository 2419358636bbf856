"""Compiled loop of the SYNC producer: sleep until the deadline, send, record the delay."""

import errno
import socket
from typing import Any

import numpy as np
from numba import carray, types
from numpy.typing import NDArray

from armident.compiled import compiled
from armident.drivers.can.socketcan import Messages
from armident.drivers.canopen.objects import COB_SYNC

MAX_LATE_PERIODS = 10
"""Delay, in periods, beyond which the time grid moves instead of being caught up with."""

BIN_NS = 5_000
"""Width of a bin of the delay histogram, ns."""

BINS = 10_000
"""Number of bins of the delay histogram; the last one holds all larger delays."""

STOP, RETURN, SENT, ERROR, SKIPPED, OVERRUNS, ROW, FIRST, LATE_MAX, BASE_NS, LAST_NS, WANTED = range(12)
"""Indices of the shared state. ``STOP``: end. ``RETURN``: leave the loop for a new plan. ``ERROR``: errno while all
buses refuse SYNC. ``WANTED``: total number of SYNCs to send."""

STATE_SIZE = 12

TIMES = 1 << 16
"""Number of SYNCs whose send times are kept."""

_SEND_ATTEMPTS = 5000
_RETRY_NS = 100_000
_FEW_ATTEMPTS = 3
"""Number of attempts if other buses wait for their SYNC."""
_REALTIME, _MONOTONIC = 0, 1
_ABSOLUTE = 1
_EINTR, _EAGAIN, _ENOBUFS = errno.EINTR, errno.EAGAIN, errno.ENOBUFS
_DONTWAIT = int(socket.MSG_DONTWAIT)

_clock_nanosleep: Any = types.ExternalFunction(
    "clock_nanosleep", types.int32(types.int32, types.int32, types.intp, types.intp)
)
_clock_gettime: Any = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.intp))
_sendmmsg: Any = types.ExternalFunction("sendmmsg", types.int32(types.int32, types.intp, types.uint32, types.int32))
_errno_location: Any = types.ExternalFunction("__errno_location", types.voidptr())


def is_knot(k: int, every: int) -> bool:
    """Return True if set points become targets at SYNC ``k``, from 0: its counter is a multiple of ``every``."""
    return (k + 1) % every == 0


class Loop:
    """Compiled SYNC loop with its arrays, for B buses; a further call continues where the last one ended.

    ``counter`` is the overflow of the SYNC counter, 0: none. ``state`` (STATE_SIZE,) is shared; ``late`` (BINS,) counts
    delays. ``errors`` and ``unsent`` (B,) have the errno of the last SYNC (0: sent) and the number of refused ones.
    ``times`` has ns UTC just after SYNC k was sent, at index ``k % TIMES``.
    """

    def __init__(
        self,
        descriptors: NDArray[np.int64],
        period_ns: int,
        counter: int,
        state: NDArray[np.int64],
        late: NDArray[np.int64],
        errors: NDArray[np.int64],
        unsent: NDArray[np.int64],
        times: NDArray[np.int64],
    ) -> None:
        self._fixed = (descriptors, period_ns, counter)
        self._shared = (late, errors, unsent, times)
        self._state = state
        self._spec = np.zeros(2, dtype=np.int64)
        ended = np.ones(STATE_SIZE, dtype=np.int64)
        none = np.zeros((0, 0), dtype=np.int32)
        # Compile before the first SYNC is due.
        self._call(ended, none, np.zeros(0, np.uint32), np.zeros(0, np.int64), 1)

    def __call__(
        self, rows: NDArray[np.int32], cob_ids: NDArray[np.uint32], bus_of: NDArray[np.int64], every: int
    ) -> None:
        """Send SYNCs, and set points (M, n) from ``state[ROW]`` on, until ``STOP``, ``RETURN`` or ``WANTED`` is set."""
        self._call(self._state, rows, cob_ids, bus_of, every)

    def _call(
        self,
        state: NDArray[np.int64],
        rows: NDArray[np.int32],
        cob_ids: NDArray[np.uint32],
        bus_of: NDArray[np.int64],
        every: int,
    ) -> None:
        buses = self._fixed[0].size
        # Per bus the SYNC, followed by the set points of its drives.
        first = np.searchsorted(np.sort(bus_of), np.arange(buses + 1)) + np.arange(buses + 1)
        place = np.zeros(cob_ids.size, np.int64)
        for bus in range(buses):
            here = np.flatnonzero(bus_of == bus)
            place[here] = first[bus] + 1 + np.arange(here.size)
        messages = Messages(buses + cob_ids.size, control=False)
        body = messages.body.view(np.uint32)
        body[first[:-1], 0], body[place, 0] = COB_SYNC, cob_ids
        messages.body[first[:-1], 4], messages.body[place, 4] = (1 if self._fixed[2] else 0), 4
        body, first = messages.body.view(np.int32), first.astype(np.int64)
        _run(*self._fixed, state, *self._shared, messages.address, body, first, place, rows, every, self._spec)


@compiled()
def monotonic_ns(spec: NDArray[np.int64]) -> int:
    """Read CLOCK_MONOTONIC, ns. ``spec``: memory of a ``struct timespec``, int64, shape (2,)."""
    _clock_gettime(_MONOTONIC, spec.ctypes.data)
    return int(spec[0] * 1_000_000_000 + spec[1])


@compiled()
def utc_ns(spec: NDArray[np.int64]) -> int:
    """Read CLOCK_REALTIME, ns, the clock of the kernel's frame stamps, by a ``struct timespec``, int64 (2,)."""
    _clock_gettime(_REALTIME, spec.ctypes.data)
    return int(spec[0] * 1_000_000_000 + spec[1])


@compiled()
def sleep_until(deadline: int, spec: NDArray[np.int64]) -> None:
    """Sleep until CLOCK_MONOTONIC reaches a deadline. ``spec``: memory of a ``struct timespec``, int64, shape (2,)."""
    spec[0], spec[1] = deadline // 1_000_000_000, deadline % 1_000_000_000
    while _clock_nanosleep(_MONOTONIC, _ABSOLUTE, spec.ctypes.data, 0) == _EINTR:
        pass


@compiled()
def send_messages(descriptor: int, address: int, count: int, attempts: int, spec: NDArray[np.int64]) -> int:
    """Send ``count`` messages from ``struct mmsghdr`` at ``address`` by ``sendmmsg``; return 0 or errno."""
    sent, code = 0, 0
    for _ in range(attempts):
        done = _sendmmsg(descriptor, address + 64 * sent, count - sent, _DONTWAIT)
        if done > 0:
            sent += done
            if sent == count:
                return 0
            continue
        code = carray(_errno_location(), 1, np.int32)[0]
        if code not in (_EAGAIN, _ENOBUFS, _EINTR):
            return int(code)
        sleep_until(monotonic_ns(spec) + _RETRY_NS, spec)
    return int(code)


@compiled(
    "i8[::1], i8, i8, i8[::1], i8[::1], i8[::1], i8[::1], i8[::1], i8, i4[:, ::1], i8[::1], i8[::1], "
    "i4[:, ::1], i8, i8[::1]"
)
def _run(
    descriptors: Any, period: int, counter: int, state: Any, late: Any, errors: Any, unsent: Any, times: Any,
    address: int, body: Any, first: Any, place: Any, rows: Any, every: int, spec: Any,
) -> None:  # fmt: skip
    buses = descriptors.size
    if state[BASE_NS] == 0:
        state[BASE_NS] = monotonic_ns(spec) + period
    while state[STOP] == 0 and state[RETURN] == 0 and state[SENT] < state[WANTED]:
        k = state[SENT]
        deadline = state[BASE_NS] + k * period
        sleep_until(max(deadline, state[LAST_NS] + period // 2), spec)
        due = state[ROW] < rows.shape[0] and (k + 2) % every == 0
        if due:
            for j in range(rows.shape[1]):
                body[place[j], 2] = rows[state[ROW], j]
            state[ROW] += 1
        refused, code = 0, 0
        for b in range(buses):
            if counter > 0:
                body[first[b], 2] = k % counter + 1
            count = first[b + 1] - first[b] if due else 1
            attempts = _SEND_ATTEMPTS if buses == 1 else _FEW_ATTEMPTS
            errors[b] = send_messages(descriptors[b], address + 64 * first[b], count, attempts, spec)
            if errors[b] != 0:
                unsent[b] += 1
                refused += 1
                code = errors[b]
        state[ERROR] = code if refused == buses else 0
        # Read after sending, so that no receiver's stamp is later.
        times[k % TIMES] = utc_ns(spec)
        # The pause of half a period starts here, so that slow sending leaves the processor to other threads.
        now = monotonic_ns(spec)
        state[LAST_NS] = now
        delay = now - deadline
        late[min(BINS - 1, delay // BIN_NS)] += 1
        state[LATE_MAX] = max(state[LATE_MAX], delay)
        if delay > period:
            state[OVERRUNS] += 1
        if delay > MAX_LATE_PERIODS * period:
            state[SKIPPED] += delay // period
            state[BASE_NS] += delay // period * period
        state[SENT] = k + 1
