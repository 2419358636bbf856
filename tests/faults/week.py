"""A week of three cells in an hour, with faults at random: ``python -m tests.faults.week --minutes 60 --out DIR``.

Each cell gets a file for every half hour of the week; one in five is half, torn, replaced, deleted, or poison. Workers
announce by way of the plant's router (mutual TLS); in the last cell a capture records a virtual arm over UDP. Meanwhile
workers, capture and router are killed, disks are full, clocks jump, PostgreSQL hangs, the bus is silent, certificates
expire, and strangers attack. In the end every file has one result or one reason, every result one announcement and one
entry in the history, and nothing unauthorised has passed. Needs no CAN; full disks need root, hangs need PostgreSQL.
"""

import argparse
import json
import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from armident.configs import ConfigError
from tests.faults.week_audit import Audit, Listener, settled
from tests.faults.week_plant import KINDS, Cell, WeekPlant, set_clock
from tests.fixtures import processes, store
from tests.fixtures.postgresql import postgresql, programs
from tests.integration.test_attacks_on_wire import FORGED, ask, raw

RECORDINGS = 7 * 48
"""Files of a cell in a week."""
ODD_SHARE = 0.2
"""Share of files that are not simply whole."""
STALL_S = 600.0
"""Time without any progress after which the end is not waited for any more, s."""


@dataclass
class Fault:
    """Fault: its time since the begin, s; its duration, s; time from its begin until work went on, ``None``: never."""

    kind: str
    target: str
    at_s: float
    held_s: float = 0.0
    went_on_s: float | None = None
    note: str = ""


Held = Iterator[tuple[float, Callable[[], int]]]
"""A fault from its begin to its end: it yields its duration, s, and a count that grows as soon as work goes on."""


