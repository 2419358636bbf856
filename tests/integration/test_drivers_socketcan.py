"""Batched access to a SocketCAN bus."""

import subprocess
import time

import numpy as np
import pytest

from armident.configs import ConfigError
from armident.drivers.can.frames import BIT_RATE_SWITCH, FD_FLAG, BusDown, Frames, frame, frames
from armident.drivers.can.socketcan import BATCH, RawSocket

pytestmark = pytest.mark.vcan


def numbered(n: int, can_id: int = 0x181) -> Frames:
    """Frames whose data are their number."""
    batch = frames(n)
    batch["can_id"], batch["length"] = can_id, 8
    batch["data"] = np.arange(n, dtype="<u8").view(np.uint8).reshape(n, 8)
    return batch


def drain(socket: RawSocket, room: int = BATCH) -> Frames:
    batch, parts = frames(room), []
    while n := socket.receive(batch):
        parts.append(batch[:n].copy())
    return np.concatenate(parts) if parts else frames(0)


def test_twenty_thousand_frames_arrive_in_order_with_rising_time_stamps(vcan_bus: str) -> None:
    sent = numbered(20_000)
    with RawSocket(vcan_bus, filters=()) as sender, RawSocket(vcan_bus) as receiver:
        before = time.time_ns()
        assert sender.send(sent) == sent.size
        got = drain(receiver, room=777)
        assert receiver.dropped == 0
    for name in ("can_id", "length", "data"):
        np.testing.assert_array_equal(got[name], sent[name])
    assert (np.diff(got["t_ns"]) >= 0).all()
    # 50 ms: clock adjustments between two readings of the same clock
    assert before - 50_000_000 <= got["t_ns"][0] <= got["t_ns"][-1] <= time.time_ns() + 50_000_000


def test_every_dropped_frame_is_counted(vcan_bus: str) -> None:
    with RawSocket(vcan_bus, filters=()) as sender, RawSocket(vcan_bus, receive_buffer=8192) as receiver:
        sender.send(numbered(500))
        first = drain(receiver)
        # the count comes with the next received frame
        sender.send(numbered(1))
        second = drain(receiver)
        assert 0 < first.size < 500
        assert first.size + receiver.dropped == 500
        sender.send(numbered(500))
        third = drain(receiver)
        sender.send(numbered(1))
        fourth = drain(receiver)
        assert first.size + second.size + third.size + fourth.size + receiver.dropped == 1002


def test_frames_dropped_after_the_last_received_one_are_counted(vcan_bus: str) -> None:
    with RawSocket(vcan_bus, filters=()) as sender, RawSocket(vcan_bus, receive_buffer=8192) as receiver:
        assert receiver.drops() == 0
        sender.send(numbered(500))
        got = drain(receiver)
        assert receiver.dropped == 0
        assert receiver.drops() == 500 - got.size
        sender.send(numbered(1))
        drain(receiver)
        assert receiver.drops() == receiver.dropped == 500 - got.size


def test_the_kernel_filters_by_the_exact_identifier(vcan_bus: str) -> None:
    with RawSocket(vcan_bus, filters=()) as sender, RawSocket(vcan_bus, filters=[(0x80, 0x7FF)]) as receiver:
        for can_id in (0x80, 0x81, 0x181, 0x80):
            sender.send(frame(can_id, b"\x01"))
        assert drain(receiver)["can_id"].tolist() == [0x80, 0x80]
        assert drain(sender).size == 0


def test_own_frames_are_received_only_on_request(vcan_bus: str) -> None:
    with RawSocket(vcan_bus) as silent, RawSocket(vcan_bus, own=True) as echoing:
        silent.send(frame(0x123))
        echoing.send(frame(0x124))
        assert drain(silent)["can_id"].tolist() == [0x124]
        assert drain(echoing)["can_id"].tolist() == [0x123, 0x124]


def test_poll_returns_when_a_frame_arrives_or_at_the_timeout(vcan_bus: str) -> None:
    with RawSocket(vcan_bus, filters=()) as sender, RawSocket(vcan_bus) as receiver:
        begin = time.monotonic()
        assert not receiver.poll(0.1)
        assert time.monotonic() - begin >= 0.09
        sender.send(frame(0x80))
        assert receiver.poll(10.0)
        assert receiver.receive(frames(4)) == 1


def test_a_bus_that_goes_down_is_reported_by_every_operation_and_usable_again_once_it_is_up(vcan_bus: str) -> None:
    with RawSocket(vcan_bus) as receiver, RawSocket(vcan_bus, filters=()) as sender:
        subprocess.run(["ip", "link", "set", "dev", vcan_bus, "down"], check=True)
        with pytest.raises(BusDown, match=f"bus {vcan_bus}: the interface went down"):
            receiver.receive(frames(4))
        with pytest.raises(BusDown, match="went down"):
            sender.poll(1.0)
        with pytest.raises(BusDown, match="went down"):
            sender.send(frame(0x80))
        with pytest.raises(BusDown, match=f"is down; .*sudo ip link set dev {vcan_bus} up"):
            RawSocket(vcan_bus)
        subprocess.run(["ip", "link", "set", "dev", vcan_bus, "up"], check=True)
        sender.send(frame(0x80))
        assert drain(receiver)["can_id"].tolist() == [0x80]


def test_a_missing_interface_is_a_configuration_error() -> None:
    with pytest.raises(ConfigError, match="bus can97: no such CAN interface"):
        RawSocket("can97")


def test_an_interface_that_is_no_can_bus_is_a_configuration_error() -> None:
    with pytest.raises(ConfigError, match="bus lo: no such CAN interface"):
        RawSocket("lo")


def test_frames_of_can_fd_arrive_beside_classic_ones(vcan_bus: str) -> None:
    sent = frames(3, fd=True)
    sent["can_id"], sent["length"] = [0x181, 0x182, 0x183], [64, 8, 12]
    sent["flags"] = [FD_FLAG | BIT_RATE_SWITCH, 0, FD_FLAG]
    sent["data"] = np.arange(3 * 64, dtype=np.uint8).reshape(3, 64)
    with (
        RawSocket(vcan_bus, filters=(), fd=True) as sender,
        RawSocket(vcan_bus, fd=True) as receiver,
        RawSocket(vcan_bus) as classic,
    ):
        assert sender.send(sent) == 3
        batch = frames(16, fd=True)
        assert receiver.receive(batch) == 3
        for field in ("can_id", "length"):
            assert batch[field][:3].tolist() == sent[field].tolist()
        assert [bool(f & FD_FLAG) for f in batch["flags"][:3]] == [True, False, True]
        for k, length in enumerate((64, 8, 12)):
            assert batch["data"][k, :length].tolist() == sent["data"][k, :length].tolist()
        narrow = frames(16)
        assert classic.receive(narrow) == 1
        assert narrow["can_id"][0] == 0x182


def test_an_interface_without_can_fd_is_named_with_the_command_to_run(vcan_bus: str) -> None:
    for step in (["down"], ["mtu", "16"], ["up"]):
        subprocess.run(["ip", "link", "set", "dev", vcan_bus, *step], check=True)
    with pytest.raises(ConfigError, match="carries no CAN FD"):
        RawSocket(vcan_bus, fd=True)
