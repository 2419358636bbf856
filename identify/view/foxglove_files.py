"""A view as an MCAP file with messages of Foxglove, and the layout that arranges it."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema

from armident.configs.schema.collision import BASE
from armident.daq.recording.names import GAPS_TOPIC, MARKS_TOPIC
from armident.identify.view.arm import colours
from armident.identify.view.contents import Contents

TRANSFORMS, LINKS, JOINTS = "/arm/transforms", "/arm/links", "/arm/joints"
"""Topics of the arm: poses; the links, once; the joints in their colours."""
GREY = (0.6, 0.6, 0.6, 0.45)
VALUE = {"type": "object", "properties": {"value": {"type": "number"}}}
"""JSON schema of a point of a curve, whose topic is /QUANTITY/CURVE."""


def write_layout(view: Contents, path: Path) -> None:
    """Write the layout: arm, findings, gaps and marks of the recording on the left, diagrams on the right."""
    panels: dict[str, Any] = {
        "3D!arm": {"followTf": BASE, "topics": {topic: {"visible": True} for topic in (LINKS, JOINTS)}},
        "Markdown!findings": {"markdown": view.findings},
        "RawMessages!gaps": {"topicPath": GAPS_TOPIC, "expansion": "all"},
        "RawMessages!marks": {"topicPath": MARKS_TOPIC, "expansion": "all"},
    }
    left = _split("column", ["3D!arm", "Markdown!findings", _split("row", ["RawMessages!gaps", "RawMessages!marks"])])
    for plot in view.plots:
        series = [{"value": f"/{plot.path}/{name}.value", "label": name, "enabled": True} for name in plot.curves]
        panels[f"Plot!{plot.path}"] = {"title": plot.title, "paths": series, "showLegend": True, "isSynced": True}
    right = _split("column", [f"Plot!{plot.path}" for plot in view.plots])
    arranged = {"direction": "row", "first": left, "second": right, "splitPercentage": 40}
    text = json.dumps({"configById": panels, "layout": arranged, "globalVariables": {}, "userNodes": {}}, indent=1)
    path.write_text(text + "\n", encoding="utf-8")


def _split(direction: str, parts: Sequence[Any]) -> Any:
    """Return panels of one size beside or below each other."""
    if len(parts) == 1:
        return parts[0]
    share = 100 / len(parts)
    return {"direction": direction, "first": parts[0], "second": _split(direction, parts[1:]), "splitPercentage": share}


def write_mcap(view: Contents, path: Path) -> None:
    """Write curves (JSON), and the arm as FrameTransforms and SceneUpdate of Foxglove (protobuf)."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(library="armident")
        schema = writer.register_schema("armident.Value", "jsonschema", json.dumps(VALUE).encode())
        for plot in view.plots:
            for name, (t_ns, values) in plot.curves.items():
                channel = writer.register_channel(f"/{plot.path}/{name}", "json", schema)
                for at, value in zip(t_ns.tolist(), values.tolist(), strict=True):
                    writer.add_message(channel, at, b'{"value":%.9g}' % value, at)
        for topic, kind, messages in (
            (TRANSFORMS, FrameTransforms, _transforms(view)),
            (LINKS, SceneUpdate, _links(view)),
            (JOINTS, SceneUpdate, _joints(view)),
        ):
            channel = writer.register_channel(topic, "protobuf", register_schema(writer, kind))
            for at, message in messages:
                writer.add_message(channel, at, message.SerializeToString(), at)
        writer.finish()


def _transforms(view: Contents) -> Iterator[tuple[int, Message]]:
    names = [joint.name for joint in view.robot.joints]
    for at, places, turns in zip(view.poses[0].tolist(), *view.arm.poses(view.poses[1]), strict=True):
        message = FrameTransforms()
        for before, name, place, turn in zip([BASE, *names], names, places, turns, strict=False):
            one = message.transforms.add(parent_frame_id=before, child_frame_id=name)
            one.timestamp.FromNanoseconds(at)
            one.translation.x, one.translation.y, one.translation.z = place
            one.rotation.x, one.rotation.y, one.rotation.z, one.rotation.w = turn
        yield at, message


def _links(view: Contents) -> Iterator[tuple[int, Message]]:
    begin, message = int(view.poses[0][0]), SceneUpdate()
    for name, triangles in zip([BASE, *(joint.name for joint in view.robot.joints)], view.arm.links, strict=True):
        body = _entity(message, f"link of {name}", name, begin).triangles.add()
        body.pose.orientation.w = 1.0
        _set_colour(body, GREY)
        for x, y, z in triangles.reshape(-1, 3).tolist():
            body.points.add(x=x, y=y, z=z)
    yield begin, message


def _joints(view: Contents) -> Iterator[tuple[int, Message]]:
    t_ns, levels = view.levels or (view.poses[0][:1], np.zeros((1, view.robot.n)))
    shown = np.tile(GREY, (1, view.robot.n, 1)) if view.levels is None else colours(levels) / 255
    turns, radius, height = view.arm.axes
    for at, shades in zip(t_ns.tolist(), shown, strict=True):
        message = SceneUpdate()
        for joint, turn, shade in zip(view.robot.joints, turns, shades, strict=True):
            body = _entity(message, joint.name, joint.name, at).cylinders.add(bottom_scale=1.0, top_scale=1.0)
            orientation = body.pose.orientation
            orientation.x, orientation.y, orientation.z, orientation.w = turn
            body.size.x, body.size.y, body.size.z = 2 * radius, 2 * radius, height
            _set_colour(body, shade)
        yield at, message


def _entity(message: Any, name: str, frame: str, at: int) -> Any:
    """Return a new entity of a scene that moves with a frame."""
    entity = message.entities.add(id=name, frame_id=frame, frame_locked=True)
    entity.timestamp.FromNanoseconds(at)
    return entity


def _set_colour(body: Any, colour: Sequence[float]) -> None:
    body.color.r, body.color.g, body.color.b, body.color.a = colour