@dataclass
class Week:
    """Faults on a plant, and the job that keeps its history in a database; ``server``: PostgreSQL's folder."""

    plant: WeekPlant
    listener: Listener
    database: str
    server: Path | None
    began: float = field(default_factory=time.monotonic)
    faults: list[Fault] = field(default_factory=list)
    attacks: int = 0
    passed: list[str] = field(default_factory=list)
    jobs: list[tuple[float, str]] = field(default_factory=list)
    stop: threading.Event = field(default_factory=threading.Event)
    over: threading.Event = field(default_factory=threading.Event)

    def inject(self, kind: str, cell: Cell, size: float) -> None:
        """Carry out a fault on a cell, and wait until work goes on; ``size`` is from 0 to 1."""
        fault = Fault(kind, cell.name, round(time.monotonic() - self.began, 1))
        self.faults.append(fault)
        with contextmanager(FAULTS[kind])(self, cell, size, fault) as (seconds, count):
            self.stop.wait(seconds)
            fault.held_s = round(time.monotonic() - self.began - fault.at_s, 1)
        before = count()
        while count() <= before:
            if self.over.wait(0.5):
                return
        fault.went_on_s = round(time.monotonic() - self.began - fault.at_s, 1)

    def keep_history(self) -> None:
        """Add new results to the history as a timer does, until all are in it."""
        added: set[Path] = set()
        while True:
            ended, begin = self.over.wait(10.0), time.monotonic()
            found = {path for cell in self.plant.cells for path in cell.results.glob("*/identification.json")}
            if fresh := found - added:
                process = processes.armident("history", *fresh, "--database", self.database)
                reason = process.communicate()[1].strip().rpartition("\n")[2]
                if process.returncode in (0, 4):
                    added, reason = added | fresh, ""
                self.jobs.append((time.monotonic() - begin, reason))
            if ended and found == added:
                return

    def done_in(self, cell: Cell) -> Callable[[], int]:
        return lambda: settled(cell)[1]

    def heard(self, kind: str, *cells: Cell) -> Callable[[], int]:
        return lambda: sum(self.listener.heard[cell.name, kind] for cell in cells)

    def _killed(self, cell: Cell, _size: float, _fault: Fault) -> Held:
        self.plant.services[cell.name].kill()
        yield 0.0, self.done_in(cell)

    def _router_gone(self, _cell: Cell, size: float, _fault: Fault) -> Held:
        router = self.plant.services["router"]
        router.away.set()
        router.kill()
        yield 15.0 * size, self.heard("result", *self.plant.cells)
        router.away.clear()

    def _capture_killed(self, _cell: Cell, _size: float, _fault: Fault) -> Held:
        self.plant.services["capture"].kill()
        yield 0.0, self.heard("samples", self.plant.cells[-1])

    def _bus_silent(self, _cell: Cell, size: float, _fault: Fault) -> Held:
        """The drives of the arm end and start again, or hang."""
        robot = self.plant.services["robot"]
        robot.kill(signal.SIGKILL if size < 0.5 else signal.SIGSTOP)
        yield 12.0 * size, self.heard("samples", self.plant.cells[-1])
        robot.kill(signal.SIGCONT)

    def _disk_full(self, cell: Cell, size: float, _fault: Fault) -> Held:
        cell.resize(full=True)
        yield 5.0 + 15.0 * size, self.done_in(cell)
        cell.resize(full=False)

    def _clock_jumped(self, cell: Cell, size: float, fault: Fault) -> Held:
        """The clock is an hour behind or ahead, or forty days ahead, and later right again."""
        offset = (-3600.0, 3600.0, 40 * 86_400.0)[int(3 * size)]
        fault.note = f"{offset:+g} s"
        set_clock(cell.clock, offset)
        yield 5.0 + 20.0 * size, self.done_in(cell)
        set_clock(cell.clock, 0.0)

    def _history_hung(self, _cell: Cell, size: float, _fault: Fault) -> Held:
        assert self.server is not None
        first = int((self.server / "postmaster.pid").read_text().split()[0])
        pids = [first, *map(int, Path(f"/proc/{first}/task/{first}/children").read_text().split())]
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        yield 10.0 + 30.0 * size, lambda: sum(not reason for _, reason in self.jobs)
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)

    def _certificate_expired(self, cell: Cell, size: float, fault: Fault) -> Held:
        """The certificate of a worker ends soon; after the alarm, and its end, it is renewed."""
        name = f"worker.{cell.name}"
        self.plant.shorten(cell, 15.0)
        self.plant.services[cell.name].kill()
        out, _ = processes.armident("keys", "check", "--folder", self.plant.host).communicate()
        lines = [line for line in out.splitlines() if line.startswith("failed") and name in line]
        fault.note = lines[0] if lines else f"no alarm: {out[-300:]!r}"
        yield 15.0 + 10.0 * size, self.heard("result", cell)
        processes.armident("keys", "renew", name, "--folder", self.plant.folder).communicate()
        self.plant.install(name)

    def _attack(self, cell: Cell, _size: float, fault: Fault) -> Held:
        """Connections without a valid certificate, and messages and commands beyond a role."""
        plant, last = self.plant, self.plant.cells[-1].name
        nobody = {"root_ca_certificate": str(plant.folder / "authority.pem")}
        for name, tls in (("no", nobody), ("a foreign", plant.tls("foreign")), ("an expired", plant.tls("expired"))):
            self.attacks += 1
            with suppress(zenoh.ZError), zenoh.open(raw(plant.place, tls)):
                self.passed.append(f"connected with {name} certificate")
        for name, at in (("viewer.anna", cell.name), ("worker.week_1", last), ("capture.week_1", last)):
            try:
                with plant.attacker(name) as session:
                    for key in ("samples", "events", "health", "status", "result/identification"):
                        session.put(f"armident/{at}/emps/{key}", FORGED)
                    answers = [ask(session, f"armident/{at}/emps/command/{command}") for command in ("stop", "mark")]
                    self.attacks += 7
                    self.passed += [f"{name} commands {at}"] if any(answers) else []
            except zenoh.ZError:
                fault.note = "a router that is away has no gate"
        yield 0.0, lambda: time.monotonic_ns()


