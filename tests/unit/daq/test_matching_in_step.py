"""Rows wait for late answers only as long as necessary, and never get answers of other SYNCs."""

import numpy as np
import pytest

from armident.daq.matching.assembler import IN_STEP_S, SYNC_LOST, Assembler, Batch, TpdoStream
from armident.daq.recording import Gap
from armident.drivers.can.frames import Frames, frames

PERIOD_NS = 1_000_000
PERIOD_S = PERIOD_NS * 1e-9
T0 = 1_700_000_000_000_000_000
LONGEST_WAIT = 3 * round(IN_STEP_S / PERIOD_S) + 2
Sent = list[tuple[int, int]]
"""Identifier and value of the frames after a SYNC."""


def frames_of(k: int, sent: Sent, with_sync: bool = True, at_ns: int | None = None) -> Frames:
    """Return SYNC ``k`` and the frames after it."""
    out = frames(with_sync + len(sent))
    out["t_ns"] = (T0 + k * PERIOD_NS if at_ns is None else at_ns) + 1000 * np.arange(out.size)
    if with_sync:
        out["can_id"][0], out["length"][0], out["data"][0, 0] = 0x80, 1, k % 240 + 1
    for i, (can_id, number) in enumerate(sent, with_sync):
        out["can_id"][i], out["length"][i] = can_id, 8
        out["data"][i] = np.frombuffer(number.to_bytes(8, "little"), np.uint8)
    return out


class Bench:
    """Matcher for joints a, b on the first bus and, with two buses, c, d on the second; collects rows and gaps."""

    def __init__(self, buses: int = 1, foreign: bool = False) -> None:
        self.joints = ("a", "b", "c", "d")[: 2 * buses]
        stream = TpdoStream("samples", 1, (0x181, 0x182, 0x181, 0x182)[: 2 * buses], 8)
        first = None if foreign else 1
        bus_of = (0, 0, 1, 1)[: 2 * buses]
        self.assembler = Assembler((stream,), self.joints, PERIOD_NS, first_counter=first, bus_of=bus_of)
        self.sync: list[int] = []
        self.gaps: list[Gap] = []
        self.waited = 0

    def push(self, k: int, *sent: Sent, with_sync: bool = True) -> None:
        """Add a SYNC on every bus with the frames after it."""
        for bus, some in enumerate(sent):
            self._take(self.assembler.push(frames_of(k, some, with_sync), sent=k + 1, bus=bus))
        self.waited = max(self.waited, k - self.decided)

    @property
    def decided(self) -> int:
        """Last SYNC whose row or gap is decided; gaps may continue."""
        totals = self.assembler.counters
        return totals["samples.expected"] - 1

    def finish(self, sent: int) -> None:
        """End the input after ``sent`` SYNCs."""
        self._take(self.assembler.finish(sent))

    def _take(self, batch: Batch) -> None:
        rows = batch.rows["samples"]
        numbers = rows.data[:, :, :8].copy().view("<i8")[:, :, 0]
        assert np.all(numbers == rows.sync[:, None]), "a value is of another SYNC"
        self.sync += rows.sync.tolist()
        self.gaps += batch.gaps

    def missing(self, count: int) -> set[int]:
        """Return the SYNCs without a row among the first ``count``."""
        assert self.assembler.counters["samples.expected"] == count
        return set(range(count)) - set(self.sync)


def answers(k: int) -> Sent:
    """Return the answers of both drives of a bus to SYNC ``k``."""
    return [(0x181, k), (0x182, k)]


def test_a_lost_answer_delays_rows_by_some_ten_milliseconds_and_costs_one_row() -> None:
    bench = Bench()
    for k in range(500):
        bench.push(k, answers(k)[k == 100 :])
    bench.finish(500)
    assert bench.missing(500) == {100}
    assert bench.gaps == [Gap("samples", 100, 100, "a", "lost")]
    assert bench.waited <= LONGEST_WAIT


def test_consecutive_losses_of_both_drives_are_distinguished() -> None:
    bench = Bench()
    lost = {(100, 0x181), (110, 0x182), (125, 0x181), (300, 0x182), (301, 0x182)}
    for k in range(800):
        bench.push(k, [(cob, k) for cob, _ in answers(k) if (k, cob) not in lost])
    bench.finish(800)
    assert bench.missing(800) == {100, 110, 125, 300, 301}


def test_a_silent_drive_delays_rows_only_briefly() -> None:
    bench = Bench()
    for k in range(1000):
        bench.push(k, answers(k)[200 <= k < 600 :])
    bench.finish(1000)
    assert bench.missing(1000) == set(range(200, 600))
    assert bench.gaps == [Gap("samples", 200, 599, "a", "lost")]
    assert bench.waited <= LONGEST_WAIT


@pytest.mark.parametrize("held", [5, 35])
def test_a_drive_that_pauses_briefly_loses_no_answer(held: int) -> None:
    bench = Bench()
    for k in range(400):
        burst = [(0x181, i) for i in range(100, 100 + held + 1)] if k == 100 + held else [(0x181, k)]
        bench.push(k, [*(burst if not 100 <= k < 100 + held else []), (0x182, k)])
    bench.finish(400)
    assert bench.missing(400) == set()


