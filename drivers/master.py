"""The CANopen master: finds the drives, configures what they send, enables them and watches over them.

canopen does the protocol (SDO, NMT, EMCY). Filters in the kernel keep TPDO and SYNC away from its socket:
it costs tens of microseconds per frame and must never see the hot path.
"""

import logging
import queue
import time
from dataclasses import dataclass
from typing import Literal, Self

import can
import canopen
from canopen.emcy import EmcyError
from canopen.network import MessageListener

from configs.errors import ArmidentError, ConfigError
from configs.robot import RobotConfig
from configs.session import DriveNode, SessionConfig
from drivers import objects as od
from drivers.frames import BusDown
from drivers.mapping import check_drive, map_drive
from drivers.objects import Control, DriveState, NmtCommand, NmtState
from drivers.sdo import DriveSdo
from drivers.socketcan import RawSocket

ENABLE_TIMEOUT = 3.0
"""Longest wait for a drive to reach the next state of CiA 402, s."""

NMT_TIMEOUT = 2.0
"""Longest wait for a heartbeat that reports the NMT state commanded, s."""

POLL_INTERVAL = 0.005
HEARTBEATS_MISSED = 3
"""A drive is lost after this many of its heartbeat periods without one."""

HEARTBEAT_MARGIN = 0.1
"""What the host may be late on top, s."""

TO_ENABLED: dict[DriveState, tuple[Control, DriveState]] = {
    DriveState.SWITCH_ON_DISABLED: (Control.SHUTDOWN, DriveState.READY),
    DriveState.READY: (Control.SWITCH_ON, DriveState.SWITCHED_ON),
    DriveState.SWITCHED_ON: (Control.ENABLE_OPERATION, DriveState.ENABLED),
    DriveState.QUICK_STOP_ACTIVE: (Control.DISABLE_VOLTAGE, DriveState.SWITCH_ON_DISABLED),
    DriveState.FAULT: (Control.FAULT_RESET, DriveState.SWITCH_ON_DISABLED),
}
"""Command and next state on the way to operation enabled (CiA 402 part 2, state machine)."""


EventKind = Literal["emcy", "heartbeat_lost", "heartbeat_back", "nmt_state"]

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


class _QuietListener(MessageListener):
    """Keeps a failing bus from printing a traceback in canopen's thread; ``supervise`` raises the error."""

    def on_error(self, exc: Exception) -> None:
        """Take the exception as handled; python-can keeps it for :meth:`canopen.Network.check`."""


