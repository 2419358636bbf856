"""A stretch of a recording: the rows of the whole one, of a file that is whole, truncated or rewritten."""

from pathlib import Path

import numpy as np
import pytest

from armident.configs import DataError
from armident.daq.recording import Recording, read_recording
from armident.daq.recording.objects import ObjectUrl, located
from armident.daq.recording.stretch import chunk_table, window
from tests.unit.daq.test_recording import T0, make_recording, write_chunked
from tests.unit.daq.test_rewritten import rewritten

RATE_HZ = 5000.0
STRETCH = (0.06, 0.09)
"""Begin and end, s: SYNC 300 to 450 of the recording; an experiment is marked from 10 to 400."""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 0.6 s in thirty chunks, with gaps and marks in the last one, as they are found late."""
    path = tmp_path_factory.mktemp("stretch") / "r.mcap"
    recording = make_recording(3000)
    writer = write_chunked(recording, path)
    writer.add_gaps(recording.gaps, T0 + 600_000_000)
    writer.add_marks(recording.marks)
    writer.close({"samples.rows": 3000})
    return path


def assert_part(part: Recording, whole: Recording) -> None:
    """Compare the rows of the stretch with those of the whole recording."""
    for name, stream in whole.streams.items():
        inside = (stream.t_ns >= T0 + 60_000_000) & (stream.t_ns <= T0 + 90_000_000)
        assert np.array_equal(part.streams[name].sync, stream.sync[inside])
        for field, values in stream.raw.items():
            assert np.array_equal(part.streams[name].raw[field], values[inside])
    assert part.samples.sync.tolist() == list(range(300, 451))
    assert part.experiments() == [(300, 400)]
    assert part.missing is None or whole.missing is not None


def test_a_stretch_has_the_rows_of_the_whole_recording(file: Path) -> None:
    part = read_recording(file, STRETCH)
    assert_part(part, read_recording(file))
    assert part.gaps == ()
    assert part.counters == {}
    early = read_recording(file, (0.0, 0.01))
    assert [(gap.first, gap.last) for gap in early.gaps] == [(7, 9), (8, 8)]


def test_a_fraction_of_the_file_is_read_for_a_stretch(file: Path) -> None:
    with file.open("rb") as opened:
        table = chunk_table(opened)
    assert table is not None
    needed = sum(end - first for first, end in table.needed(window(table.begin_ns, STRETCH)))
    assert needed < 0.2 * file.stat().st_size


def test_a_stretch_of_a_truncated_file_is_read_from_its_chunks(file: Path, tmp_path: Path) -> None:
    data = file.read_bytes()
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(data[: len(data) // 2])
    part = read_recording(torn, STRETCH)
    assert part.samples.sync.tolist() == list(range(300, 451))
    assert part.missing is not None


def test_a_stretch_of_a_file_of_another_tool_has_the_same_rows(file: Path, tmp_path: Path) -> None:
    other = rewritten(file, tmp_path / "other.mcap", chunk_size=20_000)
    assert_part(read_recording(other, STRETCH), read_recording(other))


def test_a_stretch_without_a_sample_is_refused(file: Path) -> None:
    with pytest.raises(DataError, match=r"r\.mcap: no sample between 100 s and 200 s after its begin"):
        read_recording(file, (100.0, 200.0))


@pytest.mark.parametrize("text", ["s3://plant/cell_1/run.mcap", "https://host:8/a/run.mcap", "memory://run.mcap"])
def test_a_url_is_kept_also_after_it_was_a_path(text: str) -> None:
    for given in (text, Path(text), located(text)):
        url = located(given)
        assert isinstance(url, ObjectUrl)
        assert str(url) == text
        assert url.name == "run.mcap"


@pytest.mark.parametrize("text", ["run.mcap", "/data/a/run.mcap", "file:///data/a/run.mcap", "c:/run.mcap", "a b:/x"])
def test_a_path_is_not_taken_for_a_url(text: str) -> None:
    assert not isinstance(located(text), ObjectUrl)
    assert str(located(text)) == text.removeprefix("file://")
