"""Long capture at accelerated time: ``python -m tests.faults.hour --hours 1``.

A simulated bus generates the frames of six drives at 5 kHz faster than real time. Recorder, matching, files (rotated,
and deleted when finished), Zenoh and health are the real ones. Prints the memory during the capture. Needs no vcan.
"""

import argparse
import json
import os
import shutil
import sys
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np

import armident.daq.capture.capture
import armident.drivers.can.filtered_socket
from armident.configs import ArmidentError
from armident.configs.schema.session import Bus
from armident.daq.capture.plan import load_plan
from armident.daq.recording.names import in_order
from armident.drivers.can.frames import Frames, frames
from armident.drivers.canopen.objects import COB_SYNC
from tests.faults.bus import session_file
from tests.faults.sender import COUNTER, current_of, position_of
from tests.faults.soak import memory_mb

RATE_HZ = 5000
BLOCK = 500
"""Number of SYNCs at once; with six answers each less than a batch."""


class GeneratedBus:
    """A bus on which six drives answer ``count`` SYNCs, ``pace`` times as fast as real time."""

    channel, dropped, fd, timestamp_source, up, bound = "made-up", 0, False, "software", True, True

    def __init__(self, count: int, pace: float) -> None:
        self.sent, self._count = 0, count
        self._per_s, self._begin = pace * RATE_HZ, time.monotonic()
        self._begin_ns = time.time_ns()
        self._block = frames(7 * BLOCK).reshape(BLOCK, 7)
        self._block["can_id"] = [COB_SYNC, *range(0x181, 0x187)]
        self._block["length"] = [1, *[8] * 6]
        self._asked = 0

    def receive(self, batch: Frames) -> int:
        """Return the number of frames of the next SYNCs; 0 at every second call, like a bus that was read empty."""
        self._asked += 1
        n = min(BLOCK, self._count - self.sent)
        ahead_s = self.sent / self._per_s - (time.monotonic() - self._begin)
        if not n or ahead_s > 0 or self._asked % 2 == 0:
            time.sleep(min(max(ahead_s, 0.0), 0.01))
            return 0
        k = self.sent + np.arange(n)[:, None]
        block = self._block[:n]
        block["t_ns"] = self._begin_ns + k * (10**9 // RATE_HZ)
        block["data"][:, 0, 0] = k[:, 0] % COUNTER + 1
        words = block["data"].view("<i4")
        words[:, 1:, 0] = position_of(k, np.arange(6))
        words[:, 1:, 1] = current_of(k, np.arange(6))
        batch[: 7 * n] = block.reshape(-1)
        self.sent += n
        return 7 * n

    def poll(self, timeout: float) -> bool:
        """Return True: there always are frames."""
        return True

    def drops(self) -> int:
        """Return 0: no frame is dropped."""
        return 0

    def send(self, frames: Frames) -> int:
        """Discard the frames."""
        return frames.size

    def close(self) -> None:
        """Do nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None


def main() -> int:
    """Run the capture; return 1 if rows are missing, or memory grew by more than 5 % after the first quarter."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.hour", description=__doc__)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--pace", type=float, default=10.0, help="factor of acceleration")
    options = parser.parse_args()
    count = round(options.hours * 3600 * RATE_HZ)
    memory = Path("/dev/shm")
    folder = Path(tempfile.mkdtemp(prefix="armident-hour-", dir=memory if memory.is_dir() else None))
    try:
        session = session_file(folder, "hour", ["vcan0"], False, False, 10**6 // RATE_HZ, demand=False)
        text = session.read_text().replace("recording: {}", "recording: {rotate_mb: 20, drain_ms: 1}")
        session.write_text(text)
        plan = replace(load_plan(session, folder / "out", None, True))
        return watched(plan, GeneratedBus(count, options.pace), count, folder)
    finally:
        shutil.rmtree(folder)


def watched(plan: armident.daq.capture.capture.CapturePlan, bus: GeneratedBus, count: int, folder: Path) -> int:
    """Capture in this process while another thread measures memory and deletes finished files."""

    def open_bus(config: Bus, **_: object) -> GeneratedBus:
        return bus

    stop, ended = threading.Event(), threading.Event()
    memory: list[tuple[float, float]] = []
    deleted: set[Path] = set()

    def watch() -> None:
        step = count / 40
        while not ended.wait(0.05):
            if bus.sent >= len(memory) * step:
                memory.append((bus.sent / RATE_HZ / 60, memory_mb(os.getpid())))
            files = sorted((folder / "out").glob("*.mcap"), key=in_order)
            for path in files[:-2]:
                with suppress(OSError):
                    path.unlink()
                deleted.add(path)
            if bus.sent >= count:
                time.sleep(0.5)
                stop.set()

    # Only the source of the frames is simulated; it sends no EMCY.
    setattr(armident.daq.capture.capture, "open_bus", open_bus)  # noqa: B010
    setattr(armident.drivers.can.filtered_socket, "open_bus", lambda config, **_: GeneratedBus(0, 1.0))  # noqa: B010
    watcher = threading.Thread(target=watch)
    watcher.start()
    begin, cpu = time.monotonic(), time.process_time()
    try:
        done = armident.daq.capture.capture.capture(plan, stop)
    finally:
        ended.set()
        watcher.join()
    if done.failure is not None:
        raise ArmidentError(str(done.failure))
    wall, used = time.monotonic() - begin, time.process_time() - cpu
    rows = done.counters["samples.rows"]
    print(
        f"{count} SYNCs, {7 * count} frames ({count / RATE_HZ / 60:.1f} min) in {wall:.0f} s, CPU {used:.0f} s;",
        end=" ",
    )
    lost = done.counters["writer.rows_lost"]
    print(f"rows {rows}, in gaps {done.counters['samples.in_gaps']}, not written {lost}, files {len(done.paths)}")
    print(
        "memory, MB, at minute: " + ", ".join(f"{m:.1f} ({at:.0f})" for at, m in memory[:: max(1, len(memory) // 10)])
    )
    settled = memory[len(memory) // 4][1]
    print(json.dumps({"settled_mb": settled, "end_mb": memory[-1][1], "most_mb": max(m for _, m in memory)}))
    return int(rows != count or lost or memory[-1][1] > 1.05 * settled)


if __name__ == "__main__":
    sys.exit(main())
