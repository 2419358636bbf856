"""Recordings, torn and forged: what is read of them was written, and what is not there is said to be missing."""

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError
from armident.daq.recording import Recording, Stream, read_recording, recover_recording
from tests.fuzz.harness import MisreadError, Target
from tests.fuzz.mutate import forge_recording, spoil_bytes
from tests.unit.daq.test_recording import make_recording, write_chunked

ROWS = 300


@cache
def _originals() -> tuple[Recording, ...]:
    """Two recordings that differ in every value; the second has other scales and another robot, too."""
    first, second = make_recording(ROWS, seed=1), make_recording(ROWS, seed=2)
    samples = second.samples
    field = samples.fields["position"]
    fields = samples.fields | {"position": replace(field, scale=tuple(3.0 * s for s in field.scale))}
    robot = second.robot.model_copy(update={"name": "other", "bandwidth_hz": 12.5})
    streams = second.streams | {"samples": replace(samples, fields=fields)}
    return first, replace(second, streams=streams, robot=robot, marks=(), counters={"frames": 7})


def _seeds() -> list[bytes]:
    """Both recordings complete, one without its end, one healed."""
    seeds = []
    with tempfile.TemporaryDirectory() as folder:
        for k, recording in enumerate(_originals()):
            path = Path(folder, f"{k}.mcap")
            writer = write_chunked(recording, path)
            writer.add_gaps(recording.gaps, int(recording.samples.t_ns[0]))
            writer.add_marks(recording.marks)
            writer.flush()
            unfinished = path.read_bytes()
            writer.close(recording.counters)
            seeds.append(path.read_bytes())
        seeds.append(unfinished)
        torn = Path(folder, "torn.mcap")
        torn.write_bytes(unfinished[: 2 * len(unfinished) // 3])
        recover_recording(torn)
        seeds.append(torn.read_bytes())
    return seeds


def _rows(stream: Stream) -> set[bytes]:
    """Every row as bytes."""
    if stream.sync.size == 0:
        return set()
    columns: list[NDArray[np.uint8]] = [
        np.ascontiguousarray(values).view(np.uint8).reshape(stream.sync.size, -1)
        for values in (stream.sync, stream.t_ns, *stream.raw.values())
    ]
    return {row.tobytes() for row in np.concatenate(columns, axis=1)}


@cache
def _known() -> dict[str, list[set[bytes]]]:
    return {name: [_rows(r.streams[name]) for r in _originals()] for name in _originals()[0].streams}


def check_truth(read: Recording) -> None:
    """Refuse what none of the recordings holds, and what lacks something without saying so."""
    matching = []
    for k, original in enumerate(_originals()):
        same = (
            read.robot == original.robot
            and read.session == original.session
            and read.sample_rate_hz == original.sample_rate_hz
            and read.streams.keys() == original.streams.keys()
            and all(s.fields == original.streams[name].fields for name, s in read.streams.items())
            and all(s.every == original.streams[name].every for name, s in read.streams.items())
        )
        if same:
            matching.append(k)
    if not matching:
        raise MisreadError("a configuration, a rate or a scale that was not written")
    k = matching[0]
    original = _originals()[k]
    if not set(read.gaps) <= set(original.gaps) or not set(read.marks) <= set(original.marks):
        raise MisreadError("gaps or marks that were not written")
    if not set(read.metadata.items()) <= set(original.metadata.items()):
        raise MisreadError("facts that were not written")
    if not set(read.counters.items()) <= set(original.counters.items()):
        raise MisreadError("counters that were not written")
    for name, stream in read.streams.items():
        rows = _rows(stream)
        if not rows <= _known()[name][k]:
            raise MisreadError(f"rows of {name} that were not written")
        if read.missing is None and len(rows) < len(_known()[name][k]):
            lacking = len(_known()[name][k]) - len(rows)
            raise MisreadError(f"{lacking} rows of {name} are not there, and nobody says so")
    if read.missing is None and (read.gaps, read.marks) != (original.gaps, original.marks):
        raise MisreadError("gaps or marks are not there, and nobody says so")
    if read.missing is None and read.counters != original.counters:
        raise MisreadError("counters are not there, and nobody says so")


def _check(data: bytes, folder: Path, truth: bool) -> bool:
    path = folder / "r.mcap"
    for old in folder.glob("r.mcap*"):
        old.unlink()
    path.write_bytes(data)
    try:
        read = read_recording(path)
    except DataError as error:
        if "r.mcap" not in str(error):
            raise AssertionError(f"an error that does not say where: {error}") from error
        _heal_quietly(path)
        raise
    if truth:
        check_truth(read)
    healed = recover_recording(path)
    again = read_recording(path)
    if again.sha256 != read.sha256 or (again.gaps, again.marks) != (read.gaps, read.marks):
        raise MisreadError("healing changed what is read")
    if (read.missing is None) != (again.missing is None):
        raise MisreadError(f"healing changed what is missing: {read.missing!r}, {again.missing!r}")
    if healed.missing is not None and recover_recording(path).missing is not None:
        raise MisreadError("a healed file had to be healed again")
    return True


def _heal_quietly(path: Path) -> None:
    """A file that cannot be read may be refused by the healer, too; in words."""
    try:
        recover_recording(path)
    except (ConfigError, DataError):
        return


TARGETS = (
    Target("recording", _seeds, spoil_bytes, lambda data, folder: _check(data, folder, True)),
    Target("recording-forged", _seeds, forge_recording, lambda data, folder: _check(data, folder, False)),
)
