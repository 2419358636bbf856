"""The faults of a round: each is an injection, and the evidence that the recording must contain."""

import os
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
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
from tests.faults.farm import AnswerFaults, Farm

SDO_STEP_S = 0.004
"""Interval of SDO requests, s."""
BEHIND = 50
"""Number of late answers from which on the drives count as lagging."""
DISK_LEFT = 1 << 18
"""Free bytes of the disk before it is filled: more than a round writes until then."""
NEAR_END = 50
"""Number of SYNCs before the last one that count as the end of a capture."""
ROTATE_S = 0.25
"""Time span of a file in a round with rotation, s."""
FIRST_S = 0.15
"""Earliest time of a fault after the first SYNC, s."""


@dataclass
class Outcome:
    """Recording, counters and log of a capture."""

    recording: Recording
    counters: dict[str, int]
    log: str
    files: int

    def marked(self, *texts: str) -> bool:
        """Return whether the marks of the recording contain all texts."""
        return all(any(text in mark.text for mark in self.recording.marks) for text in texts)

    def gap(self, joint: str | None, *reasons: str) -> bool:
        """Return whether there is a gap of a joint (``None``: of any), for one of the reasons."""
        return any((joint is None or g.joint == joint) and g.reason in reasons for g in self.recording.gaps)

    def within(self, text: str, reason: str) -> bool:
        """Return whether a mark with a text is in a gap for a reason, or at the SYNC before it."""
        at = [mark.sync for mark in self.recording.marks if text in mark.text]
        return any(g.reason == reason and any(g.first - 1 <= k <= g.last for k in at) for g in self.recording.gaps)


@dataclass
class RoundSetup:
    """One round that is being planned."""

    rng: np.random.Generator
    farm: Farm
    seconds: float
    disk: Path
    pid: Callable[[], int]
    answer_faults: AnswerFaults = field(default_factory=AnswerFaults)
    actions: list[tuple[float, Callable[[], None]]] = field(default_factory=list)
    joints: list[int] = field(default_factory=lambda: list(range(6)))

    def __post_init__(self) -> None:
        self.rng.shuffle(self.joints)

    def at(self, until_end: float = 0.4) -> float:
        """Return a random time at least ``until_end`` before the end, s."""
        return float(self.rng.uniform(FIRST_S, max(FIRST_S + 0.05, self.seconds - until_end)))

    def sync_at(self, until_end: float = 0.4) -> int:
        """Return the SYNC at a random time."""
        return int(self.at(until_end) / self.farm.session.sync_period)

    @property
    def syncs(self) -> int:
        """Number of SYNCs of the round."""
        return round(self.seconds / self.farm.session.sync_period)

    def joint(self) -> int:
        """Return a drive that has no other fault."""
        return self.joints.pop()


Evidence = Callable[[Outcome], bool]

ORDERED = {"lost": "lost", "all_lost": "lost", "twice": "twice", "again": "again"}
"""Faults that do not occur while the drives are late anyway, and their names in ``AnswerFaults``."""


def _was_down(done: Outcome) -> bool:
    """Return whether a bus was down: nothing is sent on it then."""
    return done.counters["bus_down"] > 0


def _name(joint: int) -> str:
    return f"joint_{joint + 1}"


def lost(setup: RoundSetup) -> Evidence:
    """Single answers and sequences of them are not sent."""
    j = setup.joint()
    for _ in range(int(setup.rng.integers(1, 4))):
        k = setup.sync_at()
        setup.answer_faults.lost |= {(k + i, j) for i in range(int(setup.rng.integers(1, 20)))}
    return lambda done: done.gap(_name(j), "lost", "ambiguous order")


def all_lost(setup: RoundSetup) -> Evidence:
    """No drive answers for some SYNCs."""
    k, count = setup.sync_at(), int(setup.rng.integers(1, 50))
    setup.answer_faults.lost |= {(k + i, j) for i in range(count) for j in range(6)}
    return lambda done: done.gap(None, "lost", "ambiguous order")


