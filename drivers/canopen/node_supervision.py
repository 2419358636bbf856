"""Supervision of nodes (CiA 301, error control): by heartbeat, by node guarding, or none."""

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from armident.configs.errors import ArmidentError
from armident.configs.schema.session import SessionConfig
from armident.drivers.can.frames import BusDown
from armident.drivers.canopen.cia402_enable import POLL_INTERVAL
from armident.drivers.canopen.heartbeat_monitor import HeartbeatMonitor
from armident.drivers.canopen.network import NodeNetwork
from armident.drivers.canopen.objects import NmtState
from armident.drivers.canopen.sdo import DriveSdo

NMT_TIMEOUT = 2.0
"""Longest wait for a heartbeat that reports the NMT state commanded, s."""

HEARTBEATS_MISSED = 3
"""Number of heartbeat periods without heartbeat after which a drive is lost."""

HEARTBEAT_MARGIN = 0.1
"""Additional time for delays of this machine before a drive is lost, s."""

HEARTBEAT_CHECK_S = 0.02
"""Interval at which heartbeats are checked, s."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SupervisionChange:
    """Loss or return of a drive. ``kind``: loss or return; ``text``: message without the name of the drive."""

    kind: Literal["heartbeat_lost", "heartbeat_back"]
    sdo: DriveSdo
    text: str


class NodeSupervision:
    """Supervises the drives of a session by their heartbeats, or by node guarding where a drive has none."""

    def __init__(self, session: SessionConfig, networks: Mapping[str, NodeNetwork]) -> None:
        self._session, self._networks = session, networks
        self._joints = {(session.bus_of(d).channel, d.node_id): d.joint for d in session.drives}
        self._limits: dict[str, float] = {}
        """Longest silence of each supervised drive, s, by joint."""
        self._guarded: list[DriveSdo] = []
        self._guarded_at = 0.0
        self._monitor: HeartbeatMonitor | None = None
        self.nmt: dict[str, int] = {}
        """Last NMT state that each drive reported, by joint."""
        self.lost: set[str] = set()
        """Joints whose drives are lost."""

    def _network_of(self, sdo: DriveSdo) -> NodeNetwork:
        return self._networks[self._session.bus_of(sdo.drive).channel]

    def add(self, sdo: DriveSdo) -> None:
        """Choose how a started drive is supervised: by heartbeat, by node guarding, or not at all."""
        joint, period_ms = sdo.drive.joint, sdo.heartbeat_ms or self._session.heartbeat_ms
        limit = HEARTBEATS_MISSED * period_ms * 1e-3 + HEARTBEAT_MARGIN
        if sdo.heartbeat_ms is not None:
            self._limits[joint] = limit
            return
        self.nmt.pop(joint, None)
        until, asked = time.monotonic() + limit, 0.0
        while joint not in self.nmt and time.monotonic() < until:
            if time.monotonic() - asked > period_ms * 1e-3:
                asked = time.monotonic()
                self._network_of(sdo).guard(sdo.drive.node_id)
            time.sleep(POLL_INTERVAL)
        if joint in self.nmt:
            self._limits[joint] = limit
            self._guarded.append(sdo)
            sdo.remark(f"has no heartbeat (1017h): supervised by node guarding every {period_ms} ms")
        else:
            sdo.remark("has no heartbeat (1017h) and does not answer node guarding: its failure is not detected")

    def await_operational(self, sdo: DriveSdo) -> None:
        """Wait until a drive reports the NMT state operational; a drive that reports no state is not waited for."""
        if sdo.drive.joint not in self._limits:
            return
        deadline = time.monotonic() + NMT_TIMEOUT + (sdo.heartbeat_ms or self._session.heartbeat_ms) * 1e-3
        while self.nmt.get(sdo.drive.joint) != NmtState.OPERATIONAL:
            self._network_of(sdo).check()
            if sdo in self._guarded:
                self._guard()
            if time.monotonic() > deadline:
                raise ArmidentError(f"{sdo.label}: does not report operational after NMT start")
            time.sleep(POLL_INTERVAL)

    def begin(self) -> None:
        """Begin to measure the silence of the drives."""
        self._heartbeats()
        self._monitor = HeartbeatMonitor(self._limits, time.monotonic())

    def check(self, drives: Sequence[DriveSdo]) -> Iterator[SupervisionChange]:
        """Yield lost and returned drives, by the receive times of heartbeats and answers to node guarding."""
        monitor = self._monitor
        if monitor is None or time.monotonic() - monitor.updated < HEARTBEAT_CHECK_S:
            return
        self._guard()
        # Heartbeats that wait in the sockets count.
        monitor.update(self._heartbeats(), time.monotonic())
        for sdo in drives:
            joint = sdo.drive.joint
            if joint not in self._limits:
                continue
            silence, ended, limit = monitor.silence(joint), monitor.ended_silence(joint), self._limits[joint]
            if joint not in self.lost and max(silence, ended) > limit:
                self.lost.add(joint)
                what = "answer to node guarding" if sdo in self._guarded else "heartbeat"
                yield SupervisionChange("heartbeat_lost", sdo, f"no {what} for {max(silence, ended):.2f} s")
            if joint in self.lost and silence <= limit:
                self.lost.discard(joint)
                yield SupervisionChange("heartbeat_back", sdo, "heartbeat is back")

    def _guard(self) -> None:
        """Ask the drives without heartbeat for their NMT state, at the interval of heartbeats."""
        if time.monotonic() - self._guarded_at < self._session.heartbeat_ms * 1e-3:
            return
        self._guarded_at = time.monotonic()
        for sdo in self._guarded:
            try:
                self._network_of(sdo).guard(sdo.drive.node_id)
            except BusDown as error:
                log.debug("%s", error)

    def _heartbeats(self) -> list[tuple[str, float]]:
        """Return joint and time of the heartbeats of supervised drives since the last call."""
        return [
            (self._joints[channel, node], at)
            for channel, network in self._networks.items()
            for node, at in network.heartbeats.read()
            if self._joints[channel, node] in self._limits
        ]
