"""Identifications of arms with known parameters, for the export of models."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig
from armident.identify.document import IdentificationDocument, RecordingReference, parameter
from armident.identify.effects.terms import arm_model
from armident.identify.model_export.exported_model import ExportedModel, exported_model

Floats = NDArray[np.float64]


def identification_of(
    robot: RobotConfig, theta: Floats, relative_std: float = 0.01, verdict: str = "trustworthy"
) -> IdentificationDocument:
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
            "verdict": verdict,
            "robot": robot.name,
            "recording": RecordingReference(path=None, sha256="0" * 64, sample_rate_hz=1000.0, samples=1000),
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


def exported(robot: RobotConfig, theta: Floats) -> ExportedModel:
    """The exported model of an arm with the standard parameters ``theta``."""
    return exported_model(identification_of(robot, theta), robot, Path("identification.json"))


def random_motion(robot: RobotConfig, rng: np.random.Generator, samples: int = 100) -> tuple[Floats, Floats, Floats]:
    """Random positions, velocities and accelerations of every joint, (N, n) each."""
    q, qd, qdd = (rng.uniform(-scale, scale, (samples, robot.n)) for scale in (2.5, 3.0, 10.0))
    return q, qd, qdd


def rigid_torque(model: ExportedModel, motion: tuple[Floats, Floats, Floats], *kept: str) -> Floats:
    """Torques (N, n) of the links, and of further kinds of parameters such as ``ia`` or ``fv``."""
    theta = np.where(model.arm.of_links, model.theta, 0.0)
    for k, name in enumerate(model.arm.names):
        if name.startswith(kept):
            theta[k] = model.theta[k]
    return model.arm.inverse_dynamics(theta, *motion)


def relative_error(found: Floats, expected: Floats) -> float:
    """Largest error relative to the largest torque of each joint."""
    return float((np.abs(found - expected).max(axis=0) / np.abs(expected).max(axis=0)).max())
