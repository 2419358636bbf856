"""Nodes of the server: the arms of a plant by the names of OPC 40010-1, and the health of their axes."""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from asyncua import Node, Server, ua
from asyncua.server.event_generator import EventGenerator

from armident.configs import RobotConfig
from armident.identify.opcua.health import CALM, NAMES, Health, Reading, health_of
from armident.identify.page.attention import CellView
from armident.identify.page.cells import Cell

DI = "http://opcfoundation.org/UA/DI/"
ROBOTICS = "http://opcfoundation.org/UA/Robotics/"
OWN = "urn:armident:model-health"
"""Namespaces of devices (OPC 10000-100), of robots (OPC 40010-1), and of armident."""
SYSTEM, DEVICE, MOTOR, AXIS, TRAIN = 1002, 1004, 1019, 16601, 16794
TYPES = {
    SYSTEM: "MotionDeviceSystemType",
    DEVICE: "MotionDeviceType",
    MOTOR: "MotorType",
    AXIS: "AxisType",
    TRAIN: "PowerTrainType",
}
"""Types of `ROBOTICS` by their identifiers there; they have no instance declarations here."""
CATEGORIES = ("OTHER", "ARTICULATED_ROBOT")
PROFILES = ("OTHER", "ROTARY", "ROTARY_ENDLESS", "LINEAR")
"""Begins of MotionDeviceCategoryEnumeration (18193) and AxisMotionProfileEnumeration (3008)."""
MOVES, REQUIRES = 18178, 18179
"""References from a power train to its axes, and from an axis to its power trains."""


def _id(identifier: Any, namespace: Any = 0) -> ua.NodeId:
    """Return an identifier; asyncua wants integers and texts of its own types, and takes any."""
    return ua.NodeId(identifier, namespace)


_NUMBER = (ua.VariantType.Double, 0.0, None)
_KINDS: dict[str, tuple[ua.VariantType, object, ua.NodeId | None]] = {
    "Probability": _NUMBER,
    "Size": _NUMBER,
    "Interval": (ua.VariantType.ExtensionObject, ua.Range(), _id(ua.ObjectIds.Range)),
    "Since": (ua.VariantType.DateTime, datetime.now(UTC), None),
}
"""Kind, placeholder and data type of the readings that are no text."""


@dataclass
class _Axis:
    """Nodes of an axis: its readings by name, the unit of the size, its alarm, and what clients know of it."""

    readings: dict[str, Node]
    unit: Node
    alarm: EventGenerator
    known: Health | None = None


