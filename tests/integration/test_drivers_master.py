"""CANopen master with correct and faulty nodes; its low rate needs no SocketCAN."""

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import can
import canopen
import pytest
from canopen.sdo import SdoAbortedError

from armident.configs import ArmidentError, ConfigError, RobotConfig, SessionConfig, load_robot, load_session
from armident.configs.schema.session import Bus
from armident.drivers.can.frames import BusDown, frames
from armident.drivers.can.udp import open_bus, open_python_can
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.cia402_enable import read_drive_state
from armident.drivers.canopen.master import DriveEvent, DriveMaster
from armident.drivers.canopen.objects import Control, DriveState

NEXT = {
    (DriveState.SWITCH_ON_DISABLED, Control.SHUTDOWN): DriveState.READY,
    (DriveState.READY, Control.SWITCH_ON): DriveState.SWITCHED_ON,
    (DriveState.SWITCHED_ON, Control.ENABLE_OPERATION): DriveState.ENABLED,
    (DriveState.FAULT, Control.FAULT_RESET): DriveState.SWITCH_ON_DISABLED,
    (DriveState.ENABLED, Control.SWITCH_ON): DriveState.SWITCHED_ON,
    (DriveState.SWITCHED_ON, Control.SHUTDOWN): DriveState.READY,
    (DriveState.READY, Control.DISABLE_VOLTAGE): DriveState.SWITCH_ON_DISABLED,
}


class Servo:
    """Drive on the bus: canopen's local node with the state machine of CiA 402, without physics."""

    def __init__(self, network: canopen.Network, node_id: int, robot: RobotConfig, session: SessionConfig) -> None:
        drive = next(d for d in session.drives if d.node_id == node_id)
        motor = next(j for j in robot.joints if j.name == drive.joint).drive
        self.node = network.create_node(node_id, str(drive.eds))
        self.state = DriveState.SWITCH_ON_DISABLED
        self.obeys = True
        self.history: list[tuple[int, int, int]] = []
        self.node.add_read_callback(self._read)
        self.node.add_write_callback(self._write)
        assert motor.counts_per_unit is not None
        self.put(od.ENCODER_RESOLUTION, 1, int(motor.counts_per_unit))
        self.put(od.RATED_CURRENT, 0, od.rated_milliamperes(motor))
        self.put(od.POSITION_ACTUAL, 0, -1234 * node_id)
        self.history.clear()

    def put(self, index: int, sub: int, value: int) -> None:
        """Set an object from inside the drive."""
        variable = self.node.object_dictionary.get_variable(index, sub)
        assert variable is not None
        self.node.set_data(index, sub, variable.encode_raw(value))

    def get(self, index: int, sub: int = 0) -> Any:
        """Read an object from inside the drive."""
        variable = self.node.object_dictionary.get_variable(index, sub)
        assert variable is not None
        return variable.decode_raw(self.node.get_data(index, sub))

    def _read(self, index: int, **_: Any) -> int | None:
        if index == od.STATUSWORD:
            return od.STATE_CODES[self.state][1]
        return None

    def _write(self, index: int, subindex: int, data: bytes, **_: Any) -> None:
        self.history.append((index, subindex, int.from_bytes(data, "little")))
        if index == od.CONTROLWORD and self.obeys:
            self.state = NEXT.get((self.state, Control(int.from_bytes(data, "little"))), self.state)
        if index == od.MODE_OF_OPERATION:
            self.put(od.MODE_DISPLAY, 0, data[0])


