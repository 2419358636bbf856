"""A long capture under full load: ``python -m tests.faults.soak --seconds 600``.

One process sends prepared frames of SYNC and a drive on each of six buses at 5 kHz; a virtual arm would need more than
the one CPU of a guest. ``armident capture --listen-only`` records them. Every SYNC must be a row with the values of its
SYNC. Prints rows, gaps, drops, CPU time and memory. Runs under ``python -m armident.drivers.vcan``. Reading the
recording takes long in a guest: record there with ``--out FOLDER``, and check outside with ``--judge FOLDER``.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from armident.daq.recording import read_recording
from armident.drivers.vcan import ensure_vcan, remove_vcan
from tests.faults.bus import session_file
from tests.faults.sender import FAILED, SHIFTED, WORST_NS, Sender, current_of, position_of

ARMIDENT = [sys.executable, "-c", "from armident.daq.cli import main; main()"]
LOOK_S = 10.0
TICKS = os.sysconf("SC_CLK_TCK")


def memory_mb(pid: int) -> float:
    """Return the resident memory of a process, MB."""
    (line,) = [line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmRSS")]
    return int(line.split()[1]) / 1024


def cpu_s(pid: int) -> float:
    """Return the CPU time of a process, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def record(seconds: float, rate_hz: int, folder: Path, channels: list[str]) -> int:
    """Record into a folder and print the counters of the capture; return 1 if rows are missing."""
    period_us = 10**6 // rate_hz
    session = session_file(folder, "soak", channels, False, False, period_us, demand=False)
    count = round(seconds * rate_hz)
    with Sender(channels, period_us, count) as sender:
        options = ["--config", str(session), "--out", str(folder), "--listen-only", "--json"]
        capture = subprocess.Popen(
            [*ARMIDENT, "capture", *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert capture.stderr is not None
        while "recording to" not in (line := capture.stderr.readline()):
            if not line:
                raise RuntimeError("the capture ended")
        time.sleep(1.0)
        begin, before = time.monotonic(), cpu_s(capture.pid)
        sender.go()
        memory = []
        while sender.sent < count:
            time.sleep(min(LOOK_S, seconds / 5))
            memory.append(memory_mb(capture.pid))
        wall = time.monotonic() - begin
        time.sleep(2.0)
        used = cpu_s(capture.pid) - before
        capture.send_signal(signal.SIGINT)
        out, err = capture.communicate(timeout=120)
        late_ms, shifted, failed = sender.control[WORST_NS] / 1e6, sender.control[SHIFTED], sender.control[FAILED]
    print(err.strip())
    document = json.loads(out)
    document["sent"] = count
    (folder / "soak.json").write_text(json.dumps(document))
    counters, size = document["counters"], Path(document["recording"]).stat().st_size
    print(f"{count} SYNCs at {rate_hz} Hz on {len(channels)} buses in {wall:.1f} s, {12 * count} frames;")
    print(f"  sender: largest delay {late_ms:.1f} ms, grid moved {shifted} times, {failed} refused")
    print(
        f"  rows {counters['samples.rows']}, in gaps {counters['samples.in_gaps']}, gaps {counters['gaps']},", end=" "
    )
    print(f"kernel drops {counters['kernel_drops']}, SYNCs missing {counters['sync_missing']}")
    share, each = 100 * used / wall, 1e6 * used / (12 * count)
    print(f"  CPU of the capture {used:.1f} s: {share:.1f} % of one, {each:.2f} us a frame")
    at = f"{memory[0]:.1f} MB at first, {max(memory):.1f} at most, {memory[-1]:.1f} at the end"
    print(f"  memory {at}; file {size / 1e6:.0f} MB")
    return int(counters["samples.rows"] != count or counters["kernel_drops"] != 0)


def judge(folder: Path) -> int:
    """Compare the recording in a folder with the sent values; return 1 if a row is missing or a value wrong."""
    document = json.loads((folder / "soak.json").read_text())
    samples = read_recording(folder / Path(document["recording"]).name).samples
    joints, wrong = np.arange(6), 0
    for rows in np.array_split(np.arange(samples.sync.size), max(1, samples.sync.size // 100_000)):
        k = samples.sync[rows, None]
        wrong += int(np.count_nonzero(samples.raw["position"][rows] != position_of(k, joints)))
        wrong += int(np.count_nonzero(samples.raw["current"][rows] != current_of(k, joints)))
    lost = document["sent"] - samples.sync.size
    print(f"{document['sent']} SYNCs sent, {samples.sync.size} rows, {lost} missing, {wrong} wrong values")
    return int(lost != 0 or wrong != 0)


def main() -> int:
    """Record, check, and return 1 if anything is missing."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.soak", description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--rate", type=int, default=5000, help="SYNCs per second")
    parser.add_argument("--buses", type=int, default=6)
    parser.add_argument("--out", type=Path, help="keep the recording in this folder, for --judge")
    parser.add_argument("--judge", type=Path, help="only check the recording in this folder")
    options = parser.parse_args()
    if options.judge is not None:
        return judge(options.judge)
    channels = [f"soak{i}" for i in range(options.buses)]
    for channel in channels:
        ensure_vcan(channel)
    folder = Path(tempfile.mkdtemp(prefix="armident-soak-")) if options.out is None else options.out
    folder.mkdir(parents=True, exist_ok=True)
    try:
        amiss = record(options.seconds, options.rate, folder, channels)
        return amiss if options.out is not None else amiss | judge(folder)
    finally:
        if options.out is None:
            shutil.rmtree(folder)
        for channel in channels:
            remove_vcan(channel)


if __name__ == "__main__":
    sys.exit(main())
