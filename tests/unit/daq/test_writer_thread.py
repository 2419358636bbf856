"""Series written by a thread: no caller waits for the disk, and rows that are left out are counted and become gaps."""

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from armident.configs import ConfigError
from armident.configs.schema.session import RecordingOptions
from armident.daq.capture.health import DiskCheck
from armident.daq.capture.recording_files import chunk_duration_ns
from armident.daq.recording import (
    Gap,
    Mark,
    QueuedSeries,
    RecordingSeries,
    Stream,
    TriggeredSeries,
    join_parts,
    read_recording,
)
from armident.daq.recording import writer_thread as queued
from armident.daq.recording.lost_rows import NOT_WRITTEN
from armident.daq.recording.writer_thread import MOST_WAITING_BYTES
from tests.unit.daq.test_recording import make_recording
from tests.unit.daq.test_rotation import NAME, beginner, write

EVERY = {"samples": 1, "demand": 5}
CHUNK_NS = 20_000_000


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Return an event that is set while the disk works; while it is not set, every write to the disk blocks."""
    works, sync = threading.Event(), os.fdatasync
    works.set()

    def held(descriptor: int) -> None:
        works.wait()
        sync(descriptor)

    monkeypatch.setattr(os, "fdatasync", held)
    yield works
    works.set()


def append(series: QueuedSeries, stream: Stream, first: int, last: int) -> None:
    """Add the rows from SYNC ``first`` to before ``last``."""
    here = (stream.sync >= first) & (stream.sync < last)
    rows = {name: values[here] for name, values in stream.raw.items()}
    series.append({stream.name: (stream.sync[here], stream.t_ns[here], rows)})


def until(true: Callable[[], bool]) -> None:
    """Wait until another thread has made the condition true."""
    deadline = time.monotonic() + 30
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_every_row_is_in_exactly_one_file(tmp_path: Path) -> None:
    recording = make_recording(3000)
    series = QueuedSeries(
        RecordingSeries(beginner(recording, 2 * CHUNK_NS), tmp_path, NAME, max_bytes=60_000), EVERY, CHUNK_NS
    )
    with series:
        write(series, recording)
        series.add_gaps([Gap("samples", 3003, 3003, "joint_1", "no answer")], int(recording.samples.t_ns[-1]))
        series.add_marks([Mark("note", 17, int(recording.samples.t_ns[14]), "here")])
        series.close({"frames": 7})
    assert len(series.paths) > 3
    parts = [read_recording(path) for path in series.paths]
    assert all(part.missing is None for part in parts)
    assert parts[-1].counters == {"frames": 7}
    assert [mark.text for part in parts for mark in part.marks] == ["here"]
    assert [gap.first for part in parts for gap in part.gaps] == [3003]
    whole = join_parts(parts)
    for name, stream in recording.streams.items():
        assert np.array_equal(whole.streams[name].sync, stream.sync)
        for field, values in stream.raw.items():
            assert np.array_equal(whole.streams[name].raw[field], values)


@pytest.mark.slow
def test_a_killed_capture_loses_no_more_than_a_chunk(tmp_path: Path) -> None:
    recording = make_recording(1500)
    series = QueuedSeries(RecordingSeries(beginner(recording, 2 * CHUNK_NS), tmp_path, NAME), EVERY, CHUNK_NS)
    with series:
        for first in range(0, 1500, 10):
            append(series, recording.samples, first, first + 10)
            until(lambda: series.waiting_rows == 0)
            # Content of the file if the process were killed now.
            rows = read_recording(series.paths[0]).samples.t_ns if first > 150 else None
            assert rows is None or recording.samples.t_ns[first] - rows[-1] <= CHUNK_NS + 2_000_000


def test_a_disk_that_writes_nothing_is_reported_long_before_rows_are_lost(
    tmp_path: Path, disk: threading.Event, caplog: pytest.LogCaptureFixture
) -> None:
    recording = make_recording(3000)
    whole = QueuedSeries(RecordingSeries(beginner(recording), tmp_path, NAME), EVERY, CHUNK_NS)
    with whole:
        disk.clear()
        write(whole, recording)
        size = round(whole.waiting_share * MOST_WAITING_BYTES)
        disk.set()
    # Memory for six times these rows: their backlog uses a sixth, half of them a twelfth.
    series = QueuedSeries(RecordingSeries(beginner(recording), tmp_path, "second"), EVERY, CHUNK_NS, 6 * size)
    check = DiskCheck(series)
    with series, caplog.at_level(logging.INFO):
        disk.clear()
        append(series, recording.samples, 0, 1500)
        check.update()
        assert caplog.messages == []
        append(series, recording.samples, 1500, 3000)
        check.update()
        check.update()
        (warning,) = caplog.messages
        assert "% of the memory" in warning
        assert series.lost_rows == 0
        disk.set()
        series.flush()
        check.update()
        assert caplog.messages[1:] == ["the disk keeps up again; 0 rows wait for it"]


def test_a_stalled_disk_costs_no_row(tmp_path: Path, disk: threading.Event) -> None:
    recording = make_recording(3000)
    series = QueuedSeries(RecordingSeries(beginner(recording), tmp_path, NAME), EVERY, CHUNK_NS)
    with series:
        disk.clear()
        begun = time.monotonic()
        write(series, recording)
        # All rows were accepted, although no chunk is on the disk.
        assert 3000 <= series.waiting_rows <= 3600
        assert series.lost_rows == 0
        assert time.monotonic() - begun < 30
        disk.set()
        series.flush()
        assert series.waiting_rows == 0
        series.close({})
    (path,) = series.paths
    assert read_recording(path).samples.sync.tolist() == recording.samples.sync.tolist()


def test_a_backlog_is_written_at_a_limited_rate(tmp_path: Path, disk: threading.Event) -> None:
    """Reading the buses needs processor time, too, when the disk works again."""
    recording = make_recording(1500)
    series = QueuedSeries(RecordingSeries(beginner(recording), tmp_path, NAME), EVERY, CHUNK_NS)
    with series:
        disk.clear()
        # At least the duration at 5 kHz: 0.3 s.
        for first in range(0, 1500, 25):
            append(series, recording.samples, first, first + 25)
            time.sleep(0.005)
        disk.set()
        begun = time.monotonic()
        until(lambda: series.waiting_rows == 0)
        assert time.monotonic() - begun > 0.08
        series.close({})
    (path,) = series.paths
    sync = recording.samples.sync
    assert read_recording(path).samples.sync.tolist() == sync[sync < 1500].tolist()


def test_a_clock_step_does_not_delay_writing(tmp_path: Path, disk: threading.Event) -> None:
    recording = make_recording(1500)
    stream = recording.samples
    stream.t_ns[700:] += 3_600_000_000_000
    series = QueuedSeries(RecordingSeries(beginner(recording), tmp_path, NAME), EVERY, CHUNK_NS)
    with series:
        disk.clear()
        for first in range(0, 1500, 50):
            append(series, stream, first, first + 50)
        disk.set()
        until(lambda: series.waiting_rows == 0)
        series.close({})
    (path,) = series.paths
    assert read_recording(path).samples.sync.tolist() == stream.sync[stream.sync < 1500].tolist()


def test_the_end_writes_the_backlog_without_rate_limit(
    tmp_path: Path, disk: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the write rate of this test, the waiting rows would take hours."""
    monkeypatch.setattr(queued, "CATCH_UP", 1e-7)
    recording = make_recording(3000)
    series = QueuedSeries(RecordingSeries(beginner(recording), tmp_path, NAME), EVERY, CHUNK_NS)
    with series:
        disk.clear()
        write(series, recording)
        disk.set()
        series.close({})
    (path,) = series.paths
    assert read_recording(path).samples.sync.tolist() == recording.samples.sync.tolist()


