"""Worker that was absent, is one of two, meets a full disk, strangers on its keys, or a clock that stepped back."""

import errno
import json
import os
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armident.configs import SessionConfig
from armident.daq.recording import Recording, RecordingWriter, StreamLayout, read_recording, write_recording
from armident.daq.streaming import Keys, encode_block, encode_event, open_session
from armident.daq.streaming.codec import end_content, start_content
from armident.identify.documents.files import load_document
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.identification.identify_recording import identify_recording
from armident.identify.monitoring.worker import worker as module
from armident.identify.monitoring.worker.ledger import FILE, Ledger
from armident.identify.monitoring.worker.recorded import Captured
from armident.identify.monitoring.worker.stream_buffer import (
    LARGEST_BLOCK,
    MOST_CAPTURES,
    MOST_STREAMS,
    StreamBuffer,
    drop_oldest,
)
from armident.identify.monitoring.worker.worker import Worker
from armident.identify.report.robot_file import write_identification
from tests.fixtures import arms
from tests.fixtures.signed import put_signed
from tests.integration.test_worker import LONGEST_S, in_a_cell, publish
from tests.unit.daq.test_streaming import blocks, events

pytestmark = pytest.mark.slow


@pytest.fixture
def session(request: pytest.FixtureRequest, tmp_path: Path) -> SessionConfig:
    """A cell whose recordings are in the folder of the test."""
    session = in_a_cell("emps", request.node.name, {"method": "idim-ls"})
    recording = session.recording.model_copy(update={"directory": tmp_path})
    return session.model_copy(update={"recording": recording})


def recorded(session: SessionConfig, name: str, seed: int = 1) -> Recording:
    """A recording of the cell in its file."""
    path = session.recording.directory / f"emps-{name}.mcap"
    write_recording(replace(arms.recording("emps", "emps_excitation", seed), session=session), path)
    return read_recording(path)


def states(folder: Path) -> dict[str, tuple[str, bool]]:
    return {entry.name: (entry.state, entry.announced) for entry in Ledger(folder / FILE, "test").entries()}


def test_recordings_of_the_time_without_a_worker_are_identified_once(session: SessionConfig, tmp_path: Path) -> None:
    first, second = recorded(session, "a", 1), recorded(session, "b", 2)
    recorded(session.model_copy(update={"cell": "other"}), "c", 3)
    with Worker(session, first.robot, tmp_path) as worker:
        assert [worker.result(LONGEST_S), worker.result(LONGEST_S)] == [0, 0]
    expected = {"emps-a": ("done", True), "emps-b": ("done", True), "emps-c": ("passed", True)}
    assert states(tmp_path) == expected
    written = tmp_path / "emps-b.identification" / "identification.json"
    assert load_document(written, IdentificationDocument).recording.sha256 == second.sha256
    before = written.stat().st_mtime_ns
    with Worker(session, first.robot, tmp_path) as worker:
        assert worker.result(8.0) is None
    assert written.stat().st_mtime_ns == before
    # Without its ledger a worker still finds its results.
    for path in tmp_path.glob("worker.sqlite*"):
        path.unlink()
    with Worker(session, first.robot, tmp_path) as worker:
        assert worker.result(8.0) is None
    assert states(tmp_path) == expected


