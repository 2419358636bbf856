"""What can go wrong in a round: each fault as something done, and as what the recording has to say of it."""

import os
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from armident.daq.recording import Recording
from armident.daq.recording.lost_rows import NOT_WRITTEN
from armident.drivers.can.frames import ERROR_FLAG, Frames, frame, frames
from armident.drivers.canopen.objects import (
    COB_NMT,
    COB_SDO_REQUEST,
    PDO_NOT_VALID,
    TPDO_COMMUNICATION,
    TPDO_MAPPING,
    NmtCommand,
)
from tests.faults.farm import Farm, Orders

SDO_STEP_S = 0.004
BEHIND = 50
DISK_LEFT = 1 << 18
"""Bytes left on a disk that will be full: what a round writes until then, and more."""
NEAR_END = 50
"""SYNCs before the last one from which on a capture counts as ending."""
ROTATE_S = 0.25
"""Age at which a file of a round that rotates is full."""
FIRST_S = 0.15
"""Faults begin so long after the first SYNC at the earliest."""


@dataclass
class Outcome:
    """What a capture left."""

    recording: Recording
    counters: dict[str, int]
    said: str
    files: int

    def marked(self, *texts: str) -> bool:
        """Whether marks in the recording have all of the texts."""
        return all(any(text in mark.text for mark in self.recording.marks) for text in texts)

    def gap(self, joint: str | None, *reasons: str) -> bool:
        """Whether there is a gap of a joint (``None``: of any), for one of the reasons."""
        return any((joint is None or g.joint == joint) and g.reason in reasons for g in self.recording.gaps)

    def within(self, text: str, reason: str) -> bool:
        """Whether a mark with this text is in a gap for this reason, or at the SYNC before it."""
        at = [mark.sync for mark in self.recording.marks if text in mark.text]
        return any(g.reason == reason and any(g.first - 1 <= k <= g.last for k in at) for g in self.recording.gaps)


@dataclass
class Room:
    """One round while it is planned."""

    rng: np.random.Generator
    farm: Farm
    seconds: float
    disk: Path
    pid: Callable[[], int]
    orders: Orders = field(default_factory=Orders)
    actions: list[tuple[float, Callable[[], None]]] = field(default_factory=list)
    joints: list[int] = field(default_factory=lambda: list(range(6)))

    def __post_init__(self) -> None:
        self.rng.shuffle(self.joints)

    def at(self, until_end: float = 0.4) -> float:
        """A random time that leaves some seconds to the end."""
        return float(self.rng.uniform(FIRST_S, max(FIRST_S + 0.05, self.seconds - until_end)))

    def sync_at(self, until_end: float = 0.4) -> int:
        """The SYNC at a random time."""
        return int(self.at(until_end) / self.farm.session.sync_period)

    @property
    def syncs(self) -> int:
        """How many SYNCs the round has."""
        return round(self.seconds / self.farm.session.sync_period)

    def joint(self) -> int:
        """A drive that nothing else happens to."""
        return self.joints.pop()


Expected = Callable[[Outcome], bool]

ORDERED = {"lost": "lost", "all_lost": "lost", "twice": "twice", "again": "again"}
"""Faults that do not happen while the drives are late themselves, and the order that they become."""


def _was_down(done: Outcome) -> bool:
    """Whether a bus was down: what others send meanwhile does not happen."""
    return done.counters["bus_down"] > 0


def _name(joint: int) -> str:
    return f"joint_{joint + 1}"


def lost(room: Room) -> Expected:
    """Single answers and runs of them are not sent."""
    j = room.joint()
    for _ in range(int(room.rng.integers(1, 4))):
        k = room.sync_at()
        room.orders.lost |= {(k + i, j) for i in range(int(room.rng.integers(1, 20)))}
    return lambda done: done.gap(_name(j), "lost", "ambiguous order")


def all_lost(room: Room) -> Expected:
    """Nobody answers for a while."""
    k, count = room.sync_at(), int(room.rng.integers(1, 50))
    room.orders.lost |= {(k + i, j) for i in range(count) for j in range(6)}
    return lambda done: done.gap(None, "lost", "ambiguous order")


def late(room: Room) -> Expected:
    """A drive holds its answers back and then sends them in one go."""
    j, k = room.joint(), room.sync_at()
    count, delay = int(room.rng.integers(1, 15)), int(room.rng.integers(1, 20))
    room.orders.late |= {(k + i, j): k + count + delay for i in range(count)}
    return lambda done: done.counters["tpdo_late"] > 0


