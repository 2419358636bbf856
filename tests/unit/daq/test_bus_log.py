"""Conversion between logs of CAN tools and recordings."""

from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest
from typer.testing import CliRunner

from armident.configs import ConfigError, DataError, load_robot, load_session
from armident.daq.cli import application
from armident.daq.interchange.bus_log import recording_from_log, write_log
from armident.daq.interchange.readers import BusLog
from armident.daq.matching.streams import captured_streams
from armident.daq.recording import Recording, Stream, read_recording, write_recording

SESSION = load_session("tx40_cell.yaml")
ROBOT = load_robot(SESSION.robot)
PERIOD_NS = SESSION.sync.period_us * 1000
T0 = 1_700_000_000_000_000_000


def captured(rows: int = 3000, lost: slice = slice(0)) -> Recording:
    """Return a recording of the session's streams like that of a capture, without the ``lost`` SYNCs."""
    rng = np.random.default_rng(5)
    streams = {}
    for stream in captured_streams(SESSION, ROBOT):
        sync = np.arange(stream.layout.every - 1, rows, stream.layout.every, dtype=np.int64)
        sync = sync[~np.isin(sync, np.arange(rows)[lost])]
        raw = {
            f.name: rng.integers(np.iinfo(d).min, np.iinfo(d).max, (sync.size, ROBOT.n), endpoint=True, dtype=d)
            for f, d in zip(stream.layout.fields, stream.layout.dtypes, strict=True)
        }
        fields = {f.name: f for f in stream.layout.fields}
        streams[stream.bus.name] = Stream(
            stream.bus.name, stream.layout.every, sync, T0 + sync * PERIOD_NS, fields, raw
        )
    return Recording(None, ROBOT, SESSION, 1e9 / PERIOD_NS, streams)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", BusLog.suffixes)
def test_a_recording_survives_the_round_trip_through_every_log_format(tmp_path: Path, suffix: str) -> None:
    recording = captured()
    write_log(recording, tmp_path / f"bus{suffix}")

    read = recording_from_log(tmp_path / f"bus{suffix}", SESSION, ROBOT)

    assert read.sample_rate_hz == recording.sample_rate_hz
    assert not read.gaps
    for name, stream in recording.streams.items():
        found = read.streams[name]
        np.testing.assert_array_equal(found.sync, stream.sync)
        assert found.fields == stream.fields
        for field, values in stream.raw.items():
            np.testing.assert_array_equal(found.raw[field], values)
        steps = np.diff(found.t_ns) - np.diff(stream.t_ns)
        # Logs keep microseconds (candump, BLF) or tens of them (TRC: 0.1 ms with a decimal).
        assert np.abs(steps).max() <= 100_000
    assert [p.name for p in tmp_path.iterdir()] == [f"bus{suffix}"]


@pytest.mark.parametrize("counter", [SESSION.sync.counter, 0])
def test_without_a_counter_the_unknown_phase_of_slow_streams_is_said(tmp_path: Path, counter: int) -> None:
    session = SESSION.model_copy(update={"sync": SESSION.sync.model_copy(update={"counter": counter})})
    write_log(replace(captured(200), session=session), tmp_path / "bus.log")
    remarks = recording_from_log(tmp_path / "bus.log", session, ROBOT).metadata.get("source_remarks", "")
    assert ("demand: SYNC has no counter, so it is unknown which SYNCs are answered" in remarks) == (counter == 0)


@pytest.mark.slow
def test_a_sync_missing_from_the_log_is_a_gap(tmp_path: Path) -> None:
    write_log(captured(lost=slice(1000, 1030)), tmp_path / "bus.log")
    read = recording_from_log(tmp_path / "bus.log", SESSION, ROBOT)
    assert read.counters["samples.expected"] == 3000
    assert read.counters["samples.rows"] + read.counters["samples.in_gaps"] == 3000
    missing = {n for g in read.gaps if g.stream == "samples" for n in range(g.first, g.last + 1)}
    # The answers next to the gap may or may not belong to the SYNC before it.
    assert set(range(1000, 1030)) <= missing <= set(range(999, 1031))
    assert not missing & set(read.samples.sync.tolist())


def test_an_answer_missing_from_the_log_is_a_gap_of_its_joint(tmp_path: Path) -> None:
    write_log(captured(), tmp_path / "bus.log")
    lines = (tmp_path / "bus.log").read_text().splitlines()
    third = f" {captured_streams(SESSION, ROBOT)[0].bus.cob_ids[2]:03X}#"
    answers = [k for k, line in enumerate(lines) if third in line]
    del lines[answers[500]]
    (tmp_path / "bus.log").write_text("\n".join(lines) + "\n")
    read = recording_from_log(tmp_path / "bus.log", SESSION, ROBOT)
    assert read.counters["samples.expected"] == 3000
    gaps = [g for g in read.gaps if g.stream == "samples"]
    assert {g.joint for g in gaps} == {ROBOT.joints[2].name}
    assert any(g.first <= 500 <= g.last for g in gaps)


