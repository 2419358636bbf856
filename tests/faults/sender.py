"""Sender of SYNC and prepared TPDOs of six drives, in a compiled loop and a process of its own."""

import multiprocessing
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from armident.compiled import compiled
from armident.drivers.can.socketcan import Messages, RawSocket
from armident.drivers.canopen.objects import COB_SYNC
from armident.drivers.canopen.sync_loop import monotonic_ns, send_messages, sleep_until

READY, GO, STOP, SENT, WORST_NS, SHIFTED, FAILED = range(7)
COUNTER = 240
ATTEMPTS = 5000
SHIFT_PERIODS = 50
"""Delay from which on the sender shifts its time grid instead of catching up, in periods."""


def position_of(sync: Any, joint: Any) -> Any:
    """Return the position that encodes SYNC and joint."""
    return (sync * 8 + joint) & 0x7FFF_FFFF


def current_of(sync: Any, joint: Any) -> Any:
    """Return the current that encodes SYNC and joint, below 2^15."""
    return (sync * 31 + joint * 1009) % 32_749


@compiled(kept=True)
def _send(descriptors, address, body, first, joints, period, count, lossy, control):  # type: ignore[no-untyped-def]
    spec = np.zeros(2, dtype=np.int64)
    base = monotonic_ns(spec) + period
    k = 0
    while k < count and control[STOP] == 0:
        sleep_until(base + k * period, spec)
        late = monotonic_ns(spec) - base - k * period
        control[WORST_NS] = max(control[WORST_NS], late)
        if late > SHIFT_PERIODS * period:
            base += late
            control[SHIFTED] += 1
        for row in range(joints.size):
            if joints[row] < 0:
                body[row, 2] = k % COUNTER + 1
            else:
                body[row, 2] = (k * 8 + joints[row]) & 0x7FFFFFFF
                body[row, 3] = (k * 31 + joints[row] * 1009) % 32749
        for b in range(descriptors.size):
            count_here = first[b + 1] - first[b]
            if lossy and k % lossy == lossy - 1 and b == descriptors.size - 1:
                count_here -= 1
            if send_messages(descriptors[b], address + 64 * first[b], count_here, ATTEMPTS, spec):
                control[FAILED] += 1
        k += 1
        control[SENT] = k


class Sender:
    """Sends SYNC and TPDOs (position, current, status) of six drives, nodes 1 to 6, on some buses.

    ``channels``: the buses; the drives are distributed evenly. ``lossy``: interval in SYNCs at which the last drive
    omits an answer; 0 for never.
    """

    def __init__(self, channels: Sequence[str], period_us: int, count: int = 2**40, lossy: int = 0) -> None:
        context = multiprocessing.get_context("fork")
        shared = context.RawArray("q", 7)
        self.control: NDArray[np.int64] = np.frombuffer(shared, np.int64)
        arguments = list(channels), period_us, count, lossy, self.control
        self._process = context.Process(target=_work, args=arguments, daemon=True)

    def __enter__(self) -> Self:
        self._process.start()
        while not self.control[READY]:
            time.sleep(0.01)
            if not self._process.is_alive():
                raise RuntimeError("the sender ended")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.control[STOP] = self.control[GO] = 1
        self._process.join()

    def go(self) -> None:
        """Begin to send."""
        self.control[GO] = 1

    @property
    def sent(self) -> int:
        """Number of SYNCs sent so far."""
        return int(self.control[SENT])

    @property
    def pid(self) -> int:
        """Process id."""
        assert self._process.pid is not None
        return self._process.pid

    def stop(self) -> int:
        """End the process; return the number of SYNCs sent."""
        self.control[STOP] = 1
        self._process.join()
        return self.sent

    def wait(self) -> None:
        """Wait until all SYNCs are sent."""
        self._process.join()


def _work(channels: list[str], period_us: int, count: int, lossy: int, control: NDArray[np.int64]) -> None:
    sockets = [RawSocket(channel, filters=()) for channel in channels]
    rows: list[tuple[int, int, int]] = []
    first = [0]
    for b in range(len(channels)):
        rows.append((COB_SYNC, 1, -1))
        rows += [(0x181 + j, 8, j) for j in range(6) if j * len(channels) // 6 == b]
        first.append(len(rows))
    messages = Messages(len(rows), control=False)
    messages.body.view(np.uint32)[:, 0] = [can_id for can_id, _, _ in rows]
    messages.body[:, 4] = [length for _, length, _ in rows]
    joints = np.array([j for *_, j in rows], np.int64)
    descriptors = np.array([socket.fileno() for socket in sockets], np.int64)
    fixed = descriptors, messages.address, messages.body.view(np.int32), np.array(first, np.int64), joints
    _send(*fixed, period_us * 1000, 0, lossy, control)
    control[READY] = 1
    while not control[GO]:
        time.sleep(0.001)
    _send(*fixed, period_us * 1000, count, lossy, control)