def all_late(room: Room) -> Expected:
    """All drives hold their answers back and then send them in one go."""
    k, count = room.sync_at(), int(room.rng.integers(1, 30))
    room.orders.late |= {(k + i, j): k + count + 5 for i in range(count) for j in range(6)}
    return lambda done: done.counters["tpdo_late"] > 0


def twice(room: Room) -> Expected:
    """Answers are sent twice, one behind the other."""
    j = room.joint()
    room.orders.twice |= {(room.sync_at(), j) for _ in range(int(room.rng.integers(1, 6)))}
    return lambda done: done.counters["tpdo_duplicate"] > 0 or done.gap(None, "ambiguous order", "SYNC not received")


def again(room: Room) -> Expected:
    """An answer is sent once more behind the next SYNC, before that one's own."""
    j = room.joint()
    room.orders.again |= {(room.sync_at(), j) for _ in range(int(room.rng.integers(1, 4)))}
    return lambda done: done.counters["tpdo_duplicate"] > 0


def bus_down(room: Room) -> Expected:
    """A bus goes down and comes back (ENETDOWN)."""
    bus = int(room.rng.integers(len(room.farm.lanes)))
    begin, length = room.at(0.9), float(room.rng.uniform(0.1, 0.4))
    room.actions += [(begin, lambda: room.farm.down(bus)), (begin + length, lambda: room.farm.up(bus))]
    return lambda done: done.counters["bus_down"] > 0 and done.marked("went down", "is back")


def _errors(classes: list[int]) -> Frames:
    out = frames(len(classes))
    out["can_id"], out["length"] = [ERROR_FLAG | c for c in classes], 8
    return out


def error_frames(room: Room) -> Expected:
    """The controller reports errors."""
    bus, count = int(room.rng.integers(len(room.farm.lanes))), int(room.rng.integers(1, 40))
    room.actions.append((room.at(), lambda: room.farm.inject(bus, _errors([0x20] * count))))

    def told(done: Outcome) -> bool:
        heard, dropped = done.counters["error_frames"], done.counters["kernel_drops"]
        # Those that the kernel dropped are counted among what it dropped, and nobody knows what they said.
        return _was_down(done) or (heard + dropped >= count and (not heard or done.marked("nobody acknowledges")))

    return told


def bus_off(room: Room) -> Expected:
    """The controller reports that it is off the bus, and is restarted."""
    bus, begin = int(room.rng.integers(len(room.farm.lanes))), room.at(0.6)
    room.actions.append((begin, lambda: room.farm.inject(bus, _errors([0x40]))))
    room.actions.append((begin + 0.1, lambda: room.farm.inject(bus, _errors([0x100]))))
    return lambda done: (
        _was_down(done) or (done.counters["bus_off"] > 0 and done.marked("bus-off)", "restarted after bus-off"))
    )


def emcy(room: Room) -> Expected:
    """A drive reports an error."""
    j = room.joint()
    sent: list[bool] = []
    room.actions.append((room.at(), lambda: sent.append(room.farm.emcy(j, 0x4210))))
    return lambda done: sent == [False] or (done.counters["emcy"] > 0 and done.marked("EMCY 4210h"))


def heartbeat(room: Room) -> Expected:
    """A drive's heartbeat stops and returns."""
    j = room.joint()
    room.actions.append((room.at(0.8), lambda: room.farm.silent(j, 0.45)))
    # Nobody is silent for as long as the only bus is down.
    return lambda done: (
        _was_down(done)
        or (done.counters["heartbeat_lost"] > 0 and done.marked("no heartbeat for", "heartbeat is back"))
    )


def reboot(room: Room) -> Expected:
    """A drive loses its power for a moment and boots."""
    j, seconds = room.joint(), float(room.rng.uniform(0.03, 0.2))
    room.actions.append((room.at(1.1), lambda: room.farm.reboot(j, seconds)))

    def told(done: Outcome) -> bool:
        # While no SYNC came it owed no answer: then the gap in which it booted is everybody's.
        missed = done.gap(_name(j), "lost") or done.within("has booted again", "SYNC not received")
        return done.counters["rebooted"] > 0 and done.marked("has booted again") and missed

    return told


