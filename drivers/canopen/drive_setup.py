"""Checks and communication parameters of one drive: identity, scales, heartbeat, SYNC counter, mode of operation."""

import time

from armident.configs.errors import ConfigError
from armident.configs.schema.robot import Joint, RobotConfig
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.cia402_enable import POLL_INTERVAL
from armident.drivers.canopen.sdo import DriveSdo, SdoRefusedError

MODE_TIMEOUT = 10.0
"""Longest wait until enabled drives report their mode of operation (6061h), s."""


def check_drive(sdo: DriveSdo, robot: RobotConfig) -> None:
    """Refuse a node that is no CiA 402 drive, or another one by product, encoder resolution or rated current."""
    device = sdo.read(od.DEVICE_TYPE, 0, "I")
    if device & 0xFFFF != od.DEVICE_PROFILE_CIA402:
        raise ConfigError(
            f"{sdo.label}: is no CiA 402 drive: device type (1000h) is {device:08X}h, profile {device & 0xFFFF} "
            "instead of 402"
        )
    for sub, what in ((1, "vendor"), (2, "product code")):
        known = sdo.node.object_dictionary.get_variable(od.IDENTITY, sub)
        expected = known.default if known is not None else None
        found = sdo.read_optional(od.IDENTITY, sub, "I")
        if found is None:
            sdo.remark(f"has no {what} (1018h:{sub}): it is not checked")
        elif expected and found != expected:
            eds = sdo.drive.eds.name
            raise ConfigError(f"{sdo.label}: {what} (1018h:{sub}) is {found:X}h, {eds} has {expected:X}h")
    _check_scales(sdo, robot.name, next(j for j in robot.joints if j.name == sdo.drive.joint))


def _check_scales(sdo: DriveSdo, robot: str, joint: Joint) -> None:
    expected = joint.drive.counts_per_unit
    # Counts per metre of a prismatic joint do not determine the counts per motor turn.
    if joint.type == "revolute" and expected is not None:
        increments = sdo.read_optional(od.ENCODER_RESOLUTION, 1, "I")
        turns = sdo.read_optional(od.ENCODER_RESOLUTION, 2, "I")
        if increments is None or turns is None:
            sdo.remark(f"has no encoder resolution (608Fh): {expected:g} counts per turn of {robot} are not checked")
        elif not turns or abs(increments / turns - expected) > 0.5:
            raise ConfigError(
                f"{sdo.label}: encoder has {increments}/{turns} counts per turn (608Fh), "
                f"robot {robot} has {expected:g}; check drive and robot configuration"
            )
    if joint.drive.signal == "current":
        rated = sdo.read_optional(od.RATED_CURRENT, 0, "I")
        if rated is None:
            sdo.remark(f"has no rated current (6075h): {joint.drive.rated:g} A of {robot} are not checked")
        elif rated != od.rated_milliamperes(joint.drive):
            raise ConfigError(
                f"{sdo.label}: rated current is {rated} mA (6075h), robot {robot} has "
                f"{od.rated_milliamperes(joint.drive)} mA; check drive and robot configuration"
            )


def set_heartbeat(sdo: DriveSdo, period_ms: int) -> None:
    """Set the heartbeat (1017h) and store the period read back in ``sdo.heartbeat_ms``, ``None`` without heartbeat."""
    try:
        found = sdo.write_rounded(od.HEARTBEAT_PRODUCER, 0, period_ms, "H")
    except SdoRefusedError:
        found = sdo.read_optional(od.HEARTBEAT_PRODUCER, 0, "H") or 0
    if found not in (0, period_ms):
        sdo.remark(f"sends its heartbeat (1017h) every {found} ms instead of {period_ms} ms, and is supervised by that")
    sdo.heartbeat_ms = found or None


def set_sync_counter(sdo: DriveSdo, overflow: int) -> str | None:
    """Set the overflow of the SYNC counter (1019h; 0: none); return why it does not suit the drive, or ``None``."""
    try:
        sdo.write(od.SYNC_COUNTER_OVERFLOW, 0, overflow, "B")
    except SdoRefusedError as error:
        return "has no SYNC counter (1019h)" if error.absent else f"does not take the SYNC counter: {error}"
    return None


def await_mode(drives: list[DriveSdo]) -> None:
    """Wait until enabled drives report cyclic synchronous position mode (6061h), up to `MODE_TIMEOUT`."""
    until = time.monotonic() + MODE_TIMEOUT
    for sdo in drives:
        while (mode := sdo.read_optional(od.MODE_DISPLAY, 0, "b")) != od.CYCLIC_SYNCHRONOUS_POSITION:
            if mode is None:
                sdo.remark("does not report its mode of operation (6061h): it is not checked")
                break
            if time.monotonic() > until:
                raise ConfigError(
                    f"{sdo.label}: stays in mode of operation {mode} (6061h) for {MODE_TIMEOUT:g} s, 8 was commanded"
                )
            time.sleep(POLL_INTERVAL)