def test_the_latest_gathering_time_applies(tmp_path: Path) -> None:
    recording = make_recording(1500)
    series = QueuedSeries(RecordingSeries(beginner(recording, 2 * CHUNK_NS), tmp_path, NAME), EVERY, CHUNK_NS)
    sizes = []
    with series:
        for first in range(0, 1500, 10):
            if first == 750:
                series.gather(CHUNK_NS // 4)
            append(series, recording.samples, first, first + 10)
            until(lambda: series.waiting_rows == 0)
            sizes.append(series.paths[0].stat().st_size)
        series.close({})
    # A period is 0.2 ms: ten chunks of 100 rows, then of 25 to 30.
    assert np.count_nonzero(np.diff(sizes[:70])) in (6, 7)
    assert np.count_nonzero(np.diff(sizes[80:])) >= 20
    assert chunk_duration_ns(RecordingOptions(chunk_ms=100, drain_ms=20)) == 50_000_000
    assert chunk_duration_ns(RecordingOptions(chunk_ms=100, drain_ms=100)) == 25_000_000


@pytest.mark.parametrize("limits", [{}, {"max_bytes": 60_000}])
def test_rows_beyond_the_memory_limit_are_counted_and_become_gaps(
    tmp_path: Path, disk: threading.Event, limits: dict[str, int]
) -> None:
    recording = make_recording(3000)
    samples, demand = recording.samples, recording.streams["demand"]
    inner = RecordingSeries(beginner(recording), tmp_path, NAME, **limits)
    series, lost = QueuedSeries(inner, EVERY, CHUNK_NS, most_bytes=50_000), [0]
    with series:
        append(series, samples, 0, 500)
        series.flush()
        disk.clear()
        for first in range(500, 2500, 50):
            append(series, samples, first, first + 50)
            append(series, demand, first, first + 50)
            lost.append(series.lost_rows)
        assert lost[-1] > 1000
        assert series.problem is not None
        assert series.problem.endswith("the disk has stalled")
        disk.set()
        until(lambda: series.waiting_rows == 0)
        for first in range(2500, 3000, 50):
            series.rotate(int(samples.t_ns[first]))
            append(series, samples, first, first + 50)
            lost.append(series.lost_rows)
            until(lambda: series.waiting_rows == 0)
        series.flush()
        lost.append(series.lost_rows)
        series.close({})
    assert lost == sorted(lost)
    parts = [read_recording(path) for path in series.paths]
    assert len(parts) == 1 if not limits else len(parts) > 1
    gaps = [gap for part in parts for gap in part.gaps]
    (missing,) = [gap for gap in gaps if gap.stream == "samples"]
    (fewer,) = [gap for gap in gaps if gap.stream == "demand"]
    assert missing.reason == fewer.reason == NOT_WRITTEN
    assert 500 < missing.first < missing.last < 2500
    assert lost[-1] == missing.last - missing.first + 1 + (fewer.last - fewer.first) // 5 + 1
    left_out = np.arange(missing.first, missing.last + 1)
    assert np.isin(left_out, samples.sync).all()
    kept = np.concatenate([part.samples.sync for part in parts])
    assert np.array_equal(np.sort(np.concatenate([kept, left_out])), samples.sync[samples.sync < 3000])


def test_an_event_lists_the_gaps_of_its_last_seconds(tmp_path: Path, disk: threading.Event) -> None:
    recording = make_recording(3000)
    inner = TriggeredSeries(
        lambda number: RecordingSeries(beginner(recording), tmp_path, f"event{number}"), 10**9, 10**8
    )
    series = QueuedSeries(inner, EVERY, CHUNK_NS, most_bytes=50_000)
    with series:
        append(series, recording.samples, 0, 200)
        series.trigger(int(recording.samples.t_ns[199]))
        series.flush()
        disk.clear()
        # The end of the first event waits for the disk, and all later work waits for it.
        for first in range(200, 2500, 50):
            series.rotate(int(recording.samples.t_ns[first]))
            append(series, recording.samples, first, first + 50)
        assert series.lost_rows > 0
        disk.set()
        until(lambda: series.waiting_rows == 0)
        series.rotate(int(recording.samples.t_ns[2500]))
        append(series, recording.samples, 2500, 3000)
        series.trigger(int(recording.samples.t_ns[2999]))
        series.flush()
        lost = series.lost_rows
        series.close({})
    parts = [read_recording(path) for path in series.paths]
    gaps = {gap for part in parts for gap in part.gaps}
    assert {gap.reason for gap in gaps} == {NOT_WRITTEN}
    assert sum(gap.last - gap.first + 1 for gap in gaps) == lost
    left_out = np.concatenate([np.arange(gap.first, gap.last + 1) for gap in sorted(gaps, key=lambda g: g.first)])
    written = recording.samples.sync[recording.samples.sync < 3000]
    kept = np.unique(np.concatenate([part.samples.sync for part in parts]))
    assert np.array_equal(np.sort(np.concatenate([kept, left_out])), written)


def test_gaps_and_marks_are_kept_beyond_the_memory_limit_of_rows(tmp_path: Path, disk: threading.Event) -> None:
    recording = make_recording(1000)
    gap = Gap("samples", 1000, 1007, "joint_1", "no answer")
    series = QueuedSeries(RecordingSeries(beginner(recording), tmp_path, NAME), EVERY, CHUNK_NS, most_bytes=10_000)
    with series:
        disk.clear()
        for first in range(0, 1000, 50):
            append(series, recording.samples, first, first + 50)
        series.add_gaps([gap], int(recording.samples.t_ns[-1]))
        disk.set()
        series.flush()
        series.close({})
    assert gap in read_recording(series.paths[0]).gaps


def test_an_error_in_the_thread_is_raised_in_append(tmp_path: Path) -> None:
    recording = make_recording(100)
    with QueuedSeries(RecordingSeries(beginner(recording), tmp_path, NAME), {"samples": 1}, CHUNK_NS) as series:
        series.append({"another": (np.arange(3), np.arange(3), {})})
        with pytest.raises(KeyError, match="another"):
            series.flush()
        with pytest.raises(KeyError, match="another"):
            append(series, recording.samples, 0, 50)


def test_a_write_error_at_the_end_is_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = make_recording(100)
    with QueuedSeries(RecordingSeries(beginner(recording), tmp_path, NAME), EVERY, CHUNK_NS) as series:
        append(series, recording.samples, 0, 50)

        def refuse(descriptor: int) -> None:
            raise OSError(5, "Input/output error")

        monkeypatch.setattr(os, "fsync", refuse)
        with pytest.raises(ConfigError, match="could not be finished: Input/output error"):
            series.close({})


def test_a_capture_that_did_not_begin_leaves_no_file(tmp_path: Path) -> None:
    QueuedSeries(RecordingSeries(beginner(make_recording(100)), tmp_path, NAME), EVERY, CHUNK_NS).abort()
    assert list(tmp_path.iterdir()) == []
