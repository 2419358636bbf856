"""CPU of a whole capture of six axes at 5 kHz beside ``candump -l`` and python-can, and of six buses beside Notifiers.

All in one run and under the same load: a process of its own sends SYNC and six TPDOs from prepared frames, to one
receiver after the other. CPU is what a process that runs when nobody else wants to gets less of while the frames are
received than while they are only sent, on one CPU: a guest's kernel counts the time of processes in whole ticks, which
those that sleep by ticks escape. python-can gets fewer frames per second, which it can take.
"""

import multiprocessing
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
from numba import njit

from configs import load_robot, load_session
from daq.recording import read_recording
from daq.streams import captured_streams
from drivers.receiver import Receiver
from drivers.socketcan import RawSocket
from drivers.vcan import ensure_vcan, remove_vcan
from tests.benchmarks.harness import Row
from tests.faults.bus import session_file
from tests.faults.sender import Sender
from tests.faults.soak import ARMIDENT

NEEDS_VCAN = True
SECONDS = 6.0
REPEATS = 3
RATE_HZ, BUSES_HZ, SLOW_HZ = 5000, 2500, 500
"""SYNCs per second: on one bus, on six (which takes a sender more), and for what is written in Python."""
FULL_S = 1.0
RECORDED: list[int] = []
MEMORY = Path("/dev/shm")
"""Where recordings and logs go: the disk is no part of the comparison."""
DRAIN_S = 0.020
HERE = "tests.benchmarks.bench_acquisition"
CHANNELS = [f"acq{i}" for i in range(6)]


@njit(nogil=True, cache=True)
def _idle(counts):  # type: ignore[no-untyped-def]
    while counts[1] == 0:
        for _ in range(100):
            counts[0] += 1


class Idler:
    """A process that counts as long as nobody else wants the CPU."""

    def __init__(self) -> None:
        self._counts = np.frombuffer(multiprocessing.RawArray("q", 2), np.int64)
        self._process = multiprocessing.get_context("fork").Process(target=self._work, daemon=True)
        self._process.start()
        time.sleep(3.0)

    def _work(self) -> None:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        _idle(self._counts)

    def rate(self, until: Callable[[], bool]) -> float:
        """Counts per second until something is true."""
        begin, before = time.monotonic(), int(self._counts[0])
        while not until():
            time.sleep(0.05)
        return float((self._counts[0] - before) / (time.monotonic() - begin))

    def close(self) -> None:
        """End it."""
        self._counts[1] = 1
        self._process.join()


def free(command: list[str], channels: list[str], rate_hz: int, ready: str, folder: Path, idler: Idler) -> float:
    """Share of the CPU that is free while a receiver (none: an empty command) is sent frames."""
    until = time.monotonic() + FULL_S
    full = idler.rate(lambda: time.monotonic() > until)
    log = folder / "said"
    environment = {**os.environ, "PYTHONPATH": os.getcwd()}
    with Sender(channels, 10**6 // rate_hz, round(SECONDS * rate_hz)) as sender, log.open("w") as said:
        receiver = subprocess.Popen(command, cwd=folder, env=environment, stdout=said, stderr=said) if command else None
        deadline = time.monotonic() + 60
        while receiver is not None and ready not in log.read_text():
            if receiver.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"{command[:3]} is not ready: {log.read_text()}")
            time.sleep(0.05)
        time.sleep(1.0)
        sender.go()
        left = idler.rate(lambda: sender.sent >= round(SECONDS * rate_hz) - 1)
        if receiver is not None:
            time.sleep(0.5)
            receiver.send_signal(signal.SIGINT)
            receiver.wait(timeout=60)
    return left / full


def python(what: str, *arguments: str) -> list[str]:
    """This module as a receiver."""
    return [sys.executable, "-m", HERE, what, *arguments]


def cost(command: Callable[[Path], list[str]], channels: list[str], rate_hz: int, ready: str, idler: Idler) -> float:
    """CPU time per frame (us) that a receiver takes, the median of some runs."""
    found = []
    for _ in range(REPEATS):
        with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder:
            alone = free([], channels, rate_hz, ready, Path(folder), idler)
            beside = free(command(Path(folder)), channels, rate_hz, ready, Path(folder), idler)
            found.append(1e6 * (alone - beside) / ((len(channels) + 6) * rate_hz))
            RECORDED.extend(read_recording(path).samples.sync.size for path in Path(folder).glob("out/*.mcap"))
    return float(np.median(found))


def run() -> list[Row]:
    """Rows of CPU time per frame."""
    for channel in CHANNELS:
        ensure_vcan(channel)
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    idler = Idler()
    try:
        return _run(idler)
    finally:
        idler.close()
        os.sched_setaffinity(0, before)
        for channel in CHANNELS:
            remove_vcan(channel)


def _run(idler: Idler) -> list[Row]:
    one = CHANNELS[:1]

    def capture(folder: Path) -> list[str]:
        session = session_file(folder, "bench", one, False, False, 10**6 // RATE_HZ, demand=False)
        return [*ARMIDENT, "capture", "--config", str(session), "--out", str(folder / "out"), "--listen-only"]

    RECORDED.clear()
    ours = cost(capture, one, RATE_HZ, "recording to", idler)
    note = f"{7 * RATE_HZ} frames/s for {SECONDS:g} s, {min(RECORDED)} of {round(SECONDS * RATE_HZ)} samples recorded"
    rows = []
    candump = shutil.which("candump")
    if candump is not None:
        # It says nothing when it is ready.
        command = ["sh", "-c", f"echo begun; exec {candump} -l -r {32 << 20} {one[0]}"]
        theirs = cost(lambda _: command, one, RATE_HZ, "begun", idler)
        rows.append(Row("whole capture, CPU per frame / candump -l", ours, theirs, theirs / ours, "us", note))
    theirs = cost(lambda _: python("mcap", one[0]), one, SLOW_HZ, "ready", idler)
    slow = f"{note}; theirs at {SLOW_HZ} Hz"
    rows.append(Row("whole capture, CPU per frame / python-can to MCAP", ours, theirs, theirs / ours, "us", slow))
    ours = cost(lambda _: python("receiver", *CHANNELS), CHANNELS, BUSES_HZ, "ready", idler)
    theirs = cost(lambda _: python("notifiers", *CHANNELS), CHANNELS, SLOW_HZ, "ready", idler)
    note = f"{12 * BUSES_HZ} frames/s, theirs {12 * SLOW_HZ}"
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
