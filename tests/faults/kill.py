"""Captures killed at random moments: ``python -m tests.faults.kill --rounds 200``.

Each round captures six drives at 1 to 5 kHz and is ended by SIGKILL. Every fifth round rotates its files quickly, in
every third a drive omits some answers. The loss is the time of the SYNCs that an independent socket has received and
the files do not contain; 100 ms at most. Every file is readable without its summary. ``recover_recording`` writes the
summary and changes nothing else; other MCAP readers then open the file, too. Runs under
``python -m armident.drivers.vcan``.
"""

import argparse
import multiprocessing
import os
import queue
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from numpy.typing import NDArray

from armident.daq.recording import read_recording, recover_recording
from armident.daq.recording.model import join_parts
from armident.daq.recording.names import in_order
from armident.drivers.can.frames import STANDARD_ID_MASK
from armident.drivers.can.socketcan import RawSocket
from armident.drivers.canopen.objects import COB_SYNC
from armident.drivers.vcan import ensure_vcan, remove_vcan
from tests.faults.bus import session_file
from tests.faults.farm import read_syncs
from tests.faults.recorder import log_text, start_capture
from tests.faults.sender import Sender, current_of, position_of

RATES_HZ = (1000, 2000, 5000)
MOST_LOST_MS = 100.0
LONGEST_WAIT_S = 20.0


@dataclass(frozen=True)
class Kill:
    """Result of a round."""

    number: int
    rate_hz: int
    files: int
    lossy: bool
    received: int
    """SYNCs that an independent socket had received when the signal was sent."""
    kept: int
    lost_ms: float
    violations: list[str]