def _remap(room: Room, j: int, entries: list[int], nmt: bool) -> None:
    """Another tool on the bus maps the first TPDO of a drive anew; with ``nmt`` in pre-operational, as most do."""
    node, bus = room.farm.drives[j].node_id, room.farm.bus_of(j)
    steps = [(TPDO_COMMUNICATION, 1, (0x180 + node) | PDO_NOT_VALID, 4), (TPDO_MAPPING, 0, 0, 1)]
    steps += [(TPDO_MAPPING, i + 1, entry, 4) for i, entry in enumerate(entries)]
    steps += [(TPDO_MAPPING, 0, len(entries), 1), (TPDO_COMMUNICATION, 1, 0x180 + node, 4)]
    sent = [frame(COB_SDO_REQUEST + node, _download(*step)) for step in steps]
    if nmt:
        states = NmtCommand.PRE_OPERATIONAL, NmtCommand.START
        before, after = (frame(COB_NMT, bytes([state, node])) for state in states)
        sent = [before, *sent, after]
    begin = room.at(1.2)
    for i, one in enumerate(sent):
        room.actions.append((begin + i * SDO_STEP_S, lambda one=one: room.farm.inject(bus, one)))  # type: ignore[misc]


def _download(index: int, sub: int, value: int, size: int) -> bytes:
    """The request of an expedited SDO download (CiA 301 section 7.2.4.3.3)."""
    command = 0x23 | (4 - size) << 2
    return bytes([command]) + index.to_bytes(2, "little") + bytes([sub]) + value.to_bytes(4, "little")


def mapped_shorter(room: Room) -> Expected:
    """Somebody maps less than the session wants."""
    j = room.joint()
    _remap(room, j, [0x60640020, 0x60780010], bool(room.rng.integers(2)))
    return lambda done: _was_down(done) or (done.counters["mapping_changed"] > 0 and done.marked("PDO mapping"))


def mapped_otherwise(room: Room) -> Expected:
    """Somebody maps the same objects in another order: as many bytes as before."""
    j = room.joint()
    _remap(room, j, [0x60640020, 0x60410010, 0x60780010], bool(room.rng.integers(2)))
    return lambda done: _was_down(done) or (done.counters["mapping_changed"] > 0 and done.marked("PDO mapping"))


def kernel_drop(room: Room) -> Expected:
    """The capture is not run for a while, and the kernel's buffer overruns."""
    _stopped(room)
    return lambda done: done.counters["kernel_drops"] > 0 and bool(done.recording.gaps)


def held_up(room: Room) -> Expected:
    """The capture, and so SYNC, is not run for a while."""
    _stopped(room)
    return lambda done: done.counters["sync_skipped_periods"] > 0


