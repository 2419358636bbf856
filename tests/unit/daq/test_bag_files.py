"""Bags as recorders leave them: files and folders, MCAP and SQLite, compressed, torn and damaged."""

import sqlite3
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.writer import CompressionType

from armident.configs import ArmidentError, ConfigError, DataError
from armident.daq.interchange.importing import import_recording
from armident.daq.interchange.rosbag import JointStates, read_joint_states
from armident.daq.recording.mcap_records import MAGIC, records
from tests.unit.daq.bags import ROWS, STEP_NS, T0, TAU, TX40, Q, mcap_bag, metadata, sqlite_bag, states, zstd


def assert_rows(found: JointStates, rows: np.ndarray | range) -> None:
    """The values are those of these rows of the motion."""
    np.testing.assert_array_equal(found.q, Q[list(rows)])
    np.testing.assert_array_equal(found.tau, TAU[list(rows)])


def chunks(path: Path) -> list[tuple[int, int]]:
    """Return first byte and size of the content of the chunks of an MCAP file."""
    data = memoryview(path.read_bytes())
    return [(at + 9, len(body)) for opcode, at, body in records(data, len(MAGIC)) if opcode == Opcode.CHUNK]


@pytest.mark.parametrize("compression", list(CompressionType))
def test_chunks_of_every_compression_are_read(tmp_path: Path, compression: CompressionType) -> None:
    assert_rows(read_joint_states(mcap_bag(tmp_path / "a.mcap", states(), compression=compression), TX40), range(ROWS))


@pytest.mark.parametrize("make", [mcap_bag, sqlite_bag])
def test_compressed_messages_and_files_are_read(tmp_path: Path, make: Callable[..., Path]) -> None:
    suffix = ".mcap" if make is mcap_bag else ".db3"
    plain = make(tmp_path / f"a{suffix}", states())
    assert_rows(read_joint_states(plain, TX40), range(ROWS))
    packed = make(tmp_path / f"b{suffix}", states(), pack=zstd)
    assert packed.read_bytes() != plain.read_bytes()
    assert_rows(read_joint_states(packed, TX40), range(ROWS))
    (tmp_path / f"c{suffix}.zstd").write_bytes(zstd(plain.read_bytes()))
    recording = import_recording(tmp_path / f"c{suffix}.zstd", TX40)
    np.testing.assert_array_equal(recording.samples.raw["position"], Q)


@pytest.mark.parametrize("make", [mcap_bag, sqlite_bag])
@pytest.mark.parametrize("listed", [True, False])
def test_a_folder_of_several_files_is_one_bag(tmp_path: Path, make: Callable[..., Path], listed: bool) -> None:
    suffix = ".mcap" if make is mcap_bag else ".db3"
    files = [f"run_{k}{suffix}" for k in range(12)]
    for k, name in enumerate(files):
        make(tmp_path / name, states()[k * 10 : k * 10 + 10])
    if listed:
        metadata(tmp_path, files, ROWS)
    recording = import_recording(tmp_path, TX40)
    np.testing.assert_array_equal(recording.samples.raw["position"], Q)
    assert "source_remarks" not in recording.metadata
    assert recording.metadata["source"] == tmp_path.name


@pytest.mark.parametrize("content", [b"", b"no bag at all"])
@pytest.mark.parametrize("make", [mcap_bag, sqlite_bag])
def test_a_file_without_any_message_is_a_gap_and_said(
    tmp_path: Path, make: Callable[..., Path], content: bytes
) -> None:
    files = [tmp_path / f"run_{k}{'.mcap' if make is mcap_bag else '.db3'}" for k in range(3)]
    for k in (0, 2):
        make(files[k], states()[k * 40 : k * 40 + 40])
    files[1].write_bytes(content)
    recording = import_recording(tmp_path, TX40)
    assert [(gap.first, gap.last) for gap in recording.gaps] == [(40, 79)]
    assert f"{files[1].name} is left out: " in recording.metadata["source_remarks"]
    for file in files:
        file.write_bytes(content)
    with pytest.raises(DataError, match=r"run_0\.\w+: (empty, )?not a"):
        import_recording(tmp_path, TX40)


