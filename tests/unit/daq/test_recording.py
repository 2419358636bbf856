"""Recordings: written and read content agree, with our reader and the mcap library."""

import json
import os
import resource
import struct
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from armident.configs import ConfigError, DataError, SessionConfig, config_path, load_robot
from armident.configs.loading import parse
from armident.daq.recording import (
    Field,
    Gap,
    Mark,
    Recording,
    RecordingWriter,
    Stream,
    StreamLayout,
    read_recording,
    write_recording,
)
from armident.daq.recording import mcap_records as mcap

T0 = 1_700_000_000_000_000_000


def make_recording(rows: int = 1500, seed: int = 0) -> Recording:
    """Return a recording like that of a cell: samples on every SYNC but a few, demand on every fifth."""
    rng = np.random.default_rng(seed)
    robot = load_robot("tx40.yaml")
    session = parse(config_path("tx40_cell.yaml").read_text(), SessionConfig, "tx40_cell.yaml")
    one = (1.0,) * robot.n
    sync = np.delete(np.arange(rows + 3, dtype=np.int64), [7, 8, 9])
    int32 = np.iinfo(np.int32)
    samples = Stream(
        "samples",
        1,
        sync,
        T0 + sync * 200_000,
        {
            "position": Field("position", "position", "rad", "motor", tuple(2 * np.pi / 65536 for _ in one)),
            "current": Field("current", "current", "A", "motor", tuple(0.0025 for _ in one)),
            "status": Field("status", "status", "", "motor", one),
        },
        {
            "position": rng.integers(int32.min, int32.max, (rows, robot.n), dtype=np.int32, endpoint=True),
            "current": rng.integers(-32768, 32767, (rows, robot.n), dtype=np.int16, endpoint=True),
            "status": rng.integers(0, 65535, (rows, robot.n), dtype=np.uint16, endpoint=True),
        },
    )
    fifth = np.arange(4, rows, 5, dtype=np.int64)
    demand = Stream(
        "demand",
        5,
        fifth,
        T0 + fifth * 200_000,
        {"demand": Field("demand", "demand", "rad", "motor", tuple(2 * np.pi / 65536 for _ in one))},
        {"demand": rng.integers(int32.min, int32.max, (fifth.size, robot.n), dtype=np.int32)},
    )
    return Recording(
        None,
        robot,
        session,
        5000.0,
        {"samples": samples, "demand": demand},
        (Gap("samples", 7, 9, "joint_2", "lost"), Gap("samples", 8, 8, None, "SYNC not received")),
        (Mark("experiment_start", 10, T0, "a"), Mark("experiment_end", 400, T0 + 1)),
        {"sync_sent": rows + 3, "frames": 5},
        {"host": "x"},
    )


def assert_same(a: Recording, b: Recording) -> None:
    """Compare two recordings in everything but the path."""
    assert a.sha256 == b.sha256
    assert (a.robot, a.session, a.sample_rate_hz) == (b.robot, b.session, b.sample_rate_hz)
    assert (a.gaps, a.marks, a.counters, a.metadata) == (b.gaps, b.marks, b.counters, b.metadata)
    assert a.streams.keys() == b.streams.keys()
    for name, stream in a.streams.items():
        other = b.streams[name]
        assert stream.fields == other.fields
        assert stream.every == other.every
        assert np.array_equal(stream.t_ns, other.t_ns)
        for key, values in stream.raw.items():
            assert values.dtype == other.raw[key].dtype
            assert np.array_equal(values, other.raw[key])


def test_a_recording_is_read_back_to_the_last_bit(tmp_path: Path) -> None:
    recording = make_recording(12_000)
    write_recording(recording, tmp_path / "r.mcap")
    read = read_recording(tmp_path / "r.mcap")
    assert read.missing is None
    assert_same(recording, read)
    assert [p.name for p in tmp_path.iterdir()] == ["r.mcap"]


def test_float64_channels_are_read_back_to_the_last_bit(tmp_path: Path) -> None:
    robot = load_robot("emps.yaml")
    sync = np.arange(300, dtype=np.int64)
    raw = {"position": np.random.default_rng(1).normal(size=(300, 1))}
    stream = Stream(
        "samples", 1, sync, sync * 10**6, {"position": Field("position", "position", "m", "joint", (1.0,))}, raw
    )
    recording = Recording(None, robot, None, 1000.0, {"samples": stream})
    write_recording(recording, tmp_path / "e.mcap")
    assert_same(recording, read_recording(tmp_path / "e.mcap"))


