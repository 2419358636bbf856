"""URDF: a copy of the source with the identified bodies and friction, or a new one of the Denavit-Hartenberg frames."""

import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from armident.configs.schema.limits import WRITTEN_NO_LIMIT
from armident.configs.urdf_origin import rotation, rotation_of_quaternion, rounded_angle
from armident.identify.model_export.exported_model import ExportedFriction, ExportedModel, LinkBody
from armident.identify.model_export.rigid_effects import with_rigid_effects
from armident.identify.model_export.sheet import LimitationSheet, limitation_sheet
from armident.identify.model_export.source_urdf import SourceUrdf
from armident.identify.model_export.xml_text import numbers, roll_pitch_yaw, write_xml
from armident.identify.robot.chain import Floats

HOLDS = ("viscous friction", "Coulomb friction")


def write_urdf(model: ExportedModel, out: Path) -> tuple[list[Path], LimitationSheet]:
    """Write a URDF. Returns ``files``: the file; ``sheet``: limits of the format."""
    model, parts = with_rigid_effects(model)
    if model.source_urdf is None:
        root, remarks = _new(model), ["there are no meshes"]
    else:
        root, remarks = _copy(model, model.source_urdf, out)
    write_xml(root, out)
    return [out], limitation_sheet(model, "urdf", HOLDS, parts=parts, remarks=remarks)


def _new(model: ExportedModel) -> ET.Element:
    """Return a URDF with a link and a joint for each Denavit-Hartenberg frame."""
    root = ET.Element("robot", name=model.robot.name)
    ET.SubElement(root, "link", name=model.frames.base)
    parent = model.frames.base
    for k, (body, joint) in enumerate(zip(model.links, model.joints, strict=True)):
        ET.SubElement(root, "link", name=body.name).append(_inertial(body))
        limits, endless = model.robot.joints[k].limits, model.frames.endless[k]
        element = ET.SubElement(root, "joint", name=joint.name, type="continuous" if endless else joint.type)
        _set_origin(element, model.frames.placements[k])
        ET.SubElement(element, "parent", link=parent)
        ET.SubElement(element, "child", link=body.name)
        ET.SubElement(element, "axis", xyz=numbers(model.frames.axes[k]))
        low, high = limits.position
        range_ = {} if endless else {"lower": _limit(low), "upper": _limit(high)}
        ET.SubElement(
            element, "limit", {**range_, "effort": _limit(limits.torque), "velocity": _limit(limits.velocity)}
        )
        _set_dynamics(element, joint)
        parent = body.name
    return root


def _copy(model: ExportedModel, source: SourceUrdf, out: Path) -> tuple[ET.Element, list[str]]:
    """Return a copy of the source with the identified bodies, and remarks on what was changed."""
    root = source.root()
    remarks = [f"a copy of {source.file.name} with its names, meshes and limits; identified inertias are in its links"]
    links = {str(link.get("name")): link for link in root.findall("link")}
    joints = {str(joint.get("name")): joint for joint in root.findall("joint")}
    moved, fixed = [], []
    for body, joint in zip(model.links, model.joints, strict=True):
        _set_dynamics(joints[joint.name], joint)
        for name, element in _carried(body.name, root, set(model.frames.joints)):
            if links[name].find("inertial") is not None:
                moved.append(name)
                _remove(links[name], "inertial")
            if element.get("type") != "fixed":
                fixed.append(str(element.get("name")))
                _fix(element)
        _remove(links[body.name], "inertial")
        links[body.name].insert(0, _inertial(body))
    if moved:
        remarks.append(f"masses of {', '.join(moved)} are part of the moving links that carry them")
    if fixed:
        remarks.append(f"joints {', '.join(fixed)} after the tip are fixed: their links were identified as load")
    rewritten = [name for name, joint in joints.items() if _exact_origin(joint)]
    if rewritten:
        remarks.append(f"origins of {', '.join(rewritten)} are written as exact angles, as the model reads them")
    for name, axis in zip(model.frames.joints, model.frames.axes, strict=True):
        found = joints[name].find("axis")
        if found is not None and not np.array_equal([float(w) for w in found.get("xyz", "").split()], axis):
            found.set("xyz", numbers(axis))
    _relocate(root, source.file.resolve().parent, out.resolve().parent)
    return root, remarks


def _carried(link: str, root: ET.Element, chain: set[str]) -> Iterator[tuple[str, ET.Element]]:
    """Return the links that a link carries up to the next joint of the chain, and the joint above each."""
    for joint in root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is None or child is None or parent.get("link") != link or joint.get("name") in chain:
            continue
        name = str(child.get("link"))
        yield name, joint
        yield from _carried(name, root, chain)


def _inertial(body: LinkBody) -> ET.Element:
    """Return the element of a body, with axes of its link."""
    element = ET.Element("inertial")
    ET.SubElement(element, "origin", xyz=numbers(body.centre), rpy="0 0 0")
    ET.SubElement(element, "mass", value=numbers(body.mass))
    central = body.central_inertia
    cells = {
        f"i{'xyz'[i]}{'xyz'[j]}": numbers(central[i, j]) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    }
    ET.SubElement(element, "inertia", cells)
    return element


def _set_dynamics(element: ET.Element, joint: ExportedFriction) -> None:
    """Write viscous and Coulomb friction of a joint."""
    found = element.find("dynamics")
    dynamics = ET.SubElement(element, "dynamics") if found is None else found
    dynamics.set("damping", numbers(joint.viscous))
    dynamics.set("friction", numbers(joint.coulomb))


def _set_origin(element: ET.Element, placement: Floats) -> None:
    """Write the placement (4, 4) of a joint."""
    xyz, rpy = numbers(placement[:3, 3]), numbers(roll_pitch_yaw(placement[:3, :3]))
    ET.SubElement(element, "origin", xyz=xyz, rpy=rpy)


def _exact_origin(element: ET.Element) -> bool:
    """Write rounded right angles and quaternions of a joint as exact angles; return True if that changes the file."""
    origin = element.find("origin")
    if origin is None:
        return False
    quaternion = origin.get("quat_xyzw")
    if quaternion is not None:
        turn = rotation_of_quaternion([float(w) for w in quaternion.split()])
        del origin.attrib["quat_xyzw"]
        origin.set("rpy", numbers(roll_pitch_yaw(turn)))
        return True
    words = origin.get("rpy", "0 0 0").split()
    angles = [rounded_angle(word) for word in words]
    if np.allclose(rotation(*angles), rotation(*(float(word) for word in words)), rtol=0.0, atol=1e-15):
        return False
    origin.set("rpy", numbers(angles))
    return True


def _fix(joint: ET.Element) -> None:
    """Fix a joint at position zero."""
    joint.set("type", "fixed")
    for tag in ("axis", "limit", "dynamics", "mimic", "calibration", "safety_controller"):
        _remove(joint, tag)


def _remove(element: ET.Element, tag: str) -> None:
    for found in element.findall(tag):
        element.remove(found)


def _relocate(root: ET.Element, source: Path, out: Path) -> None:
    """Make file names relative to the folder of the source relative to that of the copy; addresses stay."""
    for element in root.iter():
        name = element.get("filename") if isinstance(element.tag, str) else None
        if name and not re.match(r"[a-z][a-z0-9+.-]*:", name) and not Path(name).is_absolute():
            element.set("filename", Path(os.path.relpath(source / name, out)).as_posix())


def _limit(value: float) -> str:
    """Return a limit as text; an infinite one as the number that means none."""
    return numbers(float(np.clip(value, -WRITTEN_NO_LIMIT, WRITTEN_NO_LIMIT)))
