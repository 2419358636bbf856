"""Captures killed at random moments: ``python -m tests.faults.kill --rounds 200``.

Each round captures what six drives send at 1 to 5 kHz and is ended by SIGKILL, every fifth with files that are turned
over all the time, every third with a drive that does not answer now and then. By the kill an independent socket on the
bus has heard some SYNCs; those that the files do not account for afterwards are what it cost, at most 100 ms of them.
Every file opens torn, is healed by ``recover_recording``, and says the same as before; other MCAP readers then open it
too. Runs under ``python -m armident.drivers.vcan``.
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
from armident.drivers.can.frames import STANDARD_ID_MASK
from armident.drivers.can.socketcan import RawSocket
from armident.drivers.canopen.objects import COB_SYNC
from armident.drivers.vcan import ensure_vcan, remove_vcan
from tests.faults.bus import session_file
from tests.faults.farm import drained
from tests.faults.recorder import Recorders, said, warm
from tests.faults.sender import Sender, current_of, position_of

RATES_HZ = (1000, 2000, 5000)
MOST_LOST_MS = 100.0
LONGEST_WAIT_S = 20.0


@dataclass(frozen=True)
class Kill:
    """What one kill cost."""

    number: int
    rate_hz: int
    files: int
    lossy: bool
    heard: int
    """SYNCs that an independent socket had received when the signal was sent."""
    kept: int
    lost_ms: float
    violations: list[str]


class Lane:
    """Rounds one after the other on a bus of their own."""

    def __init__(self, name: str, seed: int) -> None:
        self._name, self._seed = name, seed
        self._recorders = Recorders()
        self._folder = Path(tempfile.mkdtemp(prefix="armident-kill-"))
        ensure_vcan(name)

    def close(self) -> None:
        """Leave nothing behind."""
        self._recorders.close()
        remove_vcan(self._name)
        shutil.rmtree(self._folder)

    def run(self, number: int) -> Kill:
        """One round."""
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
            capture = self._recorders.start(path, out, log, listen_only=True)
            deadline = time.monotonic() + LONGEST_WAIT_S
            while "recording to" not in said(log) and capture.exitcode is None and time.monotonic() < deadline:
                time.sleep(0.01)
            time.sleep(0.1)
            sender.go()
            time.sleep(float(rng.uniform(0.15, 1.2)))
            # What the bus had carried by the moment of the kill; what comes after it is nobody's loss.
            at_ns = time.time_ns()
            capture.kill()
            capture.join()
            sender.stop()
            heard = drained(witness)
        heard = heard[heard[:, 0] <= at_ns, 0]
        wrong = [] if capture.exitcode == -signal.SIGKILL else [f"ended with {capture.exitcode}: {said(log)}"]
        files, kept = sorted(out.glob("*.mcap")), 0
        try:
            kept = self._checked(files, heard, wrong)
        except Exception as error:
            wrong.append(f"{type(error).__name__}: {error}")
        lost_ms = _lost_ms(np.append(heard[max(kept, 1) - 1 :], at_ns), 10**9 // rate) if kept else np.inf
        if lost_ms > MOST_LOST_MS:
            wrong.append(f"{lost_ms:.1f} ms lost")
        shutil.rmtree(out)
        return Kill(number, rate, len(files), lossy > 0, heard.size, kept, lost_ms, wrong)

    def _checked(self, files: list[Path], heard: NDArray[np.int64], wrong: list[str]) -> int:
        """How many of the SYNCs heard the files account for, as found torn, and the same when healed."""
        torn = [read_recording(path) for path in files]
        if all(part.missing is None for part in torn):
            wrong.append("nothing is said to be missing")
        for path in files:
            recover_recording(path)
        whole = [read_recording(path) for path in files]
        for path, before, after in zip(files, torn, whole, strict=True):
            if before.sha256 != after.sha256 or before.gaps != after.gaps or before.missing != after.missing:
                wrong.append(f"{path.name}: healing has changed what it says")
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
        here = samples.sync < heard.size
        if not np.array_equal(samples.t_ns[here], heard[samples.sync[here]]):
            wrong.append("rows are not numbered as the SYNCs were sent")
        k, joints = samples.sync[:, None], np.arange(6)
        right = samples.raw["position"] == position_of(k, joints)
        if not (right & (samples.raw["current"] == current_of(k, joints))).all():
            wrong.append("values are not of their SYNC")
        return int(min(together.size, heard.size))


def _lost_ms(times: NDArray[np.int64], period_ns: int) -> float:
    """Time that the samples cover between the first of ``times``, that of the last SYNC kept, and the last, the kill.

    What comes until the next SYNC belongs to the last. A machine that stood still as a whole lost no samples meanwhile.
    """
    return float(np.minimum(np.diff(times), period_ns).sum()) / 1e6 if times.size > 2 else 0.0


def in_lanes(rounds: int, seed: int, lanes: int) -> list[Kill]:
    """Rounds in several processes at once."""
    warm()
    context = multiprocessing.get_context("fork")
    numbers, done = context.Queue(), context.Queue()
    for number in [*range(rounds), *[None] * lanes]:
        numbers.put(number)

    def work(name: str) -> None:
        lane = Lane(name, seed)
        try:
            while (number := numbers.get()) is not None:
                done.put(lane.run(number))
        finally:
            lane.close()

    running = [context.Process(target=work, args=(f"k{os.getpid() % 10**6}x{i}",)) for i in range(lanes)]
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
    """Print what was lost, by rate, and what was wrong; how many rounds that concerns."""
    line = "{:>8} {:>7} {:>7} {:>11} {:>11} {:>9} {:>9} {:>11}"
    print(line.format("rate", "rounds", "files", "SYNCs", "median ms", "p90 ms", "max ms", "violations"))
    for rate in (*RATES_HZ, "lossy", "all"):
        part = [kill for kill in kills if rate in ("all", kill.rate_hz) or (rate == "lossy" and kill.lossy)]
        if part:
            lost = np.array([kill.lost_ms for kill in part])
            figures = [f"{x:.1f}" for x in (np.median(lost), np.quantile(lost, 0.9), lost.max())]
            heard, files = sum(k.heard for k in part), sum(k.files for k in part)
            print(line.format(rate, len(part), files, heard, *figures, sum(1 for k in part if k.violations)))
    bad = [kill for kill in kills if kill.violations]
    for kill in bad:
        kind = f"{kill.rate_hz} Hz, {kill.files} files{', lossy' if kill.lossy else ''}"
        print(f"round {kill.number} ({kind}): {'; '.join(kill.violations)}")
    return len(bad)


def main() -> int:
    """Run the rounds and print the table; 1 if anything is wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.kill", description=__doc__)
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--lanes", type=int, default=1, help="captures at once")
    options = parser.parse_args()
    begin = time.monotonic()
    kills = in_lanes(options.rounds, options.seed, options.lanes)
    bad = show(kills)
    print(f"{len(kills)} kills in {time.monotonic() - begin:.0f} s, seed {options.seed}; {bad} with something wrong")
    return int(bad > 0 or len(kills) != options.rounds)


if __name__ == "__main__":
    sys.exit(main())
