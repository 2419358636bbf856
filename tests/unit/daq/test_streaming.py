"""Zenoh interface: published captures equal their files, and malformed data is refused with a description."""

import json
import socket
import struct
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh.ext
from hypothesis import given
from hypothesis import strategies as st

from armident.configs import ConfigError, DataError, SessionConfig, config_path, load_robot
from armident.configs.loading import HERE, parse
from armident.daq.capture.publisher import Publisher
from armident.daq.recording import Field, Gap, Mark, StreamLayout, read_recording, write_recording
from armident.daq.streaming import (
    Block,
    Keys,
    assemble,
    decode_block,
    decode_event,
    encode_block,
    encode_event,
    open_session,
)
from armident.daq.streaming.codec import VERSION, end_content, start_content
from armident.daq.streaming.zenoh_session import configuration, endpoints

ROBOT = load_robot("tx40.yaml")
JOINTS = tuple(joint.name for joint in ROBOT.joints)
ONE = (1.0,) * ROBOT.n
SAMPLES = StreamLayout(
    "samples",
    1,
    JOINTS,
    (Field("position", "position", "rad", "motor", ONE), Field("current", "current", "A", "motor", ONE)),
    ("int32", "int16"),
)
DEMAND = StreamLayout("demand", 5, JOINTS, (Field("demand", "demand", "rad", "motor", ONE),), ("int32",))


def cell(name: str, **zenoh_options: Any) -> SessionConfig:
    session = parse(config_path("tx40_cell.yaml").read_text(), SessionConfig, "tx40_cell.yaml")
    options = session.zenoh.model_copy(update=zenoh_options)
    return session.model_copy(update={"cell": name, "zenoh": options})


def blocks(count: int, rows: int = 50) -> list[Block]:
    rng = np.random.default_rng(5)
    made = []
    for k in range(count):
        sync = np.arange(k * rows, (k + 1) * rows, dtype=np.int64)
        position = rng.integers(-(2**31), 2**31, (rows, ROBOT.n)).astype(np.int32)
        current = rng.integers(-(2**15), 2**15, (rows, ROBOT.n)).astype(np.int16)
        raw: dict[str, Any] = {"position": position, "current": current}
        made.append(Block(SAMPLES, 2 * k, sync, sync * 200_000, raw, "c1"))
        fifth = sync[4::5]
        made.append(Block(DEMAND, 2 * k + 1, fifth, fifth * 200_000, {"demand": position[4::5]}, "c1"))
    return made


def events(session: SessionConfig, total: int) -> tuple[dict[str, Any], dict[str, Any]]:
    start = start_content("c1", ROBOT, session, 5000.0, [SAMPLES, DEMAND], {"host": "x"})
    gaps, marks = [Gap("samples", 3, 4)], [Mark("experiment_start", 5, 9)]
    end = end_content("c1", total, {"samples.rows": 50}, gaps, marks, [Path("x.mcap")])
    return decode_event(encode_event("experiment_start", start)), decode_event(encode_event("experiment_end", end))


def test_a_block_is_decoded_to_the_last_bit() -> None:
    for block in blocks(2):
        got = decode_block(encode_block(block))
        assert (got.capture, got.layout, got.sequence) == ("c1", block.layout, block.sequence)
        assert np.array_equal(got.sync, block.sync)
        assert np.array_equal(got.t_ns, block.t_ns)
        for name, values in block.raw.items():
            assert got.raw[name].dtype == values.dtype
            assert np.array_equal(got.raw[name], values)


@given(st.binary(max_size=300))
def test_bytes_that_are_no_block_are_refused(data: bytes) -> None:
    with pytest.raises(DataError):
        decode_block(data)
    with pytest.raises(DataError):
        decode_event(data)


