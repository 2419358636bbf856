"""Capture in several files, deletion of old files, and write errors."""

import datetime
import fcntl
import logging
import resource
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from armident.configs import ConfigError
from armident.daq.capture.recording_files import capture_stamp, next_time
from armident.daq.recording import (
    Mark,
    QueuedSeries,
    Recording,
    RecordingSeries,
    RecordingWriter,
    StreamLayout,
    read_recording,
    recover_recording,
)
from armident.daq.recording.names import in_order
from armident.daq.recording.retention import RetentionThread, prune
from tests.unit.daq.test_recording import make_recording

NAME = "tx40-20260101T000000-000Z"


def beginner(recording: Recording, chunk_ns: int = 20_000_000) -> Callable[[Path, int], RecordingWriter]:
    joints = [joint.name for joint in recording.robot.joints]
    layouts = [StreamLayout.of(stream, joints) for stream in recording.streams.values()]
    return lambda path, part: RecordingWriter(
        path, recording.robot, recording.session, 5000.0, layouts, {"part": str(part)}, chunk_ns
    )


def write(series: RecordingSeries | QueuedSeries, recording: Recording, step: int = 50) -> list[Path]:
    """Append a recording like a capture, in batches; return the files that were finished meanwhile."""
    finished = []
    samples, demand = recording.streams["samples"], recording.streams["demand"]
    for first in range(0, samples.sync.size, step):
        part = slice(first, first + step)
        finished.append(series.rotate(int(samples.t_ns[part][0])))
        rows = {}
        for stream in (samples, demand):
            here = (stream.sync >= samples.sync[part][0]) & (stream.sync <= samples.sync[part][-1])
            raw = {name: values[here] for name, values in stream.raw.items()}
            rows[stream.name] = stream.sync[here], stream.t_ns[here], raw
        if isinstance(series, QueuedSeries):
            series.append(rows)
        else:
            for name, columns in rows.items():
                series.append(name, *columns)
    return [path for path in finished if path is not None]


@pytest.mark.parametrize(
    "limits", [{"max_bytes": 60_000}, {"max_ns": 50_000_000}, {"max_bytes": 90_000, "max_ns": 10**8}]
)
def test_every_row_is_in_exactly_one_complete_file(tmp_path: Path, limits: dict[str, int]) -> None:
    recording = make_recording(3000)
    with RecordingSeries(beginner(recording), tmp_path, NAME, **limits) as series:
        finished = write(series, recording)
        series.close({"frames": 7})
    assert [p.name for p in series.paths] == [
        f"{NAME}.mcap",
        *(f"{NAME}.{k:04d}.mcap" for k in range(2, len(series.paths) + 1)),
    ]
    assert len(series.paths) > 3
    assert finished == series.paths[:-1]
    assert sorted(tmp_path.iterdir(), key=in_order) == series.paths
    parts = [read_recording(path) for path in series.paths]
    for number, part in enumerate(parts, start=1):
        assert part.missing is None
        assert recover_recording(series.paths[number - 1]).missing is None
        assert part.metadata["part"] == str(number)
    for part in parts[:-1]:
        assert part.counters["samples.rows"] == part.samples.sync.size
    assert parts[-1].counters == {"frames": 7}
    for name, stream in recording.streams.items():
        sync = np.concatenate([part.streams[name].sync for part in parts])
        np.testing.assert_array_equal(sync, stream.sync[stream.sync <= recording.samples.sync[-1]])
        for field, values in stream.raw.items():
            together = np.concatenate([part.streams[name].raw[field] for part in parts])
            np.testing.assert_array_equal(together, values[: sync.size])


def test_without_limits_it_is_one_file_of_the_plain_name(tmp_path: Path) -> None:
    recording = make_recording(300)
    with RecordingSeries(beginner(recording), tmp_path, NAME) as series:
        assert write(series, recording) == []
        series.close({})
    assert [p.name for p in tmp_path.iterdir()] == [f"{NAME}.mcap"]


def test_rows_continue_in_the_old_file_if_no_new_one_can_be_created(tmp_path: Path) -> None:
    recording = make_recording(3000)
    begin = beginner(recording)
    refused: list[Path] = []

    def sometimes(path: Path, part: int) -> RecordingWriter:
        if part == 2 and not refused:
            refused.append(path)
            raise ConfigError(f"{path}: cannot be written: No space left on device")
        return begin(path, part)

    with RecordingSeries(sometimes, tmp_path, NAME, max_bytes=60_000) as series:
        write(series, recording)
        problem = series.problem
        series.close({})
    assert refused
    assert problem is not None
    assert "No space left" in problem
    # 0.6 s are less than the time until the next attempt: all is in the first file.
    (part,) = [read_recording(path) for path in series.paths]
    np.testing.assert_array_equal(part.samples.sync, recording.samples.sync)