def late(setup: RoundSetup) -> Evidence:
    """A drive delays its answers and then sends them at once."""
    j, k = setup.joint(), setup.sync_at()
    count, delay = int(setup.rng.integers(1, 15)), int(setup.rng.integers(1, 20))
    setup.answer_faults.late |= {(k + i, j): k + count + delay for i in range(count)}
    return lambda done: done.counters["tpdo_late"] > 0


def all_late(setup: RoundSetup) -> Evidence:
    """All drives delay their answers and then send them at once."""
    k, count = setup.sync_at(), int(setup.rng.integers(1, 30))
    setup.answer_faults.late |= {(k + i, j): k + count + 5 for i in range(count) for j in range(6)}
    return lambda done: done.counters["tpdo_late"] > 0


def twice(setup: RoundSetup) -> Evidence:
    """Answers are sent twice, one behind the other."""
    j = setup.joint()
    setup.answer_faults.twice |= {(setup.sync_at(), j) for _ in range(int(setup.rng.integers(1, 6)))}
    return lambda done: done.counters["tpdo_duplicate"] > 0 or done.gap(None, "ambiguous order", "SYNC not received")


def again(setup: RoundSetup) -> Evidence:
    """An answer is sent once more behind the next SYNC, before that one's own."""
    j = setup.joint()
    setup.answer_faults.again |= {(setup.sync_at(), j) for _ in range(int(setup.rng.integers(1, 4)))}
    return lambda done: done.counters["tpdo_duplicate"] > 0


def bus_down(setup: RoundSetup) -> Evidence:
    """A bus goes down and comes back (ENETDOWN)."""
    bus = int(setup.rng.integers(len(setup.farm.buses)))
    begin, length = setup.at(0.9), float(setup.rng.uniform(0.1, 0.4))
    setup.actions += [(begin, lambda: setup.farm.down(bus)), (begin + length, lambda: setup.farm.up(bus))]
    return lambda done: done.counters["bus_down"] > 0 and done.marked("went down", "is back")


def _errors(classes: list[int]) -> Frames:
    out = frames(len(classes))
    out["can_id"], out["length"] = [ERROR_FLAG | c for c in classes], 8
    return out


def error_frames(setup: RoundSetup) -> Evidence:
    """The controller reports errors."""
    bus, count = int(setup.rng.integers(len(setup.farm.buses))), int(setup.rng.integers(1, 40))
    setup.actions.append((setup.at(), lambda: setup.farm.inject(bus, _errors([0x20] * count))))

    def evidence(done: Outcome) -> bool:
        received, dropped = done.counters["error_frames"], done.counters["kernel_drops"]
        # Error frames may be among the frames that the kernel dropped.
        return _was_down(done) or (received + dropped >= count and (not received or done.marked("nobody acknowledges")))

    return evidence


def bus_off(setup: RoundSetup) -> Evidence:
    """The controller reports bus-off, and is restarted."""
    bus, begin = int(setup.rng.integers(len(setup.farm.buses))), setup.at(0.6)
    setup.actions.append((begin, lambda: setup.farm.inject(bus, _errors([0x40]))))
    setup.actions.append((begin + 0.1, lambda: setup.farm.inject(bus, _errors([0x100]))))

    def evidence(done: Outcome) -> bool:
        off, restarted = done.marked("bus-off)"), done.marked("restarted after bus-off")
        # Error frames may be among the frames that the kernel dropped.
        missing = 2 - off - restarted
        return _was_down(done) or (missing <= done.counters["kernel_drops"] and off == (done.counters["bus_off"] > 0))

    return evidence


def emcy(setup: RoundSetup) -> Evidence:
    """A drive sends an EMCY."""
    j = setup.joint()
    sent: list[bool] = []
    setup.actions.append((setup.at(), lambda: sent.append(setup.farm.emcy(j, 0x4210))))
    return lambda done: sent == [False] or (done.counters["emcy"] > 0 and done.marked("EMCY 4210h"))


def heartbeat(setup: RoundSetup) -> Evidence:
    """A drive's heartbeat stops and returns."""
    j = setup.joint()
    setup.actions.append((setup.at(0.8), lambda: setup.farm.silent(j, 0.45)))
    # A lost heartbeat is not reported while the only bus is down.
    return lambda done: (
        _was_down(done)
        or (done.counters["heartbeat_lost"] > 0 and done.marked("no heartbeat for", "heartbeat is back"))
    )


