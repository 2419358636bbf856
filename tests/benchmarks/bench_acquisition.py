"""CPU time per frame of our receivers beside ``candump -l`` and python-can: one bus, six buses, and a whole capture.

All receivers run at once, each on buses of its own. A process sends SYNC and six TPDOs from prepared frames to one of
them after the other, in several rounds. Compared is the CPU time of the receiving process in a window of steady
frames, without its start. python-can gets fewer frames per second, as many as it can take.

The kernel of a guest counts CPU time in ticks of 10 ms. Thus windows are long, and no period here divides a tick or is
a multiple of one. ``ARMIDENT_BENCH_ROUNDS`` and ``ARMIDENT_BENCH_SECONDS`` change the number of rounds and the length
of our windows; ``ARMIDENT_BENCH_LOADED=1`` runs a busy process beside the receivers.
"""

import os
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import can
import numpy as np

from armident.configs import load_robot, load_session
from armident.configs.schema.session import Bus
from armident.daq.matching.streams import captured_streams
from armident.daq.recording import read_recording
from armident.drivers.can.receiver import Receiver
from armident.drivers.can.udp import open_bus
from armident.drivers.vcan import ensure_vcan, remove_vcan
from tests.benchmarks.harness import Row, ratio_of_medians
from tests.faults.bus import session_file
from tests.faults.sender import Sender

NEEDS_VCAN = True
ROUNDS = int(os.environ.get("ARMIDENT_BENCH_ROUNDS", "5"))
SECONDS = float(os.environ.get("ARMIDENT_BENCH_SECONDS", "24"))
"""Length of a window of our receivers, s; those of the others, which take more CPU time, are a third as long."""
LOADED = os.environ.get("ARMIDENT_BENCH_LOADED", "") not in ("", "0")
LEAD_S = 1.0
"""Time for which frames are sent before a window, s."""
SETTLE_S = 0.3
"""Time in which a receiver takes the last frames of a window, s."""
RATE_HZ, SLOW_HZ = 5025, 501
"""SYNCs per second, and those for receivers that handle frames in Python."""
MEMORY = Path("/dev/shm")
"""Folder of recordings and logs: the disk is no part of the comparison."""
DRAIN_S = 0.019
READY_S = 300.0
"""Longest start of a receiver, s; most of it is compilation."""
HERE = "tests.benchmarks.bench_acquisition"
ARMIDENT = [sys.executable, "-c", "from armident.daq.cli import main; main()"]
BUSY = "import numpy\na = numpy.ones(1 << 22)\nwhile True: a += 1.0"
TICKS = os.sysconf("SC_CLK_TCK")


