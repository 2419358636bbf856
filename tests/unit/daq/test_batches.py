"""Rows of lagging drives are written in the order of time, and in pieces if they become complete at once."""

from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from armident.configs import load_robot, load_session
from armident.daq.capture.batches import PIECE_NS, FileBoundaries, SamplesFirst, pieces
from armident.daq.capture.publisher import Publisher
from armident.daq.capture.recording_files import open_series
from armident.daq.capture.sink import Sink
from armident.daq.matching.assembler import Assembler, Batch, Rows
from armident.daq.matching.streams import captured_streams
from armident.daq.recording import Gap, read_recording
from armident.daq.recording.names import in_order
from armident.daq.streaming import Keys
from armident.drivers.can.frames import FRAME

PERIOD_NS = 200_000


def batch_of(first: int, count: int, missing: list[int]) -> Batch:
    """Return samples at every SYNC and demand at every tenth, except at SYNCs that are gaps of one joint."""
    sync = np.setdiff1d(np.arange(first, first + count), missing)
    rows = {}
    for name, every in (("samples", 1), ("demand", 10)):
        here = sync[(sync + 1) % every == 0]
        data = here[:, None, None].astype(np.uint8) + np.arange(8, dtype=np.uint8)
        rows[name] = Rows(here, here * PERIOD_NS, np.repeat(data, 2, axis=1))
    gaps = tuple(Gap("samples", k, k, "joint_1") for k in sorted(missing))
    return Batch(rows, gaps, dict.fromkeys(rows, first + count))


