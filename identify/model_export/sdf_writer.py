"""SDFormat, the format of Gazebo and Drake: bodies, friction, springs, elastic joints, and rotor inertias for Drake."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np

from armident.identify.model_export.exported_model import ExportedModel, LinkBody
from armident.identify.model_export.rigid_effects import (
    SHAFT_KG,
    SHAFT_KG_M2,
    SPRINGS,
    gear_spring,
    motor_inertia,
    second_hinges,
    springs,
    with_rigid_effects,
)
from armident.identify.model_export.sheet import LimitationSheet, limitation_sheet
from armident.identify.model_export.xml_text import numbers, roll_pitch_yaw, write_xml
from armident.identify.robot.chain import Floats

HOLDS = ("rotor inertia", "viscous friction", "Coulomb friction", SPRINGS)

SHAFT = LinkBody("", SHAFT_KG, np.zeros(3), SHAFT_KG_M2 * np.eye(3))
"""Body of a motor before an elastic gear; its inertia is the rotor inertia of its joint."""

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
    # The sides of a backlash are limits of a joint, which Drake's plants of continuous time do not have.
    elastic = {k: each for k, each in second_hinges(model).items() if each.effect == "joint_elasticity"}
    stiffness = springs(model)
    for k, body in enumerate(model.links):
        joint, placement = model.joints[k], model.frames.placements[k]
        moved = replace(SHAFT, name=f"{body.name}_motor") if k in elastic else body
        inertia = motor_inertia(model, k, joint.rotor_inertia) if k in elastic else joint.rotor_inertia
        _add_link(arm, moved, parent, placement)
        axis = _add_joint(arm, model, k, parent, moved.name, inertia)
        _add_dynamics(axis, joint.viscous, joint.coulomb, stiffness.get(k, 0.0))
        if k in elastic:
            _add_link(arm, body, moved.name, np.eye(4))
            gear = _joint(arm, f"{joint_name(model, k)}_gear", joint.type, moved.name, body.name)
            axis = ET.SubElement(gear, "axis")
            _text(axis, "xyz", model.frames.axes[k])
            _text(ET.SubElement(axis, "limit"), "effort", 0.0)
            spring, damping = gear_spring(elastic[k])
            _add_dynamics(axis, damping, 0.0, spring)
        parent = body.name
    write_xml(root, out)
    remarks = (
        "the base is fixed to the world; meshes are not copied",
        f"Drake has no Coulomb friction; Gazebo has no rotor inertia{', which an elastic joint needs' * bool(elastic)}",
    )
    return [out], limitation_sheet(model, "sdf", HOLDS, effects=[*elastic.values()], parts=parts, remarks=remarks)


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


def _add_joint(arm: ET.Element, model: ExportedModel, k: int, parent: str, child: str, inertia: float) -> ET.Element:
    """Add joint k, whose frame is that of the link that it moves; return its axis."""
    limits = model.robot.joints[k].limits
    kind = "continuous" if model.frames.endless[k] else model.joints[k].type
    element = _joint(arm, joint_name(model, k), kind, parent, child)
    _text(element, "drake:rotor_inertia", inertia)
    _text(element, "drake:gear_ratio", 1.0)
    axis = ET.SubElement(element, "axis")
    _text(axis, "xyz", model.frames.axes[k])
    bounds = dict(zip(("lower", "upper"), model.position_limits(k) or (), strict=False))
    element = ET.SubElement(axis, "limit")
    for tag, value in {**bounds, "effort": limits.torque, "velocity": limits.velocity}.items():
        if np.isfinite(value):
            _text(element, tag, value)
    return axis


def _add_dynamics(axis: ET.Element, damping: float, friction: float, stiffness: float) -> None:
    """Add friction and spring of a joint."""
    dynamics = ET.SubElement(axis, "dynamics")
    _text(dynamics, "damping", damping)
    _text(dynamics, "friction", friction)
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
