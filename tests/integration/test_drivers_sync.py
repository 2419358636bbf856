"""SYNC producer: order and numbers on UDP, times and outages on SocketCAN."""

import subprocess
import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import pytest

from armident.configs.schema.session import Bus
from armident.drivers.can.frames import BusDown, FrameBus, Frames, frames
from armident.drivers.can.socketcan import RawSocket
from armident.drivers.can.udp import open_bus
from armident.drivers.canopen.kernel_sync import KernelSync
from armident.drivers.canopen.objects import COB_SYNC
from armident.drivers.canopen.sync_producer import SetpointPlan, SyncProducer

PERIOD_US = 1000
UDP_PERIOD_US = 5000
"""A busy machine may stop a receiver for a second: the buffer of a UDP socket then holds the frames."""
COBS = (0x201, 0x202)


def record(bus: Bus, producer: SyncProducer, until: Callable[[], bool]) -> Frames:
    """All frames from the first SYNC until ``until()`` and the end of the producer."""
    batch, parts = frames(4096), []
    deadline = time.monotonic() + 60

    def drain(socket: FrameBus) -> None:
        while n := socket.receive(batch):
            parts.append(batch[:n].copy())

    with open_bus(bus) as socket:
        with producer:
            while not until():
                assert time.monotonic() < deadline
                socket.poll(0.1)
                drain(socket)
        drain(socket)
    return np.concatenate(parts)


def producer_on(bus: Bus, counter: int = 240, plan: SetpointPlan | None = None) -> SyncProducer:
    return SyncProducer(bus, UDP_PERIOD_US if bus.interface == "udp_multicast" else PERIOD_US, counter, plan)


def test_every_sync_number_is_sent_once_with_its_counter(udp_bus: Bus) -> None:
    producer = producer_on(udp_bus, counter=10)
    got = record(udp_bus, producer, lambda: producer.sent >= 100)
    assert (got["can_id"] == COB_SYNC).all()
    assert (got["length"] == 1).all()
    assert got["data"][:, 0].tolist() == [k % 10 + 1 for k in range(producer.sent)]


@pytest.mark.vcan
def test_syncs_stay_on_the_time_grid_except_for_skipped_periods(vcan_bus: str) -> None:
    producer = producer_on(Bus(channel=vcan_bus))
    got = record(Bus(channel=vcan_bus), producer, lambda: producer.sent >= 500)
    stats = producer.stats()
    grid = (got.size - 1 + stats.skipped) * PERIOD_US
    elapsed = (got["t_ns"][-1] - got["t_ns"][0]) / 1000
    # first and last SYNC may each be late, by no more than the producer reports
    assert abs(elapsed - grid) <= stats.late_max_us + 2000
    assert 0 <= stats.late_p50_us <= stats.late_p99_us <= stats.late_max_us + 5


@pytest.mark.vcan
def test_two_syncs_are_never_closer_than_half_a_period(vcan_bus: str) -> None:
    producer = producer_on(Bus(channel=vcan_bus))
    got = record(Bus(channel=vcan_bus), producer, lambda: producer.sent >= 500)
    # 50 us: the two clocks, and the granularity of the guest's
    assert np.diff(got["t_ns"]).min() > PERIOD_US * 500 - 50_000


def test_no_sync_follows_the_last_one(udp_bus: Bus) -> None:
    producer = producer_on(udp_bus, counter=10)
    producer.stop_after(70)
    begin = time.monotonic()
    got = record(udp_bus, producer, lambda: time.monotonic() > begin + 1.0 and producer.sent == 70)
    assert got["data"][:, 0].tolist() == [k % 10 + 1 for k in range(70)]


def rows_of(got: Frames, cob: int) -> list[int]:
    return [int(v) for v in got[got["can_id"] == cob]["data"][:, :4].copy().view("<i4")[:, 0]]


def test_row_m_is_on_the_bus_between_the_sync_before_its_knot_and_the_knot(udp_bus: Bus) -> None:
    rows = np.array([[-7 * m, 100_000 + m] for m in range(20)], dtype=np.int32)
    producer = producer_on(udp_bus, plan=SetpointPlan(rows, COBS, every=5))
    got = record(udp_bus, producer, lambda: producer.sent > 4 + 20 * 5)
    number = np.cumsum(got["can_id"] == COB_SYNC) - 1
    for column, cob in enumerate(COBS):
        assert rows_of(got, cob) == rows[:, column].tolist()
        assert number[got["can_id"] == cob].tolist() == [4 + 5 * m - 1 for m in range(20)]


