"""CPU of a whole capture of six axes at 5 kHz beside ``candump -l`` and python-can, and of six buses beside Notifiers.

All in one run and under the same load: a process of its own sends SYNC and six TPDOs from prepared frames, to one
receiver after the other. What is compared is CPU time of the receiving process while the frames come, without its
start. python-can gets fewer frames per second, which it can take. A guest's kernel counts CPU time by ticks of 10 ms,
so that no period here divides a tick: who runs at a tick is a fair sample then.
"""

import os
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import numpy as np

from armident.configs import load_robot, load_session
from armident.daq.matching.streams import captured_streams
from armident.daq.recording import read_recording
from armident.drivers.can.receiver import Receiver
from armident.drivers.can.socketcan import RawSocket
from armident.drivers.vcan import ensure_vcan, remove_vcan
from tests.benchmarks.harness import Row
from tests.faults.bus import session_file
from tests.faults.sender import Sender
from tests.faults.soak import ARMIDENT, cpu_s

NEEDS_VCAN = True
SECONDS = 6.0
REPEATS = 2
RATE_HZ, SLOW_HZ = 5025, 501
"""SYNCs per second, and for what is written in Python."""
MEMORY = Path("/dev/shm")
"""Where recordings and logs go: the disk is no part of the comparison."""
DRAIN_S = 0.019
READY_S = 300.0
"""Most that a receiver takes to begin: to begin with there is much to compile."""
HERE = "tests.benchmarks.bench_acquisition"
CHANNELS = [f"acq{i}" for i in range(6)]


def measured(command: list[str], channels: list[str], rate_hz: int, ready: str, folder: Path) -> tuple[float, int]:
    """CPU seconds of a receiver while it is sent frames, and how many frames those were."""
    count = round(SECONDS * rate_hz)
    frames = count * (len(channels) + 6)
    log = folder / "said"
    environment = {**os.environ, "PYTHONPATH": os.getcwd()}
    with Sender(channels, 10**6 // rate_hz, count) as sender, log.open("w") as said:
        receiver = subprocess.Popen(command, cwd=folder, env=environment, stdout=said, stderr=said)
        deadline = time.monotonic() + READY_S
        while ready not in log.read_text():
            if receiver.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"{command[:3]} is not ready: {log.read_text()}")
            time.sleep(0.05)
        time.sleep(1.0)
        before = cpu_s(receiver.pid)
        sender.go()
        sender.wait()
        time.sleep(0.5)
        used = cpu_s(receiver.pid) - before
        receiver.send_signal(signal.SIGINT)
        receiver.wait(timeout=60)
    return used, frames


def python(what: str, *arguments: str) -> list[str]:
    """This module as a receiver."""
    return [sys.executable, "-m", HERE, what, *arguments]


def median(once: Callable[[Path], tuple[float, int]]) -> float:
    """CPU time per frame (us), the median of some runs."""
    found = []
    for _ in range(REPEATS):
        with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder:
            used, frames = once(Path(folder))
            found.append(1e6 * used / frames)
    print([round(figure, 3) for figure in found], file=sys.stderr, flush=True)
    return float(np.median(found))


def run() -> list[Row]:
    """Rows of CPU time per frame."""
    for channel in CHANNELS:
        ensure_vcan(channel)
    try:
        return _run()
    finally:
        for channel in CHANNELS:
            remove_vcan(channel)


