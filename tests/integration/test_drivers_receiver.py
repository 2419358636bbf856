"""Reception of several buses in one thread: no bus waits for the backlog of another."""

from functools import partial

import numpy as np
import pytest

from armident.drivers.can.error_frames import NO_ACKNOWLEDGE
from armident.drivers.can.frames import ERROR_FLAG, Frames, frames
from armident.drivers.can.receiver import BATCH, Receiver
from armident.drivers.can.socketcan import RawSocket

pytestmark = pytest.mark.vcan


def numbered(first: int, count: int) -> Frames:
    """Frames whose data are their number."""
    batch = frames(count)
    batch["can_id"], batch["length"] = 0x181, 8
    batch["data"] = np.arange(first, first + count, dtype="<u8").view(np.uint8).reshape(count, 8)
    return batch


def test_an_empty_bus_is_read_again_after_every_batch_of_another(vcan_buses: list[str]) -> None:
    quiet, busy = vcan_buses
    with (
        RawSocket(quiet, filters=()) as one,
        RawSocket(busy, filters=()) as other,
        Receiver([partial(RawSocket, name) for name in vcan_buses]) as receiver,
    ):
        backlog = 3 * BATCH + 5
        other.send(numbered(0, backlog))
        order: list[tuple[int, int]] = []
        for bus, batch, dropped in receiver.drain():
            assert not dropped
            numbers = batch["data"].copy().view("<u8").ravel()
            order.append((bus, int(numbers[0])))
            if len(order) == 1:
                one.send(numbered(0, 7))
        # Frames that came while the backlog was read do not wait for its end.
        assert order == [(1, 0), (0, 0), (1, BATCH), (1, 2 * BATCH), (1, 3 * BATCH)]
        assert [bus for bus, _, _ in receiver.drain()] == []


def test_pending_errors_are_reported_at_the_end(vcan_bus: str) -> None:
    error = frames(1)
    error["can_id"], error["length"] = ERROR_FLAG | NO_ACKNOWLEDGE, 8
    with RawSocket(vcan_bus, filters=()) as other, Receiver([partial(RawSocket, vcan_bus, errors=True)]) as receiver:
        for told in (1, 0):
            other.send(error)
            assert [batch.size for _, batch, _ in receiver.drain()] == [0]
            assert len(receiver.events()) == told
        (event,) = receiver.events(last=True)
        assert (event.kind, event.text) == ("bus_errors", f"bus {vcan_bus}: nobody acknowledges")
        assert receiver.error_frames == 2
