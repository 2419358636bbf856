"""Effects that are parameters of the arm in other words: rotor inertias, couplings, gravity, springs, second joints."""

from dataclasses import replace

import numpy as np

from armident.identify.effects.link import across
from armident.identify.effects.registry import known
from armident.identify.model_export.exported_model import ExportedEffect, ExportedModel, JointCoupling

SPRINGS = "springs"
"""Part of a model that a linear spring is held as."""

LEAST_ROTOR = 1e-3
"""Least inertia of the motor of a joint with two hinges, relative to the mean inertia of the joint."""

SHAFT_KG, SHAFT_KG_M2 = 1e-6, 1e-9
"""Mass and inertia of the body of a motor, which simulators need; its inertia is the rotor inertia of its joint."""


def with_rigid_effects(model: ExportedModel) -> tuple[ExportedModel, dict[int, str]]:
    """Return the model with such effects added to its joints, couplings and gravity, and the part that holds each.

    Parts by index of the effect: ``rotor inertia``, ``couplings``, ``gravity`` or `SPRINGS`. Springs are not added.
    """
    parts = {k: part for k, effect in enumerate(model.effects) if (part := _part(model, effect)) is not None}
    joints, couplings, gravity = list(model.joints), list(model.couplings), model.frames.gravity
    for k, part in parts.items():
        effect = model.effects[k]
        value, j = effect.parameters, effect.joint
        if part == "rotor inertia":
            joints[j] = replace(joints[j], rotor_inertia=joints[j].rotor_inertia + value["iax"])
        elif part == "couplings" and effect.other is not None:
            name = f"{model.joints[j].name}_{model.joints[effect.other].name}"
            three = (value.get(key, 0.0) for key in ("iac", "fvc", "fcc"))
            couplings.append(JointCoupling(name, (j, effect.other), *three))
        elif part == "gravity":
            down = np.array(model.robot.gravity)
            tilt = np.array([value.get("tilt_x", 0.0), value.get("tilt_y", 0.0)])
            gravity = gravity + model.frames.frame_0 @ (np.linalg.norm(down) * tilt @ across(down))
    frames = replace(model.frames, gravity=gravity)
    return replace(model, joints=tuple(joints), couplings=tuple(couplings), frames=frames), parts


def springs(model: ExportedModel) -> dict[int, float]:
    """Return the stiffness of the linear spring at each joint that has one, N m/rad or N/m, by index of the joint."""
    found: dict[int, float] = {}
    for effect in model.effects:
        if _part(model, effect) == SPRINGS:
            found[effect.joint] = found.get(effect.joint, 0.0) + effect.parameters["ks"]
    return found


def _part(model: ExportedModel, effect: ExportedEffect) -> str | None:
    """Part of the model that holds an effect; ``None`` if none does."""
    part = "" if effect.of_recording or effect.law else known(effect.effect).rigid_part
    # A motor that turns with two joints couples them; a spring that pushes away from its centre is none.
    two = part == "rotor inertia" and np.count_nonzero(model.robot.transmission_matrix[effect.joint]) > 1
    return None if not part or two or (part == SPRINGS and effect.parameters.get("ks", 0.0) <= 0.0) else part


def second_hinges(model: ExportedModel) -> dict[int, ExportedEffect]:
    """Return the elasticity or backlash of each joint that becomes two hinges, by index of the joint.

    A rotor inertia that the model has in the link cannot be taken from a body, and a joint has one such effect.
    """
    found: dict[int, ExportedEffect] = {}
    for effect in model.effects:
        possible = effect.parameters.get("compliance", effect.parameters.get("gap", 0.0)) > 0.0
        if effect.effect in ("joint_elasticity", "backlash") and possible and not effect.parameters.get("rotor"):
            found.setdefault(effect.joint, effect)
    return found


def gear_spring(effect: ExportedEffect) -> tuple[float, float]:
    """Return stiffness and damping of an elastic gear, N m/rad and N m s/rad, or N/m and N s/m."""
    value = effect.parameters
    return 1.0 / value["compliance"], value["damping"] / (value["compliance"] * np.pi * value["frequency"])


def motor_inertia(model: ExportedModel, k: int, own: float) -> float:
    """Return the armature of a joint with two hinges: ``own`` or, where it is less, `LEAST_ROTOR` of the joint's."""
    still = np.zeros((1, len(model.joints)))
    return max(own, LEAST_ROTOR * float(model.arm.mass_matrix(model.theta, still)[0, k, k]))