def _run() -> list[Row]:
    one = CHANNELS[:1]

    def capture(folder: Path) -> tuple[float, int]:
        session = session_file(folder, "bench", one, False, False, 10**6 // RATE_HZ, demand=False)
        text = session.read_text().replace("recording: {}", "recording: {drain_ms: 19}")
        session.write_text(text)
        options = ["--config", str(session), "--out", str(folder / "out"), "--listen-only"]
        result = measured([*ARMIDENT, "capture", *options], one, RATE_HZ, "recording to", folder)
        (path,) = (folder / "out").glob("*.mcap")
        recorded.append(read_recording(path).samples.sync.size)
        return result

    recorded: list[int] = []
    ours = median(capture)
    note = f"{7 * RATE_HZ} frames/s for {SECONDS:g} s, {min(recorded)} of {round(SECONDS * RATE_HZ)} samples recorded"
    rows = []
    candump = shutil.which("candump")
    if candump is not None:
        # It says nothing when it is ready.
        command = ["sh", "-c", f"echo begun; exec {candump} -l -r {32 << 20} {one[0]}"]
        theirs = median(lambda folder: measured(command, one, RATE_HZ, "begun", folder))
        rows.append(Row("whole capture, CPU per frame / candump -l", ours, theirs, theirs / ours, "us", note))
    theirs = median(lambda folder: measured(python("mcap", one[0]), one, SLOW_HZ, "ready", folder))
    slow = f"{note}; theirs at {SLOW_HZ} Hz"
    rows.append(Row("whole capture, CPU per frame / python-can to MCAP", ours, theirs, theirs / ours, "us", slow))
    ours = median(lambda folder: measured(python("receiver", *CHANNELS), CHANNELS, RATE_HZ, "ready", folder))
    theirs = median(lambda folder: measured(python("notifiers", *CHANNELS), CHANNELS, SLOW_HZ, "ready", folder))
    note = f"{12 * RATE_HZ} frames/s, theirs {12 * SLOW_HZ}"
    rows.append(Row("six buses, CPU per frame / Notifiers", ours, theirs, theirs / ours, "us", note))
    return rows


def receive(channels: list[str]) -> None:
    """Read all buses as a capture does, and count."""
    with Receiver([lambda name=name: RawSocket(name) for name in channels]) as receiver:  # type: ignore[misc]
        print("ready", flush=True)
        count = 0
        while True:
            for _, batch, _ in receiver.drain():
                count += batch.size
            time.sleep(DRAIN_S)


def notify(channels: list[str]) -> None:
    """Read all buses with python-can's Notifier, and count."""
    count = 0

    class Counter(can.Listener):
        def on_message_received(self, msg: can.Message) -> None:
            nonlocal count
            count += 1

    buses = [can.Bus(name, interface="socketcan") for name in channels]
    notifier = can.Notifier(buses, [Counter()])
    print("ready", flush=True)
    try:
        while True:
            time.sleep(1.0)
    finally:
        notifier.stop()


def to_mcap(channel: str) -> None:
    """Write samples with python-can, protobuf objects and the stock MCAP writer, as one would."""
    from mcap.writer import Writer

    from tests.benchmarks.bench_recording import _message_class

    with tempfile.TemporaryDirectory() as folder:
        session = load_session(session_file(Path(folder), "stock", [channel], False, False, demand=False))
    layout = captured_streams(session, load_robot("tx40.yaml"))[0].layout
    message, joints = _message_class(layout), layout.joints
    with Path("stock.mcap").open("wb") as file, can.Bus(channel, interface="socketcan") as bus:
        writer = Writer(file, chunk_size=75_000)
        writer.start()
        schema = writer.register_schema(layout.message_name, "protobuf", layout.descriptor)
        topic = writer.register_channel("/samples", "protobuf", schema)
        print("ready", flush=True)
        sync, got, sample, t_ns = 0, 0, message(), 0
        while True:
            received: Any = bus.recv()
            if received.arbitration_id == 0x80:
                sync, got, sample, t_ns = sync + 1, 0, message(sync=sync), round(received.timestamp * 1e9)
                sample.t_ns = t_ns
                continue
            j = received.arbitration_id - 0x181
            values = getattr(sample, joints[j])
            values.position, values.current, values.status = struct.unpack("<ihH", received.data)
            got += 1
            if got == len(joints):
                writer.add_message(topic, t_ns, sample.SerializeToString(), t_ns, sync)


def main(what: str, channels: list[str]) -> None:
    """Be a receiver until interrupted."""
    try:
        if what == "mcap":
            to_mcap(channels[0])
        else:
            {"receiver": receive, "notifiers": notify}[what](channels)
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