class DriveMaster:
    """The master of the drives of one session; use it in a ``with`` block.

    ``configure()``, then ``start()``, then ``supervise()`` every now and then, and ``stop()`` at the end.

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
        self._nmt: dict[int, int] = {}
        self._beat: dict[int, float] = {}
        self._lost: set[int] = set()
        self._started = False
        self._enabled = False
        self._network = canopen.Network(bus=self._open())
        self._network.NOTIFIER_CYCLE = 0.05
        self._network.listeners = [_QuietListener(self._network)]
        self._network.connect()
        self._drives = {d.node_id: self._add(d) for d in session.drives}

    def _open(self) -> can.BusABC:
        bus = self._session.bus
        filters = [
            {"can_id": base + d.node_id, "can_mask": od.COB_MASK, "extended": False}
            for d in self._session.drives
            # The full mask matters: EMCY is 80h + node, and any coarser one lets SYNC (80h) through.
            for base in (od.COB_SDO_RESPONSE, od.COB_HEARTBEAT, od.COB_EMCY)
        ]
        if bus.interface == "socketcan":
            # Says what is wrong with the interface, and what to do about it.
            RawSocket(bus.channel, filters=(), receive_buffer=4096).close()
        try:
            return can.Bus(bus.channel, interface=bus.interface, can_filters=filters)
        except (can.CanError, OSError) as error:
            raise ConfigError(f"bus {bus.channel}: {error.__cause__ or error}") from error

    def _add(self, drive: DriveNode) -> DriveSdo:
        try:
            node = self._network.add_node(drive.node_id, str(drive.eds))
        except Exception as error:
            raise ConfigError(f"{drive.eds}: not a valid EDS file: {error}") from error
        sdo = DriveSdo(node, drive, self._session)
        node.emcy.add_callback(lambda emcy: self._on_emcy(sdo, emcy))
        node.nmt.add_heartbeat_callback(lambda state: self._on_heartbeat(sdo, state))
        return sdo

    def configure(self) -> None:
        """Check every drive against the robot, then map and switch on what the session streams.

        Raises
        ------
        ConfigError
            If a drive is missing, is not the one expected, or refuses a mapping.
        BusDown
            If the bus went down.
        """
        for node_id in self._drives:
            self._nmt_command(NmtCommand.PRE_OPERATIONAL, node_id)
        for sdo in self._drives.values():
            check_drive(sdo, self._robot)
        for sdo in self._drives.values():
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
        for node_id in self._drives:
            self._nmt_command(NmtCommand.START, node_id)
        self._await_operational()
        self._started = True
        if not enable:
            return
        self._enabled = True
        for sdo in self._drives.values():
            sdo.write(od.MODE_OF_OPERATION, 0, od.CYCLIC_SYNCHRONOUS_POSITION, "b")
            # The drive must stand where it is when it is enabled, whatever was commanded before.
            sdo.write(od.TARGET_POSITION, 0, sdo.read(od.POSITION_ACTUAL, 0, "i"), "i")
        for sdo in self._drives.values():
            _enable(sdo)
        for sdo in self._drives.values():
            mode = sdo.read(od.MODE_DISPLAY, 0, "b")
            if mode != od.CYCLIC_SYNCHRONOUS_POSITION:
                raise ConfigError(f"{sdo.who}: stays in mode of operation {mode} (6061h), 8 was commanded")

    def supervise(self) -> list[DriveEvent]:
        """Return what has happened since the last call: EMCY, lost and returned heartbeats, NMT states.

        Never waits.

        Raises
        ------
        BusDown
            If the bus went down.
        """
        self._check_bus()
        limit = HEARTBEATS_MISSED * self._session.heartbeat_ms * 1e-3 + HEARTBEAT_MARGIN
        for node_id, sdo in self._drives.items() if self._started else ():
            silent = time.monotonic() - self._beat[node_id]
            if silent > limit and node_id not in self._lost:
                self._lost.add(node_id)
                self._report("heartbeat_lost", sdo, time.time_ns(), f"no heartbeat for {silent:.2f} s")
        events = []
        while not self._events.empty():
            events.append(self._events.get())
        return events

    def positions(self) -> list[int]:
        """Position actual values (6064h) over SDO, counts, in the order of the session's drives."""
        return [sdo.read(od.POSITION_ACTUAL, 0, "i") for sdo in self._drives.values()]

    def states(self) -> list[DriveState | None]:
        """CiA 402 states from the statuswords over SDO, in the order of the session's drives."""
        return [_state(sdo) for sdo in self._drives.values()]

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
            try:
                for node_id in self._drives:
                    self._nmt_command(NmtCommand.PRE_OPERATIONAL, node_id)
            except ArmidentError as error:
                log.debug("%s", error)

    def close(self) -> None:
        """Stop the drives and leave the bus."""
        self.stop()
        try:
            self._network.disconnect()
        except Exception as error:  # canopen raises here again what ended its receive thread
            log.debug("disconnect: %s", error)

    def __enter__(self) -> Self:
        """Use the master in a ``with`` block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the drives and leave the bus."""
        self.close()

    def _await_operational(self) -> None:
        deadline = time.monotonic() + NMT_TIMEOUT + self._session.heartbeat_ms * 1e-3
        for node_id, sdo in self._drives.items():
            while self._nmt.get(node_id) != NmtState.OPERATIONAL:
                self._check_bus()
                if time.monotonic() > deadline:
                    raise ArmidentError(f"{sdo.who}: does not report operational after NMT start")
                time.sleep(POLL_INTERVAL)

    def _order(self, controls: tuple[Control, ...]) -> None:
        # A lost drive would cost a timeout each; NMT reaches it too, if anything does.
        for sdo in [sdo for node_id, sdo in self._drives.items() if node_id not in self._lost]:
            try:
                for control in controls:
                    sdo.order(od.CONTROLWORD, 0, control, "H")
            except ArmidentError as error:
                log.debug("%s", error)

    def _nmt_command(self, command: NmtCommand, node_id: int) -> None:
        try:
            self._network.send_message(od.COB_NMT, bytes([command, node_id]))
        except (can.CanError, OSError) as error:
            raise self._bus_down(error) from error

    def _check_bus(self) -> None:
        try:
            self._network.check()
        except Exception as error:
            raise self._bus_down(error) from error

    def _bus_down(self, error: Exception) -> BusDown:
        return BusDown(f"bus {self._session.bus.channel}: {error}")

    def _report(self, kind: EventKind, sdo: DriveSdo, t_ns: int, text: str, code: int = 0) -> None:
        drive = sdo.drive
        self._events.put(DriveEvent(kind, drive.joint, drive.node_id, t_ns, f"{sdo.who}: {text}", code))

    def _on_emcy(self, sdo: DriveSdo, emcy: EmcyError) -> None:
        text = f"EMCY {emcy.code:04X}h, {od.emcy_text(emcy.code)} (error register {emcy.register:02X}h)"
        self._report("emcy", sdo, round(emcy.timestamp * 1e9), text, emcy.code)

    def _on_heartbeat(self, sdo: DriveSdo, state: int) -> None:
        node_id = sdo.drive.node_id
        before = self._nmt.get(node_id)
        self._nmt[node_id], self._beat[node_id] = state, time.monotonic()
        if node_id in self._lost:
            self._lost.discard(node_id)
            self._report("heartbeat_back", sdo, time.time_ns(), "heartbeat is back")
        if self._started and state != before:
            self._report("nmt_state", sdo, time.time_ns(), f"NMT state is {_nmt_name(state)}", state)


