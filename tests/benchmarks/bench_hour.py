"""An hour of six axes at 5 kHz: written as fast as it goes, and read into arrays; time and memory.

``python -m tests.benchmarks.bench_hour`` takes the whole hour, ``--minutes M`` another length; `run` takes two minutes.
"""

import argparse
import hashlib
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import load_robot
from armident.daq.recording import Field, RecordingWriter, StreamLayout
from tests.benchmarks.harness import Row

RATE = 5000
CHUNK = 500
"""Rows of a chunk: 100 ms, as a capture writes them."""

READ = """
import sys, time
from pathlib import Path
from armident.daq.recording import read_recording

def kilobytes(name):
    # What getrusage calls the peak is that of whoever started this process, if that had more.
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name))

before = kilobytes("VmRSS:")
wall, cpu = time.perf_counter(), time.process_time()
recording = read_recording(sys.argv[1])
wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
peak = kilobytes("VmHWM:")
samples = recording.samples
size = samples.sync.nbytes + samples.t_ns.nbytes + sum(values.nbytes for values in samples.raw.values())
assert recording.missing is None
print(wall, cpu, (peak - before) * 1024, size, samples.sync.size, recording.sha256)
"""


def write_minutes(path: Path, minutes: float) -> str:
    """Write so many minutes of smooth motion with noise; the digest of what was written."""
    robot = load_robot("tx40.yaml")
    one = (1.0,) * robot.n
    fields = (Field("position", "position", "rad", "motor", one), Field("current", "current", "A", "motor", one))
    layout = StreamLayout("samples", 1, tuple(j.name for j in robot.joints), fields, ("int32", "int16"))
    rng = np.random.default_rng(0)
    block = 60 * RATE
    noise = rng.integers(-300, 300, (block, robot.n)).astype(np.int16)
    step = rng.integers(-50, 50, (block, robot.n))
    total = round(minutes * block)
    digests = {name: hashlib.sha256() for name in ("sync", "position", "current")}
    with RecordingWriter(path, robot, None, float(RATE), [layout], {}, 10**18) as writer:
        position = np.zeros(robot.n, np.int64)
        for first in range(0, total, block):
            sync = np.arange(first, min(first + block, total), dtype=np.int64)
            walk = position + np.cumsum(step[: sync.size], axis=0)
            position = walk[-1] % 2**24
            raw: dict[str, NDArray[Any]] = {"position": walk.astype(np.int32), "current": noise[: sync.size]}
            for name, values in ({"sync": sync} | raw).items():
                digests[name].update(np.ascontiguousarray(values).tobytes())
            for begin in range(0, sync.size, CHUNK):
                part = slice(begin, begin + CHUNK)
                t_ns = 1_700_000_000_000_000_000 + sync[part] * (10**9 // RATE)
                writer.append("samples", sync[part], t_ns, {name: values[part] for name, values in raw.items()})
                writer.flush()
        writer.close({"samples.rows": total})
    return " ".join(digest.hexdigest() for digest in digests.values())


def measure(minutes: float) -> list[Row]:
    """Write and read so many minutes; reading in a process of its own, so that its memory can be told."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "hour.mcap")
        begin = time.process_time()
        write_minutes(path, minutes)
        writing = time.process_time() - begin
        done = subprocess.run([sys.executable, "-c", READ, str(path)], capture_output=True, text=True, check=True)
        wall, cpu, memory, size = (float(word) for word in done.stdout.split()[:4])
        megabytes = path.stat().st_size / 1e6
    note = f"{minutes:g} min of six axes at {RATE} Hz, a file of {megabytes:.0f} MB"
    return [
        Row("read a recording into arrays, wall time", wall, None, None, "s", note),
        Row("the same, CPU time of both cores", cpu, None, None, "s", note),
        Row("memory it takes, beside that of its arrays", memory / 1e6, size / 1e6, size / memory, "MB", note),
        Row("write it, CPU time", writing, None, None, "s", note),
    ]


def run() -> list[Row]:
    """Two minutes of six axes at 5 kHz."""
    return measure(2.0)


def main() -> None:
    """Print the figures of an hour."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.bench_hour")
    parser.add_argument("--minutes", type=float, default=60.0)
    for row in measure(parser.parse_args().minutes):
        print(f"{row.name:45} {row.ours:8.2f} {row.unit}   {row.note}")
    print(f"peak of the writing process {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3:.0f} MB")


if __name__ == "__main__":
    main()
