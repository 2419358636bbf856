"""The packet ring on a SocketCAN bus delivers what a raw CAN socket delivers."""

import errno
import logging
import subprocess
import time

import numpy as np
import pytest

from armident.configs import ConfigError
from armident.configs.schema.session import Bus
from armident.drivers.can import packet_ring
from armident.drivers.can.frames import (
    BIT_RATE_SWITCH,
    ERROR_FLAG,
    FD_FLAG,
    BusDown,
    Frames,
    FrameSource,
    frame,
    frames,
)
from armident.drivers.can.packet_ring import PacketRing, open_source
from armident.drivers.can.receiver import Receiver
from armident.drivers.can.socketcan import RawSocket

pytestmark = pytest.mark.vcan

SLOTS = 640
"""Slots of the smallest ring: one block."""


def numbered(first: int, count: int, can_id: int = 0x181) -> Frames:
    """Frames whose data are their number."""
    batch = frames(count)
    batch["can_id"], batch["length"] = can_id, 8
    batch["data"] = np.arange(first, first + count, dtype="<u8").view(np.uint8).reshape(count, 8)
    return batch


def drain(source: FrameSource, room: int = 4096) -> Frames:
    batch, parts = frames(room, source.fd), []
    while n := source.receive(batch):
        parts.append(batch[:n].copy())
    return np.concatenate(parts) if parts else frames(0, source.fd)


def numbers(batch: Frames) -> list[int]:
    return [int(number) for number in batch["data"].copy().view("<u8").ravel()]


def test_the_same_frames_arrive_in_the_same_order_with_the_same_kernel_times(vcan_bus: str) -> None:
    error = frame(ERROR_FLAG | 0x20, bytes(8))
    with (
        RawSocket(vcan_bus, filters=()) as sender,
        RawSocket(vcan_bus, errors=True) as raw,
        PacketRing(vcan_bus, errors=True, slots=SLOTS) as ring,
    ):
        for part in range(50):  # ten times around the ring
            sender.send(numbered(100 * part, 100))
            sender.send(frame(0x80))
            sender.send(frame(0x8000_0000 | 0x1ABCDE, b"extended"))
            sender.send(frame(0x4000_0000 | 0x181))  # remote frame
            sender.send(error)
            before = time.time_ns()
            of_raw, of_ring = drain(raw), drain(ring, room=33)
            np.testing.assert_array_equal(of_ring, of_raw)
            assert of_ring.size == 104
            assert abs(before - int(of_ring["t_ns"][-1])) < 1_000_000_000
        assert ring.drops() == ring.dropped == 0


@pytest.mark.parametrize("errors", [False, True])
def test_filters_pass_what_those_of_a_raw_socket_pass(vcan_bus: str, errors: bool) -> None:
    filters = [(0x80, 0x7FF), (0x180, 0x780)]
    with (
        RawSocket(vcan_bus, filters=()) as sender,
        RawSocket(vcan_bus, filters=filters, errors=errors) as raw,
        PacketRing(vcan_bus, filters=filters, errors=errors, slots=SLOTS) as ring,
    ):
        for can_id in (0x80, 0x81, 0x181, 0x1FF, 0x281, 0x8000_0080, 0x4000_0181, ERROR_FLAG | 0x4):
            sender.send(frame(can_id, b"\x01" * 8))
        np.testing.assert_array_equal(got := drain(ring), drain(raw))
        assert got.size == 5 + errors


def test_frames_of_can_fd_and_classic_ones_arrive_once(vcan_bus: str) -> None:
    fd = frames(3, fd=True)
    fd["can_id"], fd["length"] = [0x181, 0x182, 0x183], [64, 12, 8]
    fd["flags"] = [FD_FLAG, FD_FLAG | BIT_RATE_SWITCH, 0]
    fd["data"][:, :8] = np.arange(8)
    with (
        RawSocket(vcan_bus, filters=(), fd=True) as sender,
        RawSocket(vcan_bus, fd=True) as raw,
        PacketRing(vcan_bus, fd=True, slots=SLOTS) as ring,
        PacketRing(vcan_bus, slots=SLOTS) as classic,
    ):
        sender.send(fd)
        np.testing.assert_array_equal(got := drain(ring), drain(raw))
        assert got["flags"].tolist() == [FD_FLAG, FD_FLAG | BIT_RATE_SWITCH, 0]
        assert drain(classic)["can_id"].tolist() == [0x183]


def test_every_dropped_frame_is_counted_and_known_before_another_one_comes(vcan_bus: str) -> None:
    with RawSocket(vcan_bus, filters=()) as sender, PacketRing(vcan_bus, slots=SLOTS) as ring:
        sender.send(numbered(0, 1000))
        assert numbers(drain(ring)) == list(range(SLOTS))
        # The count comes with the next frame that finds a slot.
        assert ring.dropped == 0
        sender.send(numbered(1000, 1))
        assert numbers(drain(ring)) == [1000]
        assert ring.dropped == 360
        sender.send(numbered(0, 700))
        drain(ring)
        assert (ring.drops(), ring.dropped) == (420, 360)
        sender.send(numbered(1, 1))
        drain(ring)
        assert ring.drops() == ring.dropped == 420


def test_a_receiver_marks_the_batches_behind_each_loss(vcan_bus: str) -> None:
    with (
        RawSocket(vcan_bus, filters=()) as sender,
        Receiver([lambda: PacketRing(vcan_bus, slots=SLOTS)]) as receiver,
    ):
        sender.send(numbered(0, 700))
        assert (receiver.dropped, receiver.dropped_behind) == (60, (60,))
        assert [(batch.size, lost) for _, batch, lost in receiver.drain()] == [(SLOTS, False)]
        sender.send(numbered(700, 10))
        assert receiver.dropped_behind == (60,)
        assert [(batch.size, lost) for _, batch, lost in receiver.drain()] == [(10, True)]
        sender.send(numbered(710, 10))
        assert [(batch.size, lost) for _, batch, lost in receiver.drain()] == [(10, False)]
        assert (receiver.dropped, receiver.dropped_behind) == (60, (0,))


