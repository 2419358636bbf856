"""Oddities of virtual drives, and their configuration over SDO on a bus within this process."""

# mypy: disable-error-code="no-untyped-call"
# canopen is typed in part only.

from collections.abc import Iterator
from contextlib import contextmanager

import canopen
import numpy as np
import pytest

from armident.configs import ConfigError, RobotConfig, SessionConfig, load_robot, load_session
from armident.configs.schema.scenario import OddDrive, Scenario
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.cia402_enable import enable_drive, hold_position
from armident.drivers.canopen.drive_setup import await_mode, check_drive, set_heartbeat, set_sync_counter
from armident.drivers.canopen.pdo_mapping import map_drive, mapping_differs
from armident.drivers.canopen.sdo import DriveSdo, SdoRefusedError
from armident.drivers.canopen.sdo_client import SdoNode
from armident.virtual_robot.arm import Arm
from armident.virtual_robot.inertias import rest_posture
from armident.virtual_robot.node import Drive
from armident.virtual_robot.oddities import ODDITIES, describe_oddities, drive_oddities, make_oddities

NODE = 3
CONFIGURED = {
    "no60c0": [],
    "no60c2": ["has no interpolation time (60C2h): it interpolates set points by its own setting"],
    "no608f": ["has no encoder resolution (608Fh): 65536 counts per turn of tx40 are not checked"],
    "no6075": ["has no rated current (6075h): 1.6 A of tx40 are not checked"],
    "no_product_code": ["has no product code (1018h:2): it is not checked"],
    "heartbeat_rounds": [
        "sends its heartbeat (1017h) every 128 ms instead of 100 ms, and is supervised by that",
    ],
    "bit30_kept": [],
    "bit30_demanded": [],
    "tpdo_timers": [
        f"had an {timer} in TPDO{k}: 0 is written"
        for k in (1, 2)
        for timer in ("inhibit time of 50 ms", "event timer of 100 ms")
    ],
    "tpdo_timers_fixed": [
        f"keeps an inhibit time of 50 ms in TPDO{k + 1}: node 3 (joint_3): refuses object 180{k}h:3 = 0h: attempt to "
        "write a read only object (SDO abort 06010002h); a TPDO that follows the one before sooner may be lost"
        for k in (0, 1)
    ],
    "no_inhibit_time": [],
    "write_late": [],
    "mode_when_enabled": [],
    "target_follows": [],
    "abort_busy": [],
    "twice": [],
    "twice_late": [],
    "short_answer": [],
}
"""Remarks about the drive while it is configured and enabled, by oddity."""


@pytest.fixture(scope="module")
def session() -> SessionConfig:
    cell = load_session("tx40_cell.yaml")
    # Only the kind of a bus matters here: SDO uses the bus of the test.
    return cell.model_copy(update={"bus": cell.bus.model_copy(update={"interface": "udp_multicast"})})


@pytest.fixture(scope="module")
def robot() -> RobotConfig:
    return load_robot("tx40.yaml")


@contextmanager
def odd_drive(robot: RobotConfig, session: SessionConfig, *names: str) -> Iterator[tuple[Drive, DriveSdo, list[str]]]:
    """The drive of joint 3 on a bus within this process, our SDO access to it, and the remarks about it."""
    node = session.drives[NODE - 1]
    arm = Arm(robot, rest_posture(robot), session.sync_period, noise=0.0)
    drive = Drive(NODE, node.eds, NODE - 1, robot.joints[NODE - 1], arm, lambda: None, lambda: None)
    drive.become_odd(make_oddities(names, drive, session))
    here, there = canopen.Network(), canopen.Network()
    channel = f"oddities {'-'.join(names)}"
    for network in (here, there):
        network.NOTIFIER_CYCLE = 0.05
        network.connect(interface="virtual", channel=channel)
    try:
        there.add_node(drive)
        drive.nmt.boot()
        sdo = DriveSdo(here.add_node(SdoNode(NODE, str(node.eds))), node, session)
        remarks: list[str] = []
        sdo.on_remark = remarks.append
        yield drive, sdo, remarks
    finally:
        drive.nmt.halt()
        here.disconnect()
        there.disconnect()


