"""Recovery of truncated recordings: every reader opens them, and no complete chunk is lost."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory
from typer.testing import CliRunner

from armident.configs import ConfigError, DataError
from armident.daq.cli import application
from armident.daq.recording import Recording, read_recording, recover_recording
from tests.unit.daq.test_recording import make_recording, write_chunked


def torn(recording: Recording, path: Path, share: float) -> bytes:
    """Write the first share of a recording's bytes to a file, and return them."""
    write_chunked(recording, path.with_suffix(".whole")).close({"frames": 5})
    data = path.with_suffix(".whole").read_bytes()
    data = data[: int(share * len(data))]
    path.write_bytes(data)
    return data


def stock_count(path: Path) -> int:
    """Return the number of messages that the mcap reader finds by the index and decodes, with verified checksums."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        found = sum(1 for schema, *_ in reader.iter_decoded_messages() if schema is not None)
        assert found == summary.statistics.message_count
        return found


@pytest.mark.slow
def test_a_truncated_file_is_recovered_to_the_rows_that_our_reader_finds(tmp_path: Path) -> None:
    recording = make_recording(2000)
    path = tmp_path / "r.mcap"
    write_chunked(recording, tmp_path / "whole.mcap").close({})
    data = (tmp_path / "whole.mcap").read_bytes()
    for cut in sorted(np.random.default_rng(2).integers(12_000, len(data), 30)):
        path.write_bytes(data[:cut])
        before = read_recording(path)

        healed = recover_recording(path)

        after = read_recording(path)
        assert healed.missing == before.missing == after.missing
        assert (after.sha256, after.gaps, after.marks) == (before.sha256, before.gaps, before.marks)
        events = len(after.gaps) + len(after.marks)
        assert stock_count(path) == sum(s.sync.size for s in after.streams.values()) + events
        assert recover_recording(path).missing is None


def test_the_index_of_a_recovered_file_equals_that_of_a_finished_one(tmp_path: Path) -> None:
    recording = make_recording(2000)
    writer = write_chunked(recording, tmp_path / "r.mcap")
    writer.flush()
    unfinished = (tmp_path / "r.mcap").read_bytes()
    writer.close({})
    (tmp_path / "torn.mcap").write_bytes(unfinished)
    recover_recording(tmp_path / "torn.mcap")

    def index(path: Path) -> list[tuple[int, int, dict[int, int]]]:
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        return [(c.chunk_start_offset, c.message_start_time, c.message_index_offsets) for c in summary.chunk_indexes]

    assert index(tmp_path / "torn.mcap") == index(tmp_path / "r.mcap")


def test_damage_in_the_middle_is_left_out_and_the_damaged_file_kept(tmp_path: Path) -> None:
    recording = make_recording(2000)
    path = tmp_path / "r.mcap"
    write_chunked(recording, path).close({"frames": 5})
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)
    before = read_recording(path)

    healed = recover_recording(path)

    after = read_recording(path)
    assert healed.missing is not None
    assert "damaged" in healed.missing
    assert after.missing == healed.missing == before.missing
    assert after.sha256 == before.sha256
    assert after.counters == {"frames": 5}
    assert stock_count(path) > 0
    assert healed.original == tmp_path / "r.mcap.damaged"
    assert healed.original.read_bytes() == data
    assert sorted(p.name for p in tmp_path.iterdir()) == ["r.mcap", "r.mcap.damaged"]


def test_a_complete_file_is_not_changed(tmp_path: Path) -> None:
    write_chunked(make_recording(300), tmp_path / "r.mcap").close({})
    before = (tmp_path / "r.mcap").read_bytes()
    assert recover_recording(tmp_path / "r.mcap").missing is None
    assert (tmp_path / "r.mcap").read_bytes() == before


def test_a_file_that_is_being_written_is_refused(tmp_path: Path) -> None:
    writer = write_chunked(make_recording(300), tmp_path / "r.mcap")
    with pytest.raises(ConfigError, match="is being written"):
        recover_recording(tmp_path / "r.mcap")
    writer.close({})
    assert recover_recording(tmp_path / "r.mcap").missing is None


def test_a_file_that_is_no_recording_is_refused_and_not_changed(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such recording"):
        recover_recording(tmp_path / "gone.mcap")
    for name, content in (("empty", b""), ("text", b"t,q1\n0,1\n"), ("begun", b"\x89MCAP0\r\n\x01")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError, match=name):
            recover_recording(tmp_path / name)
        assert (tmp_path / name).read_bytes() == content
    with (tmp_path / "other.mcap").open("wb") as file:
        other = Writer(file)
        other.start()
        other.register_channel("/x", "json", other.register_schema("x", "jsonschema", b"{}"))
        other.finish()
    with pytest.raises(DataError, match="not a recording of armident"):
        recover_recording(tmp_path / "other.mcap")


def test_the_command_prints_the_missing_parts(tmp_path: Path) -> None:
    data = torn(make_recording(1000), tmp_path / "r.mcap", 0.6)
    app = application(["recover"])
    shown = CliRunner().invoke(app, ["recover", str(tmp_path / "r.mcap")])
    assert shown.exit_code == 0
    last = read_recording(tmp_path / "r.mcap").samples.sync[-1]
    assert f"r.mcap: recovered: the file was not finished: rows after SYNC {last}" in shown.output
    again = CliRunner().invoke(app, ["recover", "--json", str(tmp_path / "r.mcap")])
    assert json.loads(again.output)[0]["missing"] is None
    assert len(data) > 0


WRITE_UNTIL_KILLED = """
import sys
from pathlib import Path
from tests.unit.daq.test_recording import make_recording
from armident.daq.recording import RecordingWriter, StreamLayout
recording = make_recording(20_000)
joints = [joint.name for joint in recording.robot.joints]
layouts = [StreamLayout.of(s, joints) for s in recording.streams.values()]
writer = RecordingWriter(Path(sys.argv[1]), recording.robot, None, 5000.0, layouts, {}, 20_000_000)
stream = recording.samples
print("writing", flush=True)
for first in range(0, 20_000, 20):
    part = slice(first, first + 20)
    writer.append("samples", stream.sync[part], stream.t_ns[part], {k: v[part] for k, v in stream.raw.items()})
    if first % 1000 == 0:
        print(first, flush=True)
"""


@pytest.mark.slow
def test_a_writer_killed_at_any_moment_leaves_a_recoverable_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    whole = make_recording(20_000).samples
    for k in range(3):
        path = tmp_path / f"{k}.mcap"
        command = [sys.executable, "-c", WRITE_UNTIL_KILLED, str(path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "writing\n"
            said = int(process.stdout.readline())
            time.sleep(float(rng.uniform(0.0, 0.05)))
            process.send_signal(signal.SIGKILL)
            rest = process.stdout.read().split()
        said = int(rest[-1]) if rest else said
        healed = recover_recording(path)
        kept = read_recording(path).samples
        assert healed.missing == read_recording(path).missing
        # A chunk has 100 rows: all rows reported as handed over are on the disk, except the unfinished chunk.
        assert kept.sync.size >= said - 101
        assert np.array_equal(kept.sync, whole.sync[: kept.sync.size])
        assert np.array_equal(kept.raw["position"], whole.raw["position"][: kept.sync.size])
        if healed.missing is not None:
            assert stock_count(path) == kept.sync.size
