"""Six simulated drives with injected faults; the values of a sample encode its SYNC."""

import fcntl
import heapq
import itertools
import math
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig, SessionConfig
from armident.drivers.can.frames import BusDown, Frames, frames
from armident.drivers.can.socketcan import RawSocket
from armident.drivers.canopen.objects import (
    COB_SYNC,
    CURRENT_ACTUAL,
    POSITION_ACTUAL,
    POSITION_DEMAND,
    STATUSWORD,
    TPDO_COMMUNICATION,
    DriveState,
)
from armident.virtual_robot.bus_server import DriveBus
from armident.virtual_robot.node import Drive

SIOCGIFFLAGS, SIOCSIFFLAGS, IFF_UP = 0x8913, 0x8914, 1
COUNTER = 240
PRIORITY = 5
PROMPT = 0.5
"""Largest delay of a prompt answer after its SYNC, in SYNC periods."""


def position_of(sync: Any, joint: Any) -> Any:
    """Return the position that encodes SYNC (up to 16383) and joint, in bits that do not compress."""
    return sync * 8 + joint + ((sync * 40_503 + joint * 7_919) % 16_381 << 17)


def current_of(sync: Any, joint: Any) -> Any:
    """Return the current that encodes SYNC and joint, below 2^15."""
    return (sync * 31 + joint * 1009) % 32749


def demand_of(sync: Any, joint: Any) -> Any:
    """Return the demand that encodes SYNC and joint."""
    return -1 - sync * 8 - joint


