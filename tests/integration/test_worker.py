"""The worker hears a capture on Zenoh and identifies it as `armident identify` does its file."""

import json
import os
import queue
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zenoh

from armident.configs import SessionConfig, load_session
from armident.daq.capture.publisher import Publisher
from armident.daq.recording import Recording, StreamLayout, read_recording, write_recording
from armident.daq.streaming import Block, Keys, encode_event, open_session
from armident.daq.streaming.codec import end_content, start_content
from armident.identify.documents.files import from_json, load_document
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.worker.worker import Worker
from tests.fixtures import arms
from tests.fixtures.signed import put_signed

pytestmark = pytest.mark.slow

BLOCK_ROWS = 500
LONGEST_S = 240.0


def in_its_file(robot: str, folder: Path) -> Recording:
    """A recording of a virtual arm at 1 kHz as capture would have left it, in its file."""
    recording = arms.recording(robot, f"{robot}_excitation", 1, period=arms.FAST if robot == "tx40" else None)
    rows = {f"{name}.rows": int(s.sync.size) for name, s in recording.streams.items()}
    path = folder / f"{robot}-test.mcap"
    write_recording(replace(recording, session=load_session(f"{robot}_cell.yaml"), counters=rows), path)
    return read_recording(path)


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A recording of the virtual axis, which is quickly identified."""
    return in_its_file("emps", tmp_path_factory.mktemp("recordings"))


def in_a_cell(robot: str, name: str, options: dict[str, str]) -> SessionConfig:
    """A cell of its own, so that tests beside each other do not hear each other."""
    return load_session(f"{robot}_cell.yaml").model_copy(
        update={"cell": f"test_{os.getpid()}_{abs(hash(name)) % 10**6}", "identification": options}
    )


@pytest.fixture
def session(request: pytest.FixtureRequest, tmp_path: Path) -> SessionConfig:
    """A cell for one test, which may read the files in the folders of all tests."""
    session = in_a_cell("emps", request.node.name, {"method": "idim-ls"})
    return session.model_copy(update={"recording": session.recording.model_copy(update={"directory": tmp_path.parent})})


def blocks_of(recording: Recording) -> Iterator[Block]:
    joints = [joint.name for joint in recording.robot.joints]
    sequence = 0
    for stream in recording.streams.values():
        layout = StreamLayout.of(stream, joints)
        for first in range(0, stream.sync.size, BLOCK_ROWS):
            rows = slice(first, first + BLOCK_ROWS)
            raw = {name: values[rows] for name, values in stream.raw.items()}
            yield Block(layout, sequence, stream.sync[rows], stream.t_ns[rows], raw, "c1")
            sequence += 1


def publish(
    recording: Recording, session: SessionConfig, *, leave_out: int | None = None, path: Path | None = None
) -> None:
    """Say on Zenoh what a capture of this recording says."""
    joints = [joint.name for joint in recording.robot.joints]
    layouts = [StreamLayout.of(stream, joints) for stream in recording.streams.values()]
    publisher = Publisher(session, Keys(session.cell, recording.robot.name))
    start = start_content("c1", recording.robot, session, recording.sample_rate_hz, layouts, {})
    publisher.event(encode_event("experiment_start", start))
    made = list(blocks_of(recording))
    for block in made:
        if block.sequence != leave_out:
            publisher.offer(block)
    assert path or recording.path
    file = path or recording.path
    assert file is not None
    end = end_content("c1", len(made), recording.counters, recording.gaps, recording.marks, [file])
    publisher.event(encode_event("experiment_end", end))
    publisher.close()


def answers(session: SessionConfig, key: str) -> list[zenoh.Reply]:
    """Replies to a query, asked again until the observer has found the worker."""
    with open_session(session, "observer") as observer:
        until = time.monotonic() + 10.0
        while not (replies := list(observer.get(key))) and time.monotonic() < until:
            time.sleep(0.1)
    return replies


def test_stream_and_file_give_the_same_numbers_to_the_last_bit(tmp_path: Path) -> None:
    """Six joints and the method that needs the set points."""
    captured = in_its_file("tx40", tmp_path)
    session = in_a_cell("tx40", "bits", {})
    with Worker(session, captured.robot, tmp_path) as worker:
        publish(captured, session)
        assert worker.result(LONGEST_S) == 0
        replies = answers(session, Keys(session.cell, "tx40").identification)
    streamed = load_document(tmp_path / "tx40-test.identification" / "identification.json", IdentificationDocument)
    outcome = arms.identified("tx40", "tx40_excitation", 1, period=arms.FAST)
    assert streamed.recording.sha256 == outcome.document.recording.sha256
    assert streamed.parameters == outcome.document.parameters
    assert streamed.covariance == outcome.document.covariance
    assert (tmp_path / "tx40-test.identification" / "report.html").stat().st_size > 10_000
    assert replies[0].ok is not None
    answered = from_json(bytes(replies[0].ok.payload).decode(), IdentificationDocument, "answer")
    assert answered.parameters == streamed.parameters


def test_an_unusable_result_is_published_with_its_verdict_and_ends_with_exit_code_3(
    captured: Recording, session: SessionConfig, tmp_path: Path
) -> None:
    samples = captured.samples
    name = samples.named("voltage")
    assert name is not None
    turned = replace(samples.fields[name], scale=tuple(-scale for scale in samples.fields[name].scale))
    wrong = replace(captured, streams={"samples": replace(samples, fields={**samples.fields, name: turned})})
    write_recording(wrong, tmp_path / "emps-turned.mcap")
    with Worker(session, captured.robot, tmp_path) as worker:
        publish(wrong, session, path=tmp_path / "emps-turned.mcap")
        assert worker.result(LONGEST_S) == 3
        key = Keys(session.cell, "emps").identification
        replies = answers(session, key)
        (away,) = answers(session, f"{key}?since=2020-01-01T00:00:00Z")
        (heard,) = answers(session, f"{key}?since={wrong.sha256}")
        (misspelt,) = answers(session, f"{key}?since=yesterday")
    assert away.ok is not None
    (missed,) = json.loads(bytes(away.ok.payload))["results"]
    assert (missed["sha256"], missed["state"], missed["message"]) == (wrong.sha256, "done", "unusable")
    assert missed["document"]["verdict"] == "unusable"
    assert heard.ok is not None
    assert json.loads(bytes(heard.ok.payload)) == {"results": [], "more": False}
    assert misspelt.err is not None
    assert b"since=yesterday: expected a time" in bytes(misspelt.err.payload)
    assert replies[0].ok is not None
    published = from_json(bytes(replies[0].ok.payload).decode(), IdentificationDocument, "answer")
    assert published.verdict == "unusable"
    assert published.reasons[0].next_step


def test_a_capture_too_long_for_the_memory_is_read_from_its_file(
    captured: Recording,
    session: SessionConfig,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(
        "armident.identify.monitoring.worker.stream_buffer.MOST_BYTES", 10 * next(blocks_of(captured)).nbytes
    )
    with Worker(session, captured.robot, tmp_path) as worker:
        publish(captured, session)
        assert worker.result(LONGEST_S) == 0
    assert "samples from the file, identifying" in capfd.readouterr().out
    document = load_document(tmp_path / "emps-test.identification" / "identification.json", IdentificationDocument)
    assert document.recording.sha256 == captured.sha256


def test_invalid_messages_are_logged_once_and_then_at_powers_of_ten(
    captured: Recording, session: SessionConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    keys = Keys(session.cell, captured.robot.name)
    with Worker(session, captured.robot, tmp_path) as worker, open_session(session, "observer") as observer:
        until = time.monotonic() + 10.0
        while "(10 times)" not in caplog.text and time.monotonic() < until:
            for _ in range(5):
                put_signed(observer, session, keys.samples, b"no block")
            time.sleep(0.1)
        publish(captured, session)
        assert worker.result(LONGEST_S) == 0
    refused = [r.getMessage() for r in caplog.records if "block" in r.getMessage()]
    assert len(refused) == sum("times)" in line for line in refused) + 1
    assert "(10 times)" in caplog.text


def test_a_block_that_never_comes_is_fetched_from_the_file(
    captured: Recording, session: SessionConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("armident.identify.monitoring.worker.stream_buffer.MAX_WAITING_S", 1.0)
    with Worker(session, captured.robot, tmp_path) as worker:
        publish(captured, session, leave_out=3)
        assert worker.result(LONGEST_S) == 0
    document = load_document(tmp_path / "emps-test.identification" / "identification.json", IdentificationDocument)
    assert document.recording.sha256 == captured.sha256


def test_missing_blocks_without_a_file_end_with_exit_code_3_and_say_how_many(
    captured: Recording,
    session: SessionConfig,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr("armident.identify.monitoring.worker.stream_buffer.MAX_WAITING_S", 1.0)
    with Worker(session, captured.robot, tmp_path) as worker:
        publish(captured, session, leave_out=3, path=tmp_path / "gone.mcap")
        assert worker.result(LONGEST_S) == 3
    assert "1 of " in caplog.text
    assert list(tmp_path.glob("*.identification")) == []


def test_payloads_that_are_not_ours_do_no_harm(captured: Recording, session: SessionConfig, tmp_path: Path) -> None:
    keys = Keys(session.cell, "emps")
    with Worker(session, captured.robot, tmp_path) as worker:
        with open_session(session, "capture") as stranger:
            for junk in (b"", b"ARMB", np.random.default_rng(0).bytes(1000), b"{}"):
                put_signed(stranger, session, keys.samples, junk)
                put_signed(stranger, session, keys.events, junk)
        assert worker.result(1.0) is None
        publish(captured, session, leave_out=0, path=tmp_path / "gone.mcap")


def test_status_tells_what_the_worker_does(captured: Recording, session: SessionConfig, tmp_path: Path) -> None:
    heard: queue.Queue[dict[str, object]] = queue.Queue()

    def listen(sample: zenoh.Sample) -> None:
        heard.put(json.loads(bytes(sample.payload)))

    with Worker(session, captured.robot, tmp_path) as worker, open_session(session, "observer") as observer:
        observer.declare_subscriber(Keys(session.cell, "emps").status, listen)
        until = time.monotonic() + 10.0
        while not (tokens := list(observer.liveliness().get(Keys(session.cell, "emps").alive("*")))):
            assert time.monotonic() < until, "the worker's token was never seen"
            time.sleep(0.1)
        assert [str(t.ok.key_expr).rsplit("/", 1)[-1] for t in tokens if t.ok] == ["worker"]
        publish(captured, session)
        assert worker.result(LONGEST_S) == 0
        states: list[object] = []
        while not states or states[-1] != "done":  # the last word may be under way when the worker has returned
            message = heard.get(timeout=10.0)
            if message.get("component") == "worker":
                states.append(message["state"])
    assert "identifying" in states


def test_a_signal_at_the_end_of_the_timeout_does_not_stop_the_wait(
    session: SessionConfig, captured: Recording, tmp_path: Path
) -> None:
    began, worker = time.monotonic(), Worker(session, captured.robot, tmp_path)

    def late(_signal: int, _frame: object) -> None:
        time.sleep(0.005)
        if time.monotonic() > began + 5.0:
            raise TimeoutError("a wait of 2 ms does not end")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, 0.01, 0.0107)
    try:
        while time.monotonic() < began + 1.0:
            assert worker.result(timeout=0.002) is None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def test_sigterm_ends_a_waiting_worker_cleanly(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "armident.daq.cli",
        "worker",
        "--config",
        "tx40_replay.yaml",
        "--out",
        str(tmp_path),
    ]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(30)
        environment = os.environ | {"NOTIFY_SOCKET": str(tmp_path / "notify")}
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
        try:
            assert process.stdout is not None
            assert process.stdout.readline().strip() == "worker: ready"
            states = {manager.recv(200).decode().partition("STATUS=")[::2] for _ in range(3)}
            assert {state for state, _ in states} == {"READY=1\n", "WATCHDOG=1\n"}
            process.send_signal(signal.SIGTERM)
            assert process.wait(30) == 0
            while (last := manager.recv(200).decode()).startswith("WATCHDOG=1"):
                pass
            assert last == "STOPPING=1"
        finally:
            process.kill()
            process.communicate()
