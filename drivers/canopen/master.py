"""CANopen master: checks, configures, enables and supervises the drives of a session, with SDO and NMT of canopen."""

import logging
import queue
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Literal

from armident.configs.errors import ArmidentError
from armident.configs.schema.robot import RobotConfig
from armident.configs.schema.session import DriveNode, SessionConfig
from armident.drivers.can.frames import BusDown
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.cia402_enable import POLL_INTERVAL, enable_drive, hold_position
from armident.drivers.canopen.drive_setup import await_mode, check_drive, set_heartbeat, set_sync_counter
from armident.drivers.canopen.network import NodeNetwork
from armident.drivers.canopen.node_supervision import NodeSupervision
from armident.drivers.canopen.objects import Control, NmtCommand, NmtState
from armident.drivers.canopen.pdo_mapping import map_drive, mapping_differs
from armident.drivers.canopen.sdo import DriveSdo, NoAnswerError

RETRY_S = 0.5
"""Time until the next attempt to reconfigure a drive, s."""

QUIET_S = 0.2
"""Time without foreign SDO writes after which a changed mapping is restored, s."""

NEVER = 2**63 - 1
"""End time of an interval that has not ended, ns."""

EventKind = Literal[
    "emcy", "heartbeat_lost", "heartbeat_back", "nmt_state", "rebooted", "mapping_changed", "configured", "failed",
    "remark",
]  # fmt: skip

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DriveEvent:
    """Event of a drive: time of the frame, or of detection of a loss, ns UTC; EMCY error code or NMT state."""

    kind: EventKind
    joint: str
    node_id: int
    t_ns: int
    text: str
    code: int = 0