def test_a_file_that_is_not_there_is_a_gap_and_said(tmp_path: Path) -> None:
    files = [f"run_{k}.mcap" for k in range(3)]
    for k in (0, 2):
        mcap_bag(tmp_path / files[k], states()[k * 40 : k * 40 + 40])
    metadata(tmp_path, files, ROWS)
    recording = import_recording(tmp_path, TX40)
    assert [(gap.first, gap.last) for gap in recording.gaps] == [(40, 79)]
    remarks = recording.metadata["source_remarks"]
    assert "run_1.mcap, which metadata.yaml lists, is missing" in remarks
    assert "40 of 120 messages of /joint_states are missing" in remarks


def test_the_complete_chunks_of_a_torn_bag_are_read_and_the_loss_is_said(tmp_path: Path) -> None:
    whole = mcap_bag(tmp_path / "a.mcap", states())
    starts = chunks(whole)
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(whole.read_bytes()[: starts[2][0] + 100])
    found = read_joint_states(torn, TX40)
    rows = len(found.q)
    assert 0 < rows < ROWS
    assert_rows(found, range(rows))
    assert "the file is torn" in found.remarks[-1]
    assert "last 109 bytes are no complete record" in found.remarks[-1]
    torn.write_bytes(whole.read_bytes()[: starts[0][0] + 100])
    with pytest.raises(DataError, match=r"torn\.mcap: no topic .*found no topic \(the file is torn"):
        read_joint_states(torn, TX40)


