"""Random faults of buses, drives, disk and host: ``python -m tests.faults.bus --rounds 200 --seed 1``.

Each round is a short capture at 1 kHz of six drives on one bus or two, with one to three faults at random times. The
first fault goes through the list by rounds. The values of a sample encode its SYNC. An independent socket counts the
SYNCs of the bus. Every SYNC must be received or in the gap list, and none twice. Every value must be of its SYNC, and
the recording must report the faults. Runs under ``python -m armident.drivers.vcan``.
"""

import argparse
import multiprocessing
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from armident.configs import config_path, load_robot, load_session
from armident.daq.recording import read_recording
from armident.daq.recording.model import join_parts
from armident.drivers.vcan import ensure_vcan, remove_vcan
from tests.faults.check import violations
from tests.faults.farm import Farm
from tests.faults.plan import EVERY_FAULT, FAULTS, ORDERED, ROTATE_S, Outcome, Plan, RoundSetup, random_plan
from tests.faults.recorder import log_text, result, start_capture
from tests.fixtures.processes import ForkedProcess

PERIOD_US = 1000
DISK_BYTES = 3 << 20
ATTEMPTS = 4
"""Most attempts of a round."""
OF_ANOTHER = "are not of their SYNC"
UNFINISHED = "could not be finished: No space left on device"
SMALL_BUFFER = 96 << 10
"""Size of the receive buffer that a fault overruns, bytes."""
LONGEST_S = 40.0
"""Longest duration of a round, s."""
SWITCH_S = 0.0005
"""Switch interval of the threads of a process, s."""
SLOW = {
    "reboot": 0.9,
    "mapped_shorter": 1.0,
    "mapped_otherwise": 1.0,
    "heartbeat": 0.5,
    "sync_stops": 0.6,
    "disk_full": 0.4,
    "rotation": 0.5,
    "kernel_drop": 0.6,
    "held_up": 0.4,
}
"""Additional duration of rounds with these faults, s."""


@dataclass(frozen=True)
class Round:
    """Result of a round."""

    number: int
    faults: list[str]
    shape: str
    syncs: int
    rows: int
    in_gaps: int
    gaps: int
    violations: list[str]
    unreported: list[str]
    log_text: str = ""
    undone: Sequence[str] = ()
    """Faults that did not occur: the drives were late anyway, or nothing was written to the disk."""
    dropped: Sequence[str] = ()
    """Violations in attempts that were repeated, because the host disturbed the planned faults."""


