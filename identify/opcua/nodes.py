"""Nodes of the server: the arms of a plant by the names of OPC 40010-1, and the health of their axes."""

from collections.abc import Iterable
from datetime import UTC, datetime

import numpy as np
from asyncua import Node, Server, ua
from asyncua.server.event_generator import EventGenerator

from armident.configs import RobotConfig
from armident.identify.opcua.health import CALM, NAMES, UNKNOWN, Health, Reading, health_of
from armident.identify.page.attention import CellView
from armident.identify.page.cells import Cell

DI, ROBOTICS = "http://opcfoundation.org/UA/DI/", "http://opcfoundation.org/UA/Robotics/"
OWN, HEALTH = "urn:armident:model-health", "ModelHealthType"
"""Namespaces of devices (OPC 10000-100) and robots (OPC 40010-1), and that of armident with its type."""
SYSTEM, DEVICE, MOTOR, AXIS, TRAIN = 1002, 1004, 1019, 16601, 16794
TYPES = {SYSTEM: "MotionDeviceSystem", DEVICE: "MotionDevice", MOTOR: "Motor", AXIS: "Axis", TRAIN: "PowerTrain"}
"""Object types of `ROBOTICS` by their identifiers there; they have no instance declarations here."""
OTHER, ARTICULATED, ROTARY, LINEAR = 0, 1, 1, 3
"""Values of MotionDeviceCategoryEnumeration and AxisMotionProfileEnumeration."""
MOVES, REQUIRES = 18178, 18179
"""References from a power train to its axes, and from an axis to its power trains."""


_NUMBER = (ua.VariantType.Double, 0.0, None)
_KINDS: dict[str, tuple[ua.VariantType, object, ua.NodeId | None]] = {
    "Probability": _NUMBER,
    "Size": _NUMBER,
    "Interval": (ua.VariantType.ExtensionObject, ua.Range(), ua.NodeId(ua.ObjectIds.Range)),
    "Since": (ua.VariantType.DateTime, datetime.now(UTC), None),
}
"""Kind, placeholder and data type of the readings that are no text."""


