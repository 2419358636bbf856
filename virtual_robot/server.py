"""The virtual drives on a bus: canopen serves SDO and NMT, a loop of its own answers every SYNC."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import can
import canopen
import numpy as np
from numpy.typing import NDArray

from configs import ConfigError, RobotConfig, SessionConfig
from drivers.frames import FrameBus, frames
from drivers.objects import COB_MASK, COB_NMT, COB_SDO_REQUEST, COB_SYNC, DriveState
from drivers.socketcan import RECEIVE_TIMEOUT, RawSocket
from drivers.udp import open_bus
from virtual_robot.arm import Motion, counts_per_si
from virtual_robot.exchange import Exchange
from virtual_robot.node import Drive

PDO_FILTERS = ((0x180, 0x780), (0x200, 0x700), (0x300, 0x700), (0x400, 0x700), (0x500, 0x780))
"""Identifiers 180h to 57Fh, which PDOs may have; a socket does not receive what it sends itself."""
BATCH = 1024
ANSWERED_SYNCS = 32
"""Most SYNCs whose answers wait for each other when the drives are behind."""
SUPERVISION_SYNCS = 64
"""Following errors are checked every so many SYNC."""
FOLLOWING_ERROR_LIMIT = 0.5
"""Following error at which a drive faults, rad or m at the joint."""
LATENESS_SYNCS = 16
"""How long a SYNC waited is measured at every so many, and at every one that found another before it."""
LATENESS_BINS = 50_000
"""Lateness is counted in bins of 1 us; the last one holds everything later."""
EMCY_FOLLOWING_ERROR, EMCY_PDO_LENGTH = 0x8611, 0x8210
MOTION_ERROR, COMMUNICATION_ERROR = 0x20, 0x10
"""Bits of the error register (1001h)."""


@dataclass(frozen=True)
class ServerReport:
    """How the drives kept up; ``lateness`` is how long a SYNC had waited in the kernel when its turn came."""

    syncs: int
    lateness_p50_us: float
    lateness_p99_us: float
    lateness_max_us: float
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
            else f"at worst {self.backlog_max - 1} SYNC behind ({self.lateness_max_us / 1000:.1f} ms)"
        )
        return (
            f"{self.syncs} SYNC answered, late by {self.lateness_p50_us:.0f} us (p50), "
            f"{self.lateness_p99_us:.0f} us (p99), {self.lateness_max_us:.0f} us (worst); {behind}; "
            f"{100 * self.cpu_share:.0f} % of one CPU; "
            f"{self.dropped} frames dropped by the kernel"
        )


class Server:
    """All drives of a session on its bus.

    Parameters
    ----------
    session, robot
        Bus, nodes and SYNC; joints and drives.
    motion
        What moves behind the drives.

    Raises
    ------
    ConfigError
        If the bus is missing or an EDS is unusable.
    """

    def __init__(self, session: SessionConfig, robot: RobotConfig, motion: Motion) -> None:
        self._session, self._motion = session, motion
        names = [joint.name for joint in robot.joints]
        self._dirty = self._status_dirty = False
        self.drives: list[Drive] = []
        told = (self._changed, self._status_changed)
        for node in session.drives:
            j = names.index(node.joint)
            self.drives.append(Drive(node.node_id, node.eds, j, robot.joints[j], motion, *told))
        self._limit = _following_limit(robot)
        self._histogram = np.zeros(LATENESS_BINS + 1, np.int64)
        self._latest = 0.0
        self._backlog = self._syncs = 0
        self._seconds = self._cpu = 0.0
        self._bus: FrameBus = open_bus(session.bus, filters=((COB_SYNC, COB_MASK), *PDO_FILTERS))
        try:
            self._network = open_network(session, self.drives)
        except BaseException:
            self._bus.close()
            raise
        self._exchange = Exchange(self.drives, motion, session.sync_period)
        self._batch = frames(BATCH)
        self._columns = self._batch["can_id"], self._batch["length"], self._batch["data"]
        # Compile before anybody waits for an answer.
        self._take(0, 0, 1)

    def _changed(self) -> None:
        self._dirty = True

    def _status_changed(self) -> None:
        self._status_dirty = True

    def _catch_up(self) -> None:
        if self._dirty:
            self._dirty = self._status_dirty = False
            self._exchange.rebuild()
        elif self._status_dirty:
            self._status_dirty = False
            self._exchange.refresh_status()

    def __enter__(self) -> Self:
        """Boot the drives: boot-up message, pre-operational, heartbeat."""
        for drive in self.drives:
            self._network.add_node(drive)
            drive.nmt.boot()
        return self

    def __exit__(self, *_: object) -> None:
        """Take the drives off the bus."""
        for drive in self.drives:
            drive.nmt.halt()
        self._network.disconnect()
        self._bus.close()

    def run(self, stopped: Callable[[], bool], duration: float | None = None) -> ServerReport:
        """Answer every SYNC until ``stopped()`` or for ``duration`` seconds.

        Raises
        ------
        BusDown
            If the bus goes down.
        """
        stamps = self._batch["t_ns"]
        outbox, queued = frames(BATCH), 0
        begin, cpu = time.monotonic(), time.process_time()
        sequence = 0
        exchange, bus = self._exchange, self._bus
        while not stopped():
            count = self._receive()
            self._catch_up()
            if duration is not None and time.monotonic() - begin > duration:
                break
            at = backlog = 0
            while at < count:
                at = self._take(at, count, sequence % self._session.sync.counter + 1)
                if at >= count:
                    break
                answers = exchange.out.size
                if queued + answers > outbox.size:
                    bus.send(outbox[:queued])
                    queued = 0
                outbox[queued : queued + answers] = exchange.out
                queued += answers
                # One system call for all answers that are due: the further behind, the cheaper each of them.
                if at + 1 == count or (backlog + 1) % ANSWERED_SYNCS == 0:
                    bus.send(outbox[:queued])
                    queued = 0
                if backlog or sequence % LATENESS_SYNCS == 0:
                    self._note(time.time_ns() - int(stamps[at]))
                exchange.act()
                self._motion.advance()
                sequence += 1
                backlog += 1
                at += 1
                if sequence % SUPERVISION_SYNCS == 0:
                    self._supervise()
            if queued:
                bus.send(outbox[:queued])
                queued = 0
            self._backlog = max(self._backlog, backlog)
        self._syncs = sequence
        self._seconds += time.monotonic() - begin
        self._cpu += time.process_time() - cpu
        return self.report()

    def _take(self, start: int, stop: int, sequence: int) -> int:
        return self._exchange.take(*self._columns, start, stop, sequence)

    def _receive(self) -> int:
        """Wait for frames; in a guest kernel system calls are dear, so with one where the bus can."""
        if isinstance(self._bus, RawSocket):
            return self._bus.receive(self._batch, wait=True)
        return self._bus.receive(self._batch) if self._bus.poll(RECEIVE_TIMEOUT) else 0

    def _note(self, late_ns: int) -> None:
        late = max(late_ns // 1000, 0)
        self._histogram[min(late, LATENESS_BINS)] += 1
        self._latest = max(self._latest, float(late))

    def _supervise(self) -> None:
        error = np.abs(self._motion.demand.astype(np.int64) - self._motion.position)
        for drive in self.drives:
            if drive.state is DriveState.ENABLED and error[drive.index] > self._limit[drive.index]:
                drive.fault(EMCY_FOLLOWING_ERROR, MOTION_ERROR)
        for index in self._exchange.take_short():
            next(d for d in self.drives if d.index == index).emcy.send(EMCY_PDO_LENGTH, COMMUNICATION_ERROR)

    def report(self) -> ServerReport:
        """How the drives kept up so far."""
        counts = np.cumsum(self._histogram)
        p50, p99 = (float(np.searchsorted(counts, share * counts[-1])) for share in (0.5, 0.99))
        return ServerReport(
            self._syncs, p50, p99, self._latest, self._backlog, self._seconds,
            self._cpu / self._seconds if self._seconds else 0.0, self._bus.dropped,
        )  # fmt: skip


def _following_limit(robot: RobotConfig) -> NDArray[np.float64]:
    return FOLLOWING_ERROR_LIMIT * np.abs(np.diag(robot.transmission_matrix)) * counts_per_si(robot)


def open_network(session: SessionConfig, drives: Sequence[Drive]) -> Any:
    """Open canopen's own bus, to which the kernel passes NMT commands and SDO requests only.

    Raises
    ------
    ConfigError
        If there is no such bus.
    """
    wanted = [COB_NMT, *(COB_SDO_REQUEST + drive.node_id for drive in drives)]
    filters = [{"can_id": can_id, "can_mask": COB_MASK, "extended": False} for can_id in wanted]
    network = canopen.Network()
    try:
        network.connect(interface=session.bus.interface, channel=session.bus.channel, can_filters=filters)
    except (OSError, can.CanError) as error:
        raise ConfigError(f"bus {session.bus.channel}: cannot be opened: {error}") from error
    return network
