"""Several buses and packed samples: every SYNC is accounted for, and samples belong to their SYNC and axis."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from armident.configs import DataError
from armident.daq.matching.assembler import INCOMPLETE_PACK, SYNC_LOST, Assembler, Batch, TpdoStream
from armident.daq.matching.gaps import REASONS
from armident.daq.matching.state import AMBIGUOUS
from armident.daq.recording import Gap
from armident.drivers.can.frames import FD_FRAME

JOINTS = ("joint_1", "joint_2", "joint_3", "joint_4")
BUS_OF = (0, 0, 1, 2)
COBS = (0x181, 0x182, 0x181, 0x181)
"""Nodes of different buses may have the same number."""
PERIOD_NS = 20_000_000
T0 = 1_700_000_000_000_000_000
SKEW_NS = (0, 40_000, 90_000)
COUNT = 240
PACKED = TpdoStream("samples", 1, COBS, 64, pack=10, size=6)
PLAIN = TpdoStream("samples", 1, COBS, 8)
DEMAND = TpdoStream("demand", 5, tuple(c + 0x100 for c in COBS), 4)


@dataclass
class Faults:
    """Lost TPDOs (SYNC at which they are sent, joint), lost SYNCs (number, bus), and a bus that is off for a while."""

    tpdo: set[tuple[int, int]] = field(default_factory=set)
    sync: set[tuple[int, int]] = field(default_factory=set)
    off: tuple[int, int, int] | None = None


def sample(k: int, joint: int) -> bytes:
    """Six bytes that encode SYNC and joint."""
    return k.to_bytes(4, "little", signed=True) + bytes([joint, 0xA5])


def bus_frames(bus: int, streams: tuple[TpdoStream, ...], faults: Faults, origin: int = 1) -> NDArray[np.void]:
    """Frames of one bus in ``COUNT`` SYNCs."""
    out = np.zeros(COUNT * 16, FD_FRAME)
    n = 0

    def put(t_ns: int, can_id: int, data: bytes) -> None:
        nonlocal n
        out[n]["t_ns"], out[n]["can_id"], out[n]["length"] = t_ns, can_id, len(data)
        out[n]["data"][: len(data)] = np.frombuffer(data, np.uint8)
        n += 1

    for k in range(COUNT):
        if faults.off is not None and faults.off[0] == bus and faults.off[1] <= k < faults.off[2]:
            continue
        t = T0 + k * PERIOD_NS + SKEW_NS[bus]
        counter = (origin - 1 + k) % 240 + 1
        if (k, bus) not in faults.sync:
            put(t, 0x80, bytes([counter]))
        for stream in streams:
            if counter % stream.shape.every:
                continue
            for j in (j for j in range(len(JOINTS)) if BUS_OF[j] == bus and (k, j) not in faults.tpdo):
                if stream.pack > 1:
                    data = b"".join(sample(i, j) for i in range(k - stream.pack + 1, k + 1))
                else:
                    data = sample(k, j)
                put(t + 1000 + j, stream.cob_ids[j], data[: stream.length].ljust(stream.length, b"\0"))
    return out[:n]


def in_turn(per_bus: list[NDArray[np.void]], cuts: Iterable[int] = ()) -> Iterator[tuple[int, NDArray[np.void]]]:
    """Frames of one bus after the other, as a capture drains them; some two seconds at most in a piece."""
    for first, last in pairwise(sorted({0, 100, 200, COUNT, *cuts})):
        for b, frames in enumerate(per_bus):
            number = (frames["t_ns"] - T0) // PERIOD_NS
            yield b, frames[(number >= first) & (number < last)]


def run(
    streams: tuple[TpdoStream, ...], faults: Faults, cuts: list[int], origin: int | None = None
) -> tuple[dict[str, NDArray[np.int64]], dict[str, NDArray[np.uint8]], list[Gap], dict[str, int]]:
    """Rows, data, gaps and counters; the buses are read in turn, in pieces."""
    assembler = Assembler(streams, JOINTS, PERIOD_NS, first_counter=1 if origin is None else None, bus_of=BUS_OF)
    batches: list[Batch] = []
    per_bus = [bus_frames(b, streams, faults, origin or 1) for b in range(3)]
    batches += [assembler.push(frames, bus=b) for b, frames in in_turn(per_bus, cuts)]
    batches.append(assembler.finish(COUNT))
    sync = {s.name: np.concatenate([b.rows[s.name].sync for b in batches]) for s in streams}
    data = {s.name: np.concatenate([b.rows[s.name].data for b in batches]) for s in streams}
    gaps = [g for b in batches for g in b.gaps]
    return sync, data, gaps, assembler.counters


def in_gaps(gaps: list[Gap], stream: TpdoStream) -> set[int]:
    """SYNC numbers of the stream's gaps."""
    return {k for g in gaps if g.stream == stream.name for k in range(g.first, g.last + 1, stream.every)}