@dataclass
class Competitor:
    """One receiver.

    ``name``: also of its folder and its buses; ``command``: program and arguments; ``ready``: text that it prints when
    it receives; ``rate_hz``: SYNCs per second that are sent to it; ``seconds``: length of a window, s.
    """

    name: str
    command: list[str]
    ready: str
    channels: list[str]
    rate_hz: int
    seconds: float
    process: "subprocess.Popen[bytes] | None" = None
    figures: list[float] = field(default_factory=list)
    cpu_s: float = 0.0
    syncs: int = 0

    def start(self, folder: Path) -> None:
        """Start it in a folder, and wait until it receives."""
        log = folder / "log"
        environment = {**os.environ, "PYTHONPATH": os.getcwd()}
        with log.open("w") as output:
            self.process = subprocess.Popen(self.command, cwd=folder, env=environment, stdout=output, stderr=output)
        deadline = time.monotonic() + READY_S
        while self.ready not in log.read_text():
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"{self.name} is not ready: {log.read_text()}")
            time.sleep(0.05)

    def measure(self) -> None:
        """Send frames to it for one window, and note its CPU time per frame (us)."""
        assert self.process is not None
        lead, count = (round(seconds * self.rate_hz) for seconds in (LEAD_S, LEAD_S + self.seconds))
        with Sender(self.channels, 10**6 // self.rate_hz, count) as sender:
            sender.go()
            while sender.sent < lead:
                time.sleep(0.013)
            first, before = sender.sent, used_s(self.process.pid)
            sender.wait()
            time.sleep(SETTLE_S)
            used = used_s(self.process.pid) - before
        self.cpu_s += used
        self.syncs += count
        self.figures.append(1e6 * used / ((count - first) * (len(self.channels) + 6)))

    def stop(self) -> None:
        """End it."""
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            self.process.wait(timeout=120)


def used_s(pid: int) -> float:
    """CPU time of a process so far, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def competitors(folder: Path) -> dict[str, Competitor]:
    """Receivers by name; candump only where it is installed."""
    found: dict[str, Competitor] = {}

    def add(name: str, command: list[str], ready: str = "ready", buses: int = 1, slow: bool = False) -> None:
        channels = [f"{name}{k}" for k in range(buses)]
        ours = name in ("acqc", "acqr", "acqs")
        seconds = SECONDS if ours else SECONDS / 3
        found[name] = Competitor(name, [*command, *channels], ready, channels, SLOW_HZ if slow else RATE_HZ, seconds)

    def python(kind: str) -> list[str]:
        return [sys.executable, "-m", HERE, kind]

    (folder / "acqc").mkdir()
    session = session_file(folder / "acqc", "bench", ["acqc0"], False, False, 10**6 // RATE_HZ, demand=False)
    session.write_text(session.read_text().replace("recording: {}", "recording: {drain_ms: 19}"))
    add("acqc", [], "recording to")
    options = ["--config", str(session), "--out", str(folder / "acqc" / "out"), "--listen-only"]
    found["acqc"].command = [*ARMIDENT, "capture", *options]
    add("acqr", python("receiver"))
    if candump := shutil.which("candump"):
        # It prints nothing when it is ready.
        add("acqd", ["sh", "-c", f'echo begun; exec {candump} -l -r {32 << 20} "$@"', "sh"], "begun")
    add("acqm", python("mcap"), slow=True)
    add("acqn", python("notifiers"), slow=True)
    add("acqs", python("receiver"), buses=6)
    add("acqt", python("notifiers"), buses=6, slow=True)
    return found


def run() -> list[Row]:
    """Rows of CPU time per frame."""
    with ExitStack() as stack:
        at = MEMORY if MEMORY.is_dir() else None
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=at)))
        found = competitors(folder)
        for one in found.values():
            for channel in one.channels:
                ensure_vcan(channel)
                stack.callback(remove_vcan, channel)
            (folder / one.name).mkdir(exist_ok=True)
            stack.callback(one.stop)
            one.start(folder / one.name)
        if LOADED:
            busy = subprocess.Popen([sys.executable, "-c", BUSY])
            stack.callback(busy.wait)
            stack.callback(busy.kill)
        for _ in range(ROUNDS):
            for one in found.values():
                one.measure()
                print(one.name, round(one.figures[-1], 3), file=sys.stderr, flush=True)
        capture = found["acqc"]
        capture.stop()
        recorded = sum(read_recording(path).samples.sync.size for path in (folder / "acqc" / "out").glob("*.mcap"))
        return rows(found, f"{recorded} of {capture.syncs} samples recorded")


def rows(found: dict[str, Competitor], recorded: str) -> list[Row]:
    """Rows of the table.

    ``found``: receivers by name, measured; ``recorded``: note on the completeness of the capture.
    """
    pairs = (
        ("receive, CPU per frame / candump -l", "acqr", "acqd", ""),
        ("receive, CPU per frame / python-can Notifier", "acqr", "acqn", ""),
        ("whole capture, CPU per frame / candump -l", "acqc", "acqd", recorded),
        ("whole capture, CPU per frame / python-can to MCAP", "acqc", "acqm", recorded),
        ("six buses, CPU per frame / Notifiers", "acqs", "acqt", ""),
    )
    table = []
    for name, ours, theirs, note in pairs:
        if theirs not in found:
            continue
        one, other = found[ours], found[theirs]
        median, low, high = ratio_of_medians(one.figures, other.figures)
        seconds = f"{one.cpu_s:.1f} s and {other.cpu_s:.1f} s of CPU in {len(one.figures)} rounds"
        rates = f"{one.rate_hz} and {other.rate_hz} SYNCs/s"
        notes = "; ".join(text for text in (rates, seconds, note) if text)
        mine, others = float(np.median(one.figures)), float(np.median(other.figures))
        loaded = " (loaded)" if LOADED else ""
        table.append(Row(name + loaded, mine, others, median, "us", notes, low, high))
    return table


def receive(channels: list[str]) -> None:
    """Read all buses as a capture does, and count."""
    openers = [partial(open_bus, Bus(channel=name)) for name in channels]
    with Receiver(openers) as receiver:
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


def main(kind: str, channels: list[str]) -> None:
    """Run as a receiver until interrupted."""
    try:
        if kind == "mcap":
            to_mcap(channels[0])
        else:
            {"receiver": receive, "notifiers": notify}[kind](channels)
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
