"""Ambiguous samples are discarded: answers next to lost ones, repeated frames, TPDOs with a changed mapping."""

import numpy as np
from numpy.typing import NDArray

from armident.daq.matching.assembler import Assembler, Batch, TpdoStream
from armident.drivers.can.frames import frames

PERIOD = 1_000_000
T0 = 1_700_000_000_000_000_000
STREAMS = (TpdoStream("samples", 1, (0x181, 0x182), 8),)


def assembled(
    events: list[tuple[int, int, bytes]], sent: int
) -> tuple[Assembler, NDArray[np.int64], NDArray[np.int64]]:
    """Match frames (time in us, identifier, data); return assembler, SYNC numbers and joint 1's values at these."""
    assembler = Assembler(STREAMS, ("a", "b"), PERIOD, nodes=(1, 2))
    batch = frames(len(events))
    for i, (t_us, can_id, data) in enumerate(events):
        batch["t_ns"][i], batch["can_id"][i], batch["length"][i] = T0 + 1000 * t_us, can_id, len(data)
        batch["data"][i, : len(data)] = np.frombuffer(data, np.uint8)
    batches: list[Batch] = [assembler.push(batch), assembler.finish(sent)]
    sync = np.concatenate([b.rows["samples"].sync for b in batches])
    taken = np.concatenate([b.rows["samples"].data for b in batches])
    return assembler, sync, taken[:, 0].copy().view("<i8")[:, 0]


def bus(count: int, first: dict[int, list[tuple[int, int]]]) -> list[tuple[int, int, bytes]]:
    """Return SYNCs and prompt answers; ``first``: times (us after SYNC) and values of joint 1's frames at a SYNC."""
    events = []
    for k in range(count):
        events.append((1000 * k, 0x80, bytes([k % 240 + 1])))
        events += [(1000 * k + at, 0x181, value.to_bytes(8, "little")) for at, value in first.get(k, [(50, k)])]
        events.append((1000 * k + 100, 0x182, k.to_bytes(8, "little")))
    return events


def test_an_answer_repeated_behind_the_next_sync_is_not_matched_to_it() -> None:
    assembler, sync, value = assembled(bus(50, {20: [(10, 19), (50, 20)]}), 50)
    assert np.array_equal(value, sync)
    assert set(range(50)) - set(sync.tolist()) == {20}
    assert assembler.counters["tpdo_duplicate"] == 1


def test_a_repeated_frame_is_dropped_if_its_bytes_identify_it() -> None:
    _, sync, value = assembled(bus(50, {20: [(50, 20), (60, 20)]}), 50)
    assert np.array_equal(value, sync)
    assert sync.size == 50


def test_a_repeated_late_answer_is_not_matched_to_the_next_sync() -> None:
    """The next answer, which is late too, is not matched to the SYNC after it."""
    _, sync, value = assembled(bus(60, {30: [], 31: [(40, 30), (50, 30)], 32: [(40, 31), (50, 32)]}), 60)
    assert np.array_equal(value, sync)
    assert sync.size == 60


def test_late_answers_with_equal_bytes_are_not_dropped_as_repetitions() -> None:
    """At standstill all answers have the same bytes, repeated or not."""
    late = {k: [] if k % 4 else [(10 * i, 7) for i in range(4)] for k in range(17, 37)}
    rest = {k: [(50, 7)] for k in range(60)}
    assembler, sync, value = assembled(bus(60, rest | late), 60)
    assert np.array_equal(sync, np.arange(60))
    assert set(value.tolist()) == {7}
    assert assembler.counters["tpdo_duplicate"] == 0


def test_a_late_answer_before_a_lost_one_is_discarded_if_the_drive_lagged_before() -> None:
    """Answer 10 is late and arrives with 11, so late answers are known to occur. Then 30 is late and 31 is lost."""
    late = {10: [], 11: [(40, 10), (50, 11)], 30: [], 31: [(50, 30)]}
    _, sync, value = assembled(bus(60, late), 60)
    assert np.array_equal(value, sync)
    assert {30, 31} == set(range(60)) - set(sync.tolist())


