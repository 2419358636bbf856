"""SDFormat, the format of Gazebo and Drake: bodies, friction, springs, and rotor inertias for Drake."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from armident.identify.model_export.exported_model import ExportedModel, LinkBody
from armident.identify.model_export.rigid_effects import SPRINGS, springs, with_rigid_effects
from armident.identify.model_export.sheet import LimitationSheet, limitation_sheet
from armident.identify.model_export.xml_text import numbers, roll_pitch_yaw, write_xml
from armident.identify.robot.chain import Floats

HOLDS = ("rotor inertia", "viscous friction", "Coulomb friction", SPRINGS)

DRAKE = "drake.mit.edu"
"""Namespace of the elements that Drake adds to the format."""

VERSION = "1.7"
"""First version of SDFormat with ``relative_to``."""


def write_sdf(model: ExportedModel, out: Path) -> tuple[list[Path], LimitationSheet]:
    """Write an SDF file with one model, fixed to the world; return it and the limits of the format."""
    model, parts = with_rigid_effects(model)
    root = ET.Element("sdf", {"version": VERSION, "xmlns:drake": DRAKE})
    arm = ET.SubElement(root, "model", name=model.robot.name)
    parent = model.frames.free_base
    ET.SubElement(arm, "link", name=parent)
    _joint(arm, f"{parent}_to_world", "fixed", "world", parent)
    stiffness = springs(model)
    for k, body in enumerate(model.links):
        _add_link(arm, body, parent, model.frames.placements[k])
        _add_joint(arm, model, k, parent, stiffness.get(k, 0.0))
        parent = body.name
    write_xml(root, out)
    remarks = (
        "the base is fixed to the world; meshes are not copied",
        "Drake has no Coulomb friction; Gazebo has no rotor inertia",
    )
    return [out], limitation_sheet(model, "sdf", HOLDS, parts=parts, remarks=remarks)


def _add_link(arm: ET.Element, body: LinkBody, parent: str, placement: Floats) -> None:
    """Add a link, placed in the link before it."""
    link = ET.SubElement(arm, "link", name=body.name)
    pose = ET.SubElement(link, "pose", relative_to=parent)
    pose.text = numbers(np.concatenate([placement[:3, 3], roll_pitch_yaw(placement[:3, :3])]))
    inertial = ET.SubElement(link, "inertial")
    _text(inertial, "pose", np.concatenate([body.centre, np.zeros(3)]))
    _text(inertial, "mass", body.mass)
    inertia, central = ET.SubElement(inertial, "inertia"), body.central_inertia
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        _text(inertia, f"i{'xyz'[i]}{'xyz'[j]}", central[i, j])


def _add_joint(arm: ET.Element, model: ExportedModel, k: int, parent: str, stiffness: float) -> None:
    """Add joint k, whose frame is that of its link."""
    joint, limits = model.joints[k], model.robot.joints[k].limits
    kind = "continuous" if model.frames.endless[k] else joint.type
    element = _joint(arm, joint_name(model, k), kind, parent, model.links[k].name)
    _text(element, "drake:rotor_inertia", joint.rotor_inertia)
    _text(element, "drake:gear_ratio", 1.0)
    axis = ET.SubElement(element, "axis")
    _text(axis, "xyz", model.frames.axes[k])
    bounds = dict(zip(("lower", "upper"), model.position_limits(k) or (), strict=False))
    element = ET.SubElement(axis, "limit")
    for tag, value in {**bounds, "effort": limits.torque, "velocity": limits.velocity}.items():
        if np.isfinite(value):
            _text(element, tag, value)
    dynamics = ET.SubElement(axis, "dynamics")
    _text(dynamics, "damping", joint.viscous)
    _text(dynamics, "friction", joint.coulomb)
    if stiffness:
        _text(dynamics, "spring_reference", 0.0)
        _text(dynamics, "spring_stiffness", stiffness)


def joint_name(model: ExportedModel, k: int) -> str:
    """Return the name of joint k: links and joints share their names in SDF."""
    name = model.joints[k].name
    return f"{name}_joint" if name in (model.frames.free_base, *model.frames.links) else name


def _joint(arm: ET.Element, name: str, kind: str, parent: str, child: str) -> ET.Element:
    joint = ET.SubElement(arm, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent").text = parent
    ET.SubElement(joint, "child").text = child
    return joint


def _text(parent: ET.Element, tag: str, values: float | Floats) -> None:
    """Add an element with numbers as its text."""
    ET.SubElement(parent, tag).text = numbers(values)