def test_the_stock_reader_decodes_every_message(tmp_path: Path) -> None:
    recording = make_recording(700)
    write_recording(recording, tmp_path / "r.mcap")
    with (tmp_path / "r.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 700 + recording.streams["demand"].sync.size + 4
        rows = [m for *_, m in reader.iter_decoded_messages(topics=["/samples"])]
        names = {m.name: m.metadata for m in reader.iter_metadata()}
        gaps = [json.loads(m.data) for _, _, m in reader.iter_messages(topics=["/events/gaps"])]
    assert [r.sync for r in rows] == recording.samples.sync.tolist()
    for name in ("position", "current", "status"):
        got = [[getattr(getattr(r, j.name), name) for j in recording.robot.joints] for r in rows]
        assert np.array_equal(got, recording.samples.raw[name])
    assert names["armident.counters"] == {"sync_sent": "703", "frames": "5"}
    assert gaps[0] == {"stream": "samples", "first": 7, "last": 9, "joint": "joint_2", "reason": "lost"}


def test_the_stock_reader_finds_a_time_span_by_the_index(tmp_path: Path) -> None:
    recording = make_recording(2000)
    write_chunked(recording, tmp_path / "r.mcap").close({})
    with (tmp_path / "r.mcap").open("rb") as file:
        found = list(
            make_reader(file).iter_messages(
                ["/samples"], starting_at=T0 + 100 * 200_000, ending_before=T0 + 200 * 200_000
            )
        )
    assert len(found) == 100
    assert found[0][2].sequence == 100


def started(recording: Recording, path: Path, chunk_ns: int = 20_000_000) -> RecordingWriter:
    """Return a writer that has written the head of a file."""
    joints = [j.name for j in recording.robot.joints]
    layouts = [StreamLayout.of(s, joints) for s in recording.streams.values()]
    return RecordingWriter(path, recording.robot, recording.session, 5000.0, layouts, recording.metadata, chunk_ns)


def write_chunked(recording: Recording, path: Path, chunk_ns: int = 20_000_000) -> RecordingWriter:
    """Write a recording like a capture, in small batches and many chunks; the file is not closed."""
    writer = started(recording, path, chunk_ns)
    for first in range(0, int(recording.samples.sync[-1]) + 1, 50):
        for stream in recording.streams.values():
            part = (stream.sync >= first) & (stream.sync < first + 50)
            writer.append(
                stream.name, stream.sync[part], stream.t_ns[part], {k: v[part] for k, v in stream.raw.items()}
            )
    return writer


def test_values_do_not_depend_on_batches_and_chunks(tmp_path: Path) -> None:
    recording = make_recording(3000)
    write_chunked(recording, tmp_path / "r.mcap").close(recording.counters)
    assert read_recording(tmp_path / "r.mcap").sha256 == recording.sha256


def test_a_truncated_file_is_read_up_to_its_last_complete_chunk(tmp_path: Path) -> None:
    recording = make_recording(2000)
    write_chunked(recording, tmp_path / "whole.mcap").close({})
    data = (tmp_path / "whole.mcap").read_bytes()
    rng = np.random.default_rng(2)
    seen = []
    for cut in sorted(rng.integers(8_000, len(data), 60)):
        torn = tmp_path / "torn.mcap"
        torn.write_bytes(data[:cut])
        read = read_recording(torn)
        assert read.missing is not None
        assert "not finished" in read.missing
        count = read.samples.sync.size
        assert np.array_equal(read.samples.sync, recording.samples.sync[:count])
        assert np.array_equal(read.samples.raw["position"], recording.samples.raw["position"][:count])
        seen.append(count)
    assert seen == sorted(seen)
    assert seen[-1] > 1000


def test_an_unclosed_file_loses_at_most_one_chunk(tmp_path: Path) -> None:
    recording = make_recording(2000)
    write_chunked(recording, tmp_path / "r.mcap")
    read = read_recording(tmp_path / "r.mcap")
    assert recording.samples.sync[-1] - read.samples.sync[-1] <= 150
    assert read.missing is not None
    assert f"after SYNC {read.samples.sync[-1]}" in read.missing


def test_a_flipped_bit_in_a_chunk_is_detected_and_reported(tmp_path: Path) -> None:
    recording = make_recording(2000)
    write_chunked(recording, tmp_path / "r.mcap").close({})
    data = bytearray((tmp_path / "r.mcap").read_bytes())
    data[len(data) // 2] ^= 0x10
    (tmp_path / "r.mcap").write_bytes(data)
    read = read_recording(tmp_path / "r.mcap")
    assert read.missing is not None
    assert "damaged" in read.missing
    kept = np.isin(recording.samples.sync, read.samples.sync)
    assert np.array_equal(recording.samples.raw["position"][kept], read.samples.raw["position"])
    assert 0 < (~kept).sum() < 300


@pytest.mark.parametrize(
    ("content", "words"), [(b"", "empty"), (b"t,q1\n0,1\n", "not an MCAP"), (b"\x89MCAP0\r\n\x01", "truncated before")]
)
def test_a_file_that_is_no_recording_is_refused_with_its_kind(tmp_path: Path, content: bytes, words: str) -> None:
    (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(DataError, match=words) as caught:
        read_recording(tmp_path / "x.mcap")
    # Dask follows causes to their end.
    assert caught.value.__cause__ is not caught.value


def test_another_tool_s_mcap_is_not_a_recording(tmp_path: Path) -> None:
    with (tmp_path / "x.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    with pytest.raises(DataError, match="not a recording of armident"):
        read_recording(tmp_path / "x.mcap")


def test_a_missing_recording_is_a_configuration_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such recording"):
        read_recording(tmp_path / "x.mcap")


def test_an_unwritable_path_is_a_configuration_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written"):
        write_recording(make_recording(10), tmp_path / "file" / "r.mcap")


def test_a_file_has_its_head_as_soon_as_it_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process is killed at each of the system calls that write the head."""
    recording, write = make_recording(10), os.write
    left = 0

    def killed(file: int, data: Any) -> int:
        nonlocal left
        left -= 1
        if left < 0:
            raise KeyboardInterrupt
        return write(file, data)

    monkeypatch.setattr(os, "write", killed)
    for calls in range(20):
        left = calls
        try:
            started(recording, tmp_path / f"{calls}.mcap")
        except KeyboardInterrupt:
            assert not (tmp_path / f"{calls}.mcap").exists()
        else:
            break
    assert 1 < calls < 19
    assert read_recording(tmp_path / f"{calls}.mcap").samples.sync.size == 0


@pytest.mark.parametrize("links", [True, False])
def test_an_existing_file_is_not_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, links: bool) -> None:
    if not links:
        # Error of a memory card's file system.
        monkeypatch.setattr(os, "link", lambda *_: (_ for _ in ()).throw(PermissionError(1, "Operation not permitted")))
    write_chunked(make_recording(10), tmp_path / "r.mcap")
    before = (tmp_path / "r.mcap").read_bytes()
    with pytest.raises(ConfigError, match=r"r\.mcap: cannot be written: File exists"):
        started(make_recording(20), tmp_path / "r.mcap")
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("r.mcap", before)]


def test_a_full_disk_keeps_the_file_whole_and_counts_the_loss(tmp_path: Path) -> None:
    recording = make_recording(2000)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, before[1]))
    try:
        writer = write_chunked(recording, tmp_path / "r.mcap")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    writer.close({})
    read = read_recording(tmp_path / "r.mcap")
    assert writer.problem is not None
    assert writer.lost_rows > 0
    rows = sum(s.sync.size for s in read.streams.values())
    assert rows + writer.lost_rows == sum(s.sync.size for s in recording.streams.values())
    assert read.missing is None


def with_chunks(data: bytes, change: Callable[[bytearray], None]) -> bytes:
    """Return a recording with changed chunk records and corrected lengths."""
    out = bytearray(mcap.MAGIC)
    for opcode, _, body in mcap.records(memoryview(data), len(mcap.MAGIC)):
        content = bytearray(body)
        if opcode == Opcode.CHUNK:
            change(content)
        out += mcap.record(opcode, bytes(content))
    return bytes(out) + mcap.MAGIC


def _with_size(size: int, content: bytearray) -> None:
    """State another uncompressed size in a chunk."""
    struct.pack_into("<Q", content, 16, size)


def test_memory_is_not_reserved_by_sizes_stated_in_a_file(tmp_path: Path) -> None:
    write_chunked(make_recording(2000), tmp_path / "r.mcap").close({})
    data = (tmp_path / "r.mcap").read_bytes()
    for size in (2**28, 2**31, 2**40, 2**63, 2**64 - 1):
        forged = with_chunks(data, partial(_with_size, size))
        (tmp_path / "f.mcap").write_bytes(forged)
        tracemalloc.start()
        read = read_recording(tmp_path / "f.mcap")
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert read.samples.sync.size == 0
        assert read.missing is not None
        assert read.missing.count("is damaged and left out") > 10
        assert peak < 20e6


def test_a_recording_with_a_wrong_number_of_rows_in_its_summary_is_read(tmp_path: Path) -> None:
    recording = make_recording(2000)
    write_chunked(recording, tmp_path / "r.mcap").close({})
    data = (tmp_path / "r.mcap").read_bytes()
    place = next(at for op, at, _ in mcap.records(memoryview(data), len(mcap.MAGIC)) if op == Opcode.STATISTICS)
    forged = bytearray(data)
    # The counts by channel are the last of the statistics: make the first one enormous, and remove the checksum.
    struct.pack_into("<Q", forged, place + mcap.RECORD_HEAD.size + 46 + 2, 2**60)
    struct.pack_into("<I", forged, len(forged) - len(mcap.MAGIC) - 4, 0)
    (tmp_path / "f.mcap").write_bytes(forged)
    read = read_recording(tmp_path / "f.mcap")
    assert read.sha256 == recording.sha256
    assert read.missing is not None
    assert f"2000 of {2**60} messages of topic /samples are left" in read.missing


@pytest.mark.parametrize("at", ["robot", "scale", "sample_rate_hz"])
def test_a_flipped_bit_in_the_head_is_found(at: str, tmp_path: Path) -> None:
    """The meaning of rows is only in the head, which the checksums of chunks do not cover."""
    write_chunked(make_recording(300), tmp_path / "r.mcap").close({})
    data = bytearray((tmp_path / "r.mcap").read_bytes())
    word = {"robot": b'"torque":', "scale": b'"scale": [', "sample_rate_hz": b"sample_rate_hz"}[at]
    data[data.index(word) + len(word) + 4] ^= 0x01
    (tmp_path / "r.mcap").write_bytes(data)
    with pytest.raises(DataError, match="wrong checksum"):
        read_recording(tmp_path / "r.mcap")


def test_damaged_counters_are_left_out_and_reported(tmp_path: Path) -> None:
    recording = make_recording(300)
    write_chunked(recording, tmp_path / "r.mcap").close({"frames": 12345})
    data = (tmp_path / "r.mcap").read_bytes().replace(b"12345", b"12346")
    (tmp_path / "r.mcap").write_bytes(data)
    read = read_recording(tmp_path / "r.mcap")
    assert read.sha256 == recording.sha256
    assert read.counters == {}
    assert "is damaged and left out" in str(read.missing)


def test_a_chunk_of_another_recording_is_detected(tmp_path: Path) -> None:
    one, other = make_recording(300, seed=1), make_recording(300, seed=2)
    write_chunked(one, tmp_path / "1.mcap").close({})
    write_chunked(replace(other, metadata={"host": "y"}), tmp_path / "2.mcap").close({})
    parts = [(tmp_path / name).read_bytes() for name in ("1.mcap", "2.mcap")]
    chunks = [
        [(at, at + 9 + len(body)) for op, at, body in mcap.records(memoryview(part), 8) if op == Opcode.CHUNK]
        for part in parts
    ]
    (begin, end), (first, last) = chunks[0][1], chunks[1][1]
    (tmp_path / "x.mcap").write_bytes(parts[0][:begin] + parts[1][first:last] + parts[0][end:])
    read = read_recording(tmp_path / "x.mcap")
    assert "that the file does not define" in str(read.missing)
    rows = np.isin(one.samples.sync, read.samples.sync)
    assert 0 < rows.sum() < 300
    assert np.array_equal(read.samples.raw["position"], one.samples.raw["position"][rows])