FAULTS: dict[str, Callable[[Week, Cell, float, Fault], Held]] = {
    "worker killed": Week._killed,
    "router gone": Week._router_gone,
    "capture killed": Week._capture_killed,
    "bus silent": Week._bus_silent,
    "disk full": Week._disk_full,
    "clock jumped": Week._clock_jumped,
    "PostgreSQL hung": Week._history_hung,
    "certificate expired": Week._certificate_expired,
    "attack": Week._attack,
}


def run(
    minutes: float, seed: int, folder: Path, every_s: float = 20.0, faults: Sequence[str] = (), odd: Sequence[str] = ()
) -> dict[str, Any]:
    """Run a week in a new folder, print its tables, and return them; ``wrong`` says what is wrong.

    ``every_s``: mean time between faults, s. ``faults``, ``odd``: kinds of faults and odd files, by default all.
    """
    rng, seconds = random.Random(seed), 60.0 * minutes
    store.use_folder(folder / "shared")
    with ExitStack() as stack:
        database, server = stack.enter_context(_database(folder))
        plant = WeekPlant(folder)
        stack.callback(plant.close)
        listener = _listener(plant)
        stack.callback(listener.close)
        while not all("worker: ready" in (plant.logs / f"{cell.name}.log").read_text() for cell in plant.cells):
            time.sleep(0.5)
        missing = {"disk full"} if not plant.cells[0].has_disk else set[str]()
        missing |= {"PostgreSQL hung"} if server is None else set()
        missing |= {"capture killed", "bus silent"} if plant.bus is None else set()
        week = Week(plant, listener, database, server)
        feeds, threads = [], [threading.Thread(target=week.keep_history)]
        for cell in plant.cells:
            kinds = [
                rng.choice(odd or KINDS) if rng.random() < ODD_SHARE else "whole"
                for _ in range(round(RECORDINGS * minutes / 60.0))
            ]
            sizes = [rng.random() for _ in kinds]
            feeds.append(threading.Thread(target=_feed, args=(cell, kinds, sizes, seconds, week.stop)))
        for at_s, kind in _plan(rng, [kind for kind in faults or FAULTS if kind not in missing], seconds, every_s):
            threads.append(threading.Timer(at_s, week.inject, (kind, rng.choice(plant.cells), rng.random())))
        for thread in [*feeds, *threads]:
            thread.daemon = True
            thread.start()
        time.sleep(seconds)
        week.stop.set()
        for thread in feeds:
            thread.join()
        audit = Audit(wrong=_settle(week))
        week.over.set()
        for thread in threads:
            thread.join()
        for cell in plant.cells:
            audit.add(cell, listener, plant, database)
            audit.add_life(cell.name, plant.services[cell.name])
        audit.add_logs(plant.logs)
        audit.wrong += [*week.passed, *(f"forged on {key}" for key in listener.forged)]
        audit.wrong += [f"{each.kind}, {each.target}: no work after it" for each in week.faults if not each.went_on_s]
        audit.wrong += [f"{each.target}: {each.note}" for each in week.faults if each.note.startswith("no alarm")]
        report = {
            "minutes": minutes, "seed": seed, "took_s": round(time.monotonic() - week.began), "load": os.getloadavg(),
            "history": "PostgreSQL" if server else "SQLite", "missing": sorted(missing),
            "faults": [asdict(fault) for fault in week.faults], "audit": audit.figures, "attacks": week.attacks,
            "files": Counter(fed.kind for cell in plant.cells for fed in cell.fed), "workers": audit.growth,
            "refused messages": listener.refused, "jobs of the history": len(week.jobs),
            "refused jobs": Counter(reason for _, reason in week.jobs if reason),
            "longest job, s": round(max((each for each, _ in week.jobs), default=0.0)),
            "starts": {name: len(service.lives) for name, service in plant.services.items()}, "wrong": audit.wrong,
        }  # fmt: skip
    (folder / "week.json").write_text(json.dumps(report, indent=1))
    _show(report)
    return report


