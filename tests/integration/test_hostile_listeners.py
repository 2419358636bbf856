"""Subscribers do not affect a capture, even if they are frozen, slow, or flood it with invalid messages."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh

from armident.configs import RobotConfig, SessionConfig, load_robot, load_session
from armident.daq.capture.publisher import Publisher
from armident.daq.capture.recording_files import open_series
from armident.daq.capture.sink import Sink
from armident.daq.matching.assembler import Batch, Rows
from armident.daq.matching.streams import captured_streams
from armident.daq.recording import Gap, read_recording
from armident.daq.streaming import Keys, decode_block, open_session

pytestmark = pytest.mark.slow

ROWS, EVERY_S, SECONDS = 100, 0.02, 1.2
"""Six axes at 5 kHz, taken every 20 ms."""
MEMORY = 150_000_000

LISTENER = """
import sys, threading, time
import zenoh, zenoh.ext
from armident.configs import load_session
from armident.daq.streaming import Keys, open_session
role, cell = sys.argv[1:]
session = load_session("tx40_cell.yaml").model_copy(update={"cell": cell})
keys = Keys(cell, "tx40")
got = 0
def heard(sample):
    global got
    got += 1
    if got == 1:
        print("ready", flush=True)
    if role == "slow":
        time.sleep(0.3)
with open_session(session, "observer") as listener:
    if role != "hostile":
        subscribers = [
            zenoh.ext.declare_advanced_subscriber(
                listener, key, heard,
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
                recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
            )
            for key in (keys.samples, keys.events)
        ]
        threading.Event().wait()
    waiting = listener.declare_querier(keys.command("*"), timeout=5.0)
    while not waiting.matching_status:
        time.sleep(0.01)
    print("ready", flush=True)
    garbage, small = b"\\xff" * 1_000_000, b"{" * 300
    while True:
        for key in (keys.samples, keys.events, keys.health, keys.status, keys.command("stop"), keys.alive("capture")):
            listener.put(key, garbage)
        for _ in range(20):
            listener.get(keys.samples + "/@adv/**", lambda reply: None, timeout=1.0)
            listener.get(keys.base + "/**", lambda reply: None, timeout=1.0)
            got += 2
        for text in (garbage, small):
            listener.get(keys.command("mark"), lambda reply: None, payload=text, timeout=1.0)
            listener.get(keys.command("nonsense"), lambda reply: None, payload=text, timeout=1.0)
            got += 2
        sys.stderr.write(f"{got}\\n")
