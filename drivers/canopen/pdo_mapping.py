"""Configuration of one drive over SDO: identity and scales, PDO mapping, heartbeat and SYNC counter."""

import logging

from armident.configs.errors import ConfigError
from armident.configs.schema.robot import Joint, RobotConfig
from armident.configs.schema.session import SessionConfig
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.sdo import DriveSdo

log = logging.getLogger(__name__)


def check_drive(sdo: DriveSdo, robot: RobotConfig) -> None:
    """Refuse a node that is not the drive of the robot configuration.

    Parameters
    ----------
    sdo
        The drive.
    robot
        Expected encoder resolution and rated current.

    Raises
    ------
    ConfigError
        If the node is not a CiA 402 drive, or if product, encoder resolution or rated current differ.
    """
    device = sdo.read(od.DEVICE_TYPE, 0, "I")
    if device & 0xFFFF != od.DEVICE_PROFILE_CIA402:
        raise ConfigError(
            f"{sdo.label}: is no CiA 402 drive: device type (1000h) is {device:08X}h, profile {device & 0xFFFF} "
            "instead of 402"
        )
    for sub, what in ((1, "vendor"), (2, "product code")):
        known = sdo.node.object_dictionary.get_variable(od.IDENTITY, sub)
        expected = known.default if known is not None else None
        found = sdo.read(od.IDENTITY, sub, "I")
        if expected and found != expected:
            eds = sdo.drive.eds.name
            raise ConfigError(f"{sdo.label}: {what} (1018h:{sub}) is {found:X}h, {eds} says {expected:X}h")
    _check_scales(sdo, robot.name, next(j for j in robot.joints if j.name == sdo.drive.joint))


def _check_scales(sdo: DriveSdo, robot: str, joint: Joint) -> None:
    expected = joint.drive.counts_per_unit
    # Counts per metre of a prismatic joint do not determine the counts per motor turn.
    if joint.type == "revolute" and expected is not None:
        increments = sdo.read(od.ENCODER_RESOLUTION, 1, "I")
        turns = sdo.read(od.ENCODER_RESOLUTION, 2, "I")
        if not turns or abs(increments / turns - expected) > 0.5:
            raise ConfigError(
                f"{sdo.label}: encoder has {increments}/{turns} counts per turn (608Fh), "
                f"robot {robot} says {expected:g}; check drive and robot configuration"
            )
    if joint.drive.signal == "current":
        rated = sdo.read(od.RATED_CURRENT, 0, "I")
        if rated != od.rated_milliamperes(joint.drive):
            raise ConfigError(
                f"{sdo.label}: rated current is {rated} mA (6075h), robot {robot} says "
                f"{od.rated_milliamperes(joint.drive)} mA; check drive and robot configuration"
            )


def map_drive(sdo: DriveSdo, session: SessionConfig) -> None:
    """Write heartbeat, SYNC counter, the session's TPDOs and the RPDO of its set points, and read them back.

    Other TPDOs are disabled.

    Parameters
    ----------
    sdo
        The drive, in pre-operational.
    session
        Heartbeat, SYNC, streams and set points.

    Raises
    ------
    ConfigError
        If the drive refuses an object or a mapping; names both, with the text of the SDO abort.
    """
    node = sdo.drive.node_id
    sdo.write(od.HEARTBEAT_PRODUCER, 0, session.heartbeat_ms, "H")
    sdo.write(od.SYNC_COUNTER_OVERFLOW, 0, session.sync.counter, "B")
    streams = {s.tpdo: (name, s) for name, s in session.streams.items()}
    for tpdo in range(1, 5):
        communication = od.TPDO_COMMUNICATION + tpdo - 1
        if tpdo in streams:
            name, stream = streams[tpdo]
            entries = od.TpdoLayout.of(stream.objects, f"streams.{name}", stream.pack, sdo.fd).entries
            cob, interval = od.tpdo_cob(tpdo, node), max(stream.every, stream.pack)
            _map_pdo(sdo, communication, od.TPDO_MAPPING + tpdo - 1, cob, entries, interval)
        elif communication in sdo.node.object_dictionary:
            cob = sdo.read(communication, 1, "I")
            if not cob & od.PDO_NOT_VALID:
                sdo.write(communication, 1, cob | od.PDO_NOT_VALID, "I")
    if session.setpoints is not None:
        k, every = session.setpoints.rpdo - 1, session.setpoints.every
        cob = od.rpdo_cob(k + 1, node)
        _map_pdo(sdo, od.RPDO_COMMUNICATION + k, od.RPDO_MAPPING + k, cob, (od.SETPOINT.entry,), every)
        sdo.write(od.INTERPOLATION_MODE, 0, 0, "h")
        value, exponent = interpolation_period(session.sync.period_us * every, sdo.label)
        sdo.write(od.INTERPOLATION_PERIOD, 1, value, "B")
        sdo.write(od.INTERPOLATION_PERIOD, 2, exponent, "b")
        _map_stop(sdo, od.stop_rpdo(session.setpoints.rpdo))


