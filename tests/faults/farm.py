"""Six drives whose samples say which SYNC they answer, on buses and with faults of our making."""

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
"""An answer is prompt that is sent so many periods after its SYNC at the latest."""


def position_of(sync: Any, joint: Any) -> Any:
    """Position that tells SYNC (up to 16383) and joint, in bits that a disk cannot compress."""
    return sync * 8 + joint + ((sync * 40_503 + joint * 7_919) % 16_381 << 17)


def current_of(sync: Any, joint: Any) -> Any:
    """Current that tells SYNC and joint, below 2^15."""
    return (sync * 31 + joint * 1009) % 32749


def demand_of(sync: Any, joint: Any) -> Any:
    """Demand that tells SYNC and joint."""
    return -1 - sync * 8 - joint


def set_link(channel: str, up: bool) -> None:
    """Bring an interface up or down."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        request = struct.pack("16sh14x", channel.encode(), 0)
        (flags,) = struct.unpack_from("h", fcntl.ioctl(control, SIOCGIFFLAGS, request), 16)
        flags = flags | IFF_UP if up else flags & ~IFF_UP
        fcntl.ioctl(control, SIOCSIFFLAGS, struct.pack("16sh14x", channel.encode(), flags))


Sent = tuple[int, int, int, list[tuple[int, int, int]]]
"""A TPDO as it is mapped: joint, COB-ID, every how many SYNCs, and of each object index, bytes and constant value."""


class Still:
    """Nothing moves behind the drives: what they report comes from the SYNC number."""

    def __init__(self, n: int) -> None:
        self.position, self.demand = np.zeros(n, np.int32), np.zeros(n, np.int32)
        self.current = np.zeros(n, np.int16)

    def enable(self, joint: int, enabled: bool) -> None:
        """Enabled or not, it is the same."""

    def set_targets(self, targets: NDArray[np.int32], fresh: NDArray[np.bool_]) -> None:
        """Set points are not followed."""

    def advance(self) -> None:
        """Nothing moves."""


@dataclass
class Orders:
    """What shall go wrong with answers: by SYNC number and joint, how often each is sent, or when.

    ``lost`` are not sent, ``twice`` sent twice, ``again`` once more behind the next SYNC, ``late`` sent behind the SYNC
    of that number. ``skipped`` SYNCs are not sent where the farm is their master. ``done`` has the names of the first
    three where they happened: they do not while the farm itself is late. ``spoilt``: it became late while they did.
    ``done`` also has ``full`` where a disk refused something; ``full_at_end``: it did so until the capture
    was to end.
    """

    lost: set[tuple[int, int]] = field(default_factory=set)
    twice: set[tuple[int, int]] = field(default_factory=set)
    again: set[tuple[int, int]] = field(default_factory=set)
    late: dict[tuple[int, int], int] = field(default_factory=dict)
    skipped: set[int] = field(default_factory=set)
    done: set[str] = field(default_factory=set)
    spoilt: bool = False
    full_at_end: bool = False

    @cached_property
    def touched(self) -> set[int]:
        """SYNCs with whose answers something is wrong."""
        return {k for k, _ in (*self.lost, *self.twice, *self.again, *self.late)}


class _Plain:
    """The answers of drives whose TPDOs are mapped as the session wants, in arrays."""

    def __init__(self, layout: list[Sent]) -> None:
        rows = [(COB_SYNC, 1, 0), *((cob, 8 if every == 1 else 4, every) for _, cob, every, _ in layout)]
        self._every = np.array([every for *_, every in rows])
        self._joint = np.array([-1, *(j for j, *_ in layout)])
        self._word = np.array([0, *(entries[-1][2] << 16 for *_, entries in layout)])
        self._all, self._most = self._of(rows, self._every >= 0), self._of(rows, self._every <= 1)

    def _of(self, rows: list[tuple[int, int, int]], wanted: NDArray[np.bool_]) -> Any:
        """Frames of the rows wanted, their data as numbers, and what they are made of."""
        out = frames(int(wanted.sum()))
        out["can_id"], out["length"] = np.array([(cob, length) for cob, length, _ in rows])[wanted].T
        return out, out["data"].view("<i4"), self._joint[wanted], self._word[wanted], self._every[wanted] > 1

    def answers(self, k: int, counter: int, with_sync: bool) -> Frames:
        """What answers SYNC ``k``, with the SYNC itself or without."""
        out, data, joint, word, demand = self._most if counter % 5 else self._all
        data[:, 0] = np.where(demand, demand_of(k, joint), position_of(k, joint))
        data[:, 1] = word | current_of(k, joint)
        data[0] = counter, 0
        answers: Frames = out[0 if with_sync else 1 :]
        return answers


def _plain(sent: Sent) -> bool:
    _, _, every, entries = sent
    indexes = [index for index, *_ in entries]
    return (every, indexes) in ((1, [POSITION_ACTUAL, CURRENT_ACTUAL, STATUSWORD]), (5, [POSITION_DEMAND]))


class _Lane:
    """One bus of the farm, its drives, and who listens there independently."""

    def __init__(self, line: DriveBus) -> None:
        self.line = line
        self.ledger: list[int] = []
        """Number of every SYNC that went over the bus, in order."""
        self.counter = self.stamp = self.last = -1
        self.sent_ns = 0
        self.prompt = True
        self.was_down = False
        self.up = True
        self.held: list[tuple[int, int, Any]] = []
        self.repeats: list[Any] = []
        self.layout: list[Sent] | None = None
        self.plain: _Plain | bool | None = None
        self.out = frames(1024)
        self.witness: RawSocket | None = None


class Farm:
    """Drives of a session in a thread of their own; with ``sync.role: consumer`` also the master who sends SYNC.

    Parameters
    ----------
    session, robot
        Buses, nodes, SYNC.
    """

    def __init__(self, session: SessionConfig, robot: RobotConfig) -> None:
        self.session = session
        self._period = session.sync_period
        motion = Still(robot.n)
        names = [joint.name for joint in robot.joints]
        self.drives: list[Drive] = []
        for node in session.drives:
            j = names.index(node.joint)
            told = self._changed, self._changed
            self.drives.append(Drive(node.node_id, node.eds, j, robot.joints[j], motion, *told))
        self.lanes: list[_Lane] = []
        self.deaf: set[int] = set()
        """Joints whose drives answer no SYNC."""
        for bus in session.all_buses:
            here = [d for d, n in zip(self.drives, session.drives, strict=True) if session.bus_of(n) == bus]
            self.lanes.append(_Lane(DriveBus(bus, here, motion, self._period)))
        self.orders = Orders()
        self.failed: BaseException | None = None
        self.master = session.sync.role == "consumer"
        self.released = threading.Event()
        """The foreign master may begin."""
        self.begun = 0.0
        """When the first SYNC of the round went out; 0: not yet."""
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
        for lane in self.lanes:
            lane.line.boot()
        self._thread.start()

    def _changed(self) -> None:
        for lane in getattr(self, "lanes", ()):
            lane.layout = None

    def prepare(self, orders: Orders, actions: list[tuple[float, Callable[[], None]]], until: int | None) -> None:
        """Begin a round: ``actions`` happen so many seconds after its first SYNC; a master ends with SYNC ``until``."""
        with self._lock:
            self.orders, self._until = orders, until
            self._plan = sorted(actions, key=lambda a: a[0])
            self._actions = []
            self.begun, self._next, self._resting_until, self._counter_offset = 0.0, 0, 0.0, 0
            self.released.clear()
            self.deaf.clear()
            for lane in self.lanes:
                lane.ledger, lane.held, lane.repeats = [], [], []
                lane.counter = lane.last = -1
                lane.was_down, lane.prompt, lane.sent_ns = False, True, 0
                if lane.witness is not None:
                    lane.witness.close()
                lane.witness = RawSocket(lane.line.config.channel, filters=[(COB_SYNC, 0x7FF)])

    def finish(self) -> list[NDArray[np.int64]]:
        """End a round; what the independent listener of each bus has: time (ns) and counter of every SYNC, (N, 2)."""
        while self._helpers:
            self._helpers.pop().join()
        with self._lock:
            for _, _, action in sorted(self._actions):
                action()
            self._actions, self.begun = [], 0.0
            self.orders = Orders()
            seen = []
            for lane in self.lanes:
                assert lane.witness is not None
                seen.append(drained(lane.witness))
                lane.witness.close()
                lane.witness = None
            return seen

    @property
    def done(self) -> bool:
        """Whether the master has sent its last SYNC, and all that was planned has happened."""
        over = self._until is not None and self._next > self._until
        return over and not self._actions and not any(helper.is_alive() for helper in self._helpers)

    def rest(self, seconds: float, restart: bool = False) -> None:
        """The master sends nothing for a while; with ``restart`` its counter begins anew afterwards."""
        self._resting_until = time.monotonic() + seconds
        if restart:
            self._counter_offset = self._next

    def down(self, bus: int) -> None:
        """A bus goes down."""
        lane = self.lanes[bus]
        lane.up, lane.was_down = False, True
        set_link(lane.line.config.channel, False)

    def up(self, bus: int) -> None:
        """And comes back, with the drives on it."""
        lane = self.lanes[bus]
        if lane.up:
            return
        set_link(lane.line.config.channel, True)
        lane.up = True
        if isinstance(lane.line.bus, RawSocket):
            # The first to send would be told once more that it was down.
            lane.line.bus._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)

    def inject(self, bus: int, out: Frames) -> None:
        """Somebody else sends frames."""
        with suppress(BusDown), RawSocket(self.lanes[bus].line.config.channel, filters=()) as other:
            other.send(out)

    def reboot(self, joint: int, seconds: float) -> None:
        """A drive loses its power for a moment."""
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
        """A drive's heartbeat stops for a while, its answers do not."""
        drive = self._drive(joint)
        drive.nmt.halt()
        self.later(seconds, drive.nmt.resume)

    def emcy(self, joint: int, code: int) -> bool:
        """A drive reports an error; whether its bus was there to take it."""
        try:
            self._drive(joint).emcy.send(code, 0x81, b"\x01\x02")
        except (can.CanError, OSError):
            return False
        return True

    def beside(self, work: Callable[[], object]) -> None:
        """Do something that takes a while."""
        self._helpers.append(threading.Thread(target=work, daemon=True))
        self._helpers[-1].start()

    def later(self, seconds: float, action: Callable[[], None]) -> None:
        """Have something happen."""
        heapq.heappush(self._actions, (time.monotonic() + seconds, next(self._number), action))

    def bus_of(self, joint: int) -> int:
        """Number of the bus a joint's drive is on."""
        return next(b for b, lane in enumerate(self.lanes) if any(d.index == joint for d in lane.line.drives))

    def _drive(self, joint: int) -> Drive:
        return next(d for d in self.drives if d.index == joint)

    def close(self) -> None:
        """Take the drives off the buses."""
        self._stop.set()
        self._thread.join()
        for lane in self.lanes:
            lane.line.close()

    def _run(self) -> None:
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
        poll = select.poll()
        for lane in self.lanes:
            assert isinstance(lane.line.bus, RawSocket)
            poll.register(lane.line.bus.fileno(), select.POLLIN)
        try:
            while not self._stop.is_set():
                with self._lock:
                    pause = self._send_sync() if self.master else self._take()
                    self._act()
                if self.master or not all(lane.up for lane in self.lanes):
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
        """Answer what has come; how long to wait for more."""
        for lane in self.lanes:
            if not lane.up:
                continue
            try:
                got = lane.line.bus.receive(lane.line.batch)
            except BusDown:
                continue
            batch = lane.line.batch[:got]
            for one in batch[batch["can_id"] == COB_SYNC]:
                stamp = int(one["t_ns"])
                self._number_of(lane, int(one["data"][0]), stamp)
                # What is lost, or sent twice, beside an answer that is late in earnest cannot be told by anybody.
                lane.prompt = lane.sent_ns < stamp and time.time_ns() - stamp < PROMPT * self._period * 1e9
                if not self.begun and lane.witness is not None:
                    self._begin()
                disorderly = bool(lane.repeats) or (lane.prompt and lane.last in self.orders.touched)
                self._answer(lane, lane.last, int(one["data"][0]))
                lane.sent_ns = time.time_ns()
                if self.orders.done and disorderly:
                    self.orders.spoilt |= lane.sent_ns - stamp >= PROMPT * self._period * 1e9
        return 0.005

    def _number_of(self, lane: _Lane, counter: int, stamp: int) -> None:
        """The number of a SYNC by its counter; whole turns of it can be missing only where the bus was down."""
        if lane.last < 0:
            step = counter
        else:
            step = (counter - lane.counter) % COUNTER
            if lane.was_down:
                elapsed = (stamp - lane.stamp) / (self._period * 1e9)
                step += COUNTER * max(0, round((elapsed - step) / COUNTER))
                # What had come before it went down is read when it is back.
                lane.was_down = step == 1
        lane.last += step
        lane.counter, lane.stamp = counter, stamp
        lane.ledger.append(lane.last)

    def _send_sync(self) -> float:
        """Be the master: send the SYNC that is due, and the answers behind it; how long until the next."""
        now = time.monotonic()
        if not self.begun:
            if not self.released.is_set() or self.lanes[0].witness is None:
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
        if k in self.orders.skipped:
            self._next += 1
            return 0.0
        if -wait > 10 * self._period:
            if k - 1 in self.orders.skipped:
                # Held up meanwhile: the counter has gone on, by turns that nobody could tell but by the time.
                turns = math.ceil(-wait / self._period / COUNTER)
                self._next += turns * COUNTER
                self._until = None if self._until is None else self._until + turns * COUNTER
                return 0.0
            self._base -= wait
        self._next += 1
        counter = (k - self._counter_offset) % COUNTER + 1
        for lane in self.lanes:
            if lane.up:
                lane.last = k
                lane.ledger.append(k)
                self._answer(lane, k, counter, with_sync=True)
        return 0.0

    def _answer(self, lane: _Lane, k: int, counter: int, with_sync: bool = False) -> None:
        """Send what the drives of a bus have to say to SYNC ``k``."""
        out, n = lane.out, 0
        if with_sync:
            n = self._put(out, n, COB_SYNC, bytes([counter]))
        orders = self.orders
        if (
            k not in orders.touched
            and not lane.held
            and not lane.repeats
            and self._plainly(lane, k, counter, with_sync)
        ):
            return
        for item in lane.repeats:
            n = self._put(out, n, *item)
        lane.repeats = []
        due = [held for held in lane.held if held[0] <= k]
        lane.held = [held for held in lane.held if held[0] > k]
        for _, _, item in due:
            n = self._put(out, n, *item)
        for j, cob_id, every, entries in self._layout(lane):
            if counter % every or j in self.deaf:
                continue
            if (k, j) in orders.lost and lane.prompt:
                orders.done.add("lost")
                continue
            item = cob_id, b"".join(_value(index, k, j, size, word) for index, size, word in entries)
            waits = max([orders.late.get((k, j), 0), *(h[0] for h in lane.held if h[1] == j)])
            if waits > k:
                lane.held.append((waits, j, item))
                continue
            n = self._put(out, n, *item)
            if (k, j) in orders.twice and lane.prompt:
                orders.done.add("twice")
                n = self._put(out, n, *item)
            if (k, j) in orders.again and lane.prompt:
                orders.done.add("again")
                lane.repeats.append(item)
        if n:
            with suppress(BusDown):
                lane.line.bus.send(out[:n])

    def _plainly(self, lane: _Lane, k: int, counter: int, with_sync: bool) -> bool:
        """Send the answers to SYNC ``k`` from arrays, where nothing is wrong with them."""
        layout = self._layout(lane)
        if lane.plain is None:
            lane.plain = _Plain(layout) if all(_plain(sent) for sent in layout) else False
        if not isinstance(lane.plain, _Plain) or self.deaf:
            return False
        with suppress(BusDown):
            lane.line.bus.send(lane.plain.answers(k, counter, with_sync))
        return True

    @staticmethod
    def _put(out: Frames, n: int, cob_id: int, data: bytes) -> int:
        out["can_id"][n], out["length"][n] = cob_id, len(data)
        out["data"][n, : len(data)] = np.frombuffer(data, np.uint8)
        return n + 1

    def _layout(self, lane: _Lane) -> list[Sent]:
        """What the drives of a bus send as they are mapped now: joint, COB-ID, every how many SYNCs, objects."""
        if lane.layout is None:
            found: list[Sent] = []
            for drive in lane.line.drives:
                if not drive.nmt.operational:
                    continue
                for cob_id, kind, mapped in drive.pdos(TPDO_COMMUNICATION):
                    if 1 <= kind <= COUNTER:
                        words = {STATUSWORD: drive.status}
                        entries = [(index, size, words.get(index, 0)) for index, _, size in mapped]
                        found.append((drive.index, cob_id, kind, entries))
            lane.layout, lane.plain = found, None
        return lane.layout

    @property
    def operational(self) -> bool:
        """Whether all drives exchange PDOs."""
        return all(drive.nmt.operational for drive in self.drives)

    @property
    def enabled(self) -> bool:
        """Whether all drives are in operation."""
        return all(drive.state is DriveState.ENABLED for drive in self.drives)


def _value(index: int, k: int, j: int, size: int, word: int) -> bytes:
    """Bytes of one object in the answer to SYNC ``k``; ``word`` where it does not depend on that."""
    if index == POSITION_ACTUAL:
        value = position_of(k, j)
    elif index == CURRENT_ACTUAL:
        value = current_of(k, j)
    elif index == POSITION_DEMAND:
        value = demand_of(k, j)
    else:
        value = word
    return int(value).to_bytes(size, "little", signed=value < 0)


def drained(witness: RawSocket) -> NDArray[np.int64]:
    """All that a socket has: time and counter of each SYNC (N, 2)."""
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