def reboot(setup: RoundSetup) -> Evidence:
    """A drive is switched off for a moment and boots."""
    j, seconds = setup.joint(), float(setup.rng.uniform(0.03, 0.2))
    setup.actions.append((setup.at(1.1), lambda: setup.farm.reboot(j, seconds)))

    def evidence(done: Outcome) -> bool:
        # Without SYNC there is no answer to lose: the gap of the reboot is of all joints then.
        missed = done.gap(_name(j), "lost") or done.within("has booted again", "SYNC not received")
        return done.counters["rebooted"] > 0 and done.marked("has booted again") and missed

    return evidence


def _remap(setup: RoundSetup, j: int, entries: list[int], nmt: bool) -> None:
    """Another tool changes the mapping of a drive's TPDO1; with ``nmt`` in pre-operational, as most tools do."""
    node, bus = setup.farm.drives[j].node_id, setup.farm.bus_of(j)
    steps = [(TPDO_COMMUNICATION, 1, (0x180 + node) | PDO_NOT_VALID, 4), (TPDO_MAPPING, 0, 0, 1)]
    steps += [(TPDO_MAPPING, i + 1, entry, 4) for i, entry in enumerate(entries)]
    steps += [(TPDO_MAPPING, 0, len(entries), 1), (TPDO_COMMUNICATION, 1, 0x180 + node, 4)]
    sent = [frame(COB_SDO_REQUEST + node, _download(*step)) for step in steps]
    if nmt:
        states = NmtCommand.PRE_OPERATIONAL, NmtCommand.START
        before, after = (frame(COB_NMT, bytes([state, node])) for state in states)
        sent = [before, *sent, after]
    begin = setup.at(1.2)
    for i, one in enumerate(sent):
        setup.actions.append((begin + i * SDO_STEP_S, partial(setup.farm.inject, bus, one)))


def _download(index: int, sub: int, value: int, size: int) -> bytes:
    """Return the request of an expedited SDO download (CiA 301 section 7.2.4.3.3)."""
    command = 0x23 | (4 - size) << 2
    return bytes([command]) + index.to_bytes(2, "little") + bytes([sub]) + value.to_bytes(4, "little")


def mapped_shorter(setup: RoundSetup) -> Evidence:
    """Another tool maps fewer objects than the session."""
    j = setup.joint()
    _remap(setup, j, [0x60640020, 0x60780010], bool(setup.rng.integers(2)))
    return lambda done: _was_down(done) or (done.counters["mapping_changed"] > 0 and done.marked("PDO mapping"))


def mapped_otherwise(setup: RoundSetup) -> Evidence:
    """Another tool maps the same objects in another order, so that the length stays."""
    j = setup.joint()
    _remap(setup, j, [0x60640020, 0x60410010, 0x60780010], bool(setup.rng.integers(2)))
    return lambda done: _was_down(done) or (done.counters["mapping_changed"] > 0 and done.marked("PDO mapping"))


def kernel_drop(setup: RoundSetup) -> Evidence:
    """The capture is stopped for a moment, and the receive buffer overruns."""
    _stopped(setup)
    return lambda done: done.counters["kernel_drops"] > 0 and bool(done.recording.gaps)


def held_up(setup: RoundSetup) -> Evidence:
    """The capture, and with it SYNC, is stopped for a moment."""
    _stopped(setup)
    return lambda done: done.counters["sync_skipped_periods"] > 0


