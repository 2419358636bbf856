"""Numbering of SYNCs by a counter that wraps: pauses, outages, several buses and frames missing at the end."""

from collections.abc import Callable

import numpy as np
import pytest

from armident.daq.matching.assembler import SYNC_LOST, Assembler, TpdoStream
from armident.daq.recording import Gap
from armident.drivers.can.frames import Frames, frames

PERIOD_NS = 200_000
OVERFLOW = 240
STREAM = TpdoStream("samples", 1, (0x181, 0x182), 8)
T0 = 1_700_000_000_000_000_000


class Listener:
    """Assembler on the bus of another master, with the gaps found so far."""

    def __init__(self) -> None:
        self.assembler = Assembler([STREAM], ("joint_1", "joint_2"), PERIOD_NS, OVERFLOW, None)
        self.gaps: list[Gap] = []

    def push(self, part: Frames, dropped: bool = False) -> None:
        """Add frames."""
        self.gaps += self.assembler.push(part, dropped=dropped).gaps

    def finish(self, sent: int | None = None) -> list[Gap]:
        """End the input and return all gaps."""
        return [*self.gaps, *self.assembler.finish(sent).gaps]


def outages(gaps: list[Gap]) -> list[tuple[int, int]]:
    """Return first and last SYNC of gaps without SYNC; other gaps may only contain the row before."""
    missing = [(gap.first, gap.last) for gap in gaps if gap.reason == SYNC_LOST]
    assert {gap.first for gap in gaps if gap.reason != SYNC_LOST} <= {first - 1 for first, _ in missing}
    return missing


def answered(numbers: list[int], late_ns: Callable[[int], int] = lambda k: 0) -> Frames:
    """Return SYNCs of these numbers, each with its two answers."""
    out = frames(3 * len(numbers))
    k = np.array(numbers)
    out["t_ns"] = np.repeat(T0 + k * PERIOD_NS + np.array([late_ns(int(i)) for i in k]), 3)
    out["can_id"] = np.tile([0x80, 0x181, 0x182], k.size)
    out["length"] = np.tile([1, 8, 8], k.size)
    out["data"][::3, 0] = k % OVERFLOW + 1
    return out


def test_a_pause_of_one_counter_turn_of_an_irregular_master_is_no_loss() -> None:
    """If the time stamps are irregular, a pause of exactly one turn is no evidence for missing SYNCs either."""
    listener = Listener()
    stalls = {400: 37, 700: 90, 900: OVERFLOW, 1500: 2 * OVERFLOW}
    listener.push(answered(list(range(2000)), lambda k: sum(n for at, n in stalls.items() if k >= at) * PERIOD_NS))
    assert listener.finish() == []
    assert listener.assembler.last_sync == 1999


@pytest.mark.parametrize("turns", [0.76, 1.1, 3.2])
@pytest.mark.parametrize("cut", [False, True])
def test_a_delayed_master_has_sent_no_sync_meanwhile(turns: float, cut: bool) -> None:
    listener = Listener()
    stall = round(turns * OVERFLOW) * PERIOD_NS
    sent = answered(list(range(1000)), lambda k: stall if k >= 500 else 0)
    for part in np.split(sent, [1500] if cut else []):
        listener.push(part)
    assert listener.finish() == []
    counters = listener.assembler.counters
    assert counters["samples.rows"] == counters["samples.expected"] == 1000


@pytest.mark.parametrize("why", ["dropped", "down", "bus-off"])
def test_whole_counter_turns_count_as_missing_only_if_frames_are_missing(why: str) -> None:
    listener = Listener()
    listener.push(answered(list(range(500))))
    if why == "down":
        listener.assembler.set_bus_down(0, True)
        listener.assembler.set_bus_down(0, False)
    elif why == "bus-off":
        listener.assembler.mark_incomplete(0)
    listener.push(answered(list(range(500 + 2 * OVERFLOW, 1500))), dropped=why == "dropped")
    assert outages(listener.finish()) == [(500, 500 + 2 * OVERFLOW - 1)]


def test_an_unreported_outage_is_detected_by_the_counter_and_measured_by_the_time() -> None:
    listener = Listener()
    listener.push(answered([*range(500), *range(1217, 1500)]))
    assert outages(listener.finish()) == [(500, 1216)]


def test_known_missing_frames_affect_only_the_next_sync() -> None:
    listener = Listener()
    stall = round(1.1 * OVERFLOW) * PERIOD_NS
    sent = answered(list(range(1000)), lambda k: stall if k >= 500 else 0)
    listener.push(sent[:600], dropped=True)
    listener.push(sent[600:])
    assert listener.finish() == []


@pytest.mark.parametrize(("dropped", "passed", "at_most"), [(0, 50, 0), (13, 50, 13), (700, 50, 50), (7, 0, 0)])
def test_unreceived_syncs_are_bounded_by_dropped_frames_and_elapsed_periods(
    dropped: int, passed: int, at_most: int
) -> None:
    listener = Listener()
    listener.push(answered(list(range(100))))
    now = T0 + (99 + passed) * PERIOD_NS
    assert listener.assembler.most_unreceived([dropped], now) == at_most
    gaps = listener.finish(100 + at_most)
    assert Gap("samples", 100, 99 + at_most, None, SYNC_LOST) in gaps or not at_most
    assert {k for gap in gaps for k in range(gap.first, gap.last + 1)} <= set(range(99, 100 + at_most))
    assert listener.assembler.counters["samples.expected"] == 100 + at_most