class Nodes:
    """Nodes of the cells of a plant below ``DeviceSet``; the identifier of a node is its path there."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._alarms: dict[tuple[str, str], EventGenerator] = {}
        self._known: dict[tuple[str, str], Health] = {}

    async def build(self, cells: Iterable[Cell]) -> None:
        """Add the types, and an arm for each cell, whose readings have no values yet."""
        server = self._server
        self._di, self._robotics, self._own = [await server.register_namespace(uri) for uri in (DI, ROBOTICS, OWN)]
        for large in (ua.ObjectIds.OpcUa_BinarySchema, ua.ObjectIds.OpcUa_XmlSchema):
            # Deprecated. A client that reads half a megabyte again and again would fill the memory.
            await self._server.write_attribute_value(ua.NodeId(large), _value("", UNKNOWN))
        await self._types()
        devices = await server.nodes.objects.add_object(
            ua.NodeId(5001, self._di), ua.QualifiedName("DeviceSet", self._di)
        )
        system = await self._object(devices, "MotionDeviceSystem", SYSTEM)
        for name in ("Controllers", "SafetyStates"):
            await self._object(system, name)
        arms = await self._object(system, "MotionDevices")
        for cell in cells:
            arm = await self._object(arms, cell.name, DEVICE)
            await self._identify(arm, None if cell.robot is None else cell.robot.name)
            if cell.robot is not None:
                await self._arm(arm, cell.name, cell.robot)

    async def update(self, view: CellView) -> None:
        """Write the readings of a cell that have changed, and announce a change of state by an alarm."""
        for joint in () if view.cell.robot is None else view.cell.robot.joints:
            key, health = (view.cell.name, joint.name), health_of(view, joint.name)
            known, alarm = self._known.get(key), self._alarms[key]
            if health == known:
                continue
            place = alarm.event.SourceNode.Identifier
            unit = ua.EUInformation(DisplayName=ua.LocalizedText(str(health.readings["Unit"].value)), UnitId=-1)
            await self._write(f"{place}/Size/EngineeringUnits", ua.DataValue(ua.Variant(unit)))
            for name in NAMES:
                if known is None or health.readings[name] != known.readings[name]:
                    await self._write(f"{place}/{name}", _value(name, health.readings[name]))
            self._known[key] = health
            if known is not None and known.state != health.state:
                await _announce(alarm, f"{view.cell.title}, {joint.name}: {health.sentence}", health, known)

    async def _types(self) -> None:
        """Add the types that the arms name."""
        root, robotics, own = self._server.nodes.base_object_type, self._robotics, self._own
        await root.add_object_type(ua.NodeId(HEALTH, own), ua.QualifiedName(HEALTH, own))
        for number, name in ((1001, "TopologyElementType"), (15063, "ComponentType")):
            root = await root.add_object_type(ua.NodeId(number, self._di), ua.QualifiedName(name, self._di))
        for number, name in TYPES.items():
            await root.add_object_type(ua.NodeId(number, robotics), ua.QualifiedName(f"{name}Type", robotics))
        root = self._server.get_node(ua.NodeId(ua.ObjectIds.HierarchicalReferences))
        for number, name, inverse in ((MOVES, "Moves", "IsMovedBy"), (REQUIRES, "Requires", "IsRequiredBy")):
            await root.add_reference_type(ua.NodeId(number, robotics), ua.QualifiedName(name, robotics), False, inverse)

    async def _arm(self, arm: Node, cell: str, robot: RobotConfig) -> None:
        """Add category, axes and power trains of an arm."""
        category = ARTICULATED if {joint.type for joint in robot.joints} == {"revolute"} else OTHER
        place = self._place(arm, "MotionDeviceCategory", self._robotics)
        await arm.add_property(*place, category, ua.VariantType.Int32)
        within, trains = await self._object(arm, "Axes"), await self._object(arm, "PowerTrains")
        axes = [await self._object(within, joint.name, AXIS) for joint in robot.joints]
        for joint, axis in zip(robot.joints, axes, strict=True):
            place, turns = self._place(axis, "MotionProfile", self._robotics), joint.type == "revolute"
            await axis.add_property(*place, ROTARY if turns else LINEAR, ua.VariantType.Int32)
            self._alarms[cell, joint.name] = await self._health(axis)
        # q_motor = R q: a joint that moves alone turns the motors of its column, a motor the joints of the inverse.
        ratios = np.eye(len(axes)) if robot.transmission is None else np.array(robot.transmission)
        moved = np.linalg.inv(ratios).round(9)
        for number in range(len(axes)):
            train = await self._object(trains, f"PowerTrain_{number + 1}", TRAIN)
            await self._identify(await self._object(train, "Motor", MOTOR), None)
            for other, axis in enumerate(axes):
                if moved[other, number]:
                    await train.add_reference(axis, ua.NodeId(MOVES, self._robotics))
                if ratios[number, other]:
                    await axis.add_reference(train, ua.NodeId(REQUIRES, self._robotics))

    async def _health(self, axis: Node) -> EventGenerator:
        """Add the health of an axis, without values, and return its alarm."""
        place = await axis.add_object(*self._place(axis, "ModelHealth", self._own), ua.NodeId(HEALTH, self._own))
        for name in NAMES:
            kind, first, datatype = _KINDS.get(name, (ua.VariantType.String, "", None))
            node = await place.add_variable(*self._place(place, name, self._own), first, kind, datatype)
            await self._write(node.nodeid.Identifier, _value(name, UNKNOWN))
            if name == "Size":
                await node.add_property(*self._place(node, "EngineeringUnits", 0), ua.EUInformation())
        alarm = await self._server.get_event_generator(ua.NodeId(ua.ObjectIds.OffNormalAlarmType))
        alarm.event.SourceNode, alarm.event.NodeId = place.nodeid, self._place(place, "Alarm", 0)[0]
        alarm.event.SourceName = alarm.event.ConditionName = place.nodeid.Identifier
        return alarm

    async def _identify(self, device: Node, model: str | None) -> None:
        """Add manufacturer, model and serial number of a device; what is not known has no value."""
        for name, text in (("Manufacturer", None), ("Model", model), ("SerialNumber", None)):
            first = "" if name == "SerialNumber" else ua.LocalizedText(text or "")
            node = await device.add_property(*self._place(device, name, self._di), first)
            if text is None:
                await self._write(node.nodeid.Identifier, _value(name, UNKNOWN))

    async def _object(self, parent: Node, name: str, kind: int | None = None) -> Node:
        """Add an object of a type of `ROBOTICS`, by default a folder."""
        of_type = ua.NodeId(ua.ObjectIds.FolderType) if kind is None else ua.NodeId(kind, self._robotics)
        return await parent.add_object(*self._place(parent, name, self._robotics), of_type)

    def _place(self, parent: Node, name: str, namespace: int) -> tuple[ua.NodeId, ua.QualifiedName]:
        """Return identifier and name of a node below another one."""
        above = parent.nodeid.Identifier
        path = f"{above}/{name}" if isinstance(above, str) else name
        return ua.NodeId(path, self._own), ua.QualifiedName(name, namespace)

    async def _write(self, path: str, value: ua.DataValue) -> None:
        await self._server.write_attribute_value(ua.NodeId(path, self._own), value)


def _value(name: str, reading: Reading) -> ua.DataValue:
    """Return a reading as it is sent."""
    value, kind = reading.value, _KINDS.get(name, (ua.VariantType.String,))[0]
    variant = ua.Variant(ua.Range(*value) if isinstance(value, tuple) else value, kind) if value is not None else None
    status = ua.StatusCode(getattr(ua.StatusCodes, reading.status))
    return ua.DataValue(variant, status, SourceTimestamp=datetime.now(UTC))


async def _announce(alarm: EventGenerator, text: str, health: Health, before: Health) -> None:
    """Send the alarm of an axis; it is active while somebody should look, and acknowledged nowhere."""
    event, active = alarm.event, health.severity > CALM
    event.Severity, event.LastSeverity, event.Retain = health.severity, before.severity, active
    states = (("EnabledState", True, "Enabled"), ("AckedState", True, "Acknowledged"))
    for name, state, words in (*states, ("ActiveState", active, "Active" if active else "Inactive")):
        setattr(event, name, ua.LocalizedText(words))
        setattr(event, f"{name}/Id", state)
    await alarm.trigger(message=text)
