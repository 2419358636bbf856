"""The same chains in Pinocchio, and random ones: an oracle for the robot model that shares no code with it."""

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from armident.configs import Joint, Limits, Mdh, RobotConfig
from armident.identify.robot.arm import ArmModel

Floats = NDArray[np.float64]

TO_OURS = [9, 6, 7, 8, 0, 1, 3, 2, 4, 5]
"""Pinocchio's inertial parameters (m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz) as indices of our ten."""


def rotation_x(angle: float) -> Floats:
    """Rotation about x."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_z(angle: float) -> Floats:
    """Rotation about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def pinocchio_model(robot: RobotConfig, inertial: Floats, rotor: Floats) -> Any:
    """Pinocchio model with the link parameters ``inertial`` (n, 10, our order, about the frame's origin)."""
    model = pin.Model()
    model.gravity.linear = np.array(robot.gravity)
    parent = 0
    for k, joint in enumerate(robot.joints):
        mdh = joint.mdh
        rotation = rotation_x(mdh.alpha)
        offset = np.array([mdh.d, 0.0, 0.0]) + rotation @ np.array([0.0, 0.0, mdh.r])
        placement = pin.SE3(rotation @ rotation_z(mdh.theta), offset)
        kind = pin.JointModelRZ() if joint.type == "revolute" else pin.JointModelPZ()
        parent = model.addJoint(parent, kind, placement, joint.name)
        body = pin.Inertia.FromDynamicParameters(inertial[k][TO_OURS])
        model.appendBodyToJoint(parent, body, pin.SE3.Identity())
    model.armature[:] = rotor
    return model


def random_robot(rng: np.random.Generator, n: int, right_angles: bool) -> RobotConfig:
    """A chain of n joints; with ``right_angles`` axes are parallel or orthogonal and many lengths zero."""
    limits = Limits(position=(-3.0, 3.0), velocity=5.0, acceleration=50.0, torque=100.0)

    def angle() -> float:
        return float(rng.choice([0.0, np.pi / 2, -np.pi / 2, np.pi]) if right_angles else rng.uniform(-np.pi, np.pi))

    def length() -> float:
        return 0.0 if right_angles and rng.random() < 0.5 else float(rng.uniform(0.1, 0.6) * rng.choice([-1.0, 1.0]))

    joints = tuple(
        Joint(
            name=f"joint_{k}",
            type="prismatic" if rng.random() < 0.3 else "revolute",
            mdh=Mdh(alpha=angle(), d=length(), theta=angle(), r=length()),
            limits=limits,
            rotor_inertia=bool(rng.random() < 0.7),
        )
        for k in range(1, n + 1)
    )
    direction = np.array([0.0, 0.0, -9.81]) if right_angles else rng.normal(size=3)
    return RobotConfig(
        schema="armident/robot/1",
        name="random",
        gravity=tuple(float(g) for g in direction),
        joints=joints,
        transmission=tuple(tuple(float(i == j) for j in range(n)) for i in range(n)),
    )


def random_parameters(model: ArmModel, rng: np.random.Generator, friction: bool = False) -> Floats:
    """Standard parameters of a physical arm: each link a box of a few kilograms somewhere near its frame."""
    theta = np.zeros(len(model.names))
    for j in range(model.n):
        mass = rng.uniform(0.5, 5.0)
        lever = rng.uniform(-0.2, 0.2, 3)
        axes, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        sides = rng.uniform(0.05, 0.3, 3) ** 2 / 12
        central = mass * axes @ np.diag(sides.sum() - sides) @ axes.T
        shift = mass * (lever @ lever * np.eye(3) - np.outer(lever, lever))
        inertia = central + shift
        ten = [*inertia[0], inertia[1, 1], inertia[1, 2], inertia[2, 2], *(mass * lever), mass]
        theta[model.columns.inertial[j]] = ten
        if model.columns.ia[j] >= 0:
            theta[model.columns.ia[j]] = rng.uniform(0.05, 0.5)
        if friction:
            theta[model.columns.fv[j]] = rng.uniform(0.5, 8.0)
            theta[model.columns.fc[j]] = rng.uniform(0.3, 8.0)
            theta[model.columns.off[j]] = rng.uniform(-0.5, 0.5)
    return theta
