"""Long recordings are identified in stretches: the same numbers, in bounded memory."""

import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from armident.daq.recording import Recording
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.estimators.methods import Method
from armident.identify.identification import from_recording
from armident.identify.identification.from_recording import StretchRule, experiments_from_recording
from armident.identify.identification.identify_recording import identify_recording
from armident.identify.identification.options import Options
from armident.identify.setup.check import check_setup
from armident.identify.setup.result import SetupCheck
from armident.identify.signals.streamed import Streamed
from tests.fixtures import arms

EDGES = 0.2
"""Largest change by the ends of the stretches, standard deviations: each end costs half a filter."""
MOST_BYTES = 65.0
"""Largest memory of each further sample of one axis, bytes: 42 to 51 were measured, 28 of them of the raw sample, 24 of
the signals of the controller.

In one piece an identification takes about 260 bytes per value.
"""


def recorded() -> Recording:
    return arms.recording("emps", "emps_excitation", 1)


def numbers(document: IdentificationDocument) -> tuple[np.ndarray, np.ndarray]:
    found = [(p.value, p.std) for p in document.parameters]
    return np.array(found)[:, 0], np.array(found)[:, 1]


@pytest.mark.parametrize("robot", ["emps", "tx40"])
def test_stretches_hold_the_samples_and_references_of_the_whole(robot: str) -> None:
    recording = arms.recording(robot, f"{robot}_excitation", 1)
    (whole,), _ = experiments_from_recording(recording, recording.robot)
    size = recording.samples.sync.size * recording.robot.n
    parts, notes = experiments_from_recording(recording, recording.robot, StretchRule(0, size // 4))
    assert isinstance(parts, Streamed)
    assert len(parts) == 4
    assert "identified in 4 stretches" in notes[0]
    assert whole.q_ref is not None
    for name in ("q", "tau", "q_ref"):
        # Products of matrices of other shapes may round differently.
        together = np.concatenate([getattr(part, name) for part in parts])
        assert np.allclose(together, getattr(whole, name), rtol=1e-14, atol=1e-14)
    starts = [part.start for part in parts]
    lengths = [part.q.shape[0] * part.dt for part in parts]
    assert np.allclose(np.diff(starts), lengths[:-1], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "check"),
    [
        ("idim-ls", None),
        pytest.param("idim-iv", None, marks=[pytest.mark.slow, pytest.mark.nightly]),
        pytest.param("idim-piv", check_setup, marks=pytest.mark.slow),
    ],
)
def test_stretches_on_disk_give_the_same_bits_as_in_memory_and_the_estimate_of_the_whole(
    method: Method, check: Callable[..., SetupCheck] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = recorded()
    rule = StretchRule(0, recording.samples.sync.size // 3 + 1)
    streamed = identify_recording(recording, options=Options(method), check=check, stretches=rule)
    monkeypatch.setattr(from_recording, "OnDisk", list)
    in_memory = identify_recording(recording, options=Options(method), check=check, stretches=rule)
    theta, std = numbers(streamed.document)
    assert np.array_equal(theta, numbers(in_memory.document)[0])
    assert np.array_equal(std, numbers(in_memory.document)[1])
    assert streamed.document.verdict == in_memory.document.verdict
    whole = identify_recording(recording, options=Options(method), check=None)
    expected, deviation = numbers(whole.document)
    assert np.abs(theta - expected).max() > 0.0
    assert np.all(np.abs(theta - expected) < EDGES * deviation)
    assert np.allclose(std, deviation, rtol=0.1)


def peak_bytes(recording: Recording, rule: StretchRule) -> int:
    tracemalloc.start()
    try:
        identify_recording(recording, options=Options("idim-iv"), stretches=rule)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def repeated(recording: Recording, times: int) -> Recording:
    """The recording several times in a row; the motion ends where it began."""

    def streamed(name: str) -> dict[str, Sequence[np.ndarray]]:
        stream = recording.streams[name]
        return {key: [values] * times for key, values in stream.raw.items()}

    every = max(stream.every for stream in recording.streams.values())
    period = -(-recording.samples.sync.size // every) * every
    streams = {}
    for name, stream in recording.streams.items():
        sync = np.concatenate([stream.sync + k * period for k in range(times)])
        raw = {key: np.concatenate(values) for key, values in streamed(name).items()}
        streams[name] = replace(stream, sync=sync, t_ns=sync * 1_000_000, raw=raw)
    return replace(recording, streams=streams, marks=())


@pytest.mark.slow
def test_memory_of_a_long_recording_grows_by_its_samples_only() -> None:
    rule = StretchRule(0, 12_500)
    short, long = repeated(recorded(), 1), repeated(recorded(), 2)
    further = long.samples.sync.size - short.samples.sync.size
    growth = (peak_bytes(long, rule) - peak_bytes(short, rule)) / further
    assert growth < MOST_BYTES