def set_link(channel: str, up: bool) -> None:
    """Bring an interface up or down."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        request = struct.pack("16sh14x", channel.encode(), 0)
        (flags,) = struct.unpack_from("h", fcntl.ioctl(control, SIOCGIFFLAGS, request), 16)
        flags = flags | IFF_UP if up else flags & ~IFF_UP
        fcntl.ioctl(control, SIOCSIFFLAGS, struct.pack("16sh14x", channel.encode(), flags))


Sent = tuple[int, int, int, list[tuple[int, int, int]]]
"""A mapped TPDO: joint, COB-ID, interval in SYNCs, and of each object index, bytes and constant value."""


class NoMotion:
    """A motion without movement: the reported values come from the SYNC number."""

    def __init__(self, n: int) -> None:
        self.position, self.demand = np.zeros(n, np.int32), np.zeros(n, np.int32)
        self.current = np.zeros(n, np.int16)

    def enable(self, joint: int, enabled: bool) -> None:
        """Ignore the state of the drive."""

    def set_targets(self, targets: NDArray[np.int32], fresh: NDArray[np.bool_]) -> None:
        """Ignore set points."""

    def advance(self) -> None:
        """Do nothing."""


@dataclass
class AnswerFaults:
    """Faults of answers, by SYNC number and joint.

    ``lost`` are not sent, ``twice`` sent twice, ``again`` sent once more behind the next SYNC, and ``late`` sent behind
    the SYNC of that number. ``skipped`` SYNCs are not sent by the farm as the master. ``done`` has the names of the
    first three if they occurred; they do not while the farm itself is late. ``disturbed`` is set if it became late
    meanwhile. ``done`` also has ``full`` if the disk refused a write; ``full_at_end`` is set if it did so to the end of
    the capture.
    """

    lost: set[tuple[int, int]] = field(default_factory=set)
    twice: set[tuple[int, int]] = field(default_factory=set)
    again: set[tuple[int, int]] = field(default_factory=set)
    late: dict[tuple[int, int], int] = field(default_factory=dict)
    skipped: set[int] = field(default_factory=set)
    done: set[str] = field(default_factory=set)
    disturbed: bool = False
    full_at_end: bool = False

    @cached_property
    def faulty_syncs(self) -> set[int]:
        """SYNCs with a faulty answer."""
        return {k for k, _ in (*self.lost, *self.twice, *self.again, *self.late)}


class _PlainAnswers:
    """The answers of drives whose TPDOs are mapped as in the session, in arrays."""

    def __init__(self, layout: list[Sent]) -> None:
        rows = [(COB_SYNC, 1, 0), *((cob, 8 if every == 1 else 4, every) for _, cob, every, _ in layout)]
        self._every = np.array([every for *_, every in rows])
        self._joint = np.array([-1, *(j for j, *_ in layout)])
        self._word = np.array([0, *(entries[-1][2] << 16 for *_, entries in layout)])
        self._all, self._most = self._of(rows, self._every >= 0), self._of(rows, self._every <= 1)

    def _of(self, rows: list[tuple[int, int, int]], wanted: NDArray[np.bool_]) -> Any:
        """Return the frames of some rows, with views and columns from which their data are computed."""
        out = frames(int(wanted.sum()))
        out["can_id"], out["length"] = np.array([(cob, length) for cob, length, _ in rows])[wanted].T
        return out, out["data"].view("<i4"), self._joint[wanted], self._word[wanted], self._every[wanted] > 1

    def answers(self, k: int, counter: int, with_sync: bool) -> Frames:
        """Return the answers to SYNC ``k``, with the SYNC itself or without."""
        out, data, joint, word, demand = self._most if counter % 5 else self._all
        data[:, 0] = np.where(demand, demand_of(k, joint), position_of(k, joint))
        data[:, 1] = word | current_of(k, joint)
        data[0] = counter, 0
        answers: Frames = out[0 if with_sync else 1 :]
        return answers


def _is_plain(sent: Sent) -> bool:
    _, _, every, entries = sent
    indexes = [index for index, *_ in entries]
    return (every, indexes) in ((1, [POSITION_ACTUAL, CURRENT_ACTUAL, STATUSWORD]), (5, [POSITION_DEMAND]))


class _FarmBus:
    """One bus of the farm, its drives, and an independent socket on it."""

    def __init__(self, line: DriveBus) -> None:
        self.line = line
        self.syncs: list[int] = []
        """Numbers of all SYNCs on the bus, in order."""
        self.counter = self.stamp = self.last = -1
        self.sent_ns = 0
        self.prompt = True
        self.was_down = False
        self.up = True
        self.held: list[tuple[int, int, Any]] = []
        self.repeats: list[Any] = []
        self.layout: list[Sent] | None = None
        self.plain: _PlainAnswers | bool | None = None
        self.out = frames(1024)
        self.witness: RawSocket | None = None


class Farm:
    """Drives of a session in a thread of their own; with ``sync.role: consumer`` also the master that sends SYNC.

    ``session``: gives buses, nodes and SYNC; ``robot``: gives the joints.
    """

    def __init__(self, session: SessionConfig, robot: RobotConfig) -> None:
        self.session = session
        self._period = session.sync_period
        motion = NoMotion(robot.n)
        names = [joint.name for joint in robot.joints]
        self.drives: list[Drive] = []
        for node in session.drives:
            j = names.index(node.joint)
            callbacks = self._changed, self._changed
            self.drives.append(Drive(node.node_id, node.eds, j, robot.joints[j], motion, *callbacks))
        self.buses: list[_FarmBus] = []
        self.deaf: set[int] = set()
        """Joints whose drives do not answer SYNC."""
        for bus in session.all_buses:
            here = [d for d, n in zip(self.drives, session.drives, strict=True) if session.bus_of(n) == bus]
            self.buses.append(_FarmBus(DriveBus(bus, here, motion, self._period)))
        self.answer_faults = AnswerFaults()
        self.failed: BaseException | None = None
        self.master = session.sync.role == "consumer"
        self.released = threading.Event()
        """Set to let the foreign master begin."""
        self.begun = 0.0
        """Monotonic time of the first SYNC of the round, s; 0 before it."""
        self._resting_until = 0.0
        self._counter_offset = 0
        self._next = 0
        self._until: int | None = None
        self._actions: list[tuple[float, int, Callable[[], None]]] = []
        self._number = itertools.count()
        self._helpers: list[threading.Thread] = []
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="farm", daemon=True)
        for bus_state in self.buses:
            bus_state.line.boot()
        self._thread.start()

    def _changed(self) -> None:
        for bus_state in getattr(self, "buses", ()):
            bus_state.layout = None

    def prepare(
        self, answer_faults: AnswerFaults, actions: list[tuple[float, Callable[[], None]]], until: int | None
    ) -> None:
        """Begin a round; actions run at their time (s) after its first SYNC, a master ends with SYNC ``until``."""
        with self._lock:
            self.answer_faults, self._until = answer_faults, until
            self._plan = sorted(actions, key=lambda a: a[0])
            self._actions = []
            self.begun, self._next, self._resting_until, self._counter_offset = 0.0, 0, 0.0, 0
            self.released.clear()
            self.deaf.clear()
            for bus_state in self.buses:
                bus_state.syncs, bus_state.held, bus_state.repeats = [], [], []
                bus_state.counter = bus_state.last = -1
                bus_state.was_down, bus_state.prompt, bus_state.sent_ns = False, True, 0
                if bus_state.witness is not None:
                    bus_state.witness.close()
                bus_state.witness = RawSocket(bus_state.line.config.channel, filters=[(COB_SYNC, 0x7FF)])

    def finish(self) -> list[NDArray[np.int64]]:
        """End a round; return time (ns) and counter of every SYNC, (N, 2), from the independent socket of each bus."""
        while self._helpers:
            self._helpers.pop().join()
        with self._lock:
            for _, _, action in sorted(self._actions):
                action()
            self._actions, self.begun = [], 0.0
            self.answer_faults = AnswerFaults()
            seen = []
            for bus_state in self.buses:
                assert bus_state.witness is not None
                seen.append(read_syncs(bus_state.witness))
                bus_state.witness.close()
                bus_state.witness = None
            return seen

    @property
    def done(self) -> bool:
        """True if the master has sent its last SYNC, and all actions have run."""
        over = self._until is not None and self._next > self._until
        return over and not self._actions and not any(helper.is_alive() for helper in self._helpers)

    def rest(self, seconds: float, restart: bool = False) -> None:
        """Pause SYNC for some seconds; with ``restart`` its counter starts again at 1."""
        self._resting_until = time.monotonic() + seconds
        if restart:
            self._counter_offset = self._next

    def down(self, bus: int) -> None:
        """Set a bus down."""
        bus_state = self.buses[bus]
        bus_state.up, bus_state.was_down = False, True
        set_link(bus_state.line.config.channel, False)

    def up(self, bus: int) -> None:
        """Set a bus up again."""
        bus_state = self.buses[bus]
        if bus_state.up:
            return
        set_link(bus_state.line.config.channel, True)
        bus_state.up = True
        if isinstance(bus_state.line.bus, RawSocket):
            # Clears the pending error: the next send would fail otherwise.
            bus_state.line.bus._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)

    def inject(self, bus: int, out: Frames) -> None:
        """Send frames from another socket."""
        with suppress(BusDown), RawSocket(self.buses[bus].line.config.channel, filters=()) as other:
            other.send(out)

    def reboot(self, joint: int, seconds: float) -> None:
        """Switch a drive off for some seconds and boot it."""
        drive = self._drive(joint)
        self.deaf.add(joint)
        drive.nmt.halt()
        drive.nmt._state = 0
        self._changed()

        def boot() -> None:
            drive.reset(communication_only=False)
            self.deaf.discard(joint)
            with suppress(can.CanError, OSError):
                drive.nmt.boot()
            drive.changed()

        self.later(seconds, boot)

    def silent(self, joint: int, seconds: float) -> None:
        """Stop the heartbeat of a drive for some seconds; its answers continue."""
        drive = self._drive(joint)
        drive.nmt.halt()
        self.later(seconds, drive.nmt.resume)

    def emcy(self, joint: int, code: int) -> bool:
        """Send an EMCY of a drive; return whether its bus was up."""
        try:
            self._drive(joint).emcy.send(code, 0x81, b"\x01\x02")
        except (can.CanError, OSError):
            return False
        return True

    def run_in_thread(self, work: Callable[[], object]) -> None:
        """Run a function in a thread of its own."""
        self._helpers.append(threading.Thread(target=work, daemon=True))
        self._helpers[-1].start()

    def later(self, seconds: float, action: Callable[[], None]) -> None:
        """Run an action after some seconds."""
        heapq.heappush(self._actions, (time.monotonic() + seconds, next(self._number), action))

    def bus_of(self, joint: int) -> int:
        """Return the number of the bus of a joint's drive."""
        return next(b for b, bus_state in enumerate(self.buses) if any(d.index == joint for d in bus_state.line.drives))

    def _drive(self, joint: int) -> Drive:
        return next(d for d in self.drives if d.index == joint)

    def close(self) -> None:
        """End the thread and close the buses."""
        self._stop.set()
        self._thread.join()
        for bus_state in self.buses:
            bus_state.line.close()

    def _run(self) -> None:
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
        poll = select.poll()
        for bus_state in self.buses:
            assert isinstance(bus_state.line.bus, RawSocket)
            poll.register(bus_state.line.bus.fileno(), select.POLLIN)
        try:
            while not self._stop.is_set():
                with self._lock:
                    pause = self._send_sync() if self.master else self._take()
                    self._act()
                if self.master or not all(bus_state.up for bus_state in self.buses):
                    time.sleep(min(pause, 0.0005))
                else:
                    poll.poll(1000 * pause)
        except BaseException as error:
            self.failed = error
            raise

    def _act(self) -> None:
        now = time.monotonic()
        while self._actions and self._actions[0][0] <= now:
            heapq.heappop(self._actions)[2]()

    def _begin(self) -> None:
        self.begun = time.monotonic()
        for at, action in self._plan:
            self.later(at, action)

    def _take(self) -> float:
        """Answer the received SYNCs; return the time to wait for more, s."""
        for bus_state in self.buses:
            if not bus_state.up:
                continue
            try:
                got = bus_state.line.bus.receive(bus_state.line.batch)
            except BusDown:
                continue
            batch = bus_state.line.batch[:got]
            for one in batch[batch["can_id"] == COB_SYNC]:
                stamp = int(one["t_ns"])
                self._number_of(bus_state, int(one["data"][0]), stamp)
                # Next to an answer that is really late, a lost or repeated one cannot be identified.
                bus_state.prompt = bus_state.sent_ns < stamp and time.time_ns() - stamp < PROMPT * self._period * 1e9
                if not self.begun and bus_state.witness is not None:
                    self._begin()
                disorderly = bool(bus_state.repeats) or (
                    bus_state.prompt and bus_state.last in self.answer_faults.faulty_syncs
                )
                self._answer(bus_state, bus_state.last, int(one["data"][0]))
                bus_state.sent_ns = time.time_ns()
                if self.answer_faults.done and disorderly:
                    self.answer_faults.disturbed |= bus_state.sent_ns - stamp >= PROMPT * self._period * 1e9
        return 0.005

    def _number_of(self, bus_state: _FarmBus, counter: int, stamp: int) -> None:
        """Number a SYNC by its counter; whole turns of it can be missing only if the bus was down."""
        if bus_state.last < 0:
            step = counter
        else:
            step = (counter - bus_state.counter) % COUNTER
            if bus_state.was_down:
                elapsed = (stamp - bus_state.stamp) / (self._period * 1e9)
                step += COUNTER * max(0, round((elapsed - step) / COUNTER))
                # SYNCs from before it went down are read when it is back.
                bus_state.was_down = step == 1
        bus_state.last += step
        bus_state.counter, bus_state.stamp = counter, stamp
        bus_state.syncs.append(bus_state.last)

    def _send_sync(self) -> float:
        """Send the SYNC that is due, and the answers behind it; return the time to the next one, s."""
        now = time.monotonic()
        if not self.begun:
            if not self.released.is_set() or self.buses[0].witness is None:
                return 0.005
            self._begin()
            self._base = now
        if self._until is not None and self._next > self._until:
            return 0.005
        if now < self._resting_until:
            self._base = max(self._base, self._resting_until - self._next * self._period)
            return min(0.005, self._resting_until - now)
        wait = self._base + self._next * self._period - now
        if wait > 0:
            return min(wait, 0.005)
        k = self._next
        if k in self.answer_faults.skipped:
            self._next += 1
            return 0.0
        if -wait > 10 * self._period:
            if k - 1 in self.answer_faults.skipped:
                # The host delayed the master: the counter advances by whole turns, which only the time shows.
                turns = math.ceil(-wait / self._period / COUNTER)
                self._next += turns * COUNTER
                self._until = None if self._until is None else self._until + turns * COUNTER
                return 0.0
            self._base -= wait
        self._next += 1
        counter = (k - self._counter_offset) % COUNTER + 1
        for bus_state in self.buses:
            if bus_state.up:
                bus_state.last = k
                bus_state.syncs.append(k)
                self._answer(bus_state, k, counter, with_sync=True)
        return 0.0

    def _answer(self, bus_state: _FarmBus, k: int, counter: int, with_sync: bool = False) -> None:
        """Send the answers of the drives of a bus to SYNC ``k``."""
        out, n = bus_state.out, 0
        if with_sync:
            n = self._put(out, n, COB_SYNC, bytes([counter]))
        answer_faults = self.answer_faults
        if (
            k not in answer_faults.faulty_syncs
            and not bus_state.held
            and not bus_state.repeats
            and self._send_plain(bus_state, k, counter, with_sync)
        ):
            return
        for item in bus_state.repeats:
            n = self._put(out, n, *item)
        bus_state.repeats = []
        due = [held for held in bus_state.held if held[0] <= k]
        bus_state.held = [held for held in bus_state.held if held[0] > k]
        for _, _, item in due:
            n = self._put(out, n, *item)
        for j, cob_id, every, entries in self._layout(bus_state):
            if counter % every or j in self.deaf:
                continue
            if (k, j) in answer_faults.lost and bus_state.prompt:
                answer_faults.done.add("lost")
                continue
            item = cob_id, b"".join(_value(index, k, j, size, word) for index, size, word in entries)
            waits = max([answer_faults.late.get((k, j), 0), *(h[0] for h in bus_state.held if h[1] == j)])
            if waits > k:
                bus_state.held.append((waits, j, item))
                continue
            n = self._put(out, n, *item)
            if (k, j) in answer_faults.twice and bus_state.prompt:
                answer_faults.done.add("twice")
                n = self._put(out, n, *item)
            if (k, j) in answer_faults.again and bus_state.prompt:
                answer_faults.done.add("again")
                bus_state.repeats.append(item)
        if n:
            with suppress(BusDown):
                bus_state.line.bus.send(out[:n])

    def _send_plain(self, bus_state: _FarmBus, k: int, counter: int, with_sync: bool) -> bool:
        """Send the answers to SYNC ``k`` from arrays if there are no faults; return whether they were sent."""
        layout = self._layout(bus_state)
        if bus_state.plain is None:
            bus_state.plain = _PlainAnswers(layout) if all(_is_plain(sent) for sent in layout) else False
        if not isinstance(bus_state.plain, _PlainAnswers) or self.deaf:
            return False
        with suppress(BusDown):
            bus_state.line.bus.send(bus_state.plain.answers(k, counter, with_sync))
        return True

    @staticmethod
    def _put(out: Frames, n: int, cob_id: int, data: bytes) -> int:
        out["can_id"][n], out["length"][n] = cob_id, len(data)
        out["data"][n, : len(data)] = np.frombuffer(data, np.uint8)
        return n + 1

    def _layout(self, bus_state: _FarmBus) -> list[Sent]:
        """Return the TPDOs of the drives of a bus by their current mapping."""
        if bus_state.layout is None:
            found: list[Sent] = []
            for drive in bus_state.line.drives:
                if not drive.nmt.operational:
                    continue
                for cob_id, kind, mapped in drive.pdos(TPDO_COMMUNICATION):
                    if 1 <= kind <= COUNTER:
                        words = {STATUSWORD: drive.status}
                        entries = [(index, size, words.get(index, 0)) for index, _, size in mapped]
                        found.append((drive.index, cob_id, kind, entries))
            bus_state.layout, bus_state.plain = found, None
        return bus_state.layout

    @property
    def operational(self) -> bool:
        """True if all drives are in the NMT state operational."""
        return all(drive.nmt.operational for drive in self.drives)

    @property
    def enabled(self) -> bool:
        """True if all drives are in the state operation enabled."""
        return all(drive.state is DriveState.ENABLED for drive in self.drives)


def _value(index: int, k: int, j: int, size: int, word: int) -> bytes:
    """Return the bytes of one object in the answer to SYNC ``k``; ``word`` if it is constant."""
    if index == POSITION_ACTUAL:
        value = position_of(k, j)
    elif index == CURRENT_ACTUAL:
        value = current_of(k, j)
    elif index == POSITION_DEMAND:
        value = demand_of(k, j)
    else:
        value = word
    return int(value).to_bytes(size, "little", signed=value < 0)


def read_syncs(witness: RawSocket) -> NDArray[np.int64]:
    """Return time (ns) and counter of each SYNC that a socket has received, (N, 2)."""
    batch, found = frames(4096), []
    while True:
        try:
            got = witness.receive(batch)
        except BusDown:
            continue
        if not got:
            break
        part = batch[:got]
        found.append(np.stack([part["t_ns"], part["data"][:, 0].astype(np.int64)], axis=1))
    assert witness.dropped == 0
    return np.concatenate(found) if found else np.zeros((0, 2), np.int64)
