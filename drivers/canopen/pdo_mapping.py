"""PDO mapping of one drive over SDO: the TPDOs of the streams, and the RPDOs of set points and stop."""

import logging

from armident.configs.errors import ConfigError
from armident.configs.schema.session import SessionConfig
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.sdo import DriveSdo, NoAnswerError, SdoRefusedError

ROUNDING_US = 0.5
"""Difference of interpolation times that is an error of rounding, us: half of the unit of a session."""

TIMERS = {
    od.INHIBIT_TIME: ("inhibit time", 0.1, "a TPDO that follows the one before sooner may be lost"),
    od.EVENT_TIMER: ("event timer", 1.0, "it may send TPDOs that answer no SYNC"),
}
"""Name, unit in ms and effect on TPDOs that answer SYNC, by sub-index of their communication parameters."""

log = logging.getLogger(__name__)


def map_drive(sdo: DriveSdo, session: SessionConfig) -> None:
    """Write the session's TPDOs and the RPDO of its set points to a pre-operational drive, and read them back.

    A PDO that is right already is not written; other TPDOs are disabled. A ConfigError names the refused object.
    Inhibit time and event timer of the TPDOs become 0; a drive that keeps them is reported by a remark.
    """
    node = sdo.drive.node_id
    streams = {s.tpdo: (name, s) for name, s in session.streams.items()}
    for tpdo in range(1, 5):
        communication = od.TPDO_COMMUNICATION + tpdo - 1
        if tpdo in streams:
            name, stream = streams[tpdo]
            entries = od.TpdoLayout.of(stream.objects, f"streams.{name}", stream.pack, sdo.fd).entries
            cob, interval = od.tpdo_cob(tpdo, node), max(stream.every, stream.pack)
            _map_pdo(sdo, communication, od.TPDO_MAPPING + tpdo - 1, cob, entries, interval)
        elif communication in sdo.node.object_dictionary:
            _disable_tpdo(sdo, communication)
    if session.setpoints is not None:
        k, every = session.setpoints.rpdo - 1, session.setpoints.every
        cob = od.rpdo_cob(k + 1, node)
        _map_pdo(sdo, od.RPDO_COMMUNICATION + k, od.RPDO_MAPPING + k, cob, (od.SETPOINT.entry,), every)
        _set_interpolation(sdo, session.sync.period_us * every, session.sync.period_us)
        _map_stop(sdo, od.stop_rpdo(session.setpoints.rpdo))


def mapping_differs(sdo: DriveSdo, session: SessionConfig) -> str | None:
    """Description of the first difference between a drive's TPDO mapping and the session; ``None`` if there is none."""
    for name, stream in session.streams.items():
        entries = od.TpdoLayout.of(stream.objects, f"streams.{name}", stream.pack, sdo.fd).entries
        communication, mapping = (base + stream.tpdo - 1 for base in (od.TPDO_COMMUNICATION, od.TPDO_MAPPING))
        expected = [(mapping, 0, len(entries), "B"), *((mapping, k + 1, e, "I") for k, e in enumerate(entries))]
        expected.append((communication, 2, max(stream.every, stream.pack), "B"))
        expected.append((communication, 1, od.tpdo_cob(stream.tpdo, sdo.drive.node_id), "I"))
        for index, sub, value, code in expected:
            ignored = od.NO_RTR if (index, sub) == (communication, 1) else 0
            if ((found := sdo.read(index, sub, code)) ^ value) & ~ignored:
                return f"object {index:04X}h:{sub} is {found:X}h instead of {value:X}h"
    return None


def _disable_tpdo(sdo: DriveSdo, communication: int) -> None:
    """Disable a TPDO that the session does not use; a drive without it, or that keeps it, is accepted."""
    try:
        cob = sdo.read_optional(communication, 1, "I")
        if cob is not None and not cob & od.PDO_NOT_VALID:
            sdo.write(communication, 1, cob | od.PDO_NOT_VALID, "I", ignored=od.NO_RTR)
    except SdoRefusedError as error:
        sdo.remark(f"keeps a TPDO that the session does not use: {error}")


def _map_stop(sdo: DriveSdo, rpdo: int) -> None:
    """Map the controlword (6040h) into an event-driven RPDO, which stops a drive faster than SDO."""
    communication, mapping = od.RPDO_COMMUNICATION + rpdo - 1, od.RPDO_MAPPING + rpdo - 1
    if communication not in sdo.node.object_dictionary or mapping not in sdo.node.object_dictionary:
        return
    cob = od.rpdo_cob(rpdo, sdo.drive.node_id)
    try:
        _map_pdo(sdo, communication, mapping, cob, (od.CONTROL_ENTRY,), od.EVENT_DRIVEN)
    except SdoRefusedError as error:
        sdo.remark(f"is stopped by SDO, not by RPDO{rpdo}: {error}")