class DriveMaster(AbstractContextManager["DriveMaster", None]):
    """CANopen master of the drives of one session; use it in a ``with`` block.

    Call `configure`, `start`, `supervise` regularly, and `stop`. A drive that boots again, or whose mapping another
    master changes, is configured and enabled again; `unverified_mapping` holds the times until then.
    """

    def __init__(self, session: SessionConfig, robot: RobotConfig) -> None:
        self._session = session
        self._robot = robot
        self._events: queue.SimpleQueue[DriveEvent] = queue.SimpleQueue()
        self._joints = {(session.bus_of(d).channel, d.node_id): d.joint for d in session.drives}
        self._threads: dict[str, threading.Thread] = {}
        self.unverified_mapping: dict[str, tuple[int, int]] = {}
        """Start and end (ns, UTC) of the time in which a joint's TPDOs may be mapped otherwise; replaced on change."""
        self.sync_counter = session.sync.counter
        """Overflow of the SYNC counter that all drives take; 0: SYNC has no counter, because a drive lacks 1019h."""
        self._written: dict[str, float] = {}
        self._started = False
        self._started_ns = 0
        self._enabled = False
        self._networks: dict[str, NodeNetwork] = {}
        try:
            for bus in session.all_buses:
                self._networks[bus.channel] = NodeNetwork(bus, session.drives_on(bus))
            self._supervision = NodeSupervision(session, self._networks)
            self._drives = [self._add(drive) for drive in session.drives]
        except BaseException:
            self.close()
            raise

    def _add(self, drive: DriveNode) -> DriveSdo:
        node = self._network_of(drive).add(drive)
        sdo = DriveSdo(node, drive, self._session)
        sdo.on_remark = lambda text: self._report("remark", sdo, time.time_ns(), text)
        node.nmt.add_heartbeat_callback(lambda state: self._on_heartbeat(sdo, state))
        network = self._network_of(drive)
        network.on_sdo_write(drive.node_id, lambda index, t_ns: self._on_foreign_write(sdo, index, t_ns))
        return sdo

    def _network_of(self, drive: DriveNode) -> NodeNetwork:
        return self._networks[self._session.bus_of(drive).channel]

    def configure(self) -> None:
        """Check every drive against the robot, then map and enable the session's TPDOs; ConfigError if one refuses."""
        for sdo in self._drives:
            self._command(NmtCommand.PRE_OPERATIONAL, sdo)
        until = time.monotonic() + self._session.boot_timeout_s
        for sdo in self._drives:
            self._await_boot(sdo, until)
        for sdo in self._drives:
            check_drive(sdo, self._robot)
        self._agree_on_sync_counter()
        for sdo in self._drives:
            set_heartbeat(sdo, self._session.heartbeat_ms)
            map_drive(sdo, self._session)

    def start(self, enable: bool = True) -> None:
        """Start the nodes (NMT) and, unless ``enable`` is False, bring the drives to operation enabled."""
        for sdo in self._drives:
            self._command(NmtCommand.START, sdo)
        for sdo in self._drives:
            self._supervision.add(sdo)
            self._supervision.await_operational(sdo)
        self._supervision.begin()
        self._started, self._started_ns = True, time.time_ns()
        if not enable:
            return
        self._enabled = True
        for sdo in self._drives:
            hold_position(sdo)
        for sdo in self._drives:
            enable_drive(sdo)
        await_mode(self._drives)

    def supervise(self) -> list[DriveEvent]:
        """Return the events since the last call, without waiting: EMCY, heartbeats, NMT states, changed mappings."""
        alive = {channel: network.reopen() for channel, network in self._networks.items()}
        if not any(alive.values()):
            raise BusDown(f"bus {', '.join(alive)}: went down")
        if self._started:
            for lost in self._supervision.check(self._drives):
                self._report(lost.kind, lost.sdo, time.time_ns(), lost.text)
        self.collect_reports()
        events = []
        while not self._events.empty():
            events.append(self._events.get())
        return events

    def collect_reports(self) -> None:
        """Process emergency messages and SDO writes of other masters into `unverified_mapping`; never waits.

        `supervise` includes this. After dropped TPDOs, call it before the following ones are used: a foreign SDO write
        may have come before them.
        """
        by_joint = {sdo.drive.joint: sdo for sdo in self._drives}
        for channel, network in self._networks.items():
            for emcy in network.emergencies():
                sdo = by_joint[self._joints[channel, emcy.node]]
                self._report("emcy", sdo, emcy.t_ns, emcy.text(sdo.emcy_texts), emcy.code)
            for node, index, t_ns in network.sdo_writes():
                joint = self._joints[channel, node]
                # Own writes fall into a time span that is unverified already.
                if t_ns > max(self._started_ns, self.unverified_mapping.get(joint, (0, 0))[1]):
                    self._on_foreign_write(by_joint[joint], index, t_ns)

    @property
    def drives(self) -> tuple[DriveSdo, ...]:
        """SDO access to the drives, in the order of the session."""
        return tuple(self._drives)

    def positions(self) -> list[int]:
        """Position actual values (6064h) over SDO, counts, in the order of the session's drives."""
        return [sdo.read(od.POSITION_ACTUAL, 0, "i") for sdo in self._drives]

    def quick_stop(self) -> None:
        """Command a quick stop of every drive that is not lost; raises nothing."""
        self._send_controls((Control.QUICK_STOP,))

    def stop(self) -> None:
        """Disable the drives and set the nodes to pre-operational; raises nothing, further calls have no effect."""
        if self._enabled:
            self._enabled = False
            self._send_controls((Control.SWITCH_ON, Control.SHUTDOWN, Control.DISABLE_VOLTAGE))
        if self._started:
            self._started = False
            for sdo in self._drives:
                try:
                    self._command(NmtCommand.PRE_OPERATIONAL, sdo)
                except ArmidentError as error:
                    log.debug("%s", error)

    def close(self) -> None:
        """Stop the drives and release the buses."""
        self.stop()
        for thread in list(self._threads.values()):
            thread.join()
        for network in self._networks.values():
            network.close()

    def __exit__(self, *_: object) -> None:
        """Stop the drives and release the buses."""
        self.close()

    def _await_boot(self, sdo: DriveSdo, until: float) -> None:
        """Wait until a drive answers; it has missed the NMT command if it has booted meanwhile."""
        waited = False
        while True:
            try:
                sdo.read(od.DEVICE_TYPE, 0, "I")
            except NoAnswerError:
                if time.monotonic() >= until:
                    raise sdo.no_answer(self._session.boot_timeout_s) from None
                if not waited:
                    log.info("%s: does not answer yet; waiting for its boot", sdo.label)
                waited = True
                continue
            if waited:
                self._command(NmtCommand.PRE_OPERATIONAL, sdo)
            return

    def _agree_on_sync_counter(self) -> None:
        """Set the SYNC counter (1019h) of all drives; if one has none and SYNC is sent here, that of no drive."""
        wanted = self._session.sync.counter
        reasons = [set_sync_counter(sdo, wanted) for sdo in self._drives]
        self.sync_counter = wanted
        if not wanted or not any(reasons):
            return
        produces = self._session.sync.role == "producer"
        for sdo, reason in zip(self._drives, reasons, strict=True):
            if reason is not None:
                sdo.remark(f"{reason}: {'SYNC is sent without one' if produces else 'it may not take SYNC with one'}")
            elif produces:
                set_sync_counter(sdo, 0)
        if produces:
            self.sync_counter = 0

    def _send_controls(self, controls: tuple[Control, ...]) -> None:
        # A lost drive would cost a timeout each; NMT is sent to it anyway.
        for sdo in [sdo for sdo in self._drives if sdo.drive.joint not in self._supervision.lost]:
            try:
                for control in controls:
                    sdo.command(od.CONTROLWORD, 0, control, "H")
            except ArmidentError as error:
                log.debug("%s", error)

    def _command(self, command: NmtCommand, sdo: DriveSdo) -> None:
        self._network_of(sdo.drive).command(command, sdo.drive.node_id)

    def _report(self, kind: EventKind, sdo: DriveSdo, t_ns: int, text: str, code: int = 0) -> None:
        drive = sdo.drive
        self._events.put(DriveEvent(kind, drive.joint, drive.node_id, t_ns, f"{sdo.label}: {text}", code))

    def _on_heartbeat(self, sdo: DriveSdo, state: int) -> None:
        before = self._supervision.nmt.get(sdo.drive.joint)
        self._supervision.nmt[sdo.drive.joint] = state
        if not self._started:
            return
        if state == NmtState.BOOT_UP:
            self._report("rebooted", sdo, time.time_ns(), "has booted again", state)
            self._mark_unverified(sdo, time.time_ns())
            self._start_thread(self._reconfigure, sdo)
        elif state != before:
            self._report("nmt_state", sdo, time.time_ns(), f"NMT state is {_nmt_name(state)}", state)
            if state == NmtState.OPERATIONAL and before is not None:
                self._start_thread(self._verify, sdo)

    def _on_foreign_write(self, sdo: DriveSdo, index: int, t_ns: int) -> None:
        """Handle an SDO write of another master: a change of the PDO mapping makes the TPDOs unverified."""
        if not self._started or not od.TPDO_COMMUNICATION <= index < od.TPDO_MAPPING + od.PDOS:
            return
        joint = sdo.drive.joint
        self._written[joint] = time.monotonic()
        if self.unverified_mapping.get(joint, (0, 0))[1] != NEVER:
            self._report("mapping_changed", sdo, t_ns, f"another master changes its PDO mapping (object {index:04X}h)")
            self._mark_unverified(sdo, t_ns)
        self._start_thread(self._reconfigure, sdo)

    def _mark_unverified(self, sdo: DriveSdo, since_ns: int) -> None:
        if self.unverified_mapping.get(sdo.drive.joint, (0, 0))[1] != NEVER:
            self.unverified_mapping = {**self.unverified_mapping, sdo.drive.joint: (since_ns, NEVER)}

    def _start_thread(self, work: Callable[[DriveSdo], None], sdo: DriveSdo) -> None:
        """Run ``work`` for a drive in a thread, because SDO may wait; at most one thread per drive."""
        joint = sdo.drive.joint
        if joint not in self._threads:
            thread = threading.Thread(target=work, args=(sdo,), name=f"reconfigure {joint}", daemon=True)
            self._threads[joint] = thread
            thread.start()

    def _verify(self, sdo: DriveSdo) -> None:
        """Compare the mapping of a drive that another master has started with the session."""
        since, difference = time.time_ns(), None
        try:
            difference = mapping_differs(sdo, self._session)
        except ArmidentError as error:
            log.debug("%s", error)
        if difference is not None:
            self._report("mapping_changed", sdo, since, f"its PDO mapping was changed: {difference}")
            self._mark_unverified(sdo, since)
        self._finish(sdo)

    def _reconfigure(self, sdo: DriveSdo) -> None:
        """Configure and start a drive that has booted again or whose mapping was changed, until it succeeds."""
        joint, reported = sdo.drive.joint, False
        try:
            while self._started:
                try:
                    if self._try_configure(sdo):
                        break
                except ArmidentError as error:
                    if not reported:
                        self._report("failed", sdo, time.time_ns(), f"could not be configured again: {error}")
                    reported = True
                time.sleep(RETRY_S)
            if self._started:
                if joint in self.unverified_mapping:
                    span = self.unverified_mapping[joint][0], time.time_ns()
                    self.unverified_mapping = {**self.unverified_mapping, joint: span}
                text = "configured again, and started"
                if self.sync_counter == 0 and any(max(s.every, s.pack) > 1 for s in self._session.streams.values()):
                    text += "; without a SYNC counter, its slower streams may answer other SYNCs than before"
                self._report("configured", sdo, time.time_ns(), text)
        finally:
            self._finish(sdo)

    def _finish(self, sdo: DriveSdo) -> None:
        """End the thread of a drive; start another one if its mapping became unverified meanwhile."""
        self._threads.pop(sdo.drive.joint, None)
        if self._started and self.unverified_mapping.get(sdo.drive.joint, (0, 0))[1] == NEVER:
            self._start_thread(self._reconfigure, sdo)

    def _try_configure(self, sdo: DriveSdo) -> bool:
        """Configure and start a drive once; ``False`` if its bus went down or another master wrote meanwhile."""
        joint = sdo.drive.joint
        while self._started and time.monotonic() - self._written.get(joint, 0.0) < QUIET_S:
            time.sleep(POLL_INTERVAL)
        begun = time.monotonic()
        try:
            check_drive(sdo, self._robot)
            set_sync_counter(sdo, self.sync_counter)
            set_heartbeat(sdo, self._session.heartbeat_ms)
            map_drive(sdo, self._session)
            if not self._started:
                return False
            self._command(NmtCommand.START, sdo)
            self._supervision.await_operational(sdo)
            if self._enabled:
                hold_position(sdo)
                enable_drive(sdo)
        except BusDown:
            return False
        return self._written.get(joint, 0.0) < begun


def _nmt_name(state: int) -> str:
    return NmtState(state).name.lower().replace("_", "-") if state in set(NmtState) else f"unknown ({state})"