@contextmanager
def cell(bus: Bus, nodes: tuple[int, ...] = (1, 2), missing: tuple[int, ...] = ()) -> Iterator[Any]:
    """Session with drives ``nodes``, on the bus except for missing ones: session, robot, servos by node."""
    whole = load_session("tx40_cell")
    session = whole.model_copy(
        update={
            "bus": bus,
            "drives": tuple(d for d in whole.drives if d.node_id in nodes),
            "sdo_timeout_s": 1.0 if missing else 10.0,
            "boot_timeout_s": 0.0,
        }
    )
    robot = load_robot(session.robot)
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.05
    # The drives of a test go down with its bus.
    network.listeners[0].on_error = lambda exc: None  # type: ignore[method-assign]
    network.bus = open_python_can(bus)
    network.connect()
    try:
        servos = {k: Servo(network, k, robot, session) for k in nodes if k not in missing}
        for servo in servos.values():
            servo.node.nmt.state = "INITIALISING"
            servo.node.nmt.state = "PRE-OPERATIONAL"
        yield session, robot, servos
    finally:
        for servo in servos.values():
            servo.node.nmt.stop_heartbeat()
        with suppress(can.CanError):
            network.disconnect()


def events_within(master: DriveMaster, seconds: float, kind: str) -> list[DriveEvent]:
    """Events until one of ``kind`` or a timeout."""
    events: list[DriveEvent] = []
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline and not any(e.kind == kind for e in events):
        events += master.supervise()
        time.sleep(0.01)
    return events


def test_drives_are_mapped_by_the_session_and_enabled(udp_bus: Bus) -> None:
    with cell(udp_bus) as (session, robot, servos), DriveMaster(session, robot) as master:
        master.configure()
        for k, servo in servos.items():
            assert servo.get(0x1800, 1) == 0x180 + k
            assert servo.get(0x1800, 2) == 1
            assert [servo.get(0x1A00, sub) for sub in range(4)] == [3, 0x60640020, 0x60780010, 0x60410010]
            assert (servo.get(0x1801, 1), servo.get(0x1801, 2)) == (0x280 + k, 5)
            assert [servo.get(0x1A01, sub) for sub in range(2)] == [1, 0x60620020]
            assert (servo.get(0x1400, 1), servo.get(0x1400, 2)) == (0x200 + k, 5)
            assert [servo.get(0x1600, sub) for sub in range(2)] == [1, 0x607A0020]
            assert (servo.get(0x60C2, 1), servo.get(0x60C2, 2)) == (1, -3)
            assert servo.get(od.SYNC_COUNTER_OVERFLOW) == 240
            assert servo.get(od.HEARTBEAT_PRODUCER) == session.heartbeat_ms
        master.start()
        assert [read_drive_state(sdo) for sdo in master.drives] == [DriveState.ENABLED, DriveState.ENABLED]
        assert master.positions() == [-1234, -2468]
        # enabled at the position where it stands
        assert servos[2].get(od.TARGET_POSITION) == -2468
        master.stop()
        assert {s.state for s in servos.values()} == {DriveState.SWITCH_ON_DISABLED}


def test_a_mapping_is_changed_only_while_its_pdo_is_disabled(udp_bus: Bus) -> None:
    with cell(udp_bus, nodes=(1,)) as (session, robot, servos), DriveMaster(session, robot) as master:
        master.configure()
        valid = {0x1800 + k: k == 0 for k in range(4)}
        count = {0x1A00 + k: 1 for k in range(4)}
        for index, sub, value in servos[1].history:
            if index in valid and sub == 1:
                valid[index] = not value & od.PDO_NOT_VALID
            if index in count:
                assert not valid[index - 0x200], f"{index:04X}h:{sub} written while the PDO is valid"
                assert sub == 0 or count[index] == 0, f"{index:04X}h:{sub} written while entries are in use"
                count[index] = value if sub == 0 else count[index]
        assert valid == {0x1800: True, 0x1801: True, 0x1802: False, 0x1803: False}


def test_a_missing_drive_is_named_with_its_joint(udp_bus: Bus) -> None:
    silent = pytest.raises(ConfigError, match=rf"node 2 \(joint_2\): does not answer on {udp_bus.channel} within 1 s")
    with cell(udp_bus, missing=(2,)) as (session, robot, _), DriveMaster(session, robot) as master, silent:
        master.configure()


