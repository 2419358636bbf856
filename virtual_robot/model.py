"""Pinocchio model of the arm from its modified Denavit-Hartenberg table."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pinocchio

from armident.configs import RobotConfig

pin: Any = pinocchio


def build_model(robot: RobotConfig, standard: Mapping[str, float]) -> Any:
    """Build a Pinocchio model of n joints whose joint frames are the MDH frames (thesis section 2.1.1).

    ``Rot(z, theta)`` and ``Trans(z, r)`` commute, so offset and ``r`` precede the joint; the moving frame is frame j
    itself, for which the standard parameters (about origins, SI) apply.
    """
    model = pin.Model()
    model.name = robot.name
    parent = 0
    for j, joint in enumerate(robot.joints, 1):
        mdh = joint.mdh
        about_x = pin.SE3(pin.utils.rotate("x", mdh.alpha), np.zeros(3)) * pin.SE3(
            np.eye(3), np.array([mdh.d, 0.0, 0.0])
        )
        about_z = pin.SE3(pin.utils.rotate("z", mdh.theta), np.array([0.0, 0.0, mdh.r]))
        kind = pin.JointModelRZ() if joint.type == "revolute" else pin.JointModelPZ()
        parent = model.addJoint(parent, kind, about_x * about_z, joint.name)
        model.appendBodyToJoint(parent, _body(standard, j), pin.SE3.Identity())
    model.gravity.linear = np.array(robot.gravity)
    return model


def _body(standard: Mapping[str, float], link: int) -> Any:
    xx, xy, xz, yy, yz, zz = (standard[f"{k}{link}"] for k in ("xx", "xy", "xz", "yy", "yz", "zz"))
    mass = standard[f"m{link}"]
    com = np.array([standard[f"{k}{link}"] for k in ("mx", "my", "mz")]) / (mass or 1.0)
    about_origin = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    shift = pin.skew(com)
    return pin.Inertia(mass, com, about_origin + mass * shift @ shift)
