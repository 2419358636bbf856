"""Capture CPU per frame at 30 000 frames/s: our receive path beside ``candump -l`` and python-can's Notifier."""

import os
import resource
import shutil
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

from armident.drivers.can.frames import frames
from armident.drivers.can.socketcan import Messages, RawSocket
from armident.drivers.canopen.sync_loop import monotonic_ns, send_messages, sleep_until
from armident.drivers.vcan import ensure_vcan
from tests.benchmarks.harness import Row

NEEDS_VCAN = True
BUS = "vcan0"
FRAMES = 120_000
BURST = 6
PERIOD_NS = 200_000
DRAIN_S = 0.010
MEMORY = Path("/dev/shm")
"""Where candump's log goes: the disk is no part of the comparison."""
REPEATS = 3
SEND_ATTEMPTS = 5000
QUIET_S = 1.0
"""A receiver that has heard nothing for this long has seen the last frame."""


@njit(cache=True)
def _send_paced(descriptor, address, burst, bursts, period):  # type: ignore[no-untyped-def]
    spec = np.zeros(2, dtype=np.int64)
    begin = monotonic_ns(spec)
    for k in range(bursts):
        sleep_until(begin + k * period, spec)
        if send_messages(descriptor, address, burst, SEND_ATTEMPTS, spec):
            return k * burst
    return bursts * burst


def send() -> None:
    """Send the frames of six drives at 5 kHz, as many as the benchmark takes."""
    with RawSocket(BUS, filters=()) as socket:
        messages = Messages(BURST, control=False)
        messages.body.view(np.uint32)[:, 0] = np.arange(0x181, 0x181 + BURST)
        messages.body[:, 4] = 8
        _send_paced(socket.fileno(), messages.address, BURST, 0, PERIOD_NS)
        print("ready", flush=True)
        sys.stdin.readline()
        _send_paced(socket.fileno(), messages.address, BURST, FRAMES // BURST, PERIOD_NS)


def receive_ours() -> tuple[int, float]:
    """Frames and CPU seconds of our receive path, drained every 10 ms."""
    batch, count = frames(4096), 0
    with RawSocket(BUS) as socket:
        print("ready", flush=True)
        socket.poll(60)
        cpu, heard = time.process_time(), time.monotonic()
        while time.monotonic() - heard < QUIET_S:
            while got := socket.receive(batch):
                count, heard = count + got, time.monotonic()
                used = time.process_time() - cpu
            time.sleep(DRAIN_S)
    return count, used


def receive_notifier() -> tuple[int, float]:
    """Frames and CPU seconds of python-can's Notifier with a listener that only counts."""
    count, heard, used = 0, time.monotonic() + 60, 0.0
    begin = time.process_time()

    class Counter(can.Listener):
        def on_message_received(self, msg: can.Message) -> None:
            nonlocal count, heard
            count += 1
            if not count % 1000:
                heard = time.monotonic()

    with can.Bus(BUS, interface="socketcan", ignore_rx_error_frames=True) as bus:
        notifier = can.Notifier(bus, [Counter()])
        print("ready", flush=True)
        while time.monotonic() - heard < QUIET_S:
            time.sleep(0.2)
            used = time.process_time() - begin
        notifier.stop()
    return count, used


def measure(command: list[str], report: Callable[[subprocess.Popen[str]], tuple[int, float]]) -> tuple[int, float]:
    """Start a receiver, send it the frames; what it reports: frames and CPU seconds."""
    sender = subprocess.Popen(_self("send"), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert sender.stdin is not None
    assert sender.stdout is not None
    sender.stdout.readline()
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as receiver:
        assert receiver.stdout is not None
        if command[0] == sys.executable:
            receiver.stdout.readline()
        else:
            time.sleep(0.5)
        sender.stdin.write("go\n")
        sender.stdin.close()
        sender.wait()
        return report(receiver)


def _python(receiver: subprocess.Popen[str]) -> tuple[int, float]:
    assert receiver.stdout is not None
    count, used = receiver.stdout.readline().split()
    return int(count), float(used)


def _candump(folder: Path) -> Callable[[subprocess.Popen[str]], tuple[int, float]]:
    def report(receiver: subprocess.Popen[str]) -> tuple[int, float]:
        time.sleep(QUIET_S)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        receiver.terminate()
        receiver.wait()
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        return sum(1 for log in folder.glob("candump-*.log") for _ in log.open()), used

    return report


def _self(what: str) -> list[str]:
    return [sys.executable, "-m", "tests.benchmarks.bench_receive", what]


def run() -> list[Row]:
    """Rows of CPU time per frame, the median of three runs each."""
    ensure_vcan(BUS)
    ours, ours_got = _median(lambda: measure(_self("ours"), _python))
    rate = f"{BURST * 10**9 // PERIOD_NS} frames/s, {FRAMES} sent, received {ours_got}"
    rows = []
    if candump := shutil.which("candump"):

        def once() -> tuple[int, float]:
            with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder:
                here = os.getcwd()
                try:
                    os.environ["PYTHONPATH"] = here + os.pathsep + os.environ.get("PYTHONPATH", "")
                    os.chdir(folder)
                    return measure([candump, "-l", "-r", str(32 << 20), BUS], _candump(Path(folder)))
                finally:
                    os.chdir(here)

        used, got = _median(once)
        rows.append(Row("receive, CPU per frame / candump -l", ours, used, used / ours, "us", f"{rate}; {got}"))
    used, got = _median(lambda: measure(_self("notifier"), _python))
    rows.append(Row("receive, CPU per frame / python-can Notifier", ours, used, used / ours, "us", f"{rate}; {got}"))
    return rows


def _median(once: Callable[[], tuple[int, float]]) -> tuple[float, int]:
    """Median CPU time per frame received (us), and the fewest frames received in any run."""
    results = [once() for _ in range(REPEATS)]
    return float(np.median([1e6 * used / max(count, 1) for count, used in results])), min(c for c, _ in results)


def main(what: str) -> None:
    """Be the sender, or a receiver that prints its frames and CPU seconds."""
    if what == "send":
        send()
        return
    result: Any = {"ours": receive_ours, "notifier": receive_notifier}[what]()
    print(*result, flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