def test_a_full_disk_costs_only_the_rows_of_that_time(tmp_path: Path) -> None:
    recording = make_recording(6000)
    mark = Mark("note", 2500, int(recording.samples.t_ns[0]), "said while it was full")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with RecordingSeries(beginner(recording), tmp_path, NAME) as series:
        third = recording.samples.sync.size // 3
        samples = recording.samples
        for k in range(3):
            if k == 1:
                series.flush()
                resource.setrlimit(resource.RLIMIT_FSIZE, (series.path.stat().st_size + 5_000, hard))
                series.add_marks([mark])
            part = slice(k * third, (k + 1) * third)
            for first in range(k * third, (k + 1) * third, 100):
                rows = slice(first, min(first + 100, part.stop))
                values = {name: v[rows] for name, v in samples.raw.items()}
                series.append("samples", samples.sync[rows], samples.t_ns[rows], values)
            series.flush()
            if k == 1:
                resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        series.close({"writer.rows_lost": series.lost_rows})
    read = read_recording(series.path)
    assert read.missing is None
    assert read.counters["writer.rows_lost"] == series.lost_rows > 0
    assert read.samples.sync.size == 3 * third - series.lost_rows
    kept = np.isin(samples.sync, read.samples.sync)
    assert kept[:third].all()
    assert kept[2 * third : 3 * third].all()
    np.testing.assert_array_equal(read.samples.raw["position"], samples.raw["position"][kept])
    # Missing rows are in the gap list, and the mark added meanwhile is present.
    gaps = [g for g in read.gaps if g.reason == "not written"]
    numbers = samples.sync[: 3 * third]
    covered = np.any([(numbers >= g.first) & (numbers <= g.last) for g in gaps], axis=0)
    np.testing.assert_array_equal(covered, ~kept[: 3 * third])
    assert mark in read.marks


def test_gaps_of_an_unfinished_file_are_recorded_in_the_next_one(tmp_path: Path) -> None:
    recording = make_recording(3000)
    samples, begin = recording.samples, beginner(recording)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with begin(tmp_path / "1.mcap", 1) as full, begin(tmp_path / "2.mcap", 2) as following:
        resource.setrlimit(resource.RLIMIT_FSIZE, (full.path.stat().st_size, hard))
        try:
            full.append("samples", samples.sync[:100], samples.t_ns[:100], {n: v[:100] for n, v in samples.raw.items()})
            with pytest.raises(ConfigError):
                full.close({})
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        following.take_over(full)
        following.close({})
    gaps = read_recording(tmp_path / "2.mcap").gaps
    assert {gap.reason for gap in gaps} == {"not written"}
    assert [k for gap in gaps for k in range(gap.first, gap.last + 1)] == samples.sync[:100].tolist()


def made(directory: Path, stamp: str, name: str = "tx40", suffix: str = ".mcap") -> Path:
    path = directory / f"{name}-{stamp}-000Z{suffix}"
    path.write_bytes(b"x" * 100)
    return path


NOW = datetime.datetime(2026, 11, 20, 12, tzinfo=datetime.UTC)


def test_recordings_are_deleted_by_age(tmp_path: Path) -> None:
    old, damaged = made(tmp_path, "20261001T000000"), made(tmp_path, "20261002T000000", suffix=".0003.mcap.damaged")
    young = made(tmp_path, "20261119T000000")
    others = [
        made(tmp_path, "20200101T000000", "tx40-left"),
        made(tmp_path, "20200101T000000", suffix=".identification"),
        tmp_path / "tx40-notes.mcap",
    ]
    others[-1].write_bytes(b"by hand")
    assert prune(tmp_path, "tx40", NOW, 30.0, None) == [old, damaged]
    assert sorted(tmp_path.iterdir()) == sorted([young, *others])


