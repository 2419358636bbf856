"""The commands of a cell killed at random moments on a bus: ``python -m tests.faults.service_vcan --rounds 200``.

A virtual EMPS is on a vcan bus. Each round moves it by ``armident capture`` or ``armident reidentify`` beside two
``armident worker`` and one ``armident history``, and ends some of them by SIGKILL. The moments are uniform over the
time that a command takes. In the end one worker finishes what is left. Every recording with samples, also one that
the kill has torn, then has exactly one result, which was announced once, and one entry in the history. Commands that
are not killed end without an error, and none is left running. Runs under ``python -m armident.drivers.vcan``.
"""

import math
import os
import random
import signal
import sys
import time
from collections import Counter
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import yaml

from armident.configs import ArmidentError, load_session
from armident.daq.recording import read_recording
from armident.drivers.vcan import ensure_vcan, remove_vcan
from armident.identify.monitoring.worker.recorded import captured_in
from tests.faults.service import (
    Audience,
    options_of_rounds,
    recorded,
    run_in_new_folder,
    store_of,
    violations,
    wait_for_results,
)
from tests.fixtures.processes import ForkedProcess, armident
from tests.statistics.weeks import cell_file, robot_on

TRAJECTORY = {
    "schema": "armident/trajectory/1",
    "start": [0],
    "moves": [
        {"to": [0.05], "duration": 0.56},
        {"to": [-0.05], "duration": 0.9},
        {"to": [0.03], "duration": 0.8},
        {"to": [0.0], "duration": 0.56},
    ],
}
"""Motion of a round: a few seconds with both directions and several accelerations."""
PART_MINUTES = 0.015
"""Length of the files of a capture that begins new ones, min."""
REIDENTIFY = 0.25
"""Share of the rounds with a re-identification: it starts guard and capture in new interpreters."""
LONGEST_S = 900.0
"""Longest time of a command on a busy machine, s."""
ENDED = {0, 4}
"""Exit codes of commands that were not killed: done, and done with a change."""
REFUSED = 3
"""Exit code of a re-identification whose recording has too many gaps, as on a machine without time for the arm."""


@dataclass
class Service:
    """Commands of a cell with an arm on a bus, and the number of their kills.

    ``folder``: folder of the cell, whose recordings and results are in it; ``rng``: source of the random moments.
    """

    folder: Path
    bus: str
    rng: random.Random
    kills: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    _workers: list[ForkedProcess] = field(default_factory=list)
    _takes: dict[str, float] = field(default_factory=lambda: {"capture": 8.0, "history": 3.0, "reidentify": 40.0})

    def __post_init__(self) -> None:
        trajectory = self.folder / "trajectory.yaml"
        trajectory.write_text(yaml.safe_dump(TRAJECTORY), encoding="utf-8")
        cell = "".join(letter if letter.isalnum() else "_" for letter in self.folder.name.lower())
        setpoints = {"rpdo": 1, "every": 5, "trajectory": str(trajectory)}
        changes = {"sync": {"period_us": 1000}, "identification": {"method": "idim-ls"}, "setpoints": setpoints}
        recording = {"directory": str(self.folder)}
        configs = self.folder / "config"
        for sort, more in (("whole", {}), ("parts", {"rotate_minutes": PART_MINUTES})):
            (configs / sort).mkdir(parents=True, exist_ok=True)
            cell_file(configs / sort, self.bus, cell, "emps_cell.yaml", **changes, recording=recording | more)
        self._configs = {sort: configs / sort / f"{cell}.yaml" for sort in ("whole", "parts")}
        self.session = load_session(self._configs["whole"])
        self._log = (self.folder / "service.log").open("ab+")
        self._robot = robot_on(self._configs["whole"], self.folder / "robot.log", self.rng.randrange(1000), None)

    def close(self) -> None:
        """End the virtual arm."""
        self._robot.terminate()
        self._robot.wait(60.0)
        self._log.close()

    def round(self, number: int) -> None:
        """Run one round: one motion; every command is killed with a probability of a half."""
        self._workers = [worker for worker in self._workers if worker.poll() is None]
        while len(self._workers) < 2:
            self._workers.append(self._start("worker", "--config", self._configs["whole"]))
        running = {}
        results = sorted(self.folder.glob("*.identification/identification.json"))
        if results:
            some = sorted(self.rng.sample(results, min(5, len(results))))
            running["history"] = self._start("history", *some, "--database", store_of(self.folder))
        if self.rng.random() < REIDENTIFY:
            job = ("--config", self._configs["whole"], "--store", store_of(self.folder), "--time-limit", 1)
            running["reidentify"] = self._start("reidentify", *job)
        else:
            config = self._configs["parts" if self.rng.random() < 0.3 else "whole"]
            running["capture"] = self._start("capture", "--config", config)
        self._run(running, number)
        self._wait_for_orphans(number)

    def _run(self, running: dict[str, ForkedProcess], number: int) -> None:
        """Wait for the commands of a round, and kill those that are chosen."""
        begin = time.monotonic()
        longest = max(self._takes[kind] for kind in running)
        doomed = {
            kind: self.rng.random() * self._takes.get(kind, longest)
            for kind in (*running, "worker")
            if self.rng.random() < 0.5
        }
        victims = running | {"worker": self.rng.choice(self._workers)}
        waiting = set(running)
        while waiting or doomed:
            now = time.monotonic() - begin
            for kind in [kind for kind, at in doomed.items() if at <= now]:
                self._kill(kind, victims[kind])
                del doomed[kind]
            for kind in [kind for kind in waiting if running[kind].poll() is not None]:
                waiting.remove(kind)
                if running[kind].returncode != -signal.SIGKILL:
                    doomed.pop(kind, None)
                    self._takes[kind] = now
                    if kind != "reidentify" or running[kind].returncode != REFUSED:
                        self._check(f"round {number}: {kind}", running[kind])
            if now > LONGEST_S:
                for kind in waiting:
                    self._kill(f"{kind} that did not end", running[kind])
                    self.wrong.append(f"round {number}: {kind} did not end")
                return
            time.sleep(0.02)

    def finish(self) -> None:
        """Let one new worker do what is left, and add all results to the history."""
        for worker in self._workers:
            self._kill("worker", worker)
        last = self._start("worker", "--config", self._configs["whole"])
        try:
            wait_for_results(self.folder, LONGEST_S)
        finally:
            last.terminate()
            last.wait(LONGEST_S)
        self._check("last worker", last)
        results = sorted(self.folder.glob("*.identification/identification.json"))
        history = self._start("history", *results, "--database", store_of(self.folder))
        history.wait(LONGEST_S)
        self._check("last history", history)

    def _start(self, *words: object) -> ForkedProcess:
        return armident(*words, stdout=self._log, stderr=self._log)

    def _kill(self, kind: str, process: ForkedProcess) -> None:
        if process.poll() is None:
            process.kill()
            process.wait()
            self.kills[kind] += 1

    def _check(self, what: str, process: ForkedProcess) -> None:
        if process.returncode not in ENDED:
            self.wrong.append(f"{what} ended with exit code {process.returncode}: {self._last_line()}")

    def _last_line(self) -> str:
        lines = _content(self._log).splitlines()
        return next((line for line in reversed(lines) if line.startswith("armident: ")), "it printed nothing")

    def _wait_for_orphans(self, number: int) -> None:
        """Wait for the end of guard and capture of a re-identification that was killed."""
        until = time.monotonic() + LONGEST_S / 10
        while orphans := commands_of(self._configs["whole"]):
            if time.monotonic() > until:
                self.wrong.append(f"round {number}: left running: {', '.join(sorted(orphans.values()))}")
                for pid in orphans:
                    os.kill(pid, signal.SIGKILL)
                until = time.monotonic() + LONGEST_S / 10
            time.sleep(0.1)


