"""Check of the excitation: inertia and gravity of each joint that the motion determines."""

from collections.abc import Sequence

import numpy as np

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.identify.estimators.reason import Level, Reason
from armident.identify.identification.checks.judged import Judged
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.identification.moving_joints import FARTHEST, MOVE
from armident.identify.identification.verdict import enumerated
from armident.identify.robot.arm import ArmModel
from armident.identify.signals.experiments import Experiment

EXAMINED_POSTURES = 100
"""Postures of the motion, and of the workspace, at which inertia and gravity are examined: the standard error of a mean
over 100 is a tenth of its spread between postures."""


def excitation(judged: Judged, criteria: IdentificationCriteria) -> list[Reason]:
    """Return a reason if the motion leaves inertia or gravity of a joint undetermined, or a joint at rest."""
    model, experiments, support = judged.prepared.model, judged.prepared.experiments, judged.support
    theta, covariance = judged.found.estimate.theta, judged.found.estimate.covariance
    names = [joint.name for joint in model.robot.joints]
    q = motion_postures(experiments)
    inertia, _ = joint_uncertainty(model, theta, covariance, q)
    anywhere, gravity = joint_uncertainty(model, theta, covariance, workspace_postures(model.robot, q))
    power = sum(np.einsum("kj,kj->j", e.tau, e.tau) for e in experiments)
    torque = np.sqrt(power / sum(e.tau.shape[0] for e in experiments))
    gravity = gravity / np.maximum(torque, 1e-300)
    weak = support.moving & (
        (np.maximum(inertia, anywhere) > criteria.max_inertia_std) | (gravity > criteria.max_gravity_std)
    )
    if not weak.any() and support.moving.all():
        return []
    unknown = ~support.moving | ((inertia > criteria.max_inertia_std) & (gravity > criteria.max_gravity_std))
    parts = []
    if not support.moving.all():
        resting = [name for name, moves in zip(names, support.moving, strict=True) if not moves]
        parts.append(f"{enumerated(resting)} {'does' if len(resting) == 1 else 'do'} not move")
    if weak.any():
        shares = [
            f"{names[j]} (inertia +- {_percent(max(inertia[j], anywhere[j]))}, gravity +- {_percent(gravity[j])})"
            for j in np.flatnonzero(weak)
        ]
        parts.append(f"inertia or gravity torque is undetermined at {enumerated(shares)}")
    message = f"The motion does not determine the whole model: {'; '.join(parts)}; {support.sentence(model, criteria)}"
    level: Level = "unusable" if unknown.sum() > model.n / 2 else "doubtful"
    return [Reason(level, message, MOVE, kind="excitation")]


def motion_postures(experiments: Sequence[Experiment], count: int = EXAMINED_POSTURES) -> Array:
    """Postures of the recordings, evenly taken, shape (about ``count``, n), rad or m."""
    every = max(1, sum(e.q.shape[0] for e in experiments) // count)
    return np.concatenate([e.q[::every].copy() for e in experiments])


def workspace_postures(robot: RobotConfig, recorded: Array, count: int = EXAMINED_POSTURES) -> Array:
    """Random postures (count, n) between the limits, rad or m, always the same; endless joints: ``recorded`` range."""
    limits = np.array([joint.limits.position for joint in robot.joints], dtype=np.float64).T
    seen = np.stack([recorded.min(axis=0), recorded.max(axis=0)])
    low, high = np.where(np.abs(limits).max(axis=0) < FARTHEST, limits, seen)
    return np.asarray(np.random.default_rng(0).uniform(low, high, (count, robot.n)), dtype=np.float64)


def joint_uncertainty(model: ArmModel, theta: Array, covariance: Array, q: Array) -> tuple[Array, Array]:
    """Relative uncertainty of inertia, and uncertainty of gravity torque, N m or N, (n,), at postures (N, n)."""
    rigid = model.base.b - model.e
    if not np.isfinite(covariance).all():
        return np.full(model.n, np.inf), np.full(model.n, np.inf)
    c, still = covariance[:rigid, :rigid], np.zeros_like(q)
    at_rest = model.rigid_regressor(q, still, still)
    # A position-independent force cannot be told from gravity at rest: offsets belong to neither.
    gravity = np.sqrt(np.maximum(np.einsum("kjb,bc,kjc->kj", at_rest, c, at_rest), 0.0)).mean(axis=0)
    inertia = np.empty(model.n)
    for j in range(model.n):
        unit = still.copy()
        unit[:, j] = 1.0
        row = (model.rigid_regressor(q, still, unit) - at_rest)[:, j]
        std = np.sqrt(np.maximum(np.einsum("kb,bc,kc->k", row, c, row), 0.0))
        inertia[j] = np.median(std / np.maximum(np.abs(row @ theta[:rigid]), 1e-300))
    return inertia, np.asarray(gravity, dtype=np.float64)


def _percent(share: float) -> str:
    return "over 1000 %" if not share < 10.0 else f"{100 * share:.0f} %"
