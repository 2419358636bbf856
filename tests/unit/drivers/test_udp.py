"""Bus over UDP multicast: frames and set points at a low rate."""

import time
from collections.abc import Iterator

import numpy as np
import pytest

from armident.configs import ConfigError
from armident.configs.schema.session import Bus
from armident.drivers.can.frames import Frames, frames
from armident.drivers.can.udp import UdpBus, open_bus
from armident.drivers.canopen.sync_producer import SetpointPlan, SyncProducer

CHANNEL = "239.74.163.77"
# Every group on the machine shares one port: identifiers that nothing else here uses keep other buses out.
MINE = [(0x7A0, 0x7F0)]


@pytest.fixture
def receiver() -> Iterator[UdpBus]:
    try:
        bus = UdpBus(CHANNEL, filters=MINE)
    except ConfigError as error:
        pytest.skip(f"no multicast here: {error}")
    with bus:
        yield bus


def collect(bus: UdpBus, n: int, seconds: float = 10.0) -> Frames:
    batch, parts, deadline = frames(64), [frames(0)], time.monotonic() + seconds
    while sum(p.size for p in parts) < n and time.monotonic() < deadline:
        bus.poll(0.1)
        parts.append(batch[: bus.receive(batch)].copy())
    return np.concatenate(parts)


def test_sent_frames_arrive_unchanged_and_filtered(receiver: UdpBus) -> None:
    sent = frames(20)
    sent["can_id"] = np.where(np.arange(20) % 2, 0x7A1, 0x6A1)
    sent["length"] = np.arange(20) % 9
    sent["data"][:, 0] = np.where(sent["length"], np.arange(20), 0)
    with UdpBus(CHANNEL, filters=()) as sender:
        assert sender.send(sent) == 20
        assert sender.receive(frames(4)) == 0
    got = collect(receiver, 10)
    for name in ("can_id", "length", "data"):
        np.testing.assert_array_equal(got[name], sent[name][1::2])
    # one minute: the stamp is a time of day in ns, not of some other clock or unit
    assert abs(got["t_ns"] - time.time_ns()).max() < 60e9


def test_the_session_chooses_the_bus() -> None:
    try:
        bus = open_bus(Bus(interface="udp_multicast", channel=CHANNEL))
    except ConfigError as error:
        pytest.skip(f"no multicast here: {error}")
    with bus:
        assert isinstance(bus, UdpBus)


def test_set_points_are_played_over_udp_in_order(receiver: UdpBus) -> None:
    rows = np.array([[m, -m] for m in range(1, 11)], dtype=np.int32)
    plan = SetpointPlan(rows, (0x7A1, 0x7A2), every=5)
    with SyncProducer(Bus(interface="udp_multicast", channel=CHANNEL), 4000, 240) as producer:
        first = producer.play(plan)
        got = collect(receiver, 20)
        while producer.sent <= first + 10 * 5:
            time.sleep(0.01)
        assert (first + 1) % 5 == 0
    for column, cob in enumerate(plan.cob_ids):
        values = got[got["can_id"] == cob]["data"][:, :4].copy().view("<i4")[:, 0]
        assert values.tolist() == rows[:, column].tolist()