class Worker:
    """Runs rounds one after the other on an own bus."""

    def __init__(self, name: str, seed: int) -> None:
        self._name, self._seed = name, seed
        self._folder = Path(tempfile.mkdtemp(prefix="armident-kill-"))
        ensure_vcan(name)

    def close(self) -> None:
        """Remove bus and files."""
        remove_vcan(self._name)
        shutil.rmtree(self._folder)

    def run(self, number: int) -> Kill:
        """Run one round."""
        rng = np.random.default_rng([self._seed, number])
        rate = int(rng.choice(RATES_HZ))
        lossy = rate // 7 if number % 3 == 2 else 0
        path = session_file(
            self._folder, f"{self._name}k{number}", [self._name], False, number % 5 == 4, 10**6 // rate, demand=False
        )
        out, log = self._folder / f"k{number}", self._folder / f"k{number}.log"
        with (
            RawSocket(self._name, filters=[(COB_SYNC, STANDARD_ID_MASK)]) as witness,
            Sender([self._name], 10**6 // rate, lossy=lossy) as sender,
        ):
            capture = start_capture(path, out, log, listen_only=True)
            deadline = time.monotonic() + LONGEST_WAIT_S
            while "recording to" not in log_text(log) and capture.returncode is None and time.monotonic() < deadline:
                time.sleep(0.01)
            time.sleep(0.1)
            sender.go()
            time.sleep(float(rng.uniform(0.15, 1.2)))
            # SYNCs after the kill are no loss.
            at_ns = time.time_ns()
            capture.kill()
            capture.wait()
            sender.stop()
            received = read_syncs(witness)
        received = received[received[:, 0] <= at_ns, 0]
        wrong = [] if capture.returncode == -signal.SIGKILL else [f"ended with {capture.returncode}: {log_text(log)}"]
        files, kept = sorted(out.glob("*.mcap"), key=in_order), 0
        try:
            kept = self._checked(files, received, wrong)
        except Exception as error:
            wrong.append(f"{type(error).__name__}: {error}")
        lost_ms = _lost_ms(np.append(received[max(kept, 1) - 1 :], at_ns), 10**9 // rate) if kept else np.inf
        if lost_ms > MOST_LOST_MS:
            wrong.append(f"{lost_ms:.1f} ms lost")
        shutil.rmtree(out)
        return Kill(number, rate, len(files), lossy > 0, received.size, kept, lost_ms, wrong)

    def _checked(self, files: list[Path], received: NDArray[np.int64], wrong: list[str]) -> int:
        """Return the number of received SYNCs that the files contain; check them before and after recovery."""
        torn = [read_recording(path) for path in files]
        if all(part.missing is None for part in torn):
            wrong.append("no file is reported as incomplete")
        for path in files:
            recover_recording(path)
        whole = [read_recording(path) for path in files]
        for path, before, after in zip(files, torn, whole, strict=True):
            if before.sha256 != after.sha256 or before.gaps != after.gaps or before.missing != after.missing:
                wrong.append(f"{path.name}: recovery has changed its contents")
            with path.open("rb") as file:
                summary = make_reader(file).get_summary()
            if summary is None or summary.statistics is None:
                wrong.append(f"{path.name}: other readers find no summary")
        recording = join_parts(whole)
        samples = recording.samples
        gaps = {k for g in recording.gaps if g.stream == "samples" for k in range(g.first, g.last + 1)}
        together = np.union1d(samples.sync, np.array(sorted(gaps), np.int64))
        if not np.array_equal(together, np.arange(together.size)):
            wrong.append("a SYNC in the middle is neither received nor in a gap")
        here = samples.sync < received.size
        if not np.array_equal(samples.t_ns[here], received[samples.sync[here]]):
            wrong.append("rows are not numbered as the SYNCs were sent")
        k, joints = samples.sync[:, None], np.arange(6)
        right = samples.raw["position"] == position_of(k, joints)
        if not (right & (samples.raw["current"] == current_of(k, joints))).all():
            wrong.append("values are not of their SYNC")
        return int(min(together.size, received.size))


def _lost_ms(times: NDArray[np.int64], period_ns: int) -> float:
    """Return the time of the lost samples, ms.

    ``times`` (ns) begin with the last SYNC that is in the files and end with the kill. An interval counts for at most
    one period: no samples are lost while the whole machine is stopped.
    """
    return float(np.minimum(np.diff(times), period_ns).sum()) / 1e6 if times.size > 2 else 0.0


def run_rounds(rounds: int, seed: int, jobs: int) -> list[Kill]:
    """Run rounds in several processes at once."""
    context = multiprocessing.get_context("fork")
    numbers, done = context.Queue(), context.Queue()
    for number in [*range(rounds), *[None] * jobs]:
        numbers.put(number)

    def work(name: str) -> None:
        worker = Worker(name, seed)
        try:
            while (number := numbers.get()) is not None:
                done.put(worker.run(number))
        finally:
            worker.close()

    running = [context.Process(target=work, args=(f"k{os.getpid() % 10**6}x{i}",)) for i in range(jobs)]
    for process in running:
        process.start()
    found: list[Kill] = []
    while len(found) < rounds and any(process.is_alive() for process in running):
        with suppress(queue.Empty):
            found.append(done.get(timeout=1.0))
    for process in running:
        process.join()
    return sorted(found, key=lambda r: r.number)


def show(kills: Sequence[Kill]) -> int:
    """Print losses by rate, and violations; return the number of rounds with any."""
    line = "{:>8} {:>7} {:>7} {:>11} {:>11} {:>9} {:>9} {:>11}"
    print(line.format("rate", "rounds", "files", "SYNCs", "median ms", "p90 ms", "max ms", "violations"))
    for rate in (*RATES_HZ, "lossy", "all"):
        part = [kill for kill in kills if rate in ("all", kill.rate_hz) or (rate == "lossy" and kill.lossy)]
        if part:
            lost = np.array([kill.lost_ms for kill in part])
            figures = [f"{x:.1f}" for x in (np.median(lost), np.quantile(lost, 0.9), lost.max())]
            received, files = sum(k.received for k in part), sum(k.files for k in part)
            print(line.format(rate, len(part), files, received, *figures, sum(1 for k in part if k.violations)))
    bad = [kill for kill in kills if kill.violations]
    for kill in bad:
        kind = f"{kill.rate_hz} Hz, {kill.files} files{', lossy' if kill.lossy else ''}"
        print(f"round {kill.number} ({kind}): {'; '.join(kill.violations)}")
    return len(bad)


def main() -> int:
    """Run the rounds and print the table; return 1 if there are violations."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.kill", description=__doc__)
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1, help="number of simultaneous captures")
    options = parser.parse_args()
    begin = time.monotonic()
    kills = run_rounds(options.rounds, options.seed, options.jobs)
    bad = show(kills)
    print(f"{len(kills)} kills in {time.monotonic() - begin:.0f} s, seed {options.seed}; {bad} with violations")
    return int(bad > 0 or len(kills) != options.rounds)


if __name__ == "__main__":
    sys.exit(main())