def _map_pdo(sdo: DriveSdo, communication: int, mapping: int, cob: int, entries: tuple[int, ...], every: int) -> None:
    """Configure a PDO in the order of CiA 301 (section 7.5.2.36), as far as it differs."""
    before = sdo.read(communication, 1, "I")
    mapped = read_mapping(sdo, mapping)
    right = mapped == entries and not (before ^ cob) & ~od.NO_RTR
    timers = _timers(sdo, communication) if communication >= od.TPDO_COMMUNICATION else {}
    if right and not timers and sdo.read(communication, 2, "B") == every:
        return
    cob |= before & od.NO_RTR
    try:
        _write_cob(sdo, communication, cob | od.PDO_NOT_VALID)
        if mapped != entries:
            sdo.write(mapping, 0, 0, "B")
            for k, entry in enumerate(entries):
                sdo.write(mapping, k + 1, entry, "I")
            sdo.write(mapping, 0, len(entries), "B")
    except SdoRefusedError as error:
        if not right:
            raise SdoRefusedError(f"{error}; {_difference(mapping, mapped, entries)}", error.code) from error
        # The COB-ID is read-only, and right.
        sdo.write(communication, 2, every, "B")
        _clear_timers(sdo, communication, timers)
        return
    sdo.write(communication, 2, every, "B")
    _clear_timers(sdo, communication, timers)
    _write_cob(sdo, communication, cob)


def _timers(sdo: DriveSdo, communication: int) -> dict[int, int]:
    """Return inhibit time and event timer of a TPDO by sub-index, as far as the drive has them and they are not 0."""
    found = {}
    for sub in TIMERS:
        try:
            found[sub] = sdo.read(communication, sub, "H")
        except NoAnswerError:
            raise
        except ConfigError as error:
            # Some drives refuse a sub-index that they lack by another code, or give it another size.
            log.debug("%s", error)
    return {sub: value for sub, value in found.items() if value}


def _clear_timers(sdo: DriveSdo, communication: int, timers: dict[int, int]) -> None:
    """Write 0 to timers of a disabled TPDO, which delay or add frames, and say what was found."""
    for sub, value in timers.items():
        name, unit_ms, effect = TIMERS[sub]
        what = f"{name} of {value * unit_ms:g} ms in TPDO{communication - od.TPDO_COMMUNICATION + 1}"
        try:
            left = sdo.write_rounded(communication, sub, 0, "H")
            reason = f"object {communication:04X}h:{sub} reads {left:X}h after writing 0h"
        except SdoRefusedError as error:
            left, reason = value, str(error)
        sdo.remark(f"keeps an {what}: {reason}; {effect}" if left else f"had an {what}: 0 is written")


def _write_cob(sdo: DriveSdo, communication: int, cob: int) -> None:
    """Write the COB-ID of a PDO; with bit 30 (no RTR) if the drive refuses it without."""
    try:
        sdo.write(communication, 1, cob, "I", ignored=od.NO_RTR)
    except SdoRefusedError:
        if cob & od.NO_RTR:
            raise
        sdo.write(communication, 1, cob | od.NO_RTR, "I")


def read_mapping(sdo: DriveSdo, mapping: int) -> tuple[int, ...]:
    """Return the entries of a PDO's mapping record (1600h, 1A00h and following)."""
    count = min(sdo.read(mapping, 0, "B"), od.MAPPED_OBJECTS)
    return tuple(sdo.read(mapping, k, "I") for k in range(1, count + 1))


def _difference(mapping: int, mapped: tuple[int, ...], wanted: tuple[int, ...]) -> str:
    def text(entries: tuple[int, ...]) -> str:
        names = {known.entry: f" ({known.name})" for known in od.OBJECTS.values()}
        return ", ".join(f"{entry:08X}h{names.get(entry, '')}" for entry in entries) or "nothing"

    if mapped == wanted:
        return "its COB-ID differs from that of the predefined connection set (CiA 301)"
    return f"{mapping:04X}h maps {text(mapped)}, the session {text(wanted)}; adapt the streams of the session"


def _set_interpolation(sdo: DriveSdo, period_us: int, sync_us: int) -> None:
    """Set the interpolation time (60C2h) to the period of the set points; a drive may round it by up to a SYNC."""
    value, exponent = interpolation_period(period_us, sdo.label)
    try:
        found = sdo.write_rounded(od.INTERPOLATION_PERIOD, 1, value, "B")
        power = sdo.write_rounded(od.INTERPOLATION_PERIOD, 2, exponent, "b")
    except SdoRefusedError as error:
        if not error.absent:
            raise
        sdo.remark("has no interpolation time (60C2h): it interpolates set points by its own setting")
        return
    found_us = found * 10.0 ** (power + 6)
    if abs(found_us - period_us) > sync_us:
        raise ConfigError(f"{sdo.label}: interpolation time (60C2h) is {found_us:g} us after writing {period_us} us")
    if abs(found_us - period_us) > ROUNDING_US:
        sdo.remark(f"interpolates set points over {found_us:g} us (60C2h) instead of {period_us} us")


def interpolation_period(period_us: int, where: str = "setpoints") -> tuple[int, int]:
    """Value (at most 255) and exponent of 60C2h for a set point period: ``value * 10**exponent`` seconds."""
    value, exponent = period_us, -6
    while value % 10 == 0 and exponent < -3:
        value, exponent = value // 10, exponent + 1
    if value > 255:
        raise ConfigError(f"{where}: a set point period of {period_us} us cannot be expressed in 60C2h")
    return value, exponent