class Nodes:
    """Nodes of the cells of a plant below ``DeviceSet``."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._axes: dict[tuple[str, str], _Axis] = {}

    async def build(self, cells: Iterable[Cell]) -> None:
        """Add the types, and an arm for each cell; an axis without results has readings without values."""
        server = self._server
        self._di, self._robotics, self._own = [await server.register_namespace(uri) for uri in (DI, ROBOTICS, OWN)]
        await self._types()
        where, named = _id(5001, self._di), ua.QualifiedName("DeviceSet", self._di)
        devices = await server.nodes.objects.add_object(where, named)
        system = await self._object(devices, "MotionDeviceSystem", self._of_robotics(SYSTEM))
        for name in ("Controllers", "SafetyStates"):
            await self._object(system, name)
        arms = await self._object(system, "MotionDevices")
        for cell in cells:
            arm = await self._object(arms, cell.name, self._of_robotics(DEVICE))
            await self._identify(arm, None if cell.robot is None else cell.robot.name)
            if cell.robot is not None:
                await self._arm(arm, cell, cell.robot)

    async def update(self, view: CellView) -> None:
        """Write the readings of a cell that have changed, and announce a change of state by an alarm."""
        for joint in () if view.cell.robot is None else view.cell.robot.joints:
            axis, health = self._axes[view.cell.name, joint.name], health_of(view, joint.name)
            if health == axis.known:
                continue
            unit = ua.EUInformation(DisplayName=ua.LocalizedText(health.unit), UnitId=-1)
            await self._write(axis.unit, ua.DataValue(ua.Variant(unit)))
            for name, reading in health.readings.items():
                if axis.known is None or reading != axis.known.readings[name]:
                    await self._write(axis.readings[name], _value(name, reading))
            before, axis.known = axis.known, health
            if before is not None and before.state != health.state:
                await _announce(axis.alarm, f"{view.cell.title}, {joint.name}: {health.sentence}", health, before)

    async def _types(self) -> None:
        """Add the types that the arms name, below the component of `DI`."""
        base, di = self._server.nodes.base_object_type, self._di
        for number, name in ((1001, "TopologyElementType"), (15063, "ComponentType")):
            base = await base.add_object_type(_id(number, di), ua.QualifiedName(name, di))
        for number, name in TYPES.items():
            await base.add_object_type(self._of_robotics(number), ua.QualifiedName(name, self._robotics))
        where, made = _id("ModelHealthType", self._own), ua.QualifiedName("ModelHealthType", self._own)
        await self._server.nodes.base_object_type.add_object_type(where, made)
        above = self._server.get_node(_id(ua.ObjectIds.HierarchicalReferences))
        for number, name, inverse in ((MOVES, "Moves", "IsMovedBy"), (REQUIRES, "Requires", "IsRequiredBy")):
            made = ua.QualifiedName(name, self._robotics)
            await above.add_reference_type(self._of_robotics(number), made, symmetric=False, inversename=inverse)
        above = self._server.get_node(_id(ua.ObjectIds.Enumeration))
        for number, name, texts in ((18193, "MotionDeviceCategory", CATEGORIES), (3008, "AxisMotionProfile", PROFILES)):
            made = ua.QualifiedName(f"{name}Enumeration", self._robotics)
            kind = await above.add_data_type(self._of_robotics(number), made)
            await kind.add_property(0, "EnumStrings", [ua.LocalizedText(text) for text in texts])

    async def _arm(self, arm: Node, cell: Cell, robot: RobotConfig) -> None:
        """Add category, axes and power trains of an arm."""
        kinds = {joint.type for joint in robot.joints}
        await self._enumerated(arm, "MotionDeviceCategory", int(kinds == {"revolute"}), 18193)
        within, trains = await self._object(arm, "Axes"), await self._object(arm, "PowerTrains")
        axes = []
        for joint in robot.joints:
            axis = await self._object(within, joint.name, self._of_robotics(AXIS))
            await self._enumerated(axis, "MotionProfile", 1 if joint.type == "revolute" else 3, 3008)
            self._axes[cell.name, joint.name] = await self._health(axis)
            axes.append(axis)
        for number in range(len(axes)):
            train = await self._object(trains, f"PowerTrain_{number + 1}", self._of_robotics(TRAIN))
            await self._identify(await self._object(train, "Motor", self._of_robotics(MOTOR)), None)
            row = None if robot.transmission is None else robot.transmission[number]
            for other, axis in enumerate(axes):
                if (number == other) if row is None else row[other]:
                    await train.add_reference(axis, self._of_robotics(MOVES))
                    await axis.add_reference(train, self._of_robotics(REQUIRES))

    async def _health(self, axis: Node) -> _Axis:
        """Add the health of an axis, without values."""
        place = await self._object(axis, "ModelHealth", _id("ModelHealthType", self._own), self._own)
        readings = {}
        for name in NAMES:
            kind, first, datatype = _KINDS.get(name, (ua.VariantType.String, "", None))
            where, named = self._below(place, name), ua.QualifiedName(name, self._own)
            readings[name] = await place.add_variable(where, named, first, kind, datatype)
            await self._write(readings[name], _value(name, Reading()))
        where, named = self._below(readings["Size"], "EngineeringUnits"), ua.QualifiedName("EngineeringUnits", 0)
        unit = await readings["Size"].add_property(where, named, ua.EUInformation())
        alarm = await self._server.get_event_generator(_id(ua.ObjectIds.OffNormalAlarmType))
        alarm.event.SourceNode, alarm.event.NodeId = place.nodeid, self._below(place, "Alarm")
        alarm.event.SourceName = alarm.event.ConditionName = place.nodeid.Identifier
        return _Axis(readings, unit, alarm)

    async def _identify(self, device: Node, model: str | None) -> None:
        """Add manufacturer, model and serial number of a device; what is not known has no value."""
        for name, text in (("Manufacturer", None), ("Model", model), ("SerialNumber", None)):
            first = "" if name == "SerialNumber" else ua.LocalizedText(text or "")
            node = await device.add_property(self._below(device, name), ua.QualifiedName(name, self._di), first)
            if text is None:
                await self._write(node, _value(name, Reading()))

    async def _enumerated(self, device: Node, name: str, value: int, kind: int) -> None:
        """Add a property of an enumeration of `ROBOTICS`."""
        where, named = self._below(device, name), ua.QualifiedName(name, self._robotics)
        await device.add_property(where, named, value, ua.VariantType.Int32, self._of_robotics(kind))

    async def _object(
        self, parent: Node, name: str, kind: ua.NodeId | None = None, namespace: int | None = None
    ) -> Node:
        """Add an object of a type, by default a folder; its identifier is its path below ``DeviceSet``."""
        where, named = self._below(parent, name), ua.QualifiedName(name, namespace or self._robotics)
        return await parent.add_object(where, named, kind or _id(ua.ObjectIds.FolderType))

    async def _write(self, node: Node, value: ua.DataValue) -> None:
        await self._server.write_attribute_value(node.nodeid, value)

    def _below(self, parent: Node, name: str) -> ua.NodeId:
        above = parent.nodeid.Identifier
        return _id(f"{above}/{name}" if isinstance(above, str) else name, self._own)

    def _of_robotics(self, number: int) -> ua.NodeId:
        return _id(number, self._robotics)


def _value(name: str, reading: Reading) -> ua.DataValue:
    """Return a reading as it is sent."""
    value, kind = reading.value, _KINDS.get(name, (ua.VariantType.String,))[0]
    if isinstance(value, tuple):
        value = ua.Range(*value)
    variant = None if value is None else ua.Variant(value, kind)
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