def _state(pid: int) -> str:
    """Return the state of a process from /proc; ``X`` if it has ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return "X"


def _stopped(setup: RoundSetup) -> None:
    begin, length = setup.at(1.2), float(setup.rng.uniform(0.1, 0.3))

    def stop() -> None:
        # The capture may have failed.
        with suppress(ProcessLookupError):
            os.kill(setup.pid(), signal.SIGSTOP)
            # SIGCONT would cancel a SIGSTOP that is still pending.
            while _state(setup.pid()) not in "TZX":
                time.sleep(0.001)
            time.sleep(length)
            os.kill(setup.pid(), signal.SIGCONT)

    setup.actions.append((begin, lambda: setup.farm.run_in_thread(stop)))


def sync_missing(setup: RoundSetup) -> Evidence:
    """The foreign master omits SYNCs; its counter continues."""
    k = setup.sync_at(0.6)
    setup.answer_faults.skipped |= set(range(k, k + int(setup.rng.integers(1, 350))))
    return lambda done: done.counters["sync_missing"] > 0 and done.gap(None, "SYNC not received")


def sync_stops(setup: RoundSetup) -> Evidence:
    """The foreign master pauses; afterwards its counter continues, or starts again."""
    length, restart = float(setup.rng.uniform(0.3, 0.6)), bool(setup.rng.integers(2))
    setup.actions.append((setup.at(1.0), lambda: setup.farm.rest(length, restart)))
    return lambda done: done.counters["sync_stopped"] > 0 and done.marked("no SYNC for", "SYNC is back")


def disk_full(setup: RoundSetup) -> Evidence:
    """The disk is full for a moment."""
    filler = setup.disk / "filler"
    length = float(setup.rng.uniform(0.3, 0.5))
    # Fill most of it before the round, so that the rest is quick.
    free = os.statvfs(setup.disk)
    filler.write_bytes(bytes(max(0, free.f_bavail * free.f_frsize - DISK_LEFT)))

    def fill() -> None:
        with filler.open("ab", buffering=0) as file:
            for block in (1 << 16, 1 << 12, 1 << 9):
                with suppress(OSError):
                    while file.write(bytes(block)) == block:
                        pass
        if _while_full(setup, length):
            setup.answer_faults.done.add("full")
        filler.unlink()
        # With more SYNCs to record, the capture ends later than this.
        syncs = setup.farm.buses[0].syncs
        setup.answer_faults.full_at_end = bool(syncs) and syncs[-1] >= setup.syncs - NEAR_END

    setup.actions.append((setup.at(1.1), lambda: setup.farm.run_in_thread(fill)))
    # While drives lag, rows wait in memory and nothing is written.
    return lambda done: (
        done.counters["tpdo_late"] > BEHIND or (done.counters["writer.rows_lost"] > 0 and done.gap(None, NOT_WRITTEN))
    )


def _while_full(setup: RoundSetup, length: float) -> bool:
    """Wait for a time, and until the disk has refused a write, since a busy host may delay the capture.

    Return whether it has refused a write.
    """

    def file_states() -> dict[Path, tuple[int, int]]:
        return {path: (stat.st_size, stat.st_mtime_ns) for path in files for stat in [path.stat()]}

    files = list(setup.disk.glob("r*/*.mcap"))
    until, last, before, refused = (
        time.monotonic() + length,
        0.8 * setup.syncs,
        file_states(),
        False,
    )
    while time.monotonic() < until or (not refused and len(setup.farm.buses[0].syncs) < last):
        time.sleep(0.005)
        now = file_states()
        # An incomplete write is undone: the file is modified, and has its former size.
        refused |= any(now[path][0] == size and now[path][1] != at for path, (size, at) in before.items())
        before = now
    return refused


def rotation(setup: RoundSetup) -> Evidence:
    """New files begin during the round, as the session configures."""
    first = round(ROTATE_S / setup.farm.session.sync_period)
    # Rows that wait for a lost answer are written at once, into one file. If the disk refuses the second file, the next
    # attempt is long after the round.
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
    # While an answer is outstanding, rows stay in memory: nothing is written to the disk.
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
    # Late and lost answers of the same moment cannot be distinguished.
    {"all_lost", "all_late", "late", "again", "kernel_drop", "bus_down", "sync_missing", "sync_stops"},
)
"""Sets of faults; a round has at most one of each set."""


Plan = tuple[list[str], bool, int]
"""Faults of a round, whether the capture produces SYNC, and the number of buses."""

EVERY_FAULT: tuple[Plan, ...] = (
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
"""Rounds that contain every fault once."""


def random_plan(rng: np.random.Generator, number: int, only: Sequence[str] = ()) -> Plan:
    """Return a random plan; its first fault follows from the number of the round."""
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
