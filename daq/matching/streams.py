"""Streams of a session: their TPDOs on the bus and their fields in the recording."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, RobotConfig, SessionConfig
from armident.configs.schema.session import ObjectName
from armident.configs.units import counts_per_si
from armident.daq.matching.assembler import Rows, TpdoStream
from armident.daq.recording import Field, StreamLayout
from armident.daq.recording.model import Quantity
from armident.drivers.can.frames import fd_length
from armident.drivers.canopen.objects import OBJECTS, TpdoLayout, tpdo_cob

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CapturedStream:
    """One stream: layout of its objects in a TPDO and the recording; COB-IDs and frame lengths for the matcher."""

    tpdo: TpdoLayout
    bus: TpdoStream
    layout: StreamLayout

    def decode(self, rows: Rows) -> dict[str, NDArray[Any]]:
        """Return the raw values of each field, (N, n), from the bytes of the TPDOs."""
        records = rows.data.view(self.tpdo.dtype)[:, :, 0]
        return {name: np.ascontiguousarray(records[name]) for name in self.tpdo.dtype.names or ()}


def captured_streams(session: SessionConfig, robot: RobotConfig) -> tuple[CapturedStream, ...]:
    """Return the streams of a session, joints in robot order; ConfigError without drive, room in a TPDO, or scale."""
    nodes = node_ids(session, robot)
    fd = all(bus.fd for bus in session.all_buses)
    if robot.transmission is None:
        log.warning("robot %s: no transmission given, so each motor is taken to turn as its joint", robot.name)
    streams = []
    for name, stream in session.streams.items():
        tpdo = TpdoLayout.of(stream.objects, f"streams.{name}", stream.pack, fd)
        fields = tuple(field_of(object_name, robot) for object_name in stream.objects)
        dtypes = tuple(np.dtype(OBJECTS[o].format).name for o in stream.objects)
        cob_ids = tuple(tpdo_cob(stream.tpdo, node) for node in nodes)
        bus = TpdoStream(name, stream.every, cob_ids, fd_length(tpdo.frame_size), stream.pack, tpdo.size)
        layout = StreamLayout(name, stream.every, tuple(j.name for j in robot.joints), fields, dtypes)
        streams.append(CapturedStream(tpdo, bus, layout))
    return tuple(streams)


def unknown_phase(session: SessionConfig) -> str | None:
    """Return a message about streams that are not sent on every SYNC, if SYNC has no counter; ``None`` without any."""
    slow = [name for name, stream in session.streams.items() if max(stream.every, stream.pack) > 1]
    if not slow:
        return None
    return (
        f"{', '.join(slow)}: SYNC has no counter, so it is unknown which SYNCs are answered: times "
        "may be wrong by less than one interval of the stream"
    )


def node_ids(session: SessionConfig, robot: RobotConfig) -> tuple[int, ...]:
    """Return the node ID of each joint's drive, in the robot's order; ConfigError if a joint has no drive."""
    by_joint: Mapping[str, int] = {drive.joint: drive.node_id for drive in session.drives}
    for joint in robot.joints:
        if joint.name not in by_joint:
            raise ConfigError(f"drives: no drive for {joint.name} of {robot.name}; every joint needs one")
    return tuple(by_joint[joint.name] for joint in robot.joints)


def bus_numbers(session: SessionConfig, robot: RobotConfig) -> tuple[int, ...]:
    """Return the number of the bus of each joint's drive, in the robot's order."""
    buses = session.all_buses
    by_joint = {drive.joint: buses.index(session.bus_of(drive)) for drive in session.drives}
    return tuple(by_joint[joint.name] for joint in robot.joints)


def field_of(name: ObjectName, robot: RobotConfig) -> Field:
    """Return quantity, unit and scale of an object (CiA 402 part 2; 6078h and 6077h in per mille of rated)."""
    one = (1.0,) * robot.n
    if name == "status":
        return Field(name, "status", "", "motor", one)
    if name in ("current", "torque"):
        rated = tuple(joint.drive.rated / 1000 for joint in robot.joints)
        return Field(name, name, "A" if name == "current" else "N m", "motor", rated)
    quantity: Quantity = name
    unit = "rad" if all(joint.type == "revolute" for joint in robot.joints) else "m"
    per_count = tuple(float(1 / x) for x in counts_per_si(robot))
    return Field(name, quantity, f"{unit}/s" if name == "velocity" else unit, "motor", per_count)
