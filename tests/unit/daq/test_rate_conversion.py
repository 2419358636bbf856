"""Resampling of a recording: pass band and stop band of the filter, times of gaps and marks."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armident.configs import ConfigError, load_robot
from armident.daq.interchange.importing import import_recording
from armident.daq.interchange.resampling import at_rate, low_passed
from armident.daq.recording import Field, Gap, Mark, Recording, Stream, write_recording

EMPS = load_robot("emps.yaml")
RATE = 4000.0


def recorded(position: np.ndarray, torque: np.ndarray, sync: np.ndarray | None = None) -> Recording:
    """A recording of one axis at 4 kHz, (N,) each."""
    sync = np.arange(position.size) if sync is None else sync
    fields = {
        "position": Field("position", "position", "m", "joint", (1.0,)),
        "torque": Field("torque", "torque", "N", "joint", (1.0,)),
        "status": Field("status", "status", "", "motor", (1.0,)),
    }
    status = np.full((position.size, 1), 39, np.uint16)
    raw = {"position": position[:, None], "torque": torque[:, None], "status": status}
    t_ns = np.round(sync * 1e9 / RATE).astype(np.int64)
    samples = Stream("samples", 1, sync.astype(np.int64), t_ns, fields, raw)
    return Recording(None, EMPS, None, RATE, {"samples": samples})


def inner(values: np.ndarray) -> np.ndarray:
    """Values away from both ends, where the filter reaches beyond the data."""
    return values[60:-60]


@pytest.mark.parametrize("rate", [1000.0, 1500.0, 2000.0, 6000.0])
def test_a_slow_motion_keeps_its_values_at_the_new_instants(rate: float) -> None:
    t = np.arange(8000) / RATE
    recording = at_rate(recorded(np.sin(2 * np.pi * 50.0 * t), np.cos(2 * np.pi * 50.0 * t)), rate)
    new = recording.samples.sync / rate
    position, torque = (recording.samples.raw[name][:, 0] for name in ("position", "torque"))
    np.testing.assert_allclose(inner(position), inner(np.sin(2 * np.pi * 50.0 * new)), atol=2e-4)
    # The time between position and torque is a property of the drives, whatever the rate.
    np.testing.assert_allclose(inner(torque), inner(np.cos(2 * np.pi * 50.0 * new)), atol=2e-4)


def test_a_disturbance_beyond_the_new_nyquist_frequency_does_not_fold_back() -> None:
    t = np.arange(8000) / RATE
    folded = np.sin(2 * np.pi * 900.0 * t)
    recording = at_rate(recorded(folded, folded), 1000.0)
    for name in ("position", "torque"):
        assert np.max(np.abs(inner(recording.samples.raw[name]))) < 1e-3


def test_the_filter_keeps_constants_and_straight_lines_up_to_the_ends() -> None:
    line = np.column_stack([np.full(400, 3.0), np.arange(400.0)])
    at = np.arange(0.0, 400.0, 4.0)
    np.testing.assert_allclose(low_passed(line, at, 0.25), np.column_stack([np.full(100, 3.0), at]), atol=1e-2)


def test_gaps_and_marks_keep_their_times() -> None:
    sync = np.concatenate([np.arange(0, 2000), np.arange(2100, 6000)])
    recording = recorded(np.sin(sync / 300.0), np.cos(sync / 300.0), sync)
    marks = (Mark("experiment_start", 401, 0), Mark("experiment_end", 5003, 0), Mark("note", -1, 0))
    made = at_rate(replace(recording, marks=marks, gaps=(Gap("samples", 2000, 2099),)), 1000.0)
    new = made.samples.sync
    assert new[0] == 0
    assert new[-1] == 1499
    assert list(np.flatnonzero(np.diff(new) != 1)) == [499]
    assert (new[499], new[500]) == (499, 525)
    assert [(gap.first, gap.last) for gap in made.gaps] == [(500, 524)]
    assert [mark.sync for mark in made.marks] == [101, 1250, -1]
    assert made.counters["samples.rows"] == new.size
    assert made.counters["samples.in_gaps"] == 25
    assert made.samples.raw["status"].dtype == np.uint16


def test_a_recording_is_imported_with_a_rate_and_without_a_configuration(tmp_path: Path) -> None:
    t = np.arange(4000) / RATE
    file = tmp_path / "a.mcap"
    write_recording(recorded(np.sin(t), np.cos(t)), file)
    made = import_recording(file, None, rate_hz=1000.0)
    assert made.sample_rate_hz == 1000.0
    assert made.samples.sync.size == 1000
    assert made.metadata["source"] == "a.mcap"
    assert made.metadata["resampled_from_hz"] == "4000"
    with pytest.raises(ConfigError, match="a recording already; --rate resamples it"):
        import_recording(file, None)
    with pytest.raises(ConfigError, match=r"--motor-side is an option of .*; not of a recording of armident"):
        import_recording(file, None, rate_hz=1000.0, motor_side=True)