def test_the_bus_of_the_session_is_read_from_a_log_of_several_buses(tmp_path: Path) -> None:
    write_log(captured(200), tmp_path / "one.log")
    channel = SESSION.bus.channel
    other = (tmp_path / "one.log").read_text().replace(f" {channel} ", " can7 ")
    both = sorted((tmp_path / "one.log").read_text().splitlines() + other.splitlines())
    (tmp_path / "both.log").write_text("\n".join(both) + "\n")
    assert recording_from_log(tmp_path / "both.log", SESSION, ROBOT).samples.sync.size == 200
    elsewhere = SESSION.model_copy(update={"bus": SESSION.bus.model_copy(update={"channel": "can3"})})
    with pytest.raises(ConfigError, match=rf"both\.log: holds the buses .*{channel}.*; the session's is can3"):
        recording_from_log(tmp_path / "both.log", elsewhere, ROBOT)


def test_a_file_that_is_no_log_of_this_cell_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        recording_from_log(tmp_path / "gone.log", SESSION, ROBOT)
    for suffix in (".log", ".blf", ".asc"):
        (tmp_path / f"text{suffix}").write_bytes(b"t,q1\n0,1\n\xff\xfe")
        with pytest.raises(DataError, match="text"):
            recording_from_log(tmp_path / f"text{suffix}", SESSION, ROBOT)
    with can.Logger(tmp_path / "silent.log") as logger:
        logger.on_message_received(can.Message(1.0, 0x123, False, data=b"\1"))
    with pytest.raises(DataError, match=r"no SYNC \(80h\) among its 1 frames"):
        recording_from_log(tmp_path / "silent.log", SESSION, ROBOT)
    with can.Logger(tmp_path / "lonely.log") as logger:
        for k in range(500):
            logger.on_message_received(can.Message(k * 2e-4, 0x80, False, data=bytes([k % 240 + 1])))
    with pytest.raises(DataError, match="answered by all drives; the session expects TPDOs 181h"):
        recording_from_log(tmp_path / "lonely.log", SESSION, ROBOT)
    imported = replace(captured(50), session=None)
    with pytest.raises(DataError, match="not captured from a bus"):
        write_log(imported, tmp_path / "never.log")
    assert not (tmp_path / "never.log").exists()


def test_the_import_and_export_commands_accept_logs(tmp_path: Path) -> None:
    write_recording(captured(400), tmp_path / "a.mcap")
    run = CliRunner().invoke
    out = run(application(["export"]), ["export", str(tmp_path / "a.mcap"), "--out", str(tmp_path / "a.blf")])
    assert out.exit_code == 0, out.output
    back = ["import", str(tmp_path / "a.blf"), "--config", "tx40_cell.yaml", "--out", str(tmp_path / "b.mcap")]
    out = run(application(["import"]), back)
    assert out.exit_code == 0, out.output
    assert "400 samples at 5000 Hz, 0 in gaps" in out.output
    assert read_recording(tmp_path / "a.mcap").sha256 == read_recording(tmp_path / "b.mcap").sha256
    assert run(application(["import"]), [*back, "--rate", "5"]).exit_code == 2


@pytest.mark.slow
def test_a_recording_of_several_buses_survives_the_round_trip_through_one_log(tmp_path: Path) -> None:
    session = load_session("tx40_six_buses.yaml")
    one = captured()
    samples = one.streams["samples"]
    kept = {"position": samples.raw["position"], "current": samples.raw["current"]}
    layout = captured_streams(session, ROBOT)[0].layout
    stream = replace(samples, fields={f.name: f for f in layout.fields}, raw=kept)
    recording = replace(one, session=session, streams={"samples": stream})
    write_log(recording, tmp_path / "buses.log")

    read = recording_from_log(tmp_path / "buses.log", session, ROBOT)

    assert not read.gaps
    np.testing.assert_array_equal(read.samples.sync, samples.sync)
    for field, values in kept.items():
        np.testing.assert_array_equal(read.samples.raw[field], values)
    renamed = tuple(bus.model_copy(update={"channel": f"can{k}"}) for k, bus in enumerate(session.all_buses))
    drives = tuple(d.model_copy(update={"bus": f"can{k}"}) for k, d in enumerate(session.drives))
    with pytest.raises(ConfigError, match="the session's is can0"):
        recording_from_log(
            tmp_path / "buses.log", session.model_copy(update={"buses": renamed, "drives": drives}), ROBOT
        )


def test_logs_are_refused_for_a_session_on_can_fd(tmp_path: Path) -> None:
    session = load_session("tx40_two_fd.yaml")
    with pytest.raises(ConfigError, match="CAN FD"):
        write_log(replace(captured(), session=session), tmp_path / "bus.log")
    assert not list(tmp_path.iterdir())
