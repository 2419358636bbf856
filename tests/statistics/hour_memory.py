"""Peak memory of the identification of long recordings: ``python -m tests.statistics.hour_memory --minutes 60``.

The virtual TX40 (six axes, 5 kHz) repeats one motion until the recording is long enough. ``armident identify`` runs in
a process of its own; printed are its largest resident memory and its time.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from armident.configs import load_robot, load_trajectory
from armident.daq.recording import RecordingWriter, StreamLayout
from armident.virtual_robot.offline import simulate_recording

CHUNK = 500
"""Rows of a chunk: 100 ms, as a capture writes them."""


def write_repeated(path: Path, minutes: float, robot: str = "tx40", motion: str = "tx40_excitation") -> int:
    """Write a recording of a shipped virtual arm that repeats a shipped motion; return its number of samples.

    ``minutes``: least duration, min; ``robot``, ``motion``: names of the robot and of its trajectory.
    """
    once = simulate_recording(load_robot(robot), load_trajectory(f"trajectories/{motion}.yaml"), 1)
    every = max(stream.every for stream in once.streams.values())
    period = once.samples.sync.size // every * every
    step_ns = round(1e9 / once.sample_rate_hz)
    repeats = -(-round(60 * minutes * once.sample_rate_hz) // period)
    joints = [joint.name for joint in once.robot.joints]
    layouts = [StreamLayout.of(stream, joints) for stream in once.streams.values()]
    with RecordingWriter(path, once.robot, None, once.sample_rate_hz, layouts, {}) as writer:
        for first in range(0, repeats * period, period):
            for stream in once.streams.values():
                whole = stream.sync < period
                sync = stream.sync[whole] + first
                for begin in range(0, sync.size, CHUNK):
                    rows = slice(begin, begin + CHUNK)
                    raw = {name: values[whole][rows] for name, values in stream.raw.items()}
                    writer.append(stream.name, sync[rows], sync[rows] * step_ns, raw)
                    writer.flush()
        writer.close({"samples.rows": repeats * period})
    return repeats * period


def identify(path: Path, method: str, out: Path) -> tuple[float, float]:
    """Run ``armident identify``; return its largest resident memory, GB, and its time, s."""
    command = [sys.executable, "-m", "armident.daq.cli", "identify", str(path), "--method", method, "--out", str(out)]
    begin = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if code := os.waitstatus_to_exitcode(status):
        raise SystemExit(f"identify ended with exit code {code}")
    return usage.ru_maxrss * 1024 / 1e9, time.monotonic() - begin


def main() -> None:
    """Print one line per method."""
    parser = argparse.ArgumentParser(prog="python -m tests.statistics.hour_memory")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--methods", nargs="+", default=["idim-piv"])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir="/var/tmp") as folder:
        path = Path(folder, "long.mcap")
        samples = write_repeated(path, options.minutes)
        for method in options.methods:
            memory, seconds = identify(path, method, Path(folder, method))
            print(f"{samples} samples of six axes, {method}: {memory:.2f} GB, {seconds:.0f} s", flush=True)


if __name__ == "__main__":
    main()