@given(st.data())
def test_a_damaged_block_is_refused(data: st.DataObject) -> None:
    good = bytearray(encode_block(blocks(1)[0]))
    place = data.draw(st.integers(0, len(good) - 1))
    good[place] ^= data.draw(st.integers(1, 255))
    with pytest.raises(DataError):
        decode_block(bytes(good))
    with pytest.raises(DataError):
        decode_block(bytes(good[:place]))


@pytest.mark.parametrize(
    "change",
    [
        {"rows": -1},
        {"rows": 2**40},
        {"rows": 49},
        {"rows": "x"},
        {"layout": {}},
        {"layout": None},
        {"sequence": None},
        {"capture": None},
        {"capture": "../x"},
    ],
)
def test_a_block_with_an_inconsistent_head_is_refused(change: dict[str, Any]) -> None:
    data = encode_block(blocks(1)[0])
    size = struct.unpack_from("<I", data, 6)[0]
    head = json.dumps(json.loads(data[14 : 14 + size]) | change).encode()
    body = head + data[14 + size :]
    with pytest.raises(DataError):
        decode_block(struct.pack("<4sHII", b"ARMB", VERSION, len(head), zlib.crc32(body)) + body)


def test_the_stream_and_the_file_are_the_same_recording(tmp_path: Path) -> None:
    made = blocks(20)
    shuffled = [made[k] for k in np.random.default_rng(0).permutation(len(made))] + made[:3]
    recording = assemble(
        *((e := events(cell("a"), len(made)))[0], [decode_block(encode_block(b)) for b in shuffled], e[1])
    )
    write_recording(recording, tmp_path / "x.mcap")
    read = read_recording(tmp_path / "x.mcap")
    assert recording.missing is None
    assert read.sha256 == recording.sha256
    assert (read.gaps, read.marks, read.counters) == (recording.gaps, recording.marks, recording.counters)


def test_missing_blocks_are_reported() -> None:
    made = blocks(4)
    start, end = events(cell("a"), len(made))
    assert assemble(start, made[:-2], end).missing == "2 of 8 blocks did not arrive"


@pytest.mark.parametrize("name", ["../../etc/x", "/tmp/x", "", ".x", "a/b", "a\x00b", 5, "x" * 300])
def test_a_capture_name_that_is_no_file_name_is_refused(name: object) -> None:
    start, end = events(cell("a"), 1)
    for event in (start, end):
        with pytest.raises(DataError, match="capture"):
            decode_event(json.dumps(event | {"capture": name}).encode())


@pytest.mark.parametrize("lacking", ["blocks", "counters", "gaps", "marks", "paths", "capture"])
def test_an_incomplete_end_event_is_refused(lacking: str) -> None:
    _, end = events(cell("a"), 1)
    with pytest.raises(DataError, match=f"experiment_end whose '{lacking}' is missing"):
        decode_event(json.dumps({key: value for key, value in end.items() if key != lacking}).encode())


def test_blocks_of_another_capture_are_refused() -> None:
    start, end = events(cell("a"), 1)
    with pytest.raises(DataError, match="different captures"):
        assemble(start, [], end | {"capture": "c2"})


def test_a_late_subscriber_gets_all_blocks() -> None:
    session = cell("late_listener")
    keys = Keys(session.cell, "tx40")
    made = blocks(50)
    publisher = Publisher(session, keys)
    for block in made[:60]:
        publisher.offer(block)
    time.sleep(0.3)
    got: list[int] = []
    with open_session(session, "worker") as listener:
        subscriber = zenoh.ext.declare_advanced_subscriber(
            listener,
            keys.samples,
            lambda sample: got.append(decode_block(sample.payload.to_bytes()).sequence),
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
            recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )
        time.sleep(1.0)
        for block in made[60:]:
            publisher.offer(block)
        deadline = time.monotonic() + 5
        while len(got) < len(made) and time.monotonic() < deadline:
            time.sleep(0.05)
        subscriber.undeclare()
    publisher.close()
    assert sorted(got) == list(range(len(made)))
    assert publisher.dropped == 0