@contextmanager
def _database(folder: Path) -> Iterator[tuple[str, Path | None]]:
    """Yield the URL of a database and the folder of its server, ``None`` if PostgreSQL is not installed."""
    binaries = programs()
    if binaries is None:
        yield f"sqlite:///{folder}/history.sqlite", None
        return
    with postgresql(binaries) as url:
        port = url.rpartition(":")[2]
        files = Path(tempfile.gettempdir()).glob("armident-pg-*/data/postmaster.pid")
        yield f"{url}/postgres", next(path.parent for path in files if path.read_text().splitlines()[3] == port)


def _listener(plant: WeekPlant) -> Listener:
    """Return the listener as soon as the router lets it in."""
    while True:
        with suppress(ConfigError):
            return Listener(plant.cells)


def _plan(rng: random.Random, kinds: Sequence[str], seconds: float, every_s: float) -> list[tuple[float, str]]:
    """Return times and kinds of faults in the first four fifths of a run; each kind comes once before any repeats."""
    found, bag, at_s = list[tuple[float, str]](), list[str](), rng.expovariate(1.0 / every_s)
    while at_s < 0.8 * seconds:
        bag = bag or rng.sample(kinds, len(kinds))
        found.append((at_s, bag.pop()))
        at_s += rng.expovariate(1.0 / every_s)
    return found


def _feed(cell: Cell, kinds: Sequence[str], sizes: Sequence[float], seconds: float, stop: threading.Event) -> None:
    """Put files into the folder of a cell at even intervals; those that take some time do not hold up others."""
    begin, slow = time.monotonic(), list[threading.Thread]()
    for slot, (kind, size) in enumerate(zip(kinds, sizes, strict=True)):
        time.sleep(max(0.0, begin + seconds * slot / len(kinds) - time.monotonic()))
        slow.append(threading.Thread(target=cell.feed, args=(kind, slot, size, stop)))
        slow[-1].start()
        if kind not in ("half", "replaced", "deleted"):
            slow[-1].join()
    for thread in slow:
        thread.join()


def _settle(week: Week) -> list[str]:
    """End the capture, and wait until all files are settled; return what is open when nothing goes on any more."""
    for name in {"capture", "robot"} & {*week.plant.services}:
        week.plant.services[name].close()
    before, changed = -1, time.monotonic()
    while time.monotonic() - changed < STALL_S:
        states = [settled(cell) for cell in week.plant.cells]
        if all(ready for ready, _ in states):
            return []
        if (number := sum(done for _, done in states)) != before:
            before, changed = number, time.monotonic()
        time.sleep(2.0)
    return [f"{cell.name}: nothing goes on any more" for cell in week.plant.cells if not settled(cell)[0]]


def _show(report: dict[str, Any]) -> None:
    row = "{:<20} {:>6} {:>14} {:>11}"
    print(row.format("fault", "count", "work went on", "longest, s"))
    for kind in FAULTS:
        times = [fault["went_on_s"] for fault in report["faults"] if fault["kind"] == kind]
        known = [each for each in times if each is not None]
        print(row.format(kind, len(times), len(known), max(known, default="-")))
    for name, value in report.items():
        if name not in ("faults", "wrong"):
            print(f"{name}: {dict(value) if isinstance(value, Counter) else value}")
    print(f"{len(report['wrong'])} violations", *report["wrong"], sep="\n")


def main() -> int:
    """Run the week; return 1 if anything is wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.week", description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--every", type=float, default=20.0, help="mean time between faults, s")
    parser.add_argument("--out", type=Path, required=True, help="new folder of logs and week.json")
    options = parser.parse_args()
    options.out.mkdir(parents=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    return int(bool(run(options.minutes, options.seed, options.out.resolve(), options.every)["wrong"]))


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main())