def test_no_sync_is_unreceived_before_the_first_one() -> None:
    assert Listener().assembler.most_unreceived([40], T0) == 0


def test_a_sync_dropped_on_one_bus_may_be_received_on_another() -> None:
    assembler = Assembler([STREAM], ("joint_1", "joint_2"), PERIOD_NS, OVERFLOW, None, bus_of=(0, 1))
    for bus, count in ((0, 100), (1, 90)):
        both = answered(list(range(count)))
        assembler.push(both[both["can_id"] != (0x182, 0x181)[bus]], bus=bus)
    now = T0 + 130 * PERIOD_NS
    assert assembler.most_unreceived([0, 5], now) == 0
    assert assembler.most_unreceived([0, 30], now) == 20


@pytest.mark.parametrize("held_up", [0.0, 0.3, 0.9, 5.0])
def test_delayed_frames_of_a_bus_are_numbered_by_the_times_of_another_bus(held_up: float) -> None:
    """The master is delayed by turns of its counter while one bus waits: nominal periods would give wrong turns."""
    count, before, after = 60_000, 22_000, 30_000
    assembler = Assembler([STREAM], ("joint_1", "joint_2"), PERIOD_NS, OVERFLOW, 1, bus_of=(0, 1))
    late = round(held_up * OVERFLOW) * PERIOD_NS
    both = answered(list(range(count)), lambda k: late * (k // 5000))
    both["data"][both["can_id"] != 0x80, :8] = np.repeat(np.arange(count), 2)[:, None].view(np.uint8)
    batches = []
    for first, until, bus in ((0, after, 1), (0, after, 0), (after, count, 0), (after, count, 1)):
        part = both[3 * first : 3 * until]
        batches.append(assembler.push(part[part["can_id"] != (0x182, 0x181)[bus]], count, bus=bus))
    batches.append(assembler.finish(count))
    rows = [batch.rows["samples"] for batch in batches]
    numbers = np.concatenate([row.sync for row in rows])
    values = np.concatenate([row.data[:, :, :8].copy().view("<i8")[:, :, 0] for row in rows])
    np.testing.assert_array_equal(values, np.repeat(numbers[:, None], 2, axis=1))
    assert numbers.size >= count - before


@pytest.mark.parametrize("turns", [1.0, 1.1, 2.4, 40.0])
@pytest.mark.parametrize("lost", [0, 700])
@pytest.mark.parametrize("held_up", [0.0, 2.0])
def test_own_syncs_are_numbered_by_their_send_times_if_frames_are_lost(turns: float, lost: int, held_up: float) -> None:
    assembler = Assembler([STREAM], ("joint_1", "joint_2"), PERIOD_NS, OVERFLOW)
    stall = round(turns * OVERFLOW) * PERIOD_NS
    sent = answered(list(range(2000)), lambda k: stall if k >= 500 else 0)
    # Bus and kernel add a delay; a producer may be delayed before it stores the send time.
    times = sent["t_ns"][::3] - 300_000
    times[499] += min(round(held_up * OVERFLOW) * PERIOD_NS, stall)
    # The last SYNC is being sent.
    assembler.send_times = lambda first: (first, times[first:1999])
    gaps = list(assembler.push(sent[:900], sent=2000).gaps)
    gaps += assembler.push(sent[3 * (300 + lost) :], sent=1999, dropped=True).gaps
    gaps += assembler.finish(2000).gaps
    assert outages(gaps) == ([(300, 300 + lost - 1)] if lost else [])
    assert assembler.counters["samples.expected"] == 2000


@pytest.mark.parametrize("back", [502, 762, 1400])
@pytest.mark.parametrize("known", [False, True])
def test_frames_delayed_by_an_outage_are_older_than_those_of_another_bus(back: int, known: bool) -> None:
    """One bus is read up to SYNC 1900 before the frames that the other has received since its return."""
    assembler = Assembler([STREAM], ("joint_1", "joint_2"), PERIOD_NS, OVERFLOW, 1, bus_of=(0, 1))
    sent = answered(list(range(2000)))
    times = sent["t_ns"][::3] + 20_000
    assembler.send_times = lambda first: (first, times[first:1999])
    one, other = (sent[sent["can_id"] != identifier] for identifier in (0x182, 0x181))
    gaps = list(assembler.push(other[:1000], 500, bus=1).gaps)
    assembler.set_bus_down(1, True)
    gaps += assembler.push(one[:3800], 1999, bus=0).gaps
    assembler.set_bus_down(1, False)
    if known:
        gaps += assembler.push(one[3800:], 1999, bus=0).gaps
    gaps += assembler.push(other[2 * back :], 1999, bus=1).gaps
    gaps += assembler.push(one[3800:], 1999, bus=0).gaps if not known else ()
    gaps += assembler.finish(2000).gaps
    assert assembler.counters["samples.expected"] == 2000
    missing = {k for gap in gaps for k in range(gap.first, gap.last + 1)}
    assert set(range(500, back)) <= missing
    assert {gap.joint for gap in gaps} <= {"joint_2", None}