faults = st.builds(
    Faults,
    tpdo=st.sets(st.tuples(st.integers(0, COUNT - 1), st.integers(0, 3)), max_size=12),
    sync=st.sets(st.tuples(st.integers(0, COUNT - 1), st.integers(0, 2)), max_size=8),
    off=st.none() | st.tuples(st.integers(0, 2), st.integers(0, COUNT), st.integers(0, COUNT)),
)
cuts = st.lists(st.integers(0, COUNT), max_size=5)
kinds = st.sampled_from([(PLAIN,), (PLAIN, DEMAND), (PACKED,), (PACKED, DEMAND)])


@pytest.mark.slow
@given(kinds, faults, cuts)
def test_every_sync_of_every_bus_is_received_or_in_a_gap(
    streams: tuple[TpdoStream, ...], faults: Faults, cuts: list[int]
) -> None:
    sync, data, gaps, counters = run(streams, faults, cuts)
    for stream in streams:
        due = set(range(stream.every - 1, COUNT, stream.every))
        received, missing = set(sync[stream.name].tolist()), in_gaps(gaps, stream)
        assert received | missing == due
        assert not received & missing
        assert counters[f"{stream.name}.expected"] == len(due)
        assert counters[f"{stream.name}.rows"] == len(received)
        assert counters[f"{stream.name}.in_gaps"] == len(missing)
        assert np.all(np.diff(sync[stream.name]) > 0)
    expected = [[list(sample(int(k), j)) for j in range(4)] for k in sync["samples"]]
    assert np.array_equal(data["samples"][:, :, :6], np.array(expected, np.uint8).reshape(-1, 4, 6))


@pytest.mark.slow
@example((PLAIN,), Faults(tpdo={(0, 1), (0, 2), (0, 0)}, sync={(18, 1)}), [17])
@example((PLAIN,), Faults(tpdo={(0, 1), (92, 2), (0, 0)}, sync={(102, 1)}), [101])
@given(kinds, faults, cuts)
def test_the_order_in_which_buses_are_read_only_changes_which_answers_are_ambiguous(
    streams: tuple[TpdoStream, ...], faults: Faults, cuts: list[int]
) -> None:
    """Drives of several buses are compared as far as their buses have been read; no value differs."""
    one, many = run(streams, faults, []), run(streams, faults, cuts)
    for stream in streams:
        rows, others = ({int(k): i for i, k in enumerate(found[0][stream.name])} for found in (one, many))
        common = sorted(set(rows) & set(others))
        left, right = (found[1][stream.name][[at[k] for k in common]] for found, at in ((one, rows), (many, others)))
        assert np.array_equal(left, right)
        for found, missing in ((one, set(others) - set(rows)), (many, set(rows) - set(others))):
            reasons = {k: g.reason for g in found[2] if g.stream == stream.name for k in range(g.first, g.last + 1)}
            assert {reasons[k] for k in missing} <= {REASONS[AMBIGUOUS], INCOMPLETE_PACK}