def commands_of(config: Path) -> dict[int, str]:
    """Return the processes that were started with a configuration: their numbers and the words of their commands."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            words = entry.joinpath("cmdline").read_bytes().decode(errors="replace").split("\0")
            if str(config) in words and "armident.daq.cli" in words:
                found[int(entry.name)] = words[words.index("armident.daq.cli") + 1]
    return found


def unreadable(folder: Path) -> list[str]:
    """Return the recordings that cannot be read, not even as empty ones, or that belong to no capture."""
    files = {path.resolve() for path in folder.glob("*.mcap")}
    known = {path for captured in captured_in((folder,), "emps") for path in captured.paths}
    wrong = [f"{path.name}: of no capture" for path in files - known]
    for path in files:
        try:
            read_recording(path)
        except ArmidentError as error:
            wrong.append(f"{path.name}: {error}")
    return wrong


def _content(file: IO[bytes]) -> str:
    return os.pread(file.fileno(), os.fstat(file.fileno()).st_size, 0).decode(errors="replace")


def run_rounds(rounds: int, seed: int, folder: Path, bus: str, minutes: float = math.inf) -> list[str]:
    """Run rounds in a new folder, fewer if the time is over, and print the figures; return what is wrong."""
    begin, done = time.monotonic(), 0
    service = Service(folder, bus, random.Random(seed))
    with closing(service), closing(Audience(service.session, "emps")) as audience:
        for number in range(rounds):
            if time.monotonic() - begin > 60.0 * minutes:
                break
            service.round(number)
            done += 1
            print(f"round {number}: {time.monotonic() - begin:.0f} s, {dict(service.kills)}", flush=True)
        service.finish()
        wrong, recordings, results = violations(folder, audience)
    wrong = service.wrong + wrong + unreadable(folder)
    if 3 * recordings < done:
        wrong.append(f"only {recordings} recordings with samples in {done} rounds")
    parts = sum(len(captured.paths) > 1 for captured in recorded(folder))
    kills = ", ".join(f"{kind} {count}" for kind, count in sorted(service.kills.items()))
    print(f"{done} rounds in {time.monotonic() - begin:.0f} s, seed {seed}; kills: {kills}")
    print(
        f"{recordings} recordings with samples ({parts} of several files), {results} results; {len(wrong)} violations"
    )
    return wrong


def main() -> int:
    """Run the rounds; return 1 if there are violations."""
    parser = options_of_rounds("tests.faults.service_vcan", __doc__)
    parser.add_argument("--minutes", type=float, default=math.inf, help="begin no round after this time")
    options = parser.parse_args()
    bus = f"ks{os.getpid() % 10**6}"

    def run(folder: Path) -> list[str]:
        return run_rounds(options.rounds, options.seed, folder, bus, options.minutes)

    ensure_vcan(bus)
    try:
        return run_in_new_folder(run, keep=options.keep)
    finally:
        remove_vcan(bus)


if __name__ == "__main__":
    sys.exit(main())