def _nmt_name(state: int) -> str:
    return NmtState(state).name.lower().replace("_", "-") if state in set(NmtState) else f"unknown ({state})"


def _state(sdo: DriveSdo) -> DriveState | None:
    return od.drive_state(sdo.read(od.STATUSWORD, 0, "H"))


def _enable(sdo: DriveSdo) -> None:
    """Take one drive through the CiA 402 state machine, from wherever it is to operation enabled."""
    state = _state(sdo)
    while state != DriveState.ENABLED:
        if state not in TO_ENABLED:
            state = _await_state(sdo, DriveState.ENABLED, *TO_ENABLED)
            continue
        control, wanted = TO_ENABLED[state]
        if control == Control.FAULT_RESET:
            # The reset acts on the rising edge of its bit.
            sdo.order(od.CONTROLWORD, 0, Control.DISABLE_VOLTAGE, "H")
        sdo.order(od.CONTROLWORD, 0, control, "H")
        state = _await_state(sdo, wanted)


def _await_state(sdo: DriveSdo, *wanted: DriveState) -> DriveState:
    deadline = time.monotonic() + ENABLE_TIMEOUT
    while (state := _state(sdo)) not in wanted:
        if time.monotonic() > deadline:
            raise ArmidentError(
                f"{sdo.who}: cannot be enabled: stays in state '{state or 'unknown'}'{_fault_cause(sdo)}, "
                f"expected '{wanted[0]}' within {ENABLE_TIMEOUT:g} s"
            )
        time.sleep(POLL_INTERVAL)
    assert state is not None
    return state


def _fault_cause(sdo: DriveSdo) -> str:
    try:
        code = sdo.read(od.ERROR_CODE, 0, "H")
    except ConfigError:  # optional object
        return ""
    return f" (error {code:04X}h, {od.emcy_text(code)})" if code else ""