def test_a_full_queue_drops_blocks_and_counts_them() -> None:
    session = cell("full_queue", queue_blocks=16)
    publisher = Publisher(session, Keys(session.cell, "tx40"))
    block = blocks(1)[0]
    start = time.perf_counter()
    for _ in range(2000):
        publisher.offer(block)
    elapsed = time.perf_counter() - start
    publisher.close()
    assert publisher.offered == 2000
    assert publisher.dropped > 0
    # Offering is an append under a lock; a second for 2000 of them would mean that it waits for the network.
    assert elapsed < 1.0


def test_waiting_events_are_bounded_and_only_the_latest_health_message_waits() -> None:
    session = cell("many_events")
    publisher = Publisher(session, Keys(session.cell, "tx40"))
    # Holding the queue's lock blocks the sending thread, like a listener that delays a put.
    with publisher._ready:
        for k in range(6000):
            publisher.event(b"{}")
            publisher.health({"k": k})
        assert publisher.events_dropped >= 6000 - 4097
        assert len(publisher._queue) <= 4096
        assert list(publisher._latest.values()) == [b'{"k": 5999}']
    publisher.close()
    assert not publisher._queue
    assert not publisher._latest


def test_a_second_capture_of_a_cell_is_refused() -> None:
    session = cell("twice")
    with open_session(session, "capture"), pytest.raises(ConfigError, match="another capture"):
        open_session(session, "capture")


def test_every_shipped_zenoh_configuration_is_one_with_which_a_session_may_leave_the_machine() -> None:
    files = sorted((HERE / "zenoh").iterdir())
    assert [file.name for file in files] == ["client.json5"]
    for file in files:
        configuration(cell("shipped", config=file), "observer")


@pytest.mark.parametrize("listen", ['["{0}"]', '{{peer: ["{0}"], router: ["{0}"]}}'])
def test_a_second_session_of_a_zenoh_file_listens_on_a_free_port(listen: str, tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    place = listen.format("tcp/127.0.0.1:17911")
    file.write_text(f'{{mode: "peer", listen: {{endpoints: {place}}}, scouting: {{multicast: {{enabled: false}}}}}}')
    session = cell("file", config=file)
    with open_session(session, "worker"):
        with pytest.raises(ConfigError, match="another worker"):
            open_session(session, "worker")
        open_session(session, "worker", any_port=True).close()
        open_session(session, "observer", any_port=True).close()


def test_a_taken_port_does_not_stop_a_capture_and_is_taken_when_it_is_free(caplog: pytest.LogCaptureFixture) -> None:
    session = cell("port_taken")
    host, port = endpoints(session)["capture"].removeprefix("tcp/").split(":")
    with socket.socket() as stranger:
        stranger.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        stranger.bind((host, int(port)))
        stranger.listen()
        publisher = Publisher(session, Keys(session.cell, "tx40"))
        try:

            def health() -> tuple[bool, bool]:
                return publisher.is_open, publisher.problem is None

            assert health() == (False, False)
            assert "recording continues" in caplog.text
            for block in blocks(400):
                publisher.offer(block)
            assert publisher.depth <= session.zenoh.queue_blocks
            assert publisher.dropped == 800 - session.zenoh.queue_blocks
            stranger.close()
            until = time.monotonic() + 15.0
            while health() != (True, True):
                assert time.monotonic() < until
                time.sleep(0.05)
        finally:
            publisher.close()


def test_a_second_capture_of_a_robot_is_refused_unless_it_only_listens() -> None:
    session = cell("two_captures")
    keys = Keys(session.cell, "tx40")
    first = Publisher(session, keys)
    try:
        with pytest.raises(ConfigError, match="another capture of cell two_captures, robot tx40, is running"):
            Publisher(session, keys)
        second = Publisher(session, keys, exclusive=False)
        assert not second.is_open
        second.close()
    finally:
        first.close()