def test_a_plan_given_later_starts_at_the_knot_that_play_returns(udp_bus: Bus) -> None:
    plan = SetpointPlan(np.arange(20, dtype=np.int32).reshape(10, 2), COBS, every=5)
    producer, first = producer_on(udp_bus), -1

    def until() -> bool:
        nonlocal first
        if first < 0 and producer.sent > 20:
            first = producer.play(plan)
        return first >= 0 and producer.sent > first + 10 * 5

    got = record(udp_bus, producer, until)
    number = np.cumsum(got["can_id"] == COB_SYNC) - 1
    assert first > 20
    assert (first + 1) % 5 == 0
    assert number[got["can_id"] == COBS[0]].tolist() == [first + 5 * m - 1 for m in range(10)]


def test_no_set_points_follow_the_last_row(udp_bus: Bus) -> None:
    plan = SetpointPlan(np.zeros((2, 2), dtype=np.int32), COBS, every=5)
    producer = producer_on(udp_bus, plan=plan)
    got = record(udp_bus, producer, lambda: producer.sent >= 30)
    assert len(rows_of(got, COBS[0])) == 2


@pytest.mark.vcan
def test_a_bus_that_is_down_raises_until_it_is_up_again(vcan_bus: str) -> None:
    producer = producer_on(Bus(channel=vcan_bus))
    with producer:
        while producer.sent < 10:
            time.sleep(0.01)
        producer.check()
        subprocess.run(["ip", "link", "set", "dev", vcan_bus, "down"], check=True)
        time.sleep(0.2)
        with pytest.raises(BusDown, match="SYNC cannot be sent"):
            producer.check()
        subprocess.run(["ip", "link", "set", "dev", vcan_bus, "up"], check=True)
        with RawSocket(vcan_bus) as socket:
            assert socket.poll(2.0)
            producer.check()
    assert producer.stats().unsent[0] >= 100


@pytest.mark.vcan
def test_several_buses_get_every_sync_and_each_its_own_set_points(vcan_buses: list[str]) -> None:
    rows = np.arange(60, dtype=np.int32).reshape(20, 3)
    plan = SetpointPlan(rows, (0x201, 0x201, 0x202), 5, bus_of=(0, 1, 0))
    producer = SyncProducer([Bus(channel=name) for name in vcan_buses], PERIOD_US, 240, plan)
    with RawSocket(vcan_buses[0]) as one, RawSocket(vcan_buses[1]) as other:
        with producer:
            while producer.sent <= 4 + 20 * 5:
                time.sleep(0.02)
                producer.check()
        got = []
        for bus in (one, other):
            batch = frames(4096)
            got.append(batch[: bus.receive(batch)])
    for log in got:
        counters = log["data"][log["can_id"] == COB_SYNC, 0].tolist()
        assert counters == [k % 240 + 1 for k in range(producer.sent)]
    for log, cob, column in ((got[0], 0x201, 0), (got[1], 0x201, 1), (got[0], 0x202, 2)):
        sent = log["data"][log["can_id"] == cob, :4].copy().view("<i4")[:, 0]
        assert sent.tolist() == rows[:, column].tolist()
    assert np.count_nonzero(got[1]["can_id"] == 0x202) == 0


@pytest.mark.vcan
def test_an_outage_of_one_bus_does_not_affect_the_others(vcan_buses: list[str]) -> None:
    producer = SyncProducer([Bus(channel=name) for name in vcan_buses], PERIOD_US, 240)
    with RawSocket(vcan_buses[0]) as one, RawSocket(vcan_buses[1]) as other:
        with producer:
            for state in ("down", "up"):
                before = producer.sent
                subprocess.run(["ip", "link", "set", vcan_buses[1], state], check=True)
                while producer.sent < before + 200:
                    time.sleep(0.02)
                    producer.check()
        unsent = producer.stats().unsent
        counts = []
        for bus in (one, other):
            batch, n = frames(4096), 0
            with suppress(BusDown):
                n = bus.receive(batch)
            n = n or bus.receive(batch)
            counts.append(n)
    assert unsent[0] == 0
    assert unsent[1] >= 100
    assert counts == [producer.sent, producer.sent - unsent[1]]


@pytest.mark.vcan
def test_the_kernel_sends_every_sync_with_its_counter(vcan_bus: str) -> None:
    with RawSocket(vcan_bus) as socket, KernelSync(Bus(channel=vcan_bus), PERIOD_US, 240):
        log, batch = frames(0), frames(4096)
        while log.size < 500:
            socket.poll(0.1)
            log = np.concatenate([log, batch[: socket.receive(batch)]])
    assert (log["can_id"] == COB_SYNC).all()
    assert (log["length"] == 1).all()
    assert log["data"][:, 0].tolist() == [k % 240 + 1 for k in range(log.size)]
    # The kernel's period is never shorter than asked for; on a guest it is longer by its timer's latency.
    assert np.median(np.diff(log["t_ns"])) >= 0.9e3 * PERIOD_US