@pytest.mark.slow
@pytest.mark.parametrize("oddity", CONFIGURED)
def test_an_odd_drive_is_configured_and_enabled(robot: RobotConfig, session: SessionConfig, oddity: str) -> None:
    with odd_drive(robot, session, oddity) as (drive, sdo, remarks):
        check_drive(sdo, robot)
        assert set_sync_counter(sdo, 240) is None
        set_heartbeat(sdo, 100)
        map_drive(sdo, session)
        assert mapping_differs(sdo, session) is None
        hold_position(sdo)
        enable_drive(sdo)
        await_mode([sdo])
        assert remarks == CONFIGURED[oddity]
        assert sdo.heartbeat_ms == (128 if oddity == "heartbeat_rounds" else 100)
        assert drive.state is od.DriveState.ENABLED
        mapped = {cob: [index for index, _, _ in entries] for cob, _, entries in drive.pdos(od.TPDO_COMMUNICATION)}
        assert mapped == {0x183: [0x6064, 0x6078, 0x6041], 0x283: [0x6062]}


def test_a_missing_sync_counter_or_heartbeat_is_found(robot: RobotConfig, session: SessionConfig) -> None:
    with odd_drive(robot, session, "no1019", "no1017") as (_, sdo, remarks):
        assert set_sync_counter(sdo, 240) == "has no SYNC counter (1019h)"
        set_heartbeat(sdo, 100)
        assert sdo.heartbeat_ms is None
        assert remarks == []


def test_a_read_only_mapping_is_accepted_or_its_difference_named(robot: RobotConfig, session: SessionConfig) -> None:
    with odd_drive(robot, session, "pdo_fixed") as (_, sdo, _):
        map_drive(sdo, session)
        assert mapping_differs(sdo, session) is None
    difference = r"1A00h maps 60410010h \(status\), the session 60640020h \(position\), 60780010h \(current\)"
    with (
        odd_drive(robot, session, "pdo_fixed_other") as (_, sdo, _),
        pytest.raises(ConfigError, match=difference),
    ):
        map_drive(sdo, session)


def test_a_mapping_that_is_right_is_not_written_again(robot: RobotConfig, session: SessionConfig) -> None:
    with odd_drive(robot, session) as (drive, sdo, _):
        map_drive(sdo, session)
        written: list[int] = []
        drive.add_write_callback(lambda index, **_: written.append(index))
        map_drive(sdo, session)
        assert [index for index in written if index != od.INTERPOLATION_PERIOD] == []


def test_an_inhibit_time_is_refused_while_its_tpdo_is_valid(robot: RobotConfig, session: SessionConfig) -> None:
    with odd_drive(robot, session) as (drive, sdo, _):
        map_drive(sdo, session)
        with pytest.raises(SdoRefusedError, match="08000022h"):
            sdo.write(od.TPDO_COMMUNICATION, od.INHIBIT_TIME, 7, "H")
        # Set inside the drive, it is found and cleared although the mapping is right.
        drive.preset(od.TPDO_COMMUNICATION, od.INHIBIT_TIME, 7)
        map_drive(sdo, session)
        assert sdo.read(od.TPDO_COMMUNICATION, od.INHIBIT_TIME, "H") == 0
        assert mapping_differs(sdo, session) is None


def test_a_drive_in_another_mode_is_refused(
    robot: RobotConfig, session: SessionConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("armident.drivers.canopen.drive_setup.MODE_TIMEOUT", 0.1)
    with odd_drive(robot, session) as (drive, sdo, _):
        drive.add_read_callback(lambda index, **_: 1 if index == od.MODE_DISPLAY else None)
        drive._read_callbacks.reverse()
        with pytest.raises(ConfigError, match=r"node 3 \(joint_3\): stays in mode of operation 1 \(6061h\)"):
            await_mode([sdo])


def test_an_unknown_oddity_is_refused_with_the_list(robot: RobotConfig) -> None:
    scenario = Scenario(schema="armident/scenario/1", drives={"joint_3": OddDrive(oddities=("no1020",))})
    with pytest.raises(ConfigError, match=r"drives\.joint_3\.oddities: 'no1020' is not .*no1019, no60c0.*emcy_burst"):
        drive_oddities(scenario, robot)


def test_oddities_of_an_unknown_joint_are_refused(robot: RobotConfig) -> None:
    scenario = Scenario(schema="armident/scenario/1", drives={"joint_7": OddDrive(oddities=("no1019",))})
    with pytest.raises(ConfigError, match=r"drives\.joint_7: not a joint of tx40 \(joint_1, "):
        drive_oddities(scenario, robot)


def test_an_empty_scenario_is_refused() -> None:
    with pytest.raises(ValueError, match="expected at least one of effects, drives"):
        Scenario(schema="armident/scenario/1")


def test_every_oddity_has_a_behaviour_and_is_listed(robot: RobotConfig) -> None:
    listed = [line.split()[0] for line in describe_oddities().splitlines()]
    assert listed == list(ODDITIES)
    assert np.all([len(meaning) > 10 for meaning, _ in ODDITIES.values()])
