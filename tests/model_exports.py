"""Identifications of arms with known parameters, for the export of models."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import RobotConfig
from armident.identify.documents.base import RecordingReference
from armident.identify.documents.identification import IdentificationDocument, parameter
from armident.identify.effects.terms import arm_model
from armident.identify.identification.saved_model import model_of
from armident.identify.model_export.exported_model import ExportedModel, exported_model
from armident.identify.robot.arm import ArmModel
from tests.pinocchio_oracle import random_parameters

Floats = NDArray[np.float64]
Motion = tuple[Floats, Floats, Floats]
"""Positions, velocities and accelerations, (N, n) each."""


def identification_of(robot: RobotConfig, theta: Floats, relative_std: float = 0.01) -> IdentificationDocument:
    """The identification that finds the standard parameters ``theta`` with a relative standard deviation."""
    model = arm_model(robot)
    base = model.base.regroup @ theta
    std = relative_std * np.maximum(np.abs(base), 1e-3)
    entries = [
        parameter(name, value, s, "SI", bool(abs(value) > 1e-3))
        for name, value, s in zip(model.base.names, base, std, strict=True)
    ]
    return IdentificationDocument.model_validate(
        {
            "verdict": "trustworthy",
            "robot": robot.name,
            "configuration": robot.model_dump(mode="json", by_alias=True),
            "recording": RecordingReference(path=None, sha256="0" * 64, sample_rate_hz=1000.0, samples=20_000),
            "method": "idim-ls",
            "options": {},
            "parameters": entries,
            "covariance": np.diag(std**2).tolist(),
            "relative_error_pct": 1.0,
            "relative_error_pct_by_joint": {joint.name: 1.0 for joint in robot.joints},
            "iterations": 1,
            "converged": True,
            "stop_reason": "linear",
            "whiteness": [],
            "noise_model": {},
            "controller": {},
            "timing_s": {},
            "versions": {},
            "warnings": [],
            "sign_smoothing": dict(zip([j.name for j in robot.joints], robot.sign_smoothing.tolist(), strict=True)),
        }
    )


def random_theta(model: ArmModel, seed: int) -> Floats:
    """Standard parameters of a random physical arm with friction, rotors and couplings."""
    theta = random_parameters(model, np.random.default_rng(seed), friction=True)
    theta[model.columns.coupling.ravel()] = np.tile([0.02, 0.4, 0.8], len(model.columns.coupling))
    return theta


def exported(robot: RobotConfig, theta: Floats, *, nearest: bool = False) -> ExportedModel:
    """The exported model of an arm with the standard parameters ``theta``."""
    saved = model_of(identification_of(robot, theta), Path("identification.json"), robot)
    return exported_model(saved, nearest=nearest)


def random_motion(robot: RobotConfig, rng: np.random.Generator, samples: int = 100) -> Motion:
    """Random positions, velocities and accelerations of every joint, (N, n) each."""
    q, qd, qdd = (rng.uniform(-scale, scale, (samples, robot.n)) for scale in (2.5, 3.0, 10.0))
    return q, qd, qdd


def rigid_torque(model: ExportedModel, motion: Motion, *kept: str) -> Floats:
    """Torques (N, n) of the links, and of further kinds of parameters such as ``ia`` or ``fv``."""
    theta = np.where(model.arm.of_links, model.theta, 0.0)
    for k, name in enumerate(model.arm.names):
        if name.startswith(kept):
            theta[k] = model.theta[k]
    return model.arm.inverse_dynamics(theta, *motion)


def relative_error(found: Floats, expected: Floats) -> float:
    """Largest error relative to the largest torque of each joint."""
    return float((np.abs(found - expected).max(axis=0) / np.abs(expected).max(axis=0)).max())


def mujoco_torque(file: Path, motion: Motion, gravity: Floats | None = None) -> Floats:
    """Inverse dynamics (N, n) by MuJoCo, without limits and Coulomb friction, which are constraints there."""
    mujoco = pytest.importorskip("mujoco")
    arm = mujoco.MjModel.from_xml_path(str(file))
    arm.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    if gravity is not None:
        arm.opt.gravity[:] = gravity
    data, rows = mujoco.MjData(arm), []
    for data.qpos[:], data.qvel[:], data.qacc[:] in zip(*motion, strict=True):
        mujoco.mj_inverse(arm, data)
        rows.append(data.qfrc_inverse.copy())
    return np.array(rows)