@pytest.mark.parametrize("origin", [1, 57, 240])
@pytest.mark.parametrize("streams", [(PLAIN, DEMAND), (PACKED,)])
def test_buses_of_another_master_are_aligned_by_counter_and_time(streams: tuple[TpdoStream, ...], origin: int) -> None:
    """Listening begins in the middle, on each bus at another SYNC."""
    assembler = Assembler(streams, JOINTS, PERIOD_NS, first_counter=None, bus_of=BUS_OF)
    batches: list[Batch] = []
    order = [1, 0, 2]
    heard = []
    for begin, bus in ((20, 1), (14, 0), (33, 2)):
        frames = bus_frames(bus, streams, Faults(), origin)
        heard.append(frames[(frames["t_ns"] - T0) // PERIOD_NS >= begin])
    batches += [assembler.push(frames, bus=order[b]) for b, frames in in_turn(heard)]
    batches.append(assembler.finish())
    sync = np.concatenate([b.rows["samples"].sync for b in batches])
    data = np.concatenate([b.rows["samples"].data for b in batches])
    # SYNC 20 came first and is number 0; the bus that was listened to last begins at 33.
    first = sync[0]
    assert 13 <= first <= 13 + streams[0].pack
    expected = [[list(sample(int(k) + 20, j)) for j in range(4)] for k in sync]
    assert np.array_equal(data[:, :, :6], np.array(expected, np.uint8))
    missing = in_gaps([g for b in batches for g in b.gaps], streams[0])
    assert set(sync.tolist()) | missing == set(range(COUNT - 20))


def test_masters_with_different_counters_are_refused() -> None:
    assembler = Assembler((PLAIN,), JOINTS, PERIOD_NS, first_counter=None, bus_of=BUS_OF)
    assembler.push(bus_frames(0, (PLAIN,), Faults(), 1)[:300], bus=0)
    with pytest.raises(DataError, match="SYNC counter"):
        assembler.push(bus_frames(1, (PLAIN,), Faults(), 100), bus=1)


def test_one_lost_packed_tpdo_is_one_gap_of_as_many_samples() -> None:
    sync, _, gaps, _ = run((PACKED,), Faults(tpdo={(99, 2)}), [])
    assert gaps == [Gap("samples", 90, 99, "joint_3", "lost")]
    assert sync["samples"].size == COUNT - 10


def test_a_bus_outage_is_a_gap_of_its_axes_only() -> None:
    """The bus is known to be down: the others continue at once, and it loses no sample afterwards."""
    assembler = Assembler((PLAIN,), JOINTS, PERIOD_NS, bus_of=BUS_OF)
    off = Faults(off=(1, 100, 180))
    per_bus = [bus_frames(b, (PLAIN,), off) for b in range(3)]
    gaps: list[Gap] = []
    rows = 0
    for k in range(COUNT):
        if k in (100, 180):
            assembler.set_bus_down(1, k == 100)
        for b, frames in enumerate(per_bus):
            now = assembler.push(frames[(frames["t_ns"] - T0) // PERIOD_NS == k], sent=k + 1, bus=b)
            gaps += now.gaps
            rows += now.rows["samples"].sync.size
        if k == 179:
            assert rows == 100
            assert assembler.counters["samples.in_gaps"] >= 78
    gaps += assembler.finish(COUNT).gaps
    assert gaps == [Gap("samples", 100, 179, "joint_3", SYNC_LOST)]
    assert assembler.counters["samples.rows"] == COUNT - 80


def test_samples_after_the_last_packed_tpdo_are_accounted_for() -> None:
    assembler = Assembler((PACKED,), JOINTS, PERIOD_NS, bus_of=BUS_OF)
    gaps: list[Gap] = []
    for b, frames in in_turn([bus_frames(b, (PACKED,), Faults()) for b in range(3)]):
        gaps += assembler.push(frames[(frames["t_ns"] - T0) // PERIOD_NS < 237], bus=b).gaps
    gaps += assembler.finish().gaps
    assert gaps == [Gap("samples", 230, 236, None, INCOMPLETE_PACK)]
    assert assembler.counters["samples.expected"] == 237


def test_late_answers_are_counted() -> None:
    frames = bus_frames(0, (PLAIN,), Faults())
    answers = np.flatnonzero(frames["can_id"] != 0x80)
    # The answers to SYNC 50 come after SYNC 51.
    late = [i for i in answers if (frames["t_ns"][i] - T0) // PERIOD_NS == 50]
    order = np.r_[0 : late[0], late[-1] + 1, late, late[-1] + 2 : frames.size]
    assembler = Assembler((TpdoStream("samples", 1, COBS[:2], 8),), JOINTS[:2], PERIOD_NS)
    assembler.push(frames[order])
    assert assembler.finish(COUNT).gaps == ()
    assert assembler.counters["tpdo_late"] == 2


def test_frames_delayed_while_their_bus_counted_as_down_add_no_counter_turn() -> None:
    """The bus is up before this is known: its frames are older than the SYNCs of the others, and are discarded."""
    assembler = Assembler((PLAIN,), JOINTS, PERIOD_NS, bus_of=BUS_OF)
    per_bus = [bus_frames(b, (PLAIN,), Faults()) for b in range(3)]
    batches: list[Batch] = []
    number = [(frames["t_ns"] - T0) // PERIOD_NS for frames in per_bus]
    for first, last in ((0, 50), (50, 180), (180, COUNT)):
        if first == 50:
            assembler.set_bus_down(1, True)
        for b in (0, 2, 1):
            batches.append(assembler.push(per_bus[b][(number[b] >= first) & (number[b] < last)], sent=last, bus=b))
        assembler.set_bus_down(1, False)
    batches.append(assembler.finish(COUNT))
    gaps = [g for b in batches for g in b.gaps]
    assert gaps == [Gap("samples", 50, 179, "joint_3", SYNC_LOST)]
    assert assembler.counters["samples.expected"] == COUNT
