"""SYNC without a counter (CiA 301, 1019h = 0): numbers by order, and by time where frames were dropped."""

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import SessionConfig, load_session
from armident.daq.capture.jitter import SyncJitter
from armident.daq.matching.assembler import Assembler, TpdoStream
from armident.drivers.can.frames import Frames, frames
from armident.drivers.canopen.bus_load import bus_loads
from armident.drivers.canopen.kernel_sync import setup_message

PERIOD_NS = 1_000_000
T0 = 1_700_000_000_000_000_000
STREAMS = (TpdoStream("samples", 1, (0x181, 0x182), 8), TpdoStream("demand", 5, (0x281, 0x282), 4))
JOINTS = ("joint_1", "joint_2")


def answered(numbers: NDArray[np.integer], late_ns: NDArray[np.integer], counter: bool = False) -> Frames:
    """SYNCs of these numbers and their answers, which hold the number."""
    out = frames(5 * numbers.size)
    out["t_ns"] = np.repeat(T0 + numbers * PERIOD_NS + late_ns, 5)
    out["can_id"] = np.tile([0x80, 0x181, 0x182, 0x281, 0x282], numbers.size)
    out["length"] = np.tile([int(counter), 8, 8, 4, 4], numbers.size)
    out["data"][:, :4] = np.repeat(numbers, 5).astype("<i4").view(np.uint8).reshape(-1, 4)
    if counter:
        out["data"][::5] = 0
        out["data"][::5, 0] = numbers % 7 + 1
    slow = np.isin(out["can_id"], [0x281, 0x282]) & (np.repeat(numbers + 1, 5) % 5 != 0)
    kept: Frames = out[~slow]
    return kept


def assembled(parts: list[Frames], assembler: Assembler, sent: int | None = None) -> dict[str, NDArray[np.int64]]:
    """Numbers of the rows of each stream, which are those that the answers hold."""
    batches = [assembler.push(part, sent, dropped=k > 0) for k, part in enumerate(parts)]
    batches.append(assembler.finish(sent))
    found = {}
    for stream in STREAMS:
        rows = [batch.rows[stream.name] for batch in batches]
        held = np.concatenate([row.data[:, :, :4].copy().view("<i4")[:, :, 0] for row in rows])
        found[stream.name] = np.concatenate([row.sync for row in rows])
        assert np.array_equal(held, np.tile(found[stream.name][:, None], (1, 2)))
    return found


def new_assembler(overflow: int = 0) -> Assembler:
    return Assembler(STREAMS, JOINTS, PERIOD_NS, overflow, 1)


@pytest.mark.parametrize("counter", [False, True])
def test_rows_have_their_numbers(counter: bool) -> None:
    """A counter that the session does not expect is ignored; delays of the producer do not matter."""
    numbers = np.arange(400)
    late = np.random.default_rng(1).integers(0, 20 * PERIOD_NS, 400)
    found = assembled([answered(numbers, np.maximum.accumulate(late), counter)], new_assembler())
    assert np.array_equal(found["samples"], numbers)
    assert np.array_equal(found["demand"], numbers[4::5])


def test_a_counter_may_be_dropped_before_the_first_sync() -> None:
    assembler = new_assembler(240)
    assembler.ignore_counter()
    found = assembled([answered(np.arange(300), np.zeros(300, int))], assembler)
    assert np.array_equal(found["samples"], np.arange(300))


def test_dropped_frames_leave_a_gap_of_their_length_by_time() -> None:
    late = np.random.default_rng(2).integers(0, PERIOD_NS // 4, 400)
    before, after = np.arange(100), np.arange(137, 400)
    parts = [answered(before, late[:100]), answered(after, late[137:])]
    assembler = new_assembler()
    found = assembled(parts, assembler)
    # Rows next to the gap may be lost with it.
    assert set(found["samples"]) <= {*before, *after}
    assert found["samples"].size >= 350
    assert found["samples"][-1] == 399
    assert assembler.counters["sync_missing"] == 37


def test_send_times_number_the_syncs_of_a_delayed_producer_exactly() -> None:
    late = np.maximum.accumulate(np.random.default_rng(3).integers(0, 30 * PERIOD_NS, 400))
    before, after = np.arange(100), np.arange(137, 400)
    parts = [answered(before, late[:100]), answered(after, late[137:])]
    assembler = new_assembler()
    sent = T0 + np.arange(400) * PERIOD_NS + late + 20_000
    assembler.send_times = lambda first: (first, sent[first:])
    found = assembled(parts, assembler, 400)
    assert found["samples"][-1] == 399
    assert assembler.counters["sync_missing"] == 37


def test_jitter_without_a_counter_is_that_of_the_intervals() -> None:
    numbers = np.arange(500)
    jitter = SyncJitter(PERIOD_NS, 0)
    jitter.take(answered(numbers, 5000 * (numbers % 2), counter=True))
    assert jitter.statistics()["p50"] == pytest.approx(5.0, abs=1.0)


def test_the_kernel_sends_one_empty_frame() -> None:
    with_counter, without = setup_message(4000, 3), setup_message(4000, 0)
    frame = (len(with_counter) - len(without)) // 2
    assert without[-frame:] == (0x80).to_bytes(4, "little") + bytes(frame - 4)


def without_counter(session: SessionConfig, **sync: object) -> SessionConfig:
    data = session.model_dump(by_alias=True, mode="python")
    data["sync"] |= {"counter": 0} | sync
    return SessionConfig.model_validate(data)


def test_a_session_without_counter_allows_every_interval_and_loads_the_bus_less() -> None:
    session = load_session("tx40_cell.yaml")
    plain = without_counter(session)
    with pytest.raises(ValueError, match=r"expected 0 .* or 2 to 240"):
        without_counter(session, counter=1)
    update = {"bus": session.bus.model_copy(update={"bitrate": 1_000_000})}
    session, plain = session.model_copy(update=update), plain.model_copy(update=update)
    with_byte, empty = (bus_loads(each, each.bus)[0] for each in (session, plain))
    assert empty.worst < with_byte.worst