def _state(pid: int) -> str:
    """What the kernel says a process does; ``X`` if it is no more."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return "X"


def _stopped(room: Room) -> None:
    begin, length = room.at(1.2), float(room.rng.uniform(0.1, 0.3))

    def stop() -> None:
        # A capture that failed is no more.
        with suppress(ProcessLookupError):
            os.kill(room.pid(), signal.SIGSTOP)
            # One that has not been obeyed yet would be called off by what follows.
            while _state(room.pid()) not in "TZX":
                time.sleep(0.001)
            time.sleep(length)
            os.kill(room.pid(), signal.SIGCONT)

    room.actions.append((begin, lambda: room.farm.beside(stop)))


def sync_missing(room: Room) -> Expected:
    """The master of others leaves SYNCs out, its counter goes on."""
    k = room.sync_at(0.6)
    room.orders.skipped |= set(range(k, k + int(room.rng.integers(1, 350))))
    return lambda done: done.counters["sync_missing"] > 0 and done.gap(None, "SYNC not received")


def sync_stops(room: Room) -> Expected:
    """The master of others stops for a while; afterwards its counter goes on, or begins anew."""
    length, restart = float(room.rng.uniform(0.3, 0.6)), bool(room.rng.integers(2))
    room.actions.append((room.at(1.0), lambda: room.farm.rest(length, restart)))
    return lambda done: done.counters["sync_stopped"] > 0 and done.marked("no SYNC for", "SYNC is back")


def disk_full(room: Room) -> Expected:
    """The disk is full for a while."""
    filler = room.disk / "filler"
    length = float(room.rng.uniform(0.3, 0.5))
    # Most of it before the round, so that the rest is done in a moment.
    free = os.statvfs(room.disk)
    filler.write_bytes(bytes(max(0, free.f_bavail * free.f_frsize - DISK_LEFT)))

    def fill() -> None:
        with filler.open("ab", buffering=0) as file:
            for block in (1 << 16, 1 << 12, 1 << 9):
                with suppress(OSError):
                    while file.write(bytes(block)) == block:
                        pass
        if _while_full(room, length):
            room.orders.done.add("full")
        filler.unlink()
        # A capture that still has SYNCs to record ends later than this.
        ledger = room.farm.lanes[0].ledger
        room.orders.full_at_end = bool(ledger) and ledger[-1] >= room.syncs - NEAR_END

    room.actions.append((room.at(1.1), lambda: room.farm.beside(fill)))
    # While drives are behind rows wait in memory, and there is nothing to write.
    return lambda done: (
        done.counters["tpdo_late"] > BEHIND or (done.counters["writer.rows_lost"] > 0 and done.gap(None, NOT_WRITTEN))
    )


def _while_full(room: Room, length: float) -> bool:
    """For so long, and until the disk has refused something: a host that is busy may keep the capture from trying.

    Whether it has refused something in the end.
    """

    def looks() -> dict[Path, tuple[int, int]]:
        return {path: (stat.st_size, stat.st_mtime_ns) for path in files for stat in [path.stat()]}

    files = list(room.disk.glob("r*/*.mcap"))
    until, last, before, refused = (
        time.monotonic() + length,
        0.8 * room.syncs,
        looks(),
        False,
    )
    while time.monotonic() < until or (not refused and len(room.farm.lanes[0].ledger) < last):
        time.sleep(0.005)
        now = looks()
        # What was not written whole is taken back: the file is touched, and no larger.
        refused |= any(now[path][0] == size and now[path][1] != at for path, (size, at) in before.items())
        before = now
    return refused


def rotation(room: Room) -> Expected:
    """New files are begun meanwhile (the session says so)."""
    first = round(ROTATE_S / room.farm.session.sync_period)
    # What waits for a lost answer is written at once when it is given up, into one file. A disk that refuses the second
    # file is asked for it again long after the round.
    return lambda done: (
        done.files >= 2
        or done.gap(None, "lost", "ambiguous order")
        or any(g.reason == NOT_WRITTEN and g.first <= first <= g.last for g in done.recording.gaps)
    )


ANY = (
    lost, all_lost, late, all_late, twice, again, bus_down, error_frames, bus_off, emcy, heartbeat, reboot,
    mapped_shorter, mapped_otherwise, disk_full, rotation,
)  # fmt: skip
PRODUCER = (held_up,)
CONSUMER = (kernel_drop, sync_missing, sync_stops)
FAULTS = {fault.__name__: fault for fault in (*ANY, *PRODUCER, *CONSUMER)}
EXCLUSIVE = (
    {"sync_stops", "kernel_drop", "held_up", "bus_down"},
    # A drive that owes an answer keeps rows in memory: the disk is not asked.
    *(
        {"disk_full", name}
        for name in (
            "lost",
            "all_lost",
            "late",
            "all_late",
            "again",
            "twice",
            "bus_down",
            "reboot",
            "mapped_shorter",
            "mapped_otherwise",
            "kernel_drop",
            "sync_missing",
            "sync_stops",
            "held_up",
        )
    ),
    # Answers that are late and answers that are lost in the same moment cannot be told apart by anybody.
    {"all_lost", "all_late", "late", "again", "kernel_drop", "bus_down", "sync_missing", "sync_stops"},
)
"""Sets of faults of which a round has one at most."""


Plan = tuple[list[str], bool, int]
"""The faults of a round, whether we produce SYNC, and on how many buses."""

HANDFUL: tuple[Plan, ...] = (
    (["lost", "twice", "emcy"], True, 1),
    (["late", "error_frames", "bus_off"], True, 2),
    (["bus_down", "heartbeat"], True, 2),
    (["reboot", "again"], True, 1),
    (["held_up"], True, 1),
    (["disk_full"], True, 1),
    (["all_late", "rotation"], True, 2),
    (["kernel_drop"], False, 1),
    (["sync_missing", "mapped_shorter"], False, 2),
    (["sync_stops", "mapped_otherwise"], False, 1),
    (["all_lost"], False, 2),
)
"""Every fault once."""


def chosen(rng: np.random.Generator, number: int, only: Sequence[str] = ()) -> Plan:
    """A round at random; its first fault by turns."""
    names = list(only) or list(FAULTS)
    first = names[number % len(names)]
    fault = FAULTS[first]
    producing = fault in PRODUCER or (fault not in CONSUMER and bool(rng.integers(2)))
    allowed = [f.__name__ for f in (*ANY, *(PRODUCER if producing else CONSUMER))]
    picked = [first]
    for name in rng.permutation(allowed)[: 0 if only else int(rng.integers(0, 3))]:
        name = str(name)
        if name not in picked and not any(name in group and set(picked) & group for group in EXCLUSIVE):
            picked.append(name)
    buses = 1 if "sync_stops" in picked else int(rng.integers(1, 3))
    return picked, producing, buses