def test_a_damaged_chunk_is_a_gap_and_said(tmp_path: Path) -> None:
    path = mcap_bag(tmp_path / "a.mcap", states())
    for damaged in (0, 2):
        at, size = chunks(path)[damaged]
        data = bytearray(path.read_bytes())
        data[at + size // 2] ^= 0xFF
        (tmp_path / "b.mcap").write_bytes(data)
        recording = import_recording(tmp_path / "b.mcap", TX40)
        kept = recording.samples.sync if damaged else recording.samples.sync + ROWS - recording.samples.sync[-1] - 1
        np.testing.assert_array_equal(recording.samples.raw["position"], Q[kept])
        assert len(recording.gaps) == (damaged > 0)
        remarks = recording.metadata["source_remarks"]
        assert f"the chunk at byte {at - 9} is damaged" in remarks
        assert f"{ROWS - kept.size} of {ROWS} messages of /joint_states are missing" in remarks


def test_messages_in_the_journal_of_a_killed_recorder_are_read(tmp_path: Path) -> None:
    sqlite_bag(tmp_path / "made.db3", states())
    with closing(sqlite3.connect(tmp_path / "live.db3")) as database:
        database.execute("PRAGMA journal_mode=WAL")
        with closing(sqlite3.connect(tmp_path / "made.db3")) as source:
            source.backup(database)
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("PRAGMA wal_autocheckpoint=0")
        database.execute("UPDATE messages SET id = id + 1000 WHERE id > 60")
        database.commit()
        for suffix in ("", "-wal"):
            (tmp_path / f"killed.db3{suffix}").write_bytes((tmp_path / f"live.db3{suffix}").read_bytes())
    before = (tmp_path / "killed.db3").read_bytes()
    assert_rows(read_joint_states(tmp_path / "killed.db3", TX40), range(ROWS))
    assert (tmp_path / "killed.db3").read_bytes() == before


def test_a_damaged_database_gives_its_readable_messages(tmp_path: Path) -> None:
    data = sqlite_bag(tmp_path / "a.db3", states()).read_bytes()
    (tmp_path / "b.db3").write_bytes(data[: len(data) // 2])
    found = read_joint_states(tmp_path / "b.db3", TX40)
    assert 0 < len(found.q) < ROWS
    assert_rows(found, (found.t_ns - T0) // STEP_NS)
    assert "the database is damaged" in found.remarks[-1]


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".mcap.zstd", ".db3.zstd"])
def test_damaged_bags_raise_no_error_of_a_library(tmp_path: Path, suffix: str) -> None:
    make = mcap_bag if ".mcap" in suffix else sqlite_bag
    whole = make(tmp_path / "whole", states()).read_bytes()
    if suffix.endswith(".zstd"):
        whole = zstd(whole)
    rng = np.random.default_rng(4)
    path = tmp_path / f"a{suffix}"
    for _ in range(60):
        data = bytearray(whole[: rng.integers(1, len(whole))] if rng.random() < 0.3 else whole)
        for at in rng.integers(0, len(data), rng.integers(0, 20)):
            data[at] = rng.integers(0, 256)
        path.write_bytes(data)
        with suppress(ArmidentError):
            found = read_joint_states(path, TX40, topic="/joint_states")
            assert (np.diff(found.t_ns) > 0).all()


def test_a_bag_of_ros_1_is_refused_with_the_command_that_converts_it(tmp_path: Path) -> None:
    (tmp_path / "run.bag").write_bytes(b"#ROSBAG V2.0\n")
    for path in (tmp_path / "run.bag", tmp_path):
        with pytest.raises(ConfigError, match=r"run.bag: a bag of ROS 1; `rosbags-convert --src run.bag --dst run`"):
            import_recording(path, TX40)


def test_files_of_two_bags_are_not_joined(tmp_path: Path) -> None:
    (tmp_path / "day").mkdir()
    for name in ("morning_0.mcap", "evening_0.mcap"):
        mcap_bag(tmp_path / "day" / name, states())
    with pytest.raises(ConfigError, match=r"several bags without metadata.yaml: evening_0.mcap, morning_0.mcap"):
        import_recording(tmp_path / "day", TX40)
    with pytest.raises(ConfigError, match=r"no bag in this folder.*; bags are in day: give one"):
        import_recording(tmp_path, TX40)


def test_a_listed_file_may_have_been_decompressed_since(tmp_path: Path) -> None:
    for k, pack in ((0, zstd), (1, bytes), (2, zstd)):
        plain = mcap_bag(tmp_path / f"run_{k}.mcap", states()[k * 40 : k * 40 + 40])
        plain.write_bytes(pack(plain.read_bytes()))
        if pack is zstd:
            plain.rename(tmp_path / f"run_{k}.mcap.zstd")
    metadata(tmp_path, [f"run_{k}.mcap.zstd" for k in range(3)], ROWS)
    recording = import_recording(tmp_path, TX40)
    np.testing.assert_array_equal(recording.samples.raw["position"], Q)
    assert "source_remarks" not in recording.metadata


def test_what_is_no_bag_is_said(tmp_path: Path) -> None:
    (tmp_path / "a.db3").write_bytes(b"no database, but long enough to be one" * 40)
    with pytest.raises(DataError, match=r"a\.db3: not a readable bag in SQLite: damaged, or without"):
        read_joint_states(tmp_path / "a.db3", TX40)
    (tmp_path / "b.mcap.zstd").write_bytes(b"plain")
    with pytest.raises(DataError, match=r"b\.mcap\.zstd: truncated zstd file"):
        read_joint_states(tmp_path / "b.mcap.zstd", TX40)
    (tmp_path / "c.mcap").touch()
    with pytest.raises(DataError, match=r"c\.mcap: empty, not a bag"):
        read_joint_states(tmp_path / "c.mcap", TX40)
    (tmp_path / "folder").mkdir()
    with pytest.raises(ConfigError, match=r"folder: no bag in this folder; expected metadata\.yaml or files \.mcap"):
        import_recording(tmp_path / "folder", TX40)
    with pytest.raises(ConfigError, match=r"none\.mcap: no such file"):
        import_recording(tmp_path / "none.mcap", TX40)
