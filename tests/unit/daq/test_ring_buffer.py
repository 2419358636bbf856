"""Series on triggers: only the rows around an event are written, and all of them."""

from pathlib import Path

import numpy as np
import pytest

from armident.configs import ConfigError, DataError
from armident.daq.recording import (
    Gap,
    Mark,
    Recording,
    RecordingSeries,
    RecordingWriter,
    TriggeredSeries,
    join_parts,
    read_recording,
)
from tests.unit.daq.test_recording import make_recording
from tests.unit.daq.test_rotation import beginner

BEFORE_NS, AFTER_NS = 100_000_000, 60_000_000


def triggered(recording: Recording, folder: Path, **limits: int) -> TriggeredSeries:
    begin = beginner(recording)
    return TriggeredSeries(
        lambda number: RecordingSeries(begin, folder, f"event{number}", **limits), BEFORE_NS, AFTER_NS
    )


def feed(
    series: TriggeredSeries, recording: Recording, triggers: list[int], step: int = 25, span: tuple[int, int] = (0, -1)
) -> None:
    """Append a recording, or a span of its rows, in batches of SYNCs, with triggers at these SYNC numbers."""
    samples = recording.samples
    for first in range(span[0], samples.sync.size if span[1] < 0 else span[1], step):
        part = slice(first, first + step)
        series.rotate(int(samples.t_ns[part][0]))
        rows = {name: values[part] for name, values in samples.raw.items()}
        series.append("samples", samples.sync[part], samples.t_ns[part], rows)
        for number in triggers:
            if samples.sync[part][0] <= number <= samples.sync[part][-1]:
                at = int(samples.t_ns[part][-1])
                series.add_gaps([Gap("samples", number, number, "joint_1")], at)
                series.add_marks([Mark("emcy", number, at, "hot")])
                series.trigger(at)


def spans(series: TriggeredSeries) -> list[tuple[int, int]]:
    found = []
    for path in series.paths:
        part = read_recording(path)
        assert part.missing is None
        assert np.all(np.diff(part.samples.sync) == 1) or part.samples.sync[0] < 10
        found.append((int(part.samples.sync[0]), int(part.samples.sync[-1])))
    return found


def test_an_event_is_written_with_the_rows_before_and_after_it(tmp_path: Path) -> None:
    recording = make_recording(6000)
    series = triggered(recording, tmp_path)
    feed(series, recording, [2000, 4000])
    series.close({})
    assert [p.name for p in series.paths] == ["event1.mcap", "event2.mcap"]
    # 0.1 s before are 500 SYNCs, 0.06 s after 300, each up to a batch of 25 more.
    for (first, last), at in zip(spans(series), (2000, 4000), strict=True):
        assert at - 500 - 50 <= first <= at - 500 + 25
        assert at + 300 <= last <= at + 300 + 50
    for path, at in zip(series.paths, (2000, 4000), strict=True):
        read = read_recording(path)
        assert [(g.first, m.sync) for g, m in zip(read.gaps, read.marks, strict=True)] == [(at, at)]
        kept = np.isin(recording.samples.sync, read.samples.sync)
        np.testing.assert_array_equal(read.samples.raw["position"], recording.samples.raw["position"][kept])


def test_the_time_around_events_can_change_during_a_capture(tmp_path: Path) -> None:
    recording = make_recording(6000)
    series = triggered(recording, tmp_path)
    feed(series, recording, [1000], span=(0, 2000))
    series.keep(2 * BEFORE_NS, AFTER_NS // 2)
    feed(series, recording, [5000], span=(2000, -1))
    series.close({})
    (early, after), (late, short) = spans(series)
    assert 450 <= early <= 525
    assert 1300 <= after <= 1350
    assert 3950 <= late <= 4025
    assert 5150 <= short <= 5200


def test_a_trigger_during_an_event_prolongs_it(tmp_path: Path) -> None:
    recording = make_recording(4000)
    series = triggered(recording, tmp_path)
    feed(series, recording, [2000, 2200, 2400])
    series.close({})
    ((first, last),) = spans(series)
    assert first <= 1525
    assert 2700 <= last <= 2750


def test_without_a_trigger_nothing_is_written_and_memory_is_bounded(tmp_path: Path) -> None:
    recording = make_recording(6000)
    series = triggered(recording, tmp_path)
    feed(series, recording, [])
    assert len(series._kept) <= 500 / 25 + 2
    series.close({})
    assert series.paths == []
    assert series.path is None
    assert list(tmp_path.iterdir()) == []


def test_an_event_goes_on_in_further_files(tmp_path: Path) -> None:
    recording = make_recording(4000)
    series = triggered(recording, tmp_path, max_ns=30_000_000)
    feed(series, recording, [2000])
    series.close({})
    assert len(series.paths) > 1
    whole = join_parts([read_recording(path) for path in series.paths])
    assert np.all(np.diff(whole.samples.sync) == 1)
    assert whole.samples.sync[-1] >= 2300
    with pytest.raises(DataError, match="does not continue the file before"):
        join_parts([read_recording(path) for path in reversed(series.paths)])


def test_a_write_error_is_reported_and_writing_is_retried(tmp_path: Path) -> None:
    recording = make_recording(6000)
    begin = beginner(recording)
    tried: list[int] = []

    def refusing(number: int) -> RecordingSeries:
        tried.append(number)
        if len(tried) == 1:
            raise ConfigError("no space")

        def part(path: Path, k: int) -> RecordingWriter:
            return begin(path, k)

        return RecordingSeries(part, tmp_path, f"event{number}")

    series = TriggeredSeries(refusing, BEFORE_NS, 10**12)
    feed(series, recording, [1000])
    assert series.problem == "no space"
    series.rotate(int(recording.samples.t_ns[-1]) + 11_000_000_000)
    assert tried == [1, 1]
    series.close({})
    # The file has the last rows; older ones had left the ring buffer.
    ((first, last),) = spans(series)
    assert last == recording.samples.sync[-1]
    assert first >= last - 600