def session_file(
    folder: Path,
    name: str,
    channels: Sequence[str],
    producing: bool,
    rotating: bool,
    period_us: int = PERIOD_US,
    demand: bool = True,
) -> Path:
    """Write a session of six drives on some buses."""
    source = config_path("tx40_replay.yaml")
    data = yaml.safe_load(source.read_text())
    data |= {"cell": name, "robot": str(config_path(data["robot"])), "heartbeat_ms": 50, "sdo_timeout_s": 1.0}
    data["sync"] = {"role": "producer" if producing else "consumer", "period_us": period_us, "counter": 240}
    if demand:
        data["streams"]["demand"] = {"tpdo": 2, "every": 5, "objects": ["demand"]}
    data["recording"] = {"rotate_minutes": ROTATE_S / 60} if rotating else {}
    del data["bus"]
    data["buses"] = [{"channel": channel, "bitrate": None} for channel in channels]
    for i, drive in enumerate(data["drives"]):
        drive |= {"eds": str(config_path(drive["eds"])), "bus": channels[i * len(channels) // 6]}
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


class Worker:
    """Runs rounds one after the other, with own buses and a small disk."""

    def __init__(self, name: str, seed: int) -> None:
        self._seed, self._name = seed, name
        self._folder = Path(tempfile.mkdtemp(prefix="armident-faults-"))
        self._disk = self._folder / "disk"
        self._disk.mkdir()
        size = f"size={DISK_BYTES}"
        subprocess.run(["mount", "-t", "tmpfs", "-o", size, "disk", str(self._disk)], check=True)
        self._channels = [f"{name}n{i}" for i in range(3)]
        for channel in self._channels:
            ensure_vcan(channel)
        robot = load_robot("tx40.yaml")
        self._farms = {}
        for buses in (1, 2):
            path = session_file(self._folder, f"{name}of{buses}", self._of(buses), True, False)
            self._farms[buses] = Farm(load_session(path), robot)

    def _of(self, buses: int) -> list[str]:
        return self._channels[:1] if buses == 1 else self._channels[1:]

    def close(self) -> None:
        """Remove buses, disk and files."""
        for farm in self._farms.values():
            farm.close()
        subprocess.run(["umount", str(self._disk)], check=False)
        for channel in self._channels:
            remove_vcan(channel)
        shutil.rmtree(self._folder)

    def run(self, number: int, plan: Plan | None = None, only: Sequence[str] = ()) -> Round:
        """Run one round, as planned or at random; repeat it if the host disturbed the planned faults.

        The disturbance must explain every violation. Drives that became late explain values of another SYNC, but no
        missing SYNC. A disk that was full to the end explains a file that could not be finished.
        """
        dropped: list[str] = []
        for attempt in range(ATTEMPTS):
            found, explained = self._attempt(number, attempt, plan, only)
            if not found.violations or explained is None or any(explained not in text for text in found.violations):
                break
            if attempt + 1 < ATTEMPTS:
                dropped += found.violations
        return replace(found, dropped=dropped)

    def _attempt(self, number: int, attempt: int, plan: Plan | None, only: Sequence[str]) -> tuple[Round, str | None]:
        """Run a round once; return its result, and the violation that a disturbance by the host explains."""
        rng = np.random.default_rng([self._seed, number])
        faults, producing, buses = random_plan(rng, number, only) if plan is None else plan
        farm = self._farms[buses]
        farm.master = not producing
        seconds = 1.0 + max([SLOW.get(name, 0.0) for name in faults])
        pids: list[int] = []
        setup = RoundSetup(rng, farm, seconds, self._disk, lambda: pids[0])
        expected = {name: FAULTS[name](setup) for name in faults}
        farm.prepare(setup.answer_faults, setup.actions, None if producing else setup.syncs)
        path = session_file(self._folder, f"{self._name}r{number}", self._of(buses), producing, "rotation" in faults)
        out, log = self._disk / f"r{number}a{attempt}", self._folder / f"r{number}a{attempt}"
        out.mkdir()
        small = SMALL_BUFFER if "kernel_drop" in faults else None
        process = start_capture(path, out, log, seconds if producing else None, small)
        pids.append(process.pid)
        try:
            self._wait(process, farm, log, producing)
        finally:
            process.kill()
            process.wait()
            seen, syncs_by_bus = farm.finish(), [list(state.syncs) for state in farm.buses]
        words = log_text(log)
        explained = OF_ANOTHER if setup.answer_faults.disturbed else None
        undone = [name for name in faults if name in ORDERED and ORDERED[name] not in setup.answer_faults.done]
        faults = [name for name in faults if name not in undone]
        if process.returncode != 0:
            what = [f"the capture ended with {process.returncode}"]
            if setup.answer_faults.full_at_end and UNFINISHED in words and _truncated_only(out):
                what, explained = [f"{what[0]}: {UNFINISHED}"], UNFINISHED
            shutil.rmtree(out)
            return Round(number, faults, _shape(producing, buses), 0, 0, 0, 0, what, [], words), explained
        try:
            paths, counters = result(log)
            done = Outcome(join_parts([read_recording(p) for p in paths]), counters, words, len(paths))
            wrong = violations(done, syncs_by_bus, seen, producing, "sync_stops" in faults)
            unreported = [name for name in faults if not expected[name](done)]
            if "disk_full" in unreported and "full" not in setup.answer_faults.done:
                for some in (unreported, faults):
                    some.remove("disk_full")
                undone.append("disk_full")
            if done.recording.missing:
                wrong.append(f"torn: {done.recording.missing}")
        except Exception as error:
            what = [f"{type(error).__name__}: {error}"]
            return Round(number, faults, _shape(producing, buses), 0, 0, 0, 0, what, [], words), None
        gaps = [g for g in done.recording.gaps if g.stream == "samples"]
        covered = {k for g in gaps for k in range(g.first, g.last + 1)}
        rows = done.recording.samples.sync.size
        shutil.rmtree(out)
        report = words if wrong or unreported else ""
        if report:
            report += f"\n{counters}\n" + "\n".join(map(str, done.recording.gaps[:30]))
        found = Round(
            number, faults, _shape(producing, buses), len(set().union(*syncs_by_bus)), rows, len(covered), len(gaps),
            wrong, unreported, report, undone,
        )  # fmt: skip
        return found, explained

    def _wait(self, process: ForkedProcess, farm: Farm, log: Path, producing: bool) -> None:
        """Wait for the end of the capture; a foreign master starts when it is ready, and ends before it."""
        deadline = time.monotonic() + LONGEST_S
        stopped = producing
        since = None
        while process.returncode is None and time.monotonic() < deadline:
            if farm.failed is not None:
                raise farm.failed
            if not producing and not farm.begun:
                ready = farm.operational and "recording to" in log_text(log)
                since = (since or time.monotonic()) if ready else None
                if since is not None and time.monotonic() - since > 0.05:
                    farm.released.set()
            if not stopped and farm.done:
                time.sleep(0.3)
                os.kill(process.pid, signal.SIGINT)
                stopped = True
            time.sleep(0.02)


def _truncated_only(folder: Path) -> bool:
    """Return whether all files are readable, and the unfinished one is reported as such."""
    return any([bool(read_recording(path).missing) for path in folder.glob("*.mcap")])


def _shape(producing: bool, buses: int) -> str:
    return f"{'own' if producing else 'foreign'} SYNC, {buses} bus{'es' if buses > 1 else ''}"


def run_rounds(rounds: int, seed: int, jobs: int, plans: Sequence[Plan] = (), only: Sequence[str] = ()) -> list[Round]:
    """Run rounds in several processes at once, since most of their time is spent waiting."""
    sys.setswitchinterval(SWITCH_S)
    context = multiprocessing.get_context("fork")
    numbers, done = context.Queue(), context.Queue()
    for number in range(rounds):
        numbers.put(number)
    for _ in range(jobs):
        numbers.put(None)

    def work(name: str) -> None:
        worker = Worker(name, seed)
        try:
            while (number := numbers.get()) is not None:
                done.put(worker.run(number, plans[number] if plans else None, only))
        finally:
            worker.close()

    # Forked before any thread exists.
    running = [context.Process(target=work, args=(f"f{os.getpid() % 10**6}x{i}",)) for i in range(jobs)]
    for process in running:
        process.start()
    found: list[Round] = []
    while len(found) < rounds and any(process.is_alive() for process in running):
        with suppress(queue.Empty):
            found.append(done.get(timeout=1.0))
            if sys.stderr.isatty() or len(found) % 20 == 0:
                print(f"{len(found)} of {rounds} rounds", file=sys.stderr, flush=True)
    for process in running:
        process.join()
    return sorted(found, key=lambda r: r.number)


def show(rounds: Sequence[Round]) -> int:
    """Print the table by fault and the violations; return the number of rounds with any."""
    by_fault: dict[str, list[Round]] = defaultdict(list)
    for one in rounds:
        for name in one.faults:
            by_fault[name].append(one)
    line = "{:18} {:>7} {:>9} {:>9} {:>9} {:>7} {:>11} {:>11}"
    print(line.format("fault", "rounds", "SYNCs", "rows", "in gaps", "gaps", "violations", "unreported"))
    for name in [*FAULTS, "all"]:
        part = list(rounds) if name == "all" else by_fault[name]
        sums = [sum(getattr(r, what) for r in part) for what in ("syncs", "rows", "in_gaps", "gaps")]
        wrong = sum(1 for r in part if r.violations)
        print(
            line.format(
                name,
                len(part),
                *sums,
                wrong,
                sum(len(r.unreported) if name == "all" else name in r.unreported for r in part),
            )
        )
    for r in rounds:
        if r.undone:
            why = "the drives were late anyway, or nothing was written to the disk"
            print(f"round {r.number}: {', '.join(r.undone)} did not occur: {why}")
        for text in r.dropped:
            print(f"round {r.number}: repeated, because the host disturbed the planned faults: {text}")
    bad = [r for r in rounds if r.violations or r.unreported]
    for r in bad:
        print(f"\nround {r.number} ({r.shape}; {', '.join(r.faults)}):")
        print(*(f"  {text}" for text in r.violations), *(f"  not reported: {name}" for name in r.unreported), sep="\n")
        print("    " + r.log_text.replace("\n", "\n    "))
    return len(bad)


def main() -> int:
    """Run the rounds and print the table; return 1 if there are violations."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.bus", description=__doc__)
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="number of simultaneous captures")
    parser.add_argument("--every-fault", action="store_true", help="few rounds that contain every fault once")
    parser.add_argument("--only", action="append", default=[], choices=list(FAULTS), help="only these faults")
    options = parser.parse_args()
    begin = time.monotonic()
    plans = EVERY_FAULT if options.every_fault else ()
    wanted = len(plans) or options.rounds
    rounds = run_rounds(wanted, options.seed, options.jobs, plans, options.only)
    bad = show(rounds)
    print(f"\n{len(rounds)} rounds in {time.monotonic() - begin:.0f} s, seed {options.seed}; {bad} with violations")
    return int(bad > 0 or len(rounds) != wanted)


if __name__ == "__main__":
    sys.exit(main())
