"""Visibility of an effect: torque residual of the rigid model with and without it, from the truth's own signals."""

from typing import Any

import numpy as np
import pinocchio
from numpy.typing import NDArray

from armident.configs import RobotConfig

Floats = NDArray[np.float64]
pin: Any = pinocchio

SAMPLES = 900
"""Samples of a recording from which the rigid model is fitted."""
STANDSTILL = 0.02
"""Speed below which the equation of a joint is left out, over its largest speed: dry friction is undefined there."""


def rigid_residual(robot: RobotConfig, q: Floats, qd: Floats, qdd: Floats, torque: Floats, smoothing: Floats) -> Floats:
    """Residual of the rigid model by joint, fitted by weighted least squares.

    The model has the inertial parameters of all links and, by joint, rotor inertia, viscous and dry friction and an
    offset. Each joint's equations are weighted by its residual of a first fit.

    ``q``, ``qd``, ``qdd``: motion, shape (M, n). ``torque``: recorded torque, N m or N, shape (M, n). ``smoothing``:
    velocity scale of the sign of dry friction by joint; 0 for a sharp one, shape (n,). Returns the root mean square of
    the residual, N m or N, shape (n,).
    """
    rows = np.unique(np.linspace(0, len(q) - 1, SAMPLES).astype(np.int64))
    q, qd, qdd, torque = q[rows], qd[rows], qdd[rows], torque[rows]
    n = robot.n
    scale = np.where(smoothing > 0.0, smoothing, 1.0)
    direction = np.where(smoothing > 0.0, np.tanh(qd / scale), np.sign(qd))
    X = _regressor(robot, q, qd, qdd, direction)
    moves = np.abs(qd) > STANDSTILL * np.abs(qd).max(axis=0)
    weights = 1.0 / np.maximum(np.std(torque, axis=0), 1e-12)
    residual, rms = np.zeros_like(torque), np.zeros(n)
    for _ in range(3):
        flat = (X * weights[:, None])[moves]
        size = np.maximum(np.linalg.norm(flat, axis=0), 1e-12)
        solution = np.linalg.lstsq(flat / size, (torque * weights)[moves], rcond=1e-9)[0]
        residual = np.where(moves, torque - X @ (solution / size), 0.0)
        rms = np.sqrt((residual**2).sum(axis=0) / np.maximum(moves.sum(axis=0), 1))
        weights = 1.0 / np.maximum(rms, 1e-6 / weights)
    return rms


def _regressor(robot: RobotConfig, q: Floats, qd: Floats, qdd: Floats, direction: Floats) -> Floats:
    """Regressor of the rigid model with the sign of dry friction, shape (M, n, P)."""
    model = configured_model(robot)
    data = model.createData()
    n, M = robot.n, len(q)
    out = np.zeros((M, n, 14 * n))
    for k in range(M):
        out[k, :, : 10 * n] = pin.computeJointTorqueRegressor(model, data, q[k], qd[k], qdd[k])
    for j, joint in enumerate(robot.joints):
        columns = (qdd[:, j] * joint.rotor_inertia, qd[:, j], direction[:, j], np.ones(M))
        for c, column in enumerate(columns):
            out[:, j, 10 * n + 4 * j + c] = column
    return out


def configured_model(robot: RobotConfig) -> Any:
    """Pinocchio model of a robot configuration, with unit bodies."""
    model = pin.Model()
    parent = 0
    for joint in robot.joints:
        mdh = joint.mdh
        about_x = pin.SE3(pin.utils.rotate("x", mdh.alpha), np.zeros(3)) * pin.SE3(np.eye(3), np.array([mdh.d, 0, 0.0]))
        about_z = pin.SE3(pin.utils.rotate("z", mdh.theta), np.array([0.0, 0.0, mdh.r]))
        kind = pin.JointModelRZ() if joint.type == "revolute" else pin.JointModelPZ()
        parent = model.addJoint(parent, kind, about_x * about_z, joint.name)
    model.gravity.linear = np.array(robot.gravity)
    return model