def test_files_that_cannot_be_read_do_not_hold_up_others(
    session: SessionConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    made = recorded(session, "a", 1)
    for seed, name in enumerate("bc", start=2):
        recorded(session, name, seed)
    read = Captured.read
    errors = {"emps-a": OSError(errno.EIO, os.strerror(errno.EIO)), "emps-b": RuntimeError("unforeseen")}

    def refused(captured: Captured) -> Recording:
        if captured.name in errors:
            raise errors[captured.name]
        return read(captured)

    monkeypatch.setattr(Captured, "read", refused)
    with Worker(session, made.robot, tmp_path) as worker:
        assert {worker.result(LONGEST_S), worker.result(LONGEST_S)} == {0, 1}
    found = states(tmp_path)
    assert found.pop("emps-a") in {("passed", True), ("waiting", False)}
    assert found == {"emps-b": ("failed", True), "emps-c": ("done", True)}
    assert "emps-a: Input/output error; trying again" in caplog.text
    assert f"emps-b: internal error of armident {module.VERSION} (RuntimeError: unforeseen)" in caplog.text


def test_two_workers_share_the_recordings(session: SessionConfig, tmp_path: Path) -> None:
    made = [recorded(session, name, seed) for seed, name in enumerate("abcd", start=1)]
    with Worker(session, made[0].robot, tmp_path) as one, Worker(session, made[0].robot, tmp_path) as other:
        done = {one: 0, other: 0}
        until = time.monotonic() + LONGEST_S
        while sum(done.values()) < 4 and time.monotonic() < until:
            for each in done:
                done[each] += each.result(0.1) is not None
        assert sum(done.values()) == 4
        assert one.result(2.0) is other.result(0.1) is None
    assert all(state == ("done", True) for state in states(tmp_path).values())


def test_a_full_disk_is_reported_and_the_result_written_when_there_is_space(
    session: SessionConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    refusals = [2]

    def refused(*arguments: Any) -> Any:
        if refusals[0]:
            refusals[0] -= 1
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write_identification(*arguments)

    monkeypatch.setattr(module, "write_identification", refused)
    monkeypatch.setattr(module, "RETRY_S", 0.1)
    made = recorded(session, "a")
    with Worker(session, made.robot, tmp_path) as worker:
        assert worker.result(LONGEST_S) == 0
    assert caplog.text.count("result: No space left on device; trying again") == 1
    assert states(tmp_path) == {"emps-a": ("done", True)}


def test_a_folder_of_a_result_that_refuses_it_holds_up_no_other(session: SessionConfig, tmp_path: Path) -> None:
    made = recorded(session, "b", 1)
    recorded(session, "$(c) [x]", 2)
    (tmp_path / "emps-$(c) [x].identification").touch()
    os.utime(tmp_path / "emps-b.mcap", (0.0, 0.0))
    with Worker(session, made.robot, tmp_path) as worker:
        # A failure that is announced later, as Zenoh is not there yet, has the code of all failures.
        assert [worker.result(LONGEST_S), worker.result(LONGEST_S)] in ([2, 0], [3, 0], [0, 3])
        entry = next(each for each in Ledger(tmp_path / FILE, "test").entries() if each.state == "failed")
        assert (entry.message or "").endswith("then: armident queue retry 'emps-$(c) [x]'")
        (tmp_path / "emps-$(c) [x].identification").unlink()
        assert Ledger(tmp_path / FILE, "test").change("retry", [entry.name]) == [entry.name]
        assert worker.result(LONGEST_S) == 0
    assert states(tmp_path) == {"emps-b": ("done", True), "emps-$(c) [x]": ("done", True)}


@pytest.mark.parametrize("change", ["cut", "signature", "other", "folder"])
def test_a_result_that_is_damaged_before_its_announcement_holds_up_no_other(
    session: SessionConfig, tmp_path: Path, change: str
) -> None:
    made = recorded(session, "a", 1)
    with Worker(session, made.robot, tmp_path) as worker:
        assert worker.result(LONGEST_S) == 0
    file, ledger = tmp_path / "emps-a.identification" / "identification.json", Ledger(tmp_path / FILE, "test")
    with ledger._transaction() as db:
        # As if Zenoh had been away until now.
        db.execute("UPDATE experiments SET announced = 0")
    text = file.read_text()
    if change == "folder":
        file.unlink()
        file.mkdir()
    else:
        other = json.loads(text) | {"signature": {"certificate": "", "value": ""}}
        file.write_text(
            {"cut": text[:1000], "signature": json.dumps(other), "other": text.replace(made.sha256, "0" * 64)}[change]
        )
    recorded(session, "b", 2)
    with Worker(session, made.robot, tmp_path) as worker:
        assert [worker.result(LONGEST_S), worker.result(LONGEST_S)] == [0, 0]
    assert states(tmp_path) == {"emps-a": ("done", True), "emps-b": ("done", True)}


def test_the_watchdog_is_fed_while_the_work_advances_and_not_while_it_hangs(
    session: SessionConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hanging, released = threading.Event(), threading.Event()

    def identified(*arguments: Any) -> Any:
        hanging.set()
        released.wait(LONGEST_S)
        return identify_recording(*arguments)

    monkeypatch.setattr(module, "identify_recording", identified)
    monkeypatch.setattr(module, "LONGEST_STAGE_S", 3.0)
    fed: list[str] = []
    made = recorded(session, "a")
    with Worker(session, made.robot, tmp_path, fed.append) as worker:
        assert hanging.wait(LONGEST_S)
        time.sleep(4.5)
        before = len(fed)
        assert fed[-1] == "identifying emps-a"
        time.sleep(2.5)
        assert len(fed) == before
        released.set()
        assert worker.result(LONGEST_S) == 0
        until = time.monotonic() + 10.0
        while fed[-1] != "waiting":
            assert time.monotonic() < until
            time.sleep(0.1)


def test_the_file_counts_where_the_stream_differs(
    session: SessionConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    made = recorded(session, "a")
    raw = {name: values.copy() for name, values in made.samples.raw.items()}
    raw["position"][7] += 1
    other = replace(made, streams={**made.streams, "samples": replace(made.samples, raw=raw)})
    with Worker(session, made.robot, tmp_path) as worker:
        publish(other, session, path=made.path)
        assert worker.result(LONGEST_S) == 0
        until = time.monotonic() + 10.0
        while "the stream has other samples than the file" not in caplog.text:
            assert time.monotonic() < until
            time.sleep(0.1)
    (entry,) = Ledger(tmp_path / FILE, "test").entries()
    assert entry.sha256 == made.sha256


def test_an_end_that_a_stranger_announces_does_not_end_a_capture(
    session: SessionConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    made = arms.recording("emps", "emps_excitation", 1)
    joints = [joint.name for joint in made.robot.joints]
    layouts = [StreamLayout.of(stream, joints) for stream in made.streams.values()]
    path = tmp_path / "emps-x.mcap"
    keys = Keys(session.cell, "emps")
    writer = RecordingWriter(path, made.robot, session, made.sample_rate_hz, layouts, {"cell": session.cell})
    with Worker(session, made.robot, tmp_path) as worker, open_session(session, "observer") as stranger:
        start = start_content("x", made.robot, session, made.sample_rate_hz, layouts, {})
        end = end_content("x", 0, {}, (), (), [path])
        until = time.monotonic() + 10.0
        while "its file is being written" not in caplog.text:
            assert time.monotonic() < until
            put_signed(stranger, session, keys.events, encode_event("experiment_start", start))
            put_signed(stranger, session, keys.events, encode_event("experiment_end", end))
            stranger.put(keys.samples, np.random.default_rng(0).bytes(2_000_000))
            time.sleep(0.2)
        assert worker.result(0.5) is None
        for stream in made.streams.values():
            writer.append(stream.name, stream.sync, stream.t_ns, stream.raw)
        writer.add_marks(made.marks)
        writer.close({})
        assert worker.result(LONGEST_S) == 0
    assert states(tmp_path) == {"emps-x": ("done", True)}


class TestStreamBuffer:
    """Bounds on what strangers publish."""

    def test_captures_and_early_blocks_are_bounded_and_reported(
        self, session: SessionConfig, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("armident.identify.monitoring.worker.stream_buffer.MOST_EARLY_BYTES", 20_000)
        buffer = StreamBuffer()
        for k in range(5 * MOST_CAPTURES):
            for block in blocks(20):
                buffer.take_block(encode_block(replace(block, capture=f"c{k}")), 1)
        assert buffer.nbytes <= 20_000
        assert "which nobody announced, fill the memory" in caplog.text
        start, _ = events(session, 1)
        for k in range(5 * MOST_CAPTURES):
            event = {key: value for key, value in start.items() if key not in ("schema", "kind")}
            buffer.take_event(encode_event("experiment_start", event | {"capture": f"s{k}"}), 1)
        assert f"more than {MOST_CAPTURES} captures at once" in caplog.text
        buffer.take_block(None, LARGEST_BLOCK + 1)
        assert f"a block of {LARGEST_BLOCK + 1} bytes, more than {LARGEST_BLOCK}" in caplog.text

    def test_blocks_without_rows_fill_the_memory_too(
        self, session: SessionConfig, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("armident.identify.monitoring.worker.stream_buffer.MOST_EARLY_BYTES", 100_000)
        buffer = StreamBuffer()
        block = next(iter(blocks(1)))
        none = np.empty(0, np.int64)
        raw = {name: values[:0] for name, values in block.raw.items()}
        for k in range(200):
            buffer.take_block(encode_block(replace(block, sequence=k, sync=none, t_ns=none, raw=raw)), 1)
        assert 50_000 < buffer.nbytes <= 100_000
        assert "which nobody announced, fill the memory" in caplog.text

    def test_made_up_names_do_not_displace_a_capture_under_way(self, session: SessionConfig) -> None:
        buffer = StreamBuffer()
        start, end = (json.loads(json.dumps(event)) for event in events(session, 4))
        sent = list(blocks(2))
        buffer.take_event(json.dumps(start).encode(), 1)
        buffer.take_block(encode_block(sent[0]), 1)
        for k in range(5 * MOST_CAPTURES):
            buffer.take_event(json.dumps(start | {"capture": f"made_up_{k}"}).encode(), 1)
        for block in sent[1:]:
            buffer.take_block(encode_block(block), 1)
        buffer.take_event(json.dumps(end).encode(), 1)
        (ended,) = buffer.take_ended()
        assert ended.capture == start["capture"]
        assert ended.complete

    def test_streams_that_wait_are_bounded_in_number_and_memory(self, monkeypatch: pytest.MonkeyPatch) -> None:
        made = arms.recording("emps", "emps_excitation", 1)
        waiting = {f"{k}": made for k in range(MOST_STREAMS + 3)}
        drop_oldest(waiting)
        assert list(waiting) == [f"{k}" for k in range(3, MOST_STREAMS + 3)]
        monkeypatch.setattr("armident.identify.monitoring.worker.stream_buffer.MOST_BYTES", 1)
        drop_oldest(waiting)
        assert list(waiting) == [f"{MOST_STREAMS + 2}"]

    def test_blocks_belong_to_a_capture_by_name_not_by_time(self, session: SessionConfig) -> None:
        """The second capture is before the first by the clock."""
        buffer = StreamBuffer()
        for name, shift in (("c1", 0), ("c2", -(10**15))):
            start, end = (json.loads(json.dumps(event)) for event in events(session, 4))
            for event in (start, end):
                event["capture"] = name
            buffer.take_event(json.dumps(start).encode(), 1)
            for block in blocks(2):
                buffer.take_block(encode_block(replace(block, capture=name, t_ns=block.t_ns + shift)), 1)
            buffer.take_event(json.dumps(end).encode(), 1)
            (ended,) = buffer.take_ended()
            assert ended.complete
            assert ended.capture == name