@given(
    first=st.integers(0, 10**6),
    count=st.integers(1, 12_000),
    missing=st.sets(st.integers(0, 11_999), max_size=5),
)
def test_pieces_hold_all_rows_and_gaps_once_and_in_order(first: int, count: int, missing: set[int]) -> None:
    whole = batch_of(first, count, [first + k for k in missing if k < count])
    parts = list(pieces(whole))
    for name, rows in whole.rows.items():
        for what in ("sync", "t_ns", "data"):
            got = np.concatenate([getattr(part.rows[name], what) for part in parts])
            assert np.array_equal(got, getattr(rows, what))
    assert tuple(gap for part in parts for gap in part.gaps) == whole.gaps
    for part in parts:
        samples = part.rows["samples"]
        if samples.sync.size:
            assert samples.t_ns[-1] - samples.t_ns[0] < PIECE_NS
            assert all(np.isin(rows.sync // 10, samples.sync // 10).all() for rows in part.rows.values())
    for before, after in pairwise(parts):
        assert all(gap.first < after.rows["samples"].sync[0] for gap in before.gaps)
        begin = whole.rows["samples"].t_ns[0]
        number, following = ((part.rows["samples"].t_ns[0] - begin) // PIECE_NS for part in (before, after))
        assert number < following


def test_gaps_without_rows_are_a_piece_of_their_own() -> None:
    whole = batch_of(0, 3, [0, 1, 2])
    assert list(pieces(whole)) == [whole]


def frames_of_lagging_drives(syncs: int, lagging: str, always: bool) -> Iterator[NDArray[np.void]]:
    """Yield frames of every SYNC and of the time after the last one.

    Six drives answer one stream an interval late, always or in the first two thirds of every 0.6 s.
    """
    answers: dict[int, list[int]] = {}
    for name, first_id, every in (("samples", 0x180, 1), ("demand", 0x280, 5)):
        for k in range(every - 1, syncs, every):
            late = name == lagging and (always or k % 3000 < 2000)
            answers.setdefault(k + late * every, []).extend(first_id + node for node in range(1, 7))
    for k in range(max(answers) + 1):
        ids = ([0x80] if k < syncs else []) + answers.get(k, [])
        frames = np.zeros(len(ids), FRAME)
        frames["can_id"], frames["t_ns"] = ids, k * PERIOD_NS + np.arange(len(ids)) * 1000
        frames["length"] = [1 if can_id == 0x80 else 8 if can_id < 0x280 else 4 for can_id in ids]
        frames["data"][:, 0] = k % 240 + 1
        yield frames


@pytest.mark.slow
@pytest.mark.parametrize(("lagging", "always"), [("samples", True), ("samples", False), ("demand", False)])
def test_streams_of_a_file_have_the_same_times_though_one_of_them_lags(
    tmp_path: Path, lagging: str, always: bool
) -> None:
    """Each file has the demand of its samples, which may be certain only at the end."""
    session = load_session("tx40_cell.yaml").model_copy(update={"cell": "lagging"})
    recording = session.recording.model_copy(update={"rotate_minutes": 0.53 / 60})
    session = session.model_copy(update={"recording": recording})
    robot = load_robot(session.robot)
    streams = captured_streams(session, robot)
    joints = [joint.name for joint in robot.joints]
    assembler = Assembler([stream.bus for stream in streams], joints, PERIOD_NS)
    writer = open_series(session, robot, streams, tmp_path, "lagging", {})
    other = "demand" if lagging == "samples" else "samples"
    other_came_first = False
    with closing(Publisher(session, Keys("lagging", robot.name), exclusive=False)) as publisher:
        sink = Sink(writer, publisher, streams, "lagging")
        frames = list(frames_of_lagging_drives(10_000, lagging, always))
        for k in range(0, len(frames), 130):
            batch = assembler.push(np.concatenate(frames[k : k + 130]), 10_000)
            other_came_first |= batch.certain[other] > batch.certain[lagging] + 1000
            sink.take(batch)
        sink.take(assembler.finish(10_000))
        sink.finish({})
    assert other_came_first
    assert not sink.gaps
    parts = [read_recording(path) for path in sorted(tmp_path.glob("*.mcap"), key=in_order)]
    assert len(parts) in (3, 4)
    for part in parts:
        samples, demand = part.samples.sync, part.streams["demand"].sync
        assert np.array_equal(demand, samples[samples % 5 == 4])
    assert np.array_equal(np.concatenate([part.samples.sync for part in parts]), np.arange(10_000))


def test_a_silent_stream_does_not_stop_the_files() -> None:
    """A file may begin once in four seconds, the time after which a missing answer is lost."""
    boundaries = FileBoundaries()
    allowed = []
    for k in range(0, 100_000, 100):
        samples = Rows(np.array([k]), np.array([k * PERIOD_NS]), np.zeros((1, 2, 8), np.uint8))
        if boundaries.allow(samples, {"samples": k + 100, "demand": max(0, k - 200)}):
            allowed.append(k * PERIOD_NS / 1e9)
    assert allowed == [0.0, 4.02, 8.02, 12.02, 16.02]


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 30)), max_size=8))
def test_rows_held_for_the_samples_come_once_and_in_order(steps: list[tuple[int, int]]) -> None:
    """After each batch, no row or gap of another stream is after the samples; at the end nothing is missing."""
    samples_first = SamplesFirst()
    certain = {"samples": 0, "demand": 0}
    got: list[Batch] = []
    for new in steps:
        rows, gaps = {}, []
        for name, count in zip(certain, new, strict=True):
            sync = np.arange(certain[name], certain[name] + count)
            whole = sync[sync % 7 != 3]
            rows[name] = Rows(whole, whole * PERIOD_NS, np.zeros((whole.size, 2, 8), np.uint8))
            gaps += [Gap(name, k, k) for k in sync[sync % 7 == 3].tolist()]
            certain[name] += count
        got.append(samples_first.take(Batch(rows, tuple(gaps), dict(certain))))
        assert got[-1].rows["samples"].sync.size == rows["samples"].sync.size
        assert (got[-1].rows["demand"].sync < certain["samples"]).all()
        assert all(gap.first < certain["samples"] for gap in got[-1].gaps)
    rest = samples_first.rest()
    assert (rest is None) == (not steps)
    got += [] if rest is None else [rest]
    for name, count in certain.items():
        syncs = [k for batch in got for k in batch.rows[name].sync.tolist()] if got else []
        missing = [gap.first for batch in got for gap in batch.gaps if gap.stream == name]
        assert syncs == [k for k in range(count) if k % 7 != 3]
        assert missing == [k for k in range(count) if k % 7 == 3]