@pytest.mark.parametrize(
    ("index", "sub", "value", "message"),
    [
        (od.DEVICE_TYPE, 0, 0x00030191, r"node 1 \(joint_1\): is no CiA 402 drive: .*profile 401 instead of 402"),
        (od.ENCODER_RESOLUTION, 1, 65536, r"encoder has 65536/1 counts per turn \(608Fh\), robot tx40 has 196608"),
        (od.RATED_CURRENT, 0, 1600, r"rated current is 1600 mA \(6075h\), robot tx40 has 2500 mA"),
    ],
)
def test_a_wrong_node_is_refused_with_its_identity(
    udp_bus: Bus, index: int, sub: int, value: int, message: str
) -> None:
    with cell(udp_bus, nodes=(1,)) as (session, robot, servos), DriveMaster(session, robot) as master:
        servos[1].put(index, sub, value)
        with pytest.raises(ConfigError, match=message):
            master.configure()


def test_a_refused_mapping_names_node_object_and_the_reason_of_the_abort(udp_bus: Bus) -> None:
    with cell(udp_bus, nodes=(1,)) as (session, robot, servos), DriveMaster(session, robot) as master:

        def refuse(index: int, subindex: int, data: bytes, **_: Any) -> None:
            if index == 0x1A00 and int.from_bytes(data, "little") == 0x60780010:
                raise SdoAbortedError(0x06040041)

        servos[1].node.add_write_callback(refuse)
        with pytest.raises(ConfigError, match=r"node 1 \(joint_1\): refuses object 1A00h:2 = 60780010h: .*mapped"):
            master.configure()


def test_a_value_that_does_not_read_back_is_refused(udp_bus: Bus) -> None:
    with cell(udp_bus, nodes=(1,)) as (session, robot, servos), DriveMaster(session, robot) as master:
        servos[1].node.add_read_callback(lambda index, **_: 20 if index == od.SYNC_COUNTER_OVERFLOW else None)
        with pytest.raises(ConfigError, match=r"object 1019h:0 reads 14h after writing F0h"):
            master.configure()


def test_a_drive_in_fault_is_reset_and_enabled(udp_bus: Bus) -> None:
    with cell(udp_bus, nodes=(1,)) as (session, robot, servos), DriveMaster(session, robot) as master:
        servos[1].state = DriveState.FAULT
        master.configure()
        master.start()
        assert [read_drive_state(sdo) for sdo in master.drives] == [DriveState.ENABLED]


@pytest.mark.slow
def test_a_drive_that_stays_in_fault_is_named_with_state_and_error(udp_bus: Bus) -> None:
    with cell(udp_bus, nodes=(1,)) as (session, robot, servos), DriveMaster(session, robot) as master:
        servos[1].state, servos[1].obeys = DriveState.FAULT, False
        servos[1].put(od.ERROR_CODE, 0, 0x3220)
        master.configure()
        with pytest.raises(
            ArmidentError, match=r"'fault' \(error 3220h, DC link under-voltage\), expected 'switch on d"
        ):
            master.start()


def test_nodes_can_be_started_without_enabling_the_drives(udp_bus: Bus) -> None:
    with cell(udp_bus, nodes=(1,)) as (session, robot, servos), DriveMaster(session, robot) as master:
        master.configure()
        master.start(enable=False)
        assert servos[1].node.nmt.state == "OPERATIONAL"
        assert servos[1].state == DriveState.SWITCH_ON_DISABLED


def test_an_emcy_becomes_an_event_with_its_text(udp_bus: Bus) -> None:
    with cell(udp_bus) as (session, robot, servos), DriveMaster(session, robot) as master:
        master.configure()
        master.start()
        servos[2].node.emcy.send(0x4310, 0x08)
        (event,) = [e for e in events_within(master, 30.0, "emcy") if e.kind == "emcy"]
        assert (event.joint, event.node_id, event.code) == ("joint_2", 2, 0x4310)
        assert "excess drive temperature" in event.text