def test_late_answers_before_a_silence_are_not_matched_as_prompt_ones() -> None:
    """From 40 on each answer follows the next SYNC, two of them in pairs, and the last two are lost."""
    late = {40: [], 41: [(50, 40)], 42: [(50, 41)], 43: [(50, 42), (60, 43)], 44: [], 45: [(50, 44)], 46: [(50, 45)]}
    late |= {47: [], 48: [(40, 46), (50, 47)], 49: [(50, 48)], 50: [(50, 49)], 51: [(50, 50)]}
    _, sync, value = assembled(bus(53, late | {52: []}), 53)
    assert np.array_equal(value, sync)
    assert set(range(40)) <= set(sync.tolist())


def test_prompt_answers_before_a_silence_are_kept() -> None:
    """The last two answers are lost; no answer before was late."""
    _, sync, value = assembled(bus(53, {51: [], 52: []}), 53)
    assert np.array_equal(value, sync)
    assert np.array_equal(sync, np.arange(51))


def test_a_repeated_frame_does_not_shift_the_answers_before_it() -> None:
    """Answer 30 is lost, 45 is repeated: as many frames as SYNCs, like two late answers."""
    _, sync, value = assembled(bus(60, {30: [], 31: [], 45: [(50, 45), (60, 45)]}), 60)
    assert np.array_equal(value, sync)
    assert set(range(30)) | set(range(46, 60)) <= set(sync.tolist())


def test_tpdos_are_unverified_from_a_write_to_their_mapping_on() -> None:
    def write(index: int) -> bytes:
        return bytes([0x23]) + index.to_bytes(2, "little") + bytes(5)

    events = [*bus(60, {}), (19_500, 0x601, bytes([0x40, 0, 0x1A, 0, 0, 0, 0, 0])), (9_500, 0x601, write(0x6040))]
    events.append((29_500, 0x601, write(0x1A00)))
    assembler, sync, value = assembled(sorted(events, key=lambda e: e[0]), 60)
    assert np.array_equal(sync, np.arange(30))
    assert np.array_equal(value, sync)
    assert assembler.counters["frames_unknown"] == 0


def test_a_write_before_the_mapping_was_verified_is_no_change() -> None:
    assembler = Assembler(STREAMS, ("a", "b"), PERIOD, nodes=(1, 2))
    assembler.mark_unverified("a", T0 + 5_000_000, T0 + 5_000_000)
    batch = frames(1)
    batch["t_ns"], batch["can_id"], batch["length"] = T0, 0x601, 8
    batch["data"][0, :3] = [0x23, 0x00, 0x1A]
    assembler.push(batch)
    rows = frames(9)
    rows["t_ns"] = T0 + 6_000_000 + np.arange(9) // 3 * PERIOD
    rows["can_id"], rows["length"] = [0x80, 0x181, 0x182] * 3, [1, 8, 8] * 3
    rows["data"][::3, 0] = [1, 2, 3]
    assembler.push(rows)
    assembler.finish(3)
    assert assembler.counters["samples.rows"] == 3


def test_a_master_delayed_by_half_a_counter_turn_has_sent_no_sync_meanwhile() -> None:
    assembler = Assembler(STREAMS, ("a", "b"), PERIOD)
    batch = frames(40)
    k = np.arange(40)
    batch["can_id"], batch["length"] = 0x80, 1
    batch["data"][:, 0] = k % 240 + 1
    batch["t_ns"] = T0 + k * PERIOD + np.where(k >= 20, 170, 0) * PERIOD
    assembler.push(batch)
    assert assembler.last_sync == 39
    batch["data"][:, 0] = (k + 40 + 240) % 240 + 1
    batch["t_ns"] = T0 + (k + 40 + 240 + 170) * PERIOD
    assembler.push(batch)
    assert assembler.last_sync == 39 + 240 + 40