def mapping_differs(sdo: DriveSdo, session: SessionConfig) -> str | None:
    """Description of the first difference between a drive's TPDO mapping and the session; ``None`` if there is none.

    Parameters
    ----------
    sdo
        The drive.
    session
        Expected streams.

    Raises
    ------
    ConfigError
        If the drive does not answer.
    """
    for name, stream in session.streams.items():
        entries = od.TpdoLayout.of(stream.objects, f"streams.{name}", stream.pack, sdo.fd).entries
        communication, mapping = (base + stream.tpdo - 1 for base in (od.TPDO_COMMUNICATION, od.TPDO_MAPPING))
        expected = [(mapping, 0, len(entries), "B"), *((mapping, k + 1, e, "I") for k, e in enumerate(entries))]
        expected.append((communication, 2, max(stream.every, stream.pack), "B"))
        expected.append((communication, 1, od.tpdo_cob(stream.tpdo, sdo.drive.node_id), "I"))
        for index, sub, value, code in expected:
            if (found := sdo.read(index, sub, code)) != value:
                return f"object {index:04X}h:{sub} is {found:X}h instead of {value:X}h"
    return None


def _map_stop(sdo: DriveSdo, rpdo: int) -> None:
    """Map the controlword (6040h) into an event-driven RPDO, which stops a drive faster than SDO.

    A drive without this RPDO, or that does not map the controlword, is stopped by SDO.
    """
    communication, mapping = od.RPDO_COMMUNICATION + rpdo - 1, od.RPDO_MAPPING + rpdo - 1
    if communication not in sdo.node.object_dictionary or mapping not in sdo.node.object_dictionary:
        return
    cob = od.rpdo_cob(rpdo, sdo.drive.node_id)
    try:
        _map_pdo(sdo, communication, mapping, cob, (od.CONTROL_ENTRY,), od.EVENT_DRIVEN)
    except ConfigError as error:
        log.warning("%s", error)


def _map_pdo(sdo: DriveSdo, communication: int, mapping: int, cob: int, entries: tuple[int, ...], every: int) -> None:
    """Configure a PDO in the order of CiA 301 (section 7.5.2.36)."""
    sdo.write(communication, 1, cob | od.PDO_NOT_VALID, "I")
    sdo.write(mapping, 0, 0, "B")
    for k, entry in enumerate(entries):
        sdo.write(mapping, k + 1, entry, "I")
    sdo.write(mapping, 0, len(entries), "B")
    sdo.write(communication, 2, every, "B")
    sdo.write(communication, 1, cob, "I")


def interpolation_period(period_us: int, where: str = "setpoints") -> tuple[int, int]:
    """Value and exponent of 60C2h for a set point period: ``value * 10**exponent`` seconds.

    Parameters
    ----------
    period_us
        Period, us.
    where
        Name of the set points in messages.

    Raises
    ------
    ConfigError
        If the period cannot be expressed with a value up to 255.
    """
    value, exponent = period_us, -6
    while value % 10 == 0 and exponent < -3:
        value, exponent = value // 10, exponent + 1
    if value > 255:
        raise ConfigError(f"{where}: a set point period of {period_us} us cannot be expressed in 60C2h")
    return value, exponent