def test_an_emcy_is_not_lost_while_the_canopen_thread_is_delayed(udp_bus: Bus) -> None:
    """Messages of fewer than eight bytes are valid."""
    short = frames(1)
    short["can_id"], short["length"] = od.COB_EMCY + 1, 3
    short["data"][0, :3] = [0x30, 0x23, 0x02]
    with cell(udp_bus) as (session, robot, servos), DriveMaster(session, robot) as master:
        master.configure()
        master.start()
        for network in master._networks.values():
            assert network._network.notifier is not None
            network._network.notifier.stop()
        servos[2].node.emcy.send(0x4310, 0x08, b"\x01\x02")
        with open_bus(udp_bus, filters=()) as other:
            other.send(short)
        first, second = (e for e in events_within(master, 30.0, "emcy") if e.kind == "emcy")
        assert (first.joint, first.code, second.joint, second.code) == ("joint_2", 0x4310, "joint_1", 0x2330)
        assert "error register 08h, manufacturer 01 02 00 00 00" in first.text
        assert "earth leakage on the output side (error register 02h)" in second.text


def test_loss_and_return_of_a_heartbeat_are_each_reported_once(udp_bus: Bus) -> None:
    with cell(udp_bus) as (session, robot, servos), DriveMaster(session, robot) as master:
        master.configure()
        master.start()
        servos[1].node.nmt.stop_heartbeat()
        lost = [e for e in events_within(master, 30.0, "heartbeat_lost") if e.kind == "heartbeat_lost"]
        assert [e.joint for e in lost] == ["joint_1"]
        time.sleep(0.2)
        assert not [e for e in master.supervise() if e.joint == "joint_1"]
        servos[1].node.nmt.start_heartbeat(session.heartbeat_ms)
        assert any(e.joint == "joint_1" for e in events_within(master, 30.0, "heartbeat_back"))


@pytest.mark.vcan
def test_foreign_sdo_writes_are_detected_and_distinguished_from_own_ones(
    vcan_bus: str,
) -> None:
    request = frames(1)
    request["can_id"], request["length"] = od.COB_SDO_REQUEST + 2, 8
    # Download of four bytes to object 1800h, subindex 1.
    request["data"][0] = [0x23, 0x00, 0x18, 0x01, 0x82, 0x01, 0x00, 0x80]
    with (
        cell(Bus(channel=vcan_bus)) as (session, robot, _),
        DriveMaster(session, robot) as master,
        open_bus(Bus(channel=vcan_bus), filters=()) as other,
    ):
        master.configure()
        master.start()
        master.collect_reports()
        assert master.unverified_mapping == {}
        before = time.time_ns()
        other.send(request)
        master.collect_reports()
        (since, until) = master.unverified_mapping["joint_2"]
        assert before <= since <= time.time_ns() < until
        told = events_within(master, 30.0, "configured")
        assert [e.kind for e in told if e.kind in ("mapping_changed", "configured")] == [
            "mapping_changed",
            "configured",
        ]
        assert since < master.unverified_mapping["joint_2"][1] <= time.time_ns()
        # Our own writes that restored the mapping were received, too.
        told = events_within(master, 0.3, "mapping_changed")
        assert [e.kind for e in told if e.kind == "mapping_changed"] == []
        assert set(master.unverified_mapping) == {"joint_2"}


@pytest.mark.vcan
def test_a_bus_outage_is_not_reported_as_a_missing_drive(vcan_bus: str) -> None:
    with cell(Bus(channel=vcan_bus)) as (session, robot, _), DriveMaster(session, robot) as master:
        subprocess.run(["ip", "link", "set", "dev", vcan_bus, "down"], check=True)
        with pytest.raises(BusDown, match=f"bus {vcan_bus}"):
            master.configure()


@pytest.mark.vcan
def test_a_missing_bus_is_a_configuration_error() -> None:
    session = load_session("tx40_cell")
    session = session.model_copy(update={"bus": session.bus.model_copy(update={"channel": "vcan97"})})
    with pytest.raises(ConfigError, match="bus vcan97: no such CAN interface"):
        DriveMaster(session, load_robot(session.robot))
