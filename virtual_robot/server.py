"""Virtual drives of a session: the canopen library serves SDO and NMT, a fast loop answers every SYNC of every bus."""

import select
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from armident.configs import RobotConfig, SessionConfig
from armident.configs.units import counts_per_si
from armident.drivers.can.frames import frames
from armident.drivers.can.socketcan import RECEIVE_TIMEOUT, RawSocket
from armident.drivers.canopen.objects import DriveState
from armident.virtual_robot.arm import DriveBackend
from armident.virtual_robot.bus_server import BATCH, DriveBus
from armident.virtual_robot.node import Drive
from armident.virtual_robot.oddities import make_oddities

TOGETHER_S = 0.05
"""Longest wait of a SYNC of one bus for that of another bus, s."""
ANSWERED_SYNCS = 32
"""Maximum number of SYNCs that are answered in one system call if the drives are behind."""
SUPERVISION_SYNCS = 64
"""Number of SYNCs between two checks of the following errors."""
FOLLOWING_ERROR_LIMIT = 0.5
"""Following error at which a drive enters the fault state, rad or m at the joint."""
DELAY_SYNCS = 16
"""Number of SYNCs between two measurements of the delay; it is also measured at each SYNC that waited for another."""
DELAY_BINS = 50_000
"""Number of bins of 1 us of the delay histogram; the last one holds all larger delays."""
EMCY_FOLLOWING_ERROR, EMCY_PDO_LENGTH = 0x8611, 0x8210
"""Emergency error codes (CiA 402, CiA 301)."""
MOTION_ERROR, COMMUNICATION_ERROR = 0x20, 0x10
"""Bits of the error register (1001h)."""


@dataclass(frozen=True)
class ServerReport:
    """Timing of answers: wait of a SYNC in the kernel, us, most SYNCs at once, and frames that the kernel dropped."""

    syncs: int
    delay_p50_us: float
    delay_p99_us: float
    delay_max_us: float
    backlog_max: int
    seconds: float
    cpu_share: float
    dropped: int

    def __str__(self) -> str:
        if not self.syncs:
            return "no SYNC answered"
        behind = (
            "never a SYNC behind"
            if self.backlog_max <= 1
            else f"at worst {self.backlog_max - 1} SYNC behind ({self.delay_max_us / 1000:.1f} ms)"
        )
        return (
            f"{self.syncs} SYNC answered, delayed by {self.delay_p50_us:.0f} us (p50), "
            f"{self.delay_p99_us:.0f} us (p99), {self.delay_max_us:.0f} us (worst); {behind}; "
            f"{100 * self.cpu_share:.0f} % of one CPU; "
            f"{self.dropped} frames dropped by the kernel"
        )


