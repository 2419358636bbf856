"""The CANopen master: finds the drives, configures what they send, enables them and watches over them.

canopen does the protocol (SDO, NMT). Filters in the kernel keep TPDO and SYNC away from its socket:
it costs tens of microseconds per frame and must never see the hot path.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Self

from armident.configs.errors import ArmidentError, ConfigError
from armident.configs.schema.robot import RobotConfig
from armident.configs.schema.session import DriveNode, SessionConfig
from armident.drivers.can.frames import BusDown
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.cia402_enable import POLL_INTERVAL, enable_drive, stand_still, state_of
from armident.drivers.canopen.heartbeat_monitor import HeartbeatMonitor
from armident.drivers.canopen.network import NodeNetwork
from armident.drivers.canopen.objects import Control, DriveState, NmtCommand, NmtState
from armident.drivers.canopen.pdo_mapping import check_drive, map_drive, mapping_differs
from armident.drivers.canopen.sdo import DriveSdo

NMT_TIMEOUT = 2.0
"""Longest wait for a heartbeat that reports the NMT state commanded, s."""

HEARTBEATS_MISSED = 3
"""A drive is lost after this many of its heartbeat periods without one."""

HEARTBEAT_MARGIN = 0.1
"""What the host may be late on top, s."""

LOOK_S = 0.02
"""How often heartbeats are looked at, s."""

AGAIN_S = 0.5
"""A drive that could not be configured again is tried again after this, s."""

QUIET_S = 0.2
"""A mapping that others change is put right when they have written nothing for so long, s."""

NEVER = 2**63 - 1

EventKind = Literal[
    "emcy", "heartbeat_lost", "heartbeat_back", "nmt_state", "rebooted", "mapping_changed", "configured", "failed"
]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DriveEvent:
    """Something a drive reported, or failed to."""

    kind: EventKind
    joint: str
    node_id: int
    t_ns: int
    """Time of the frame, or of the moment the loss was noticed; ns, UTC."""
    text: str
    code: int = 0
    """EMCY error code, or NMT state."""


class DriveMaster:
    """The master of the drives of one session; use it in a ``with`` block.

    ``configure()``, then ``start()``, then ``supervise()`` every now and then, and ``stop()`` at the end. A drive that
    boots again after ``start()``, or whose PDO mapping somebody else changes, is configured, started and enabled once
    more by itself. Until then its TPDOs are not what the session says, which ``suspect`` tells.

    Parameters
    ----------
    session
        Bus, nodes and streams.
    robot
        What the drives must match.

    Raises
    ------
    ConfigError
        If there is no such bus.
    BusDown
        If the bus is down.
    """

    def __init__(self, session: SessionConfig, robot: RobotConfig) -> None:
        self._session = session
        self._robot = robot
        self._events: queue.SimpleQueue[DriveEvent] = queue.SimpleQueue()
        self._nmt: dict[str, int] = {}
        self._limit = HEARTBEATS_MISSED * session.heartbeat_ms * 1e-3 + HEARTBEAT_MARGIN
        self._lost: set[str] = set()
        self._joints = {(session.bus_of(d).channel, d.node_id): d.joint for d in session.drives}
        self._silences: HeartbeatMonitor | None = None
        self._reviving: dict[str, threading.Thread] = {}
        self.suspect: dict[str, tuple[int, int]] = {}
        """From when on, and until when (ns, UTC), the TPDOs of joints are not to be trusted; a new one per change."""
        self._written: dict[str, float] = {}
        self._started = False
        self._started_ns = 0
        self._enabled = False
        self._networks: dict[str, NodeNetwork] = {}
        try:
            for bus in session.all_buses:
                self._networks[bus.channel] = NodeNetwork(bus, session.drives_on(bus))
            self._drives = [self._add(drive) for drive in session.drives]
        except BaseException:
            self.close()
            raise

    def _add(self, drive: DriveNode) -> DriveSdo:
        node = self._network_of(drive).add(drive)
        sdo = DriveSdo(node, drive, self._session)
        node.nmt.add_heartbeat_callback(lambda state: self._on_heartbeat(sdo, state))
        self._network_of(drive).overhear(drive.node_id, lambda index, t_ns: self._on_others(sdo, index, t_ns))
        return sdo

    def _network_of(self, drive: DriveNode) -> NodeNetwork:
        return self._networks[self._session.bus_of(drive).channel]

    def configure(self) -> None:
        """Check every drive against the robot, then map and switch on what the session streams.

        Raises
        ------
        ConfigError
            If a drive is missing, is not the one expected, or refuses a mapping.
        BusDown
            If the bus went down.
        """
        for sdo in self._drives:
            self._command(NmtCommand.PRE_OPERATIONAL, sdo)
        for sdo in self._drives:
            check_drive(sdo, self._robot)
        for sdo in self._drives:
            map_drive(sdo, self._session)

    def start(self, enable: bool = True) -> None:
        """Start the nodes (NMT) and, where the arm shall hold or move, bring the drives to operation enabled.

        Raises
        ------
        ArmidentError
            If a drive does not follow; names its state.
        BusDown
            If the bus went down.
        """
        for sdo in self._drives:
            self._command(NmtCommand.START, sdo)
        for sdo in self._drives:
            self._await_operational(sdo)
        self._heard()
        self._silences = HeartbeatMonitor(self._joints.values(), time.monotonic())
        self._started, self._started_ns = True, time.time_ns()
        if not enable:
            return
        self._enabled = True
        for sdo in self._drives:
            stand_still(sdo)
        for sdo in self._drives:
            enable_drive(sdo)
        for sdo in self._drives:
            mode = sdo.read(od.MODE_DISPLAY, 0, "b")
            if mode != od.CYCLIC_SYNCHRONOUS_POSITION:
                raise ConfigError(f"{sdo.who}: stays in mode of operation {mode} (6061h), 8 was commanded")

    def supervise(self) -> list[DriveEvent]:
        """Return what has happened since the last call: EMCY, lost and returned heartbeats, NMT states, reboots.

        Never waits. A bus that went down is opened again when it is back; while others are up, the heartbeats of its
        drives are lost meanwhile.

        Raises
        ------
        BusDown
            If all buses are down.
        """
        alive = {channel: network.revive() for channel, network in self._networks.items()}
        if not any(alive.values()):
            raise BusDown(f"bus {', '.join(alive)}: went down")
        if self._started and self._silences is not None:
            self._judge(self._silences)
        self.listen()
        events = []
        while not self._events.empty():
            events.append(self._events.get())
        return events

    def listen(self) -> None:
        """Take note of what drives have reported and others have written to them by now; never waits.

        ``suspect`` says so then; `supervise` does so, too. Where TPDOs were dropped, the requests before those that
        were not may be among them.
        """
        by_joint = {sdo.drive.joint: sdo for sdo in self._drives}
        for channel, network in self._networks.items():
            for emcy in network.emergencies():
                sdo = by_joint[self._joints[channel, emcy.node]]
                self._report("emcy", sdo, emcy.t_ns, emcy.text(sdo.emcy_texts), emcy.code)
            for node, index, t_ns in network.written():
                joint = self._joints[channel, node]
                # What we write ourselves, or somebody beside us, is in the time that is suspect anyway.
                if t_ns > max(self._started_ns, self.suspect.get(joint, (0, 0))[1]):
                    self._on_others(by_joint[joint], index, t_ns)

    @property
    def drives(self) -> tuple[DriveSdo, ...]:
        """The drives over SDO, in the order of the session's."""
        return tuple(self._drives)

    def positions(self) -> list[int]:
        """Position actual values (6064h) over SDO, counts, in the order of the session's drives."""
        return [sdo.read(od.POSITION_ACTUAL, 0, "i") for sdo in self._drives]

    def states(self) -> list[DriveState | None]:
        """CiA 402 states from the statuswords over SDO, in the order of the session's drives."""
        return [state_of(sdo) for sdo in self._drives]

    def quick_stop(self) -> None:
        """Order a quick stop from every drive that still answers; raises nothing."""
        self._order((Control.QUICK_STOP,))

    def stop(self) -> None:
        """Take the drives out of operation and the nodes to pre-operational; raises nothing, may be repeated."""
        if self._enabled:
            self._enabled = False
            self._order((Control.SWITCH_ON, Control.SHUTDOWN, Control.DISABLE_VOLTAGE))
        if self._started:
            self._started = False
            for sdo in self._drives:
                try:
                    self._command(NmtCommand.PRE_OPERATIONAL, sdo)
                except ArmidentError as error:
                    log.debug("%s", error)

    def close(self) -> None:
        """Stop the drives and leave the buses."""
        self.stop()
        for thread in list(self._reviving.values()):
            thread.join()
        for network in self._networks.values():
            network.close()

    def __enter__(self) -> Self:
        """Use the master in a ``with`` block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the drives and leave the buses."""
        self.close()

    def _await_operational(self, sdo: DriveSdo) -> None:
        deadline = time.monotonic() + NMT_TIMEOUT + self._session.heartbeat_ms * 1e-3
        while self._nmt.get(sdo.drive.joint) != NmtState.OPERATIONAL:
            self._network_of(sdo.drive).check()
            if time.monotonic() > deadline:
                raise ArmidentError(f"{sdo.who}: does not report operational after NMT start")
            time.sleep(POLL_INTERVAL)

    def _order(self, controls: tuple[Control, ...]) -> None:
        # A lost drive would cost a timeout each; NMT reaches it too, if anything does.
        for sdo in [sdo for sdo in self._drives if sdo.drive.joint not in self._lost]:
            try:
                for control in controls:
                    sdo.order(od.CONTROLWORD, 0, control, "H")
            except ArmidentError as error:
                log.debug("%s", error)

    def _command(self, command: NmtCommand, sdo: DriveSdo) -> None:
        self._network_of(sdo.drive).command(command, sdo.drive.node_id)

    def _heard(self) -> list[tuple[str, float]]:
        """Joint and time of the heartbeats that have come since the last call."""
        return [
            (self._joints[channel, node], at)
            for channel, network in self._networks.items()
            for node, at in network.heartbeats.read()
        ]

    def _judge(self, silences: HeartbeatMonitor) -> None:
        """Tell whose heartbeats stay away, and whose are back, by when they came and not by when they are looked at."""
        if time.monotonic() - silences.looked < LOOK_S:
            return
        # What waits in the sockets is read before anybody is said to be missing.
        heard = self._heard()
        silences.look(heard, time.monotonic())
        for sdo in self._drives:
            joint = sdo.drive.joint
            lasts, ended = silences.lasts(joint), silences.ended(joint)
            if joint not in self._lost and max(lasts, ended) > self._limit:
                self._lost.add(joint)
                self._report("heartbeat_lost", sdo, time.time_ns(), f"no heartbeat for {max(lasts, ended):.2f} s")
            if joint in self._lost and lasts <= self._limit:
                self._lost.discard(joint)
                self._report("heartbeat_back", sdo, time.time_ns(), "heartbeat is back")

    def _report(self, kind: EventKind, sdo: DriveSdo, t_ns: int, text: str, code: int = 0) -> None:
        drive = sdo.drive
        self._events.put(DriveEvent(kind, drive.joint, drive.node_id, t_ns, f"{sdo.who}: {text}", code))

    def _on_heartbeat(self, sdo: DriveSdo, state: int) -> None:
        joint = sdo.drive.joint
        before = self._nmt.get(joint)
        self._nmt[joint] = state
        if not self._started:
            return
        if state == NmtState.BOOT_UP:
            self._report("rebooted", sdo, time.time_ns(), "has booted again", state)
            self._distrust(sdo, time.time_ns())
            self._begin(self._revive, sdo)
        elif state != before:
            self._report("nmt_state", sdo, time.time_ns(), f"NMT state is {_nmt_name(state)}", state)
            if state == NmtState.OPERATIONAL and before is not None:
                self._begin(self._verify, sdo)

    def _on_others(self, sdo: DriveSdo, index: int, t_ns: int) -> None:
        """Somebody else writes to a drive: if it is what its TPDOs hold, that is not what we asked for any more."""
        if not self._started or not od.TPDO_COMMUNICATION <= index < od.TPDO_MAPPING + od.PDOS:
            return
        joint = sdo.drive.joint
        self._written[joint] = time.monotonic()
        if self.suspect.get(joint, (0, 0))[1] != NEVER:
            self._report("mapping_changed", sdo, t_ns, f"somebody else changes its PDO mapping (object {index:04X}h)")
            self._distrust(sdo, t_ns)
        self._begin(self._revive, sdo)

    def _distrust(self, sdo: DriveSdo, since_ns: int) -> None:
        if self.suspect.get(sdo.drive.joint, (0, 0))[1] != NEVER:
            self.suspect = {**self.suspect, sdo.drive.joint: (since_ns, NEVER)}

    def _begin(self, work: Callable[[DriveSdo], None], sdo: DriveSdo) -> None:
        """Do something with a drive in a thread of its own, which SDO may keep waiting; nothing twice at once."""
        joint = sdo.drive.joint
        if joint not in self._reviving:
            thread = threading.Thread(target=work, args=(sdo,), name=f"revive {joint}", daemon=True)
            self._reviving[joint] = thread
            thread.start()

    def _verify(self, sdo: DriveSdo) -> None:
        """Look whether a drive that somebody else has started still sends what the session wants."""
        since, difference = time.time_ns(), None
        try:
            difference = mapping_differs(sdo, self._session)
        except ArmidentError as error:
            log.debug("%s", error)
        if difference is not None:
            self._report("mapping_changed", sdo, since, f"its PDO mapping was changed: {difference}")
            self._distrust(sdo, since)
        self._end(sdo)

    def _revive(self, sdo: DriveSdo) -> None:
        """Configure and start a drive that has booted again, or that somebody else has configured otherwise."""
        joint, told = sdo.drive.joint, False
        try:
            while self._started:
                try:
                    if self._configured_again(sdo):
                        break
                except ArmidentError as error:
                    if not told:
                        self._report("failed", sdo, time.time_ns(), f"could not be configured again: {error}")
                    told = True
                time.sleep(AGAIN_S)
            if self._started:
                if joint in self.suspect:
                    self.suspect = {**self.suspect, joint: (self.suspect[joint][0], time.time_ns())}
                self._report("configured", sdo, time.time_ns(), "configured again, and started")
        finally:
            self._end(sdo)

    def _end(self, sdo: DriveSdo) -> None:
        """Be done with a drive, unless its mapping is not what it should be by now."""
        self._reviving.pop(sdo.drive.joint, None)
        if self._started and self.suspect.get(sdo.drive.joint, (0, 0))[1] == NEVER:
            self._begin(self._revive, sdo)

    def _configured_again(self, sdo: DriveSdo) -> bool:
        """Configure and start a drive once more; ``False`` if its bus went down meanwhile, or somebody else wrote.

        Raises
        ------
        ArmidentError
            If the drive does not follow.
        """
        joint = sdo.drive.joint
        while self._started and time.monotonic() - self._written.get(joint, 0.0) < QUIET_S:
            time.sleep(POLL_INTERVAL)
        begun = time.monotonic()
        try:
            check_drive(sdo, self._robot)
            map_drive(sdo, self._session)
            if not self._started:
                return False
            self._command(NmtCommand.START, sdo)
            self._await_operational(sdo)
            if self._enabled:
                stand_still(sdo)
                enable_drive(sdo)
        except BusDown:
            return False
        return self._written.get(joint, 0.0) < begun


def _nmt_name(state: int) -> str:
    return NmtState(state).name.lower().replace("_", "-") if state in set(NmtState) else f"unknown ({state})"
