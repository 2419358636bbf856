"""MJCF, the format of MuJoCo: bodies, friction, rotor inertias, couplings (as tendons), offsets, springs, gravity.

Friction and named effects are passive actuators without input: `Passive` writes them.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from armident.identify.model_export.exported_model import ExportedModel, JointCoupling, LinkBody
from armident.identify.model_export.formulas import instant_model
from armident.identify.model_export.mjcf_effects import Passive, add_effects, on_shaft
from armident.identify.model_export.rigid_effects import (
    SPRINGS,
    motor_inertia,
    second_hinges,
    springs,
    with_rigid_effects,
)
from armident.identify.model_export.saturated_dampers import coupling_law, friction_laws, top_speed
from armident.identify.model_export.sheet import PARTS, LimitationSheet, Omission, limitation_sheet
from armident.identify.model_export.xml_text import numbers, write_xml

RADIUS_M = 0.02
"""Radius of the capsules that show links without meshes, m."""

HOLDS = (*PARTS, "couplings", "gravity", SPRINGS)

TENDONS = (
    "couplings are fixed tendons over both joints, with a part of the armature and damping of each joint; "
    "MuJoCo 3.3.1 or newer reads them"
)

PASSIVE = (
    "dry friction and effects are passive actuators without input, which MuJoCo 3.12 or newer reads: subtract their "
    "forces (qfrc_actuator at zero input) from qfrc_inverse; with the smoothed sign of the identification, a loaded "
    "joint creeps at standstill"
)

REMARKS = (
    "the input of each actuator is the torque that the drive reports: the actuator subtracts the offset",
    "capsules show the links; they have no mass and no contacts, and meshes of a URDF are not copied",
)

OPTIONS = {"timestep": "0.001", "integrator": "implicitfast"}
"""Steep friction at standstill is stable with the integrator that is implicit in the velocity."""


def write_mjcf(model: ExportedModel, out: Path) -> tuple[list[Path], LimitationSheet]:
    """Write an MJCF file. Returns ``files``: the file; ``sheet``: limits of the format."""
    model, parts = with_rigid_effects(model)
    root = ET.Element("mujoco", model=model.robot.name)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    ET.SubElement(root, "option", {**OPTIONS, "gravity": numbers(model.frames.gravity)})
    parent = ET.SubElement(ET.SubElement(root, "worldbody"), "body", name=model.frames.free_base)
    stiffness, hinges = springs(model), second_hinges(model)
    own = {name: [getattr(joint, name) for joint in model.joints] for name in ("rotor_inertia", "viscous")}
    tendons, passive = ET.Element("tendon"), Passive(_actuators(model))
    omitted = [part for coupling in model.couplings for part in _add_tendons(tendons, coupling, own, model, passive)]
    held = _add_friction(model, passive) | {model.effects.index(effect) for effect in hinges.values()}
    for k, body in enumerate(model.links):
        joint = _joint(model, k)
        armature = own["rotor_inertia"][k]
        joint.set("armature", numbers(motor_inertia(model, k, armature) if k in hinges else armature))
        joint.set("damping", numbers(own["viscous"][k]))
        if k in stiffness:
            joint.set("stiffness", numbers(stiffness[k]))
            joint.set("springref", "0")
        element = _body(body, model, k)
        outer = on_shaft(element, joint, hinges[k]) if k in hinges else element
        outer.insert(0, joint)
        parent.append(outer)
        parent = element
    if len(tendons):
        root.append(tendons)
    root.append(passive.element)
    write_xml(root, out)
    unused = (
        f"MuJoCo has no form without input for the actuators {', '.join(passive.unused)}: their controls do nothing",
    )
    remarks = ((TENDONS,) if len(tendons) else ()) + (unused if passive.unused else ()) + (PASSIVE,) + REMARKS
    sheet = limitation_sheet(
        model, "mjcf", HOLDS, effects=[model.effects[k] for k in held], parts=parts, remarks=remarks
    )
    return [out], replace(sheet, omitted=(*sheet.omitted, *omitted))


def _add_friction(model: ExportedModel, passive: Passive) -> set[int]:
    """Add dry friction and the effects that passive actuators have; return the numbers of these effects."""
    held, replaced = add_effects(model, passive)
    dry = zip(model.joints, replaced, strict=True)
    model = replace(model, joints=tuple(replace(joint, coulomb=joint.coulomb - part) for joint, part in dry))
    laws, contained = friction_laws(model, instant_model(model.arm, model.theta, model.recorded_s).torques)
    for k, (joint, law) in enumerate(zip(model.joints, laws, strict=True)):
        passive.friction(joint.name, law, top_speed(model, k))
    return held | contained


def _body(body: LinkBody, model: ExportedModel, k: int) -> ET.Element:
    """Return the body of link k, with a capsule to the next joint."""
    placement = model.frames.placements[k]
    axes = np.concatenate([placement[:3, 0], placement[:3, 1]])
    element = ET.Element("body", name=body.name, pos=numbers(placement[:3, 3]), xyaxes=numbers(axes))
    # Principal axes: MuJoCo's own decomposition of a full inertia is exact to 1e-7 only in older versions.
    moments, principal = np.linalg.eigh(body.central_inertia)
    inertial = {"pos": numbers(body.centre), "mass": numbers(body.mass), "diaginertia": numbers(moments)}
    ET.SubElement(element, "inertial", inertial, xyaxes=numbers(principal[:, :2].T.ravel()))
    end = model.frames.placements[k + 1][:3, 3] if k + 1 < len(model.links) else body.centre
    if np.linalg.norm(end) > RADIUS_M:
        shape = {"type": "capsule", "size": numbers(RADIUS_M), "fromto": numbers(np.concatenate([np.zeros(3), end]))}
        ET.SubElement(element, "geom", {**shape, "contype": "0", "conaffinity": "0", "group": "1"})
    return element


def _joint(model: ExportedModel, k: int) -> ET.Element:
    """Return joint k with its axis and range."""
    kind = "hinge" if model.joints[k].type == "revolute" else "slide"
    element = ET.Element("joint", name=model.joints[k].name, type=kind, axis=numbers(model.frames.axes[k]))
    limits = model.position_limits(k)
    if limits is not None:
        element.set("range", numbers(limits))
    return element


def _actuators(model: ExportedModel) -> ET.Element:
    """Return an actuator for each joint, whose input is the torque that the drive reports."""
    actuators = ET.Element("actuator")
    for joint, configured in zip(model.joints, model.robot.joints, strict=True):
        element = ET.SubElement(actuators, "general", name=joint.name, joint=joint.name)
        if np.isfinite(configured.limits.torque):
            element.set("ctrlrange", numbers([-configured.limits.torque, configured.limits.torque]))
        if joint.offset:
            element.set("biastype", "affine")
            element.set("biasprm", numbers([-joint.offset, 0.0, 0.0]))
    return actuators


def _add_tendons(
    tendons: ET.Element,
    coupling: JointCoupling,
    own: dict[str, list[float]],
    model: ExportedModel,
    passive: Passive,
) -> Iterator[Omission]:
    """Add the tendons of a coupling and take their share from the joints; return the parts that are impossible."""
    i, j = coupling.joints
    for part, key, attribute, shared in (
        ("inertia", "rotor_inertia", "armature", coupling.inertia),
        ("viscous friction", "viscous", "damping", coupling.viscous),
    ):
        share = _tendon(own[key][i], own[key][j], shared)
        if share is None:
            names = f"{model.joints[i].name} and {model.joints[j].name}"
            yield Omission(
                f"{part} of coupling {coupling.name}: {shared:.4g}",
                f"It is larger than that of {names} themselves, which no tendon has.",
            )
            continue
        coefficient, strength = share
        if not strength:
            continue
        own[key][i] -= strength * coefficient**2
        own[key][j] -= strength
        _add_tendon(tendons, f"{coupling.name}_{attribute}", model, (i, j), (coefficient, 1.0), {attribute: strength})
    if coupling.coulomb:
        name = f"{coupling.name}_both"
        _add_tendon(tendons, name, model, (i, j), (1.0, 1.0), {})
        passive.friction(name, coupling_law(model, coupling), top_speed(model, i) + top_speed(model, j), "tendon")


def _tendon(first: float, second: float, shared: float) -> tuple[float, float] | None:
    """Coefficient of the first joint, and strength, of a tendon for ``[[first, shared], [shared, second]]``.

    The joints keep the rest, which must not be negative; ``None`` if that is impossible.
    """
    if shared <= min(first, second):
        return 1.0, shared
    if shared**2 > first * second:
        return None
    return shared / second, second


def _add_tendon(
    tendons: ET.Element,
    name: str,
    model: ExportedModel,
    joints: tuple[int, int],
    coefficients: tuple[float, float],
    strength: dict[str, float],
) -> None:
    """Add a fixed tendon over two joints."""
    element = ET.SubElement(tendons, "fixed", {"name": name} | {k: numbers(v) for k, v in strength.items()})
    for k, coefficient in zip(joints, coefficients, strict=True):
        ET.SubElement(element, "joint", joint=model.joints[k].name, coef=numbers(coefficient))