"""


@contextmanager
def listening(role: str, cell: str, log: Path) -> Iterator["subprocess.Popen[str]"]:
    with log.open("w") as errors:
        command = [sys.executable, "-c", LISTENER, role, cell]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
        try:
            yield process
        finally:
            process.kill()
            process.wait()
            assert process.stdout is not None
            process.stdout.close()


def batches(session: SessionConfig, robot: RobotConfig, seconds: float = SECONDS) -> Iterator[Batch]:
    """Output of the assembler every 20 ms: rows of every stream, and sometimes a gap."""
    rng = np.random.default_rng(0)
    streams = captured_streams(session, robot)
    for k in range(round(seconds / EVERY_S)):
        rows = {}
        for stream in streams:
            every = stream.bus.every
            sync = np.arange(k * ROWS + every - 1, (k + 1) * ROWS, every, dtype=np.int64)
            data = rng.integers(0, 256, (sync.size, robot.n, 8), dtype=np.uint8)
            data[:, :, stream.tpdo.dtype.itemsize :] = 0
            wide = data[:, :, : stream.tpdo.dtype.itemsize]
            rows[stream.bus.name] = Rows(sync, 1_700_000_000_000_000_000 + sync * 200_000, np.ascontiguousarray(wide))
        gap = Gap("samples", k * ROWS, k * ROWS, "joint_1")
        yield Batch(rows, (gap,) if k % 2 else (), dict.fromkeys(rows, (k + 1) * ROWS))


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")


@pytest.mark.parametrize("seconds", [SECONDS, pytest.param(6.0, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("roles", [("frozen", "slow"), ("hostile", "hostile")])
def test_a_listener_changes_nothing_in_the_recording(roles: tuple[str, ...], seconds: float, tmp_path: Path) -> None:
    cell = "hostile_" + ("_".join(roles) or "none")
    session = load_session("tx40_cell.yaml").model_copy(update={"cell": cell})
    session = session.model_copy(update={"zenoh": session.zenoh.model_copy(update={"commands": True})})
    robot = load_robot(session.robot)
    streams = captured_streams(session, robot)
    writer = open_series(session, robot, streams, tmp_path, "capture", {})
    longest, deepest = 0.0, 0
    with ExitStack() as stack:
        publisher = stack.enter_context(closing(Publisher(session, Keys(cell, robot.name))))
        sink = Sink(writer, publisher, streams, "capture")
        sink.announce(robot, session, 5000.0, {})
        processes = [
            stack.enter_context(listening(role, cell, tmp_path / f"{role}.{k}")) for k, role in enumerate(roles)
        ]
        for process, role in zip(processes, roles, strict=True):
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            if role == "frozen":
                process.send_signal(signal.SIGSTOP)
        before, due, asked = resident(), time.monotonic(), 0
        for batch in batches(session, robot, seconds):
            begin = time.monotonic()
            sink.take(batch)
            publisher.health({"queue_depth": publisher.depth})
            asked += len(publisher.commands.pending())
            longest, deepest = max(longest, time.monotonic() - begin), max(deepest, publisher.depth)
            due = max(due + EVERY_S, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
        grown = resident() - before
        sink.finish({})

    read = read_recording(tmp_path / "capture.mcap")
    fed = list(batches(session, robot, seconds))
    assert read.missing is None
    assert list(read.gaps) == [gap for batch in fed for gap in batch.gaps]
    for stream in streams:
        rows = [batch.rows[stream.bus.name] for batch in fed]
        got = read.streams[stream.bus.name]
        assert np.array_equal(got.sync, np.concatenate([r.sync for r in rows]))
        for name, values in got.raw.items():
            assert np.array_equal(values, np.concatenate([stream.decode(r)[name] for r in rows]))
    assert publisher.offered == len(streams) * len(fed)
    assert deepest <= session.zenoh.queue_blocks
    assert grown < MEMORY
    # The flooding subscriber was received, and its invalid requests were refused.
    floods = [int(path.read_text().split()[-1]) for path in tmp_path.glob("hostile.*")]
    assert all(count > 100 for count in floods)
    print(f"\n{roles}: held up {longest * 1e3:.1f} ms at most, queue {deepest}, {publisher.dropped} blocks dropped, "
          f"memory grew by {grown / 1e6:.0f} MB, {asked} commands, {sum(floods)} queries")  # fmt: skip


def test_a_listener_receives_everything_beside_a_frozen_one(tmp_path: Path) -> None:
    cell = "hostile_beside"
    session = load_session("tx40_cell.yaml").model_copy(update={"cell": cell})
    robot = load_robot(session.robot)
    keys, streams = Keys(cell, robot.name), captured_streams(session, robot)
    heard: list[int] = []
    health: list[dict[str, int]] = []
    writer = open_series(session, robot, streams, tmp_path, "capture", {})
    with ExitStack() as stack:
        publisher = stack.enter_context(closing(Publisher(session, keys)))
        sink = Sink(writer, publisher, streams, "capture")
        frozen = stack.enter_context(listening("frozen", cell, tmp_path / "frozen"))
        listener = stack.enter_context(open_session(session, "worker"))
        config = (
            zenoh.ext.HistoryConfig(detect_late_publishers=True),
            zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
        )
        zenoh.ext.declare_advanced_subscriber(
            listener,
            keys.samples,
            lambda sample: heard.append(decode_block(bytes(sample.payload)).sequence),
            history=config[0],
            recovery=config[1],
        )
        listener.declare_subscriber(keys.health, lambda sample: health.append(json.loads(bytes(sample.payload))))
        sink.announce(robot, session, 5000.0, {})
        assert frozen.stdout is not None
        assert frozen.stdout.readline() == "ready\n"
        frozen.send_signal(signal.SIGSTOP)
        for batch in batches(session, robot):
            sink.take(batch)
            publisher.health({"blocks_dropped": publisher.dropped, "queue_depth": publisher.depth})
            time.sleep(EVERY_S / 2)
        deadline = time.monotonic() + 20
        while len(set(heard)) < publisher.offered - publisher.dropped and time.monotonic() < deadline:
            time.sleep(0.05)
        assert len(set(heard)) == publisher.offered - publisher.dropped
        sink.finish({})
    assert health
    assert health[-1]["queue_depth"] <= session.zenoh.queue_blocks
