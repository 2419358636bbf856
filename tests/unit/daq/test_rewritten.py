"""Recordings that other MCAP tools have rewritten: the same numbers, and damage judged by contents."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.records import Channel, Message, Metadata, Schema
from mcap.writer import CompressionType, IndexType, Writer
from typer.testing import CliRunner

from armident.configs import DataError
from armident.daq.cli import application
from armident.daq.recording import Recording, read_recording, recover_recording, write_recording
from armident.daq.recording.names import CHECK, COUNTERS
from armident.daq.recording.reader import is_recording
from tests.fixtures import arms
from tests.unit.daq.test_recording import make_recording, write_chunked

Record = tuple[Schema | None, Channel, Message]


def rewritten(
    source: Path,
    target: Path,
    keep: Callable[[Record], bool] = lambda record: True,
    metadata: Callable[[Metadata], bool] = lambda entry: True,
    metadata_last: bool = False,
    copies: int = 1,
    by_time: bool = True,
    channel_per_message: bool = False,
    **options: Any,
) -> Path:
    """Copy a file record by record with the MCAP library, as its tools do."""
    with source.open("rb") as file:
        reader = make_reader(file)
        records = [record for record in reader.iter_messages(log_time_order=by_time) if keep(record)]
        entries = [entry for entry in reader.iter_metadata() if metadata(entry)]
    with target.open("wb") as output:
        writer = Writer(output, **options)
        writer.start(library="another tool")
        known: dict[int, int] = {}

        def add_metadata() -> None:
            for entry in entries:
                writer.add_metadata(entry.name, entry.metadata)

        if not metadata_last:
            add_metadata()
        for schema, channel, message in records * copies:
            assert schema is not None
            if channel.id not in known or channel_per_message:
                known[channel.id] = writer.register_channel(
                    channel.topic,
                    channel.message_encoding,
                    writer.register_schema(schema.name, schema.encoding, schema.data),
                    channel.metadata,
                )
            writer.add_message(
                known[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        if metadata_last:
            add_metadata()
        writer.finish()
    return target


@pytest.fixture(name="recording")
def fixture_recording(tmp_path: Path) -> Recording:
    write_chunked(make_recording(2000), tmp_path / "own.mcap").close({"frames": 5})
    return read_recording(tmp_path / "own.mcap")


def source_of(recording: Recording) -> Path:
    assert recording.path is not None
    return recording.path


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.ZSTD, "chunk_size": 3000},
        {"chunk_size": 3000, "by_time": False},
        {"metadata_last": True},
        {"use_chunking": False},
        {"use_chunking": False, "metadata_last": True},
        {"enable_crcs": False},
        {"index_types": IndexType.NONE},
        {"use_statistics": False, "use_summary_offsets": False},
        {"channel_per_message": True, "chunk_size": 100_000},
    ],
    ids=str,
)
def test_a_copy_record_by_record_has_the_same_numbers_and_hash(
    recording: Recording, tmp_path: Path, options: dict[str, Any]
) -> None:
    copied = read_recording(rewritten(source_of(recording), tmp_path / "copy.mcap", **options))
    assert copied.missing is None
    assert copied.sha256 == recording.sha256
    assert copied.samples.t_ns.tolist() == recording.samples.t_ns.tolist()
    assert (copied.gaps, copied.marks, copied.counters) == (recording.gaps, recording.marks, recording.counters)
    assert (copied.robot, copied.session, copied.metadata) == (recording.robot, recording.session, recording.metadata)


def test_a_rewritten_file_is_known_as_a_recording_and_needs_no_recovery(recording: Recording, tmp_path: Path) -> None:
    copy = rewritten(source_of(recording), tmp_path / "copy.mcap", metadata_last=True, compression=CompressionType.NONE)
    before = copy.read_bytes()
    assert is_recording(copy)
    assert recover_recording(copy).missing is None
    assert copy.read_bytes() == before


def test_rows_that_a_tool_left_out_are_counted(recording: Recording, tmp_path: Path) -> None:
    t_ns = int(recording.samples.t_ns[1499])
    copy = rewritten(source_of(recording), tmp_path / "copy.mcap", keep=lambda record: record[2].log_time <= t_ns)
    read = read_recording(copy)
    assert read.samples.sync.tolist() == recording.samples.sync[: read.samples.sync.size].tolist()
    assert f"{read.samples.sync.size} of 2000 messages of topic /samples are left" in str(read.missing)


def test_recordings_that_a_tool_has_joined_are_refused(recording: Recording, tmp_path: Path) -> None:
    twice = rewritten(source_of(recording), tmp_path / "twice.mcap", copies=2)
    with pytest.raises(DataError, match=r"twice\.mcap: topic /samples: .*duplicate messages, or several recordings"):
        read_recording(twice)


def test_a_recording_that_was_torn_before_it_was_rewritten_is_not_taken_as_whole(
    recording: Recording, tmp_path: Path
) -> None:
    ends = {COUNTERS, CHECK}
    seen: list[str] = []

    def of_the_head(entry: Metadata) -> bool:
        seen.append(entry.name)
        return entry.name not in ends or (entry.name == CHECK and seen.count(CHECK) == 1)

    copy = rewritten(source_of(recording), tmp_path / "copy.mcap", metadata=of_the_head)
    assert "was not finished when another tool rewrote it" in str(read_recording(copy).missing)


@pytest.mark.slow
def test_damage_in_a_rewritten_file_is_found_by_its_contents(recording: Recording, tmp_path: Path) -> None:
    for compression in (CompressionType.LZ4, CompressionType.ZSTD, CompressionType.NONE):
        copy = rewritten(source_of(recording), tmp_path / "copy.mcap", compression=compression, chunk_size=20_000)
        data = bytearray(copy.read_bytes())
        data[len(data) // 2] ^= 0x10
        copy.write_bytes(data)
        read = read_recording(copy)
        assert "is damaged and left out" in str(read.missing)
        assert 0 < read.samples.sync.size < 2000
        with pytest.raises(DataError, match="Another tool has written this file; try: mcap recover"):
            recover_recording(copy)


def test_a_torn_rewritten_file_is_read_up_to_its_end(recording: Recording, tmp_path: Path) -> None:
    copy = rewritten(source_of(recording), tmp_path / "copy.mcap", chunk_size=20_000)
    data = copy.read_bytes()
    copy.write_bytes(data[: len(data) * 2 // 3])
    read = read_recording(copy)
    assert "was not finished" in str(read.missing)
    assert read.samples.sync.tolist() == recording.samples.sync[: read.samples.sync.size].tolist()
    assert 0 < read.samples.sync.size < 2000


def test_a_copy_without_metadata_says_what_to_copy(recording: Recording, tmp_path: Path) -> None:
    copy = rewritten(source_of(recording), tmp_path / "copy.mcap", metadata=lambda entry: False)
    with pytest.raises(DataError, match="another tool left out its metadata; copy them too, as mcap filter"):
        read_recording(copy)


@pytest.mark.slow
def test_a_copy_is_exported_and_identified_as_the_recording_itself(tmp_path: Path) -> None:
    made = arms.recording("emps", "emps_excitation", 1)
    rows = {f"{name}.rows": int(stream.sync.size) for name, stream in made.streams.items()}
    write_recording(replace(made, counters=rows), tmp_path / "own.mcap")
    rewritten(tmp_path / "own.mcap", tmp_path / "copy.mcap", compression=CompressionType.LZ4, chunk_size=50_000)
    tables, parameters = [], []
    for name in ("own", "copy"):
        recording, out = tmp_path / f"{name}.mcap", tmp_path / f"{name}.identification"
        for command in (
            ["export", recording, "--out", tmp_path / f"{name}.csv"],
            ["identify", recording, "--method", "idim-ls", "--out", out],
        ):
            words = [str(word) for word in command]
            done = CliRunner().invoke(application(words), words)
            assert done.exit_code == 0, done.output
        tables.append((tmp_path / f"{name}.csv").read_bytes())
        parameters.append(json.loads((out / "identification.json").read_text())["parameters"])
    assert tables[0] == tables[1]
    assert parameters[0] == parameters[1]


def test_a_named_pipe_in_a_folder_of_recordings_is_not_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "emps-20260101T000000-000Z.mcap"
    os.mkfifo(path)
    assert not is_recording(path)
