"""The compiled loop of the SYNC producer: sleep until the deadline, send, account for the lateness."""

import errno
from typing import Any

import numpy as np
from numba import carray, njit, types
from numpy.typing import NDArray

from drivers.objects import COB_SYNC
from drivers.socketcan import Messages

MAX_LATE_PERIODS = 10
"""Lateness, in periods, beyond which the time grid moves instead of being caught up with."""

BIN_NS = 5_000
"""Width of a bin of the lateness histogram, ns."""

BINS = 10_000
"""Bins of the lateness histogram; the last one also holds everything later."""

STOP, RETURN, SENT, ERROR, SKIPPED, OVERRUNS, ROW, FIRST, LATE_MAX, BASE_NS, LAST_NS = range(11)
"""Places in the shared state. ``STOP``: end. ``RETURN``: leave the loop to take a new plan. ``ERROR``: errno."""

STATE_SIZE = 11

_SEND_ATTEMPTS = 5000
_RETRY_NS = 100_000
_MONOTONIC = 1
_ABSOLUTE = 1
_EINTR, _EAGAIN, _ENOBUFS = errno.EINTR, errno.EAGAIN, errno.ENOBUFS

_clock_nanosleep: Any = types.ExternalFunction(
    "clock_nanosleep", types.int32(types.int32, types.int32, types.intp, types.intp)
)
_clock_gettime: Any = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.intp))
_sendmmsg: Any = types.ExternalFunction("sendmmsg", types.int32(types.int32, types.intp, types.uint32, types.int32))
_errno_location: Any = types.ExternalFunction("__errno_location", types.voidptr())


def is_knot(k: int, every: int) -> bool:
    """Whether SYNC ``k`` is one at which set points become targets: its counter is a multiple of ``every``."""
    return (k + 1) % every == 0


class Loop:
    """The loop with the arrays it works on; called again, it goes on where it was."""

    def __init__(
        self, descriptor: int, period_ns: int, counter: int, state: NDArray[np.int64], late: NDArray[np.int64]
    ) -> None:
        self._fixed = (descriptor, period_ns, counter, state, late)
        self._spec = np.zeros(2, dtype=np.int64)
        compiled = Messages(1, control=False)
        ended = np.ones(STATE_SIZE, dtype=np.int64)
        # Compiled here, where nothing waits for the first SYNC yet.
        _run(
            *(descriptor, period_ns, counter, ended, late, compiled.address),
            *(compiled.body.view(np.int32), np.zeros((0, 0), dtype=np.int32), 1, self._spec),
        )

    def __call__(self, messages: Messages, rows: NDArray[np.int32], cob_ids: NDArray[np.uint32], every: int) -> None:
        """Send SYNCs, and ``rows`` from ``state[ROW]`` on, until ``state[STOP]``, ``state[RETURN]`` or an error.

        Parameters
        ----------
        messages
            Room for the SYNC and one frame per drive.
        rows
            Set points, shape (M, n), counts.
        cob_ids
            Identifiers of the set point frames, shape (n,).
        every
            SYNCs between two rows.
        """
        body = messages.body.view(np.uint32)
        body[0, 0], body[1:, 0] = COB_SYNC, cob_ids
        messages.body[0, 4], messages.body[1:, 4] = 1, 4
        _run(*self._fixed, messages.address, messages.body.view(np.int32), rows, every, self._spec)


@njit(nogil=True, cache=True)
def monotonic_ns(spec):  # type: ignore[no-untyped-def]
    """Read CLOCK_MONOTONIC (ns); ``spec`` (2,) int64 is room for a ``struct timespec``."""
    _clock_gettime(_MONOTONIC, spec.ctypes.data)
    return spec[0] * 1_000_000_000 + spec[1]


@njit(nogil=True, cache=True)
def sleep_until(deadline, spec):  # type: ignore[no-untyped-def]
    """Sleep until CLOCK_MONOTONIC reads ``deadline`` (ns)."""
    spec[0], spec[1] = deadline // 1_000_000_000, deadline % 1_000_000_000
    while _clock_nanosleep(_MONOTONIC, _ABSOLUTE, spec.ctypes.data, 0) == _EINTR:
        pass


@njit(nogil=True, cache=True)
def send_messages(descriptor, address, count, spec):  # type: ignore[no-untyped-def]
    """Hand ``count`` messages to the kernel; 0, or errno if it will not take them."""
    sent, code = 0, 0
    for _ in range(_SEND_ATTEMPTS):
        done = _sendmmsg(descriptor, address + 64 * sent, count - sent, 0)
        if done > 0:
            sent += done
            if sent == count:
                return 0
            continue
        code = carray(_errno_location(), 1, np.int32)[0]
        if code not in (_EAGAIN, _ENOBUFS, _EINTR):
            return code
        sleep_until(monotonic_ns(spec) + _RETRY_NS, spec)
    return code


@njit(nogil=True, cache=True)
def _run(descriptor, period, counter, state, late, address, body, rows, every, spec):  # type: ignore[no-untyped-def]
    if state[BASE_NS] == 0:
        state[BASE_NS] = monotonic_ns(spec) + period
    while state[STOP] == 0 and state[RETURN] == 0:
        k = state[SENT]
        deadline = state[BASE_NS] + k * period
        sleep_until(max(deadline, state[LAST_NS] + period // 2), spec)
        now = monotonic_ns(spec)
        lateness = now - deadline
        late[min(BINS - 1, lateness // BIN_NS)] += 1
        state[LATE_MAX] = max(state[LATE_MAX], lateness)
        if lateness > period:
            state[OVERRUNS] += 1
        if lateness > MAX_LATE_PERIODS * period:
            state[SKIPPED] += lateness // period
            state[BASE_NS] += lateness // period * period
        body[0, 2] = k % counter + 1
        count = 1
        if state[ROW] < rows.shape[0] and (k + 2) % every == 0:
            for j in range(rows.shape[1]):
                body[1 + j, 2] = rows[state[ROW], j]
            state[ROW] += 1
            count += rows.shape[1]
        code = send_messages(descriptor, address, count, spec)
        if code != 0:
            state[ERROR] = code
            return
        state[LAST_NS] = now
        state[SENT] = k + 1