def test_the_oldest_recordings_are_deleted_until_there_is_enough_space(tmp_path: Path) -> None:
    paths = [made(tmp_path, f"202611{day:02d}T000000") for day in range(1, 9)]

    def free(_: Path) -> int:
        return 1000 - 100 * sum(path.exists() for path in paths)

    assert prune(tmp_path, "tx40", NOW, None, 500, free) == paths[:3]
    assert prune(tmp_path, "tx40", NOW, None, 500, free) == []


def test_a_clock_that_is_ahead_deletes_nothing_younger_than_the_newest_recording_allows(tmp_path: Path) -> None:
    old = made(tmp_path, "20261001T000000")
    kept = [made(tmp_path, "20261102T000000"), made(tmp_path, "20261115T000000")]
    ahead = made(tmp_path, "20990101T000000")
    with ahead.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert prune(tmp_path, "tx40", NOW.replace(year=2099), 30.0, None) == [old]
    assert all(path.exists() for path in kept)
    # The clock is right again: the recording of the future does not count.
    assert prune(tmp_path, "tx40", NOW, 30.0, None) == []


def test_finished_recordings_of_a_clock_far_ahead_delete_nothing_until_they_are_old_themselves(tmp_path: Path) -> None:
    before = [made(tmp_path, "20261110T000000"), made(tmp_path, "20261115T000000")]
    first, second = made(tmp_path, "20990101T000000"), made(tmp_path, "20990125T000000")
    assert prune(tmp_path, "tx40", NOW.replace(year=2099), 30.0, None) == []
    third = made(tmp_path, "20990201T000000")
    # On this clock 31 days have passed: all recordings before it are older.
    assert prune(tmp_path, "tx40", NOW.replace(year=2099), 30.0, None) == [*before, first]
    assert second.exists()
    assert third.exists()


def test_recordings_that_are_written_or_in_the_future_make_no_other_older(tmp_path: Path) -> None:
    """Ages count to the newest finished recording that is not in the future."""
    kept = [made(tmp_path, "20261010T000000"), made(tmp_path, "20261015T000000")]
    written, ahead = made(tmp_path, "20261119T000000"), made(tmp_path, "20261201T000000")
    with written.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert prune(tmp_path, "tx40", NOW, 30.0, None) == []
    assert all(path.exists() for path in (*kept, ahead))
    # Finished, it is the newest: the others are 35 and 40 days old.
    assert prune(tmp_path, "tx40", NOW, 30.0, None) == kept


def test_a_name_that_only_looks_like_a_time_is_of_no_capture(tmp_path: Path) -> None:
    odd = made(tmp_path, "20261399T000000")
    assert next_time(tmp_path, "tx40", NOW) == NOW
    assert prune(tmp_path, "tx40", NOW, 1.0, None) == []
    assert odd.exists()


def test_after_a_step_of_the_clock_back_a_recording_is_named_after_the_newest_one(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert next_time(tmp_path, "tx40", NOW) == NOW
    newest = made(tmp_path, "20261120T130000")
    stamp = capture_stamp(next_time(tmp_path, "tx40", NOW))
    assert stamp == "20261120T130000-001Z"
    assert newest.name < f"tx40-{stamp}.mcap"
    assert "it has stepped back" in caplog.text
    assert next_time(tmp_path, "tx40", NOW.replace(hour=14)) == NOW.replace(hour=14)


def test_a_file_that_is_being_written_is_not_deleted(tmp_path: Path) -> None:
    first, second = made(tmp_path, "20261001T000000"), made(tmp_path, "20261002T000000")
    made(tmp_path, "20261119T000000")
    with first.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert prune(tmp_path, "tx40", NOW, 30.0, None) == [second]
    assert prune(tmp_path, "tx40", NOW, 30.0, None) == [first]


def test_deleted_files_are_logged_and_an_error_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "armident")
    looked = threading.Semaphore(0)
    problem = OSError(5, "Input/output error")
    answers: list[list[Path] | OSError] = [[], problem, problem, [Path("a.mcap")]]

    def look() -> list[Path]:
        looked.release()
        answer = answers.pop() if answers else []
        if isinstance(answer, OSError):
            raise answer
        return answer

    thread = RetentionThread(look, every_s=0.001)
    for _ in range(6):
        assert looked.acquire(timeout=10)
    thread.close()
    assert thread.deleted == 1
    assert [(record.levelname, record.message) for record in caplog.records] == [
        ("INFO", "deleted a.mcap (retention)"),
        ("WARNING", "retention: the folder: Input/output error; old recordings stay, tried again every 0.001 s"),
    ]
