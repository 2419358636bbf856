"""XML archive of a Pinocchio model, with rotor inertias, friction, limits and gravity."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from armident.configs import ConfigError
from armident.identify.documents.files import write_atomically
from armident.identify.model_export.exported_model import ExportedModel
from armident.identify.model_export.rigid_effects import with_rigid_effects
from armident.identify.model_export.sheet import LimitationSheet, limitation_sheet

HOLDS = ("rotor inertia", "viscous friction", "Coulomb friction", "gravity")

TAG = "model"
"""Name of the model in the archive, which Pinocchio wants to know when it reads."""


def write_pinocchio(model: ExportedModel, out: Path) -> tuple[list[Path], LimitationSheet]:
    """Write an XML archive that ``pinocchio.Model.loadFromXML(file, "model")`` reads; needs Pinocchio."""
    try:
        import pinocchio
    except ImportError as error:
        raise ConfigError("--format pinocchio: Pinocchio is not installed: pip install pin") from error
    pin: Any = pinocchio
    model, parts = with_rigid_effects(model)
    with TemporaryDirectory() as folder:
        # Pinocchio writes files only; written here, the archive is complete or absent.
        archive = Path(folder) / out.name
        _pinocchio_model(model, pin).saveToXML(str(archive), TAG)
        write_atomically(out, archive.read_text(encoding="utf-8"))
    remarks = (
        f'model = pinocchio.Model(); model.loadFromXML("{out.name}", "{TAG}") reads it with Pinocchio '
        f"{pin.__version__} or newer",
        "rnea and crba use the rotor inertia (armature); friction and damping are stored, and added by the caller",
    )
    return [out], limitation_sheet(model, "pinocchio", HOLDS, parts=parts, remarks=remarks)


def _pinocchio_model(model: ExportedModel, pin: Any) -> Any:
    """Return the Pinocchio model: one body and one frame for each link, all in the frames of the links."""
    arm, frames = pin.Model(), model.frames
    arm.name = model.robot.name
    arm.gravity.linear = frames.gravity
    number, frame = 0, arm.addBodyFrame(frames.base, 0, pin.SE3.Identity(), 0)
    for k, (body, joint) in enumerate(zip(model.links, model.joints, strict=True)):
        placement = pin.SE3(frames.placements[k][:3, :3], frames.placements[k][:3, 3])
        kind = pin.JointModelRevoluteUnaligned if joint.type == "revolute" else pin.JointModelPrismaticUnaligned
        limits = model.robot.joints[k].limits
        low, high = model.position_limits(k) or (-np.inf, np.inf)
        bounds = [np.array([value]) for value in (limits.torque, limits.velocity, low, high)]
        number = arm.addJoint(number, kind(frames.axes[k]), placement, joint.name, *bounds)
        inertia = pin.Inertia(body.mass, body.centre, body.central_inertia)
        arm.appendBodyToJoint(number, inertia, pin.SE3.Identity())
        frame = arm.addJointFrame(number, frame)
        frame = arm.addBodyFrame(body.name, number, pin.SE3.Identity(), frame)
    rotor, coulomb = (np.array([getattr(j, key) for j in model.joints]) for key in ("rotor_inertia", "coulomb"))
    ratios = np.abs(np.diag(model.robot.transmission_matrix))
    arm.armature = rotor
    arm.rotorGearRatio = np.where(ratios > 0.0, ratios, 1.0)
    arm.rotorInertia = rotor / np.where(ratios > 0.0, ratios, 1.0) ** 2
    arm.damping = np.array([joint.viscous for joint in model.joints])
    arm.friction = coulomb
    if hasattr(arm, "lowerDryFrictionLimit"):
        arm.lowerDryFrictionLimit = -coulomb
    return arm