@pytest.mark.parametrize("rate", [2, 7, 60])
def test_answers_to_discarded_rows_are_not_matched_to_other_rows(rate: int) -> None:
    """A drive is silent for 120 SYNCs, then sends all answers at ``rate`` per period, and is prompt again."""
    bench, queue = Bench(), list[int]()
    for k in range(700):
        queue.append(k)
        out = [] if 100 <= k < 220 else queue[:rate]
        queue = queue[len(out) :]
        bench.push(k, [*((0x181, i) for i in out), (0x182, k)])
    bench.finish(700)
    missing = bench.missing(700)
    assert set(range(100, 175)) <= missing <= set(range(100, 350))


@pytest.mark.slow
@pytest.mark.parametrize("stale", [0, 3, 42])
def test_after_an_outage_late_answers_are_matched_and_stale_ones_dropped(stale: int) -> None:
    """Bus 2 is off for 200 SYNCs; its drives send ``stale`` earlier answers afterwards and are late by 300 SYNCs."""
    bench, queue = Bench(buses=2), list[int]()
    for k in range(1500):
        if k in (300, 500):
            bench.assembler.set_bus_down(1, k == 300)
        if 300 <= k < 500:
            bench._take(bench.assembler.push(frames_of(k, answers(k)), sent=k + 1, bus=0))
            bench._take(bench.assembler.push(frames(0), sent=k + 1, bus=1))
            continue
        queue.append(k)
        out = [] if 300 - stale <= k < 300 or 510 <= k < 800 else queue[:20]
        queue = queue[len(out) :]
        bench.push(k, answers(k), [(cob, i) for i in out for cob in (0x181, 0x182)])
    bench.finish(1500)
    assert bench.missing(1500) == set(range(300 - stale, 500))
    assert {g.joint for g in bench.gaps} == {"c", "d"}
    assert {g.reason for g in bench.gaps} == ({"lost", SYNC_LOST} if stale else {SYNC_LOST})


def test_a_bus_whose_answers_are_often_one_sync_late_recovers_from_an_outage() -> None:
    """After the outage one old answer arrives, and every third answer only after the next SYNC."""
    bench, queue = Bench(buses=2), [299]
    for k in range(1001):
        if k in (300, 500):
            bench.assembler.set_bus_down(1, k == 300)
        if 300 <= k < 500:
            bench._take(bench.assembler.push(frames_of(k, answers(k)), sent=k + 1, bus=0))
            continue
        late = k >= 500 and k % 3 == 0
        sent = [] if k == 299 or late else [*(queue if k >= 500 else []), k]
        queue = [*queue, k] if late else ([299] if k < 500 else [])
        bench.push(k, answers(k), [(cob, i) for i in sent for cob in (0x181, 0x182)])
    bench.finish(1001)
    assert set(range(299, 500)) <= bench.missing(1001) <= set(range(299, 540))


@pytest.mark.parametrize("burst", [0, 60])
def test_drives_on_separate_buses_do_not_prove_losses_of_each_other(burst: int) -> None:
    """All drives pause for 150 SYNCs, and the host with them: each bus is read in long batches."""
    stream = TpdoStream("samples", 1, (0x181, 0x181, 0x181), 8)
    assembler = Assembler((stream,), ("a", "b", "c"), PERIOD_NS, bus_of=(0, 1, 2))
    parts = []
    for k in range(1000):
        stopped = 400 <= k < 550
        out = [(0x181, i) for i in range(400, 551)] if k == 550 else [(0x181, k)]
        parts.append(frames_of(k, [] if stopped else out))
    for first, last in ((0, 380), (380, 550 + burst), (550 + burst, 1000)):
        for bus in range(3):
            assembler.push(np.concatenate(parts[first:last]), sent=1000, bus=bus)
    assembler.finish(1000)
    assert assembler.counters["samples.rows"] == 1000


def test_frames_missing_on_one_bus_make_no_sample_of_another_ambiguous() -> None:
    """Joint a pauses and answers in a burst shortly after an outage of bus 2."""
    bench = Bench(buses=2)
    stream = TpdoStream("samples", 1, (0x181, 0x182, 0x181, 0x182), 8)
    assembler = Assembler((stream,), bench.joints, PERIOD_NS, bus_of=(0, 0, 1, 1))
    for k in range(600):
        if k in (200, 300):
            assembler.set_bus_down(1, k == 200)
        first = [] if 310 <= k < 330 else [(0x181, 7)] * (21 if k == 330 else 1)
        first += [(0x182, k)]
        assembler.push(frames_of(k, first), sent=k + 1, bus=0)
        assembler.push(frames(0) if 200 <= k < 300 else frames_of(k, answers(k)), sent=k + 1, bus=1)
    assembler.finish(600)
    assert assembler.counters["samples.in_gaps"] == 100


def test_a_foreign_master_delayed_at_its_first_syncs_is_recognised_as_one_master() -> None:
    """The second bus is read after the first has had more SYNCs, with a pause among them."""
    bench = Bench(buses=2, foreign=True)
    held = [T0 + k * PERIOD_NS + (k >= 30) * 9 * PERIOD_NS for k in range(300)]
    for first, last in ((0, 100), (100, 300)):
        for bus in range(2):
            some = np.concatenate([frames_of(k, answers(k), at_ns=held[k]) for k in range(first, last)])
            bench._take(bench.assembler.push(some, bus=bus))
    bench.finish(300)
    assert bench.missing(300) == set()