def test_two_losses_in_one_turn_of_the_ring_are_both_marked(vcan_bus: str) -> None:
    batch = frames(100)
    with RawSocket(vcan_bus, filters=()) as sender, PacketRing(vcan_bus, slots=SLOTS) as ring:
        sender.send(numbered(0, SLOTS + 50))
        marked, last = [], -1
        for turn in range(14):
            before = ring.dropped
            got = batch[: ring.receive(batch)]
            if ring.dropped > before:
                marked += numbers(got)
            last = numbers(got)[-1]
            if turn == 0:
                sender.send(numbered(2000, 150))  # 100 find a slot
            if turn == 1:
                sender.send(numbered(3000, 100))
            if ring.drops() == ring.dropped and turn > 1 and not ring.poll(0):
                break
        assert {2000, 3000} <= set(marked)
        assert last == 3099
        assert ring.drops() == ring.dropped == 100


def test_poll_returns_as_soon_as_a_frame_arrives_and_not_before_the_timeout_otherwise(vcan_bus: str) -> None:
    with RawSocket(vcan_bus, filters=()) as sender, PacketRing(vcan_bus, slots=SLOTS) as ring:
        begin = time.monotonic()
        assert not ring.poll(0.1)
        assert time.monotonic() - begin >= 0.09
        sender.send(frame(0x80))
        assert ring.poll(10.0)
        assert ring.receive(frames(4)) == 1
        assert not ring.poll(0.0)


def test_a_bus_that_goes_down_is_reported_after_its_last_frames_and_usable_again_once_it_is_up(vcan_bus: str) -> None:
    with (
        RawSocket(vcan_bus, filters=()) as sender,
        Receiver([lambda: PacketRing(vcan_bus, slots=SLOTS)]) as receiver,
    ):
        sender.send(numbered(0, 3))
        subprocess.run(["ip", "link", "set", "dev", vcan_bus, "down"], check=True)
        assert [batch.size for _, batch, _ in receiver.drain()] == [3]
        assert [batch.size for _, batch, _ in receiver.drain()] == []
        (event,) = receiver.events()
        assert (event.kind, receiver.down) == ("bus_down", (True,))
        assert f"bus {vcan_bus}: the interface went down" in event.text
        subprocess.run(["ip", "link", "set", "dev", vcan_bus, "up"], check=True)
        time.sleep(0.15)
        (event,) = receiver.events()
        assert event.kind == "bus_up"
        with RawSocket(vcan_bus, filters=()) as other:
            other.send(numbered(3, 2))
        assert [numbers(batch) for _, batch, _ in receiver.drain()] == [[3, 4]]


def test_a_removed_interface_is_reopened_once_it_is_back(vcan_bus: str) -> None:
    with Receiver([lambda: PacketRing(vcan_bus, slots=SLOTS)]) as receiver:
        subprocess.run(["ip", "link", "delete", "dev", vcan_bus], check=True)
        assert [batch.size for _, batch, _ in receiver.drain()] == []
        (event,) = receiver.events()
        assert "was removed" in event.text
        subprocess.run(["ip", "link", "add", "dev", vcan_bus, "type", "vcan"], check=True)
        subprocess.run(["ip", "link", "set", "dev", vcan_bus, "up"], check=True)
        time.sleep(0.15)
        (event,) = receiver.events()
        assert event.kind == "bus_up"
        with RawSocket(vcan_bus, filters=()) as sender:
            sender.send(numbered(0, 2))
        assert [numbers(batch) for _, batch, _ in receiver.drain()] == [[0, 1]]


def test_interfaces_that_are_missing_down_or_no_can_are_refused_as_by_a_raw_socket(vcan_bus: str) -> None:
    for name in ("vcan98", "lo"):
        with pytest.raises(ConfigError, match=f"bus {name}: no such CAN interface"):
            PacketRing(name, slots=SLOTS)
    subprocess.run(["ip", "link", "set", "dev", vcan_bus, "down"], check=True)
    try:
        with pytest.raises(BusDown, match="is down"):
            PacketRing(vcan_bus, slots=SLOTS)
    finally:
        subprocess.run(["ip", "link", "set", "dev", vcan_bus, "up"], check=True)
    for step in (["down"], ["mtu", "16"], ["up"]):
        subprocess.run(["ip", "link", "set", "dev", vcan_bus, *step], check=True)
    with pytest.raises(ConfigError, match="carries no CAN FD"):
        PacketRing(vcan_bus, fd=True, slots=SLOTS)
    with pytest.raises(ValueError, match="exceeds 11 bits"):
        PacketRing(vcan_bus, filters=[(0x80, 0x1FFF_FFFF)], slots=SLOTS)


def test_a_source_is_a_ring_or_else_a_raw_socket_and_the_reason_is_logged_once(
    vcan_bus: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    bus = Bus(channel=vcan_bus)
    with open_source(bus) as source:
        assert isinstance(source, PacketRing)

    def refuse(*_: object, **__: object) -> PacketRing:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    with monkeypatch.context() as patch, caplog.at_level(logging.INFO):
        patch.setattr(packet_ring, "PacketRing", refuse)
        for _ in range(2):
            with open_source(bus) as source:
                assert isinstance(source, RawSocket)
    (record,) = caplog.records
    assert "CAP_NET_RAW" in record.getMessage()