class Server:
    """All virtual drives of a session on its buses (``with`` block), with the names of oddities by joint."""

    def __init__(
        self,
        session: SessionConfig,
        robot: RobotConfig,
        motion: DriveBackend,
        oddities: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        self._session, self._motion = session, motion
        names = [joint.name for joint in robot.joints]
        self._dirty = self._status_dirty = False
        self.drives: list[Drive] = []
        callbacks = (self._changed, self._status_changed)
        for node in session.drives:
            j = names.index(node.joint)
            fd = session.bus_of(node).fd
            drive = Drive(node.node_id, node.eds, j, robot.joints[j], motion, *callbacks, fd)
            drive.become_odd(make_oddities((oddities or {}).get(node.joint, ()), drive, session))
            self.drives.append(drive)
        self._limit = FOLLOWING_ERROR_LIMIT * np.abs(np.diag(robot.transmission_matrix)) * counts_per_si(robot)
        self._histogram = np.zeros(DELAY_BINS + 1, np.int64)
        self._latest = 0.0
        self._backlog = self._syncs = 0
        self._origin, self._operational = 0, False
        self._seconds = self._cpu = 0.0
        self._buses: list[DriveBus] = []
        try:
            for bus in session.all_buses:
                both = zip(self.drives, session.drives, strict=True)
                here = [drive for drive, node in both if session.bus_of(node) == bus]
                self._buses.append(DriveBus(bus, here, motion, session.sync_period))
        except BaseException:
            for drive_bus in self._buses:
                drive_bus.close()
            raise

    def _changed(self) -> None:
        self._dirty = True

    def _status_changed(self) -> None:
        self._status_dirty = True

    def _update_exchange(self) -> None:
        if self._dirty:
            self._dirty = self._status_dirty = False
            operational = any(drive.nmt.operational for drive in self.drives)
            if operational and not self._operational:
                self._origin = self._syncs
            self._operational = operational
            for drive_bus in self._buses:
                drive_bus.exchange.rebuild()
        elif self._status_dirty:
            self._status_dirty = False
            for drive_bus in self._buses:
                drive_bus.exchange.refresh_status()

    def __enter__(self) -> Self:
        """Boot the drives: boot-up message, pre-operational, heartbeat."""
        for drive_bus in self._buses:
            drive_bus.boot()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the drives and release their buses."""
        for drive_bus in self._buses:
            drive_bus.close()

    def run(self, stopped: Callable[[], bool], duration: float | None = None) -> ServerReport:
        """Answer every SYNC until ``stopped`` or ``duration``, s; raises BusDown if the only bus goes down."""
        begin, cpu = time.monotonic(), time.process_time()

        def over() -> bool:
            return stopped() or (duration is not None and time.monotonic() - begin > duration)

        if len(self._buses) == 1:
            self._serve_one(self._buses[0], over)
        else:
            self._serve_several(over)
        self._seconds += time.monotonic() - begin
        self._cpu += time.process_time() - cpu
        return self.report()

    def _serve_one(self, drive_bus: DriveBus, over: Callable[[], bool]) -> None:
        stamps, exchange, bus = drive_bus.batch["t_ns"], drive_bus.exchange, drive_bus.bus
        outbox, queued = frames(BATCH, fd=bus.fd), 0
        while not over():
            count = drive_bus.receive(wait=True)
            self._update_exchange()
            at = backlog = 0
            while at < count:
                at = drive_bus.take(at, count, self._counter)
                if at >= count:
                    break
                answers = exchange.out.size
                if queued + answers > outbox.size:
                    bus.send(outbox[:queued])
                    queued = 0
                outbox[queued : queued + answers] = exchange.out
                queued += answers
                # One system call for all answers that are due, so that drives that are behind catch up.
                if at + 1 == count or (backlog + 1) % ANSWERED_SYNCS == 0:
                    bus.send(outbox[:queued])
                    queued = 0
                if backlog or self._syncs % DELAY_SYNCS == 0:
                    self._record_delay(time.time_ns() - int(stamps[at]))
                exchange.act()
                # Drives that are behind apply commands at the same SYNC as those that are not.
                self._update_exchange()
                self._advance()
                backlog += 1
                at += 1
            if queued:
                bus.send(outbox[:queued])
                queued = 0
            self._backlog = max(self._backlog, backlog)

    def _serve_several(self, over: Callable[[], bool]) -> None:
        """Answer SYNC k on every bus before the arm advances to k + 1."""
        poll = select.poll()
        for drive_bus in self._buses:
            assert isinstance(drive_bus.bus, RawSocket)
            poll.register(drive_bus.bus.fileno(), select.POLLIN)
        period_ns = self._session.sync_period * 1e9
        since: float | None = None
        while not over():
            due = [(drive_bus, drive_bus.next_sync()) for drive_bus in self._buses]
            waiting = [(drive_bus, *sync) for drive_bus, sync in due if sync is not None]
            missing = any(sync is None and not drive_bus.down for drive_bus, sync in due)
            self._update_exchange()
            if not waiting or (missing and (since is None or time.monotonic() - since < TOGETHER_S)):
                since = (since or time.monotonic()) if waiting else None
                for drive_bus in self._buses:
                    drive_bus.flush()
                poll.poll(1000 * (TOGETHER_S if waiting else RECEIVE_TIMEOUT))
                continue
            since = None
            _, counter, stamp = min(waiting, key=lambda one: one[2])
            for drive_bus, other, at in waiting:
                # A bus that missed a SYNC is ahead of the others: its next one waits for theirs.
                # Without a counter (0), time alone tells the SYNCs apart.
                most_ns = period_ns * max(self._session.sync.counter if counter else 1, 1) / 2
                if other == counter and abs(at - stamp) < most_ns:
                    drive_bus.answer(counter or self._counter)
            if self._syncs % DELAY_SYNCS == 0:
                self._record_delay(time.time_ns() - stamp)
            self._advance()

    @property
    def _counter(self) -> int:
        """Counter of the next SYNC if it carries none: SYNCs since the first drive became operational."""
        return self._syncs - self._origin + 1

    def _advance(self) -> None:
        self._motion.advance()
        self._syncs += 1
        if self._syncs % SUPERVISION_SYNCS == 0:
            self._supervise()

    def _record_delay(self, late_ns: int) -> None:
        late = max(late_ns // 1000, 0)
        self._histogram[min(late, DELAY_BINS)] += 1
        self._latest = max(self._latest, float(late))

    def _supervise(self) -> None:
        error = np.abs(self._motion.demand.astype(np.int64) - self._motion.position)
        for drive in self.drives:
            if drive.state is DriveState.ENABLED and error[drive.index] > self._limit[drive.index]:
                drive.fault(EMCY_FOLLOWING_ERROR, MOTION_ERROR)
        for index in [index for drive_bus in self._buses for index in drive_bus.exchange.take_short()]:
            next(d for d in self.drives if d.index == index).emcy.send(EMCY_PDO_LENGTH, COMMUNICATION_ERROR)

    def report(self) -> ServerReport:
        """Timing of the drives' answers so far."""
        counts = np.cumsum(self._histogram)
        p50, p99 = (float(np.searchsorted(counts, share * counts[-1])) for share in (0.5, 0.99))
        cpu_share = self._cpu / self._seconds if self._seconds else 0.0
        dropped = sum(drive_bus.bus.dropped for drive_bus in self._buses)
        return ServerReport(self._syncs, p50, p99, self._latest, self._backlog, self._seconds, cpu_share, dropped)
