"""Excitation: base parameters that a motion supports, and inertia and gravity of each joint that it determines."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from armident.configs import RobotConfig
from armident.identify.experiment import Experiment
from armident.identify.identification.criteria import IdentificationCriteria
from armident.identify.identification.equations import Prepared
from armident.identify.identification.moving_joints import FARTHEST, MOVE
from armident.identify.identification.result import units
from armident.identify.identification.verdict import Level, Reason, listed
from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.equations import ExperimentEquations, filtered_regressor
from armident.identify.regression.least_squares import RANK_TOLERANCE, column_norms, least_squares
from armident.identify.regression.qr import triangularize
from armident.identify.robot.arm import ArmModel
from armident.identify.signals.decimate import Decimation
from armident.identify.signals.differentiate import Derivatives
from armident.identify.streamed import kept, mapped

POSTURES = 100
"""Postures of the motion, and of the workspace, at which inertia and gravity are examined."""

NEGLIGIBLE = 1e-6
"""Torque per SI unit of a parameter, relative to the greatest of all, below which a motion does not show it."""

NON_NEGATIVE = ("fv", "fc", "ia")
"""First letters of the parameters that cannot be negative: viscous and Coulomb friction, rotor inertia."""

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Support:
    """Base parameters that a motion supports.

    Parameters
    ----------
    moving
        Joints that move (n,).
    supported
        Parameters that can be estimated together (b,). Each includes what the motion cannot separate from it.
    theta, std
        Least-squares estimate of these alone, from the joints that move, and its standard deviations; NaN elsewhere
        (b,), SI.
    """

    moving: Mask
    supported: Mask
    theta: Array
    std: Array

    def determined(self, model: ArmModel, share: float) -> Mask:
        """Return the supported parameters that are precise, and not negative where nature forbids it.

        Parameters
        ----------
        model
            The arm.
        share
            Largest relative standard deviation.

        Returns
        -------
        ndarray
            Mask (b,).
        """
        possible = np.array([not name.startswith(NON_NEGATIVE) for name in model.base.names]) | (self.theta > 0)
        with np.errstate(invalid="ignore"):
            return np.asarray(self.supported & possible & (self.std <= share * np.abs(self.theta)), dtype=np.bool_)

    def sentence(self, model: ArmModel, criteria: IdentificationCriteria) -> str:
        """List the parameters that the motion determines in words, with values if they are few.

        Parameters
        ----------
        model
            The arm.
        criteria
            Limits of the relative standard deviation and of the number of parameters that are listed.
        """
        found = np.flatnonzero(self.determined(model, criteria.max_relative_std))
        limit = f"within {100 * criteria.max_relative_std:.0f} %"
        if not found.size:
            return f"it determines none of the {self.supported.size} base parameters {limit}"
        count = f"it determines {found.size} of {self.supported.size} base parameters {limit}"
        if found.size > criteria.max_listed:
            return count
        unit = units(model)
        values = [f"{model.base.names[k]} = {self.theta[k]:.3g} +- {self.std[k]:.1g} {unit[k]}" for k in found]
        return f"{count}, each with what cannot be separated from it: {listed(values, criteria.max_listed)}"


def examine_support(
    prepared: Prepared,
    blocks: Sequence[ExperimentEquations],
    decimation: Decimation,
    moving: Mask,
    criteria: IdentificationCriteria,
    noise: Sequence[ArModel] | None = None,
) -> Support:
    """Find the base parameters that a motion supports, by rank-revealing QR of the weighted regressor.

    Joints at rest are held exactly still, so that noise and deflection do not count as excitation; their equations are
    left out. Columns are taken in the order of pivoted QR. The subset is the largest leading one in which the standard
    deviation of every parameter changes the torque of its joints by less than ``max_relative_std`` of it.

    Parameters
    ----------
    prepared
        Arm, experiments and derivatives.
    blocks, decimation
        Equations of least squares, and their parallel filter.
    moving
        Joints that move (n,).
    criteria
        Limits.
    noise
        Residual variances of least squares, which weigh the equations; ``None``: the variances of the torques.
    """
    model = prepared.model
    x, y, joint = _moving_rows(prepared, blocks, decimation, moving, noise)
    scale = column_norms(x)
    # Rounding errors, such as that of cos(pi / 2), give columns that no real parameter fills.
    scale = np.where(scale > NEGLIGIBLE * scale.max(), scale, np.inf)
    top = triangularize(x, columns=x.shape[1], scales=(scale,))
    factor, order = linalg.qr(top, mode="r", pivoting=True)
    torque = np.array([np.linalg.norm(y[joint == j]) for j in range(model.n)])
    share = np.stack([np.sum((x[joint == j] / scale) ** 2, axis=0) for j in range(model.n)])
    limit = criteria.max_relative_std * np.sqrt(torque**2 @ share)[order]
    pivots = np.abs(np.diag(factor))
    count = int(np.sum(pivots > RANK_TOLERANCE * max(float(pivots[0]), 1e-300)))
    while count:
        inverse = linalg.solve_triangular(factor[:count, :count], np.eye(count))
        if np.all(np.linalg.norm(inverse, axis=1) <= limit[:count]):
            break
        count -= 1
    supported = np.zeros(x.shape[1], dtype=np.bool_)
    supported[order[:count]] = True
    theta, std = np.full((2, x.shape[1]), np.nan)
    if count:
        chosen = x[:, supported]
        theta[supported] = least_squares(chosen, y)
        rest = y - chosen @ theta[supported]
        variance = float(rest @ rest) / max(y.size - count, 1)
        norms = column_norms(chosen)
        inverse = linalg.solve_triangular(triangularize(chosen, columns=count, scales=(norms,)), np.eye(count))
        std[supported] = np.sqrt(variance) * np.linalg.norm(inverse, axis=1) / norms
    return Support(moving, supported, theta, std)


def excitation_reasons(
    model: ArmModel,
    experiments: Sequence[Experiment],
    support: Support,
    theta: Array,
    covariance: Array,
    criteria: IdentificationCriteria,
) -> list[Reason]:
    """Return a reason if the motion leaves inertia or gravity of a joint undetermined, or a joint at rest.

    Parameters
    ----------
    model
        The arm.
    experiments
        Recordings.
    support
        Parameters that the motion supports.
    theta, covariance
        Base estimate (b,) and its covariance (b, b), SI.
    criteria
        Limits.
    """
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
        parts.append(f"{listed(resting)} {'does' if len(resting) == 1 else 'do'} not move")
    if weak.any():
        shares = [
            f"{names[j]} (inertia +- {_percent(max(inertia[j], anywhere[j]))}, gravity +- {_percent(gravity[j])})"
            for j in np.flatnonzero(weak)
        ]
        parts.append(f"inertia or gravity torque is undetermined at {listed(shares)}")
    message = f"The motion does not determine the whole model: {'; '.join(parts)}; {support.sentence(model, criteria)}"
    level: Level = "unusable" if unknown.sum() > model.n / 2 else "doubtful"
    return [Reason(level, message, MOVE, kind="excitation")]


def motion_postures(experiments: Sequence[Experiment], count: int = POSTURES) -> Array:
    """Postures of the recordings, evenly taken, shape (about ``count``, n), rad or m.

    Parameters
    ----------
    experiments
        Recordings.
    count
        Number of postures.
    """
    every = max(1, sum(e.q.shape[0] for e in experiments) // count)
    return np.concatenate([e.q[::every].copy() for e in experiments])


def workspace_postures(robot: RobotConfig, recorded: Array, count: int = POSTURES) -> Array:
    """Random postures between the position limits, shape (count, n), rad or m; the same in every call.

    Parameters
    ----------
    robot
        Configuration of the robot.
    recorded
        Recorded postures (N, n): their range replaces the limits of an endless joint.
    count
        Number of postures.
    """
    limits = np.array([joint.limits.position for joint in robot.joints], dtype=np.float64).T
    seen = np.stack([recorded.min(axis=0), recorded.max(axis=0)])
    low, high = np.where(np.abs(limits).max(axis=0) < FARTHEST, limits, seen)
    return np.asarray(np.random.default_rng(0).uniform(low, high, (count, robot.n)), dtype=np.float64)


def joint_uncertainty(model: ArmModel, theta: Array, covariance: Array, q: Array) -> tuple[Array, Array]:
    """Uncertainty of inertia and gravity torque of each joint at given postures, without terms.

    Parameters
    ----------
    model
        The arm.
    theta, covariance
        Base estimate (b,) and its covariance (b, b), SI.
    q
        Postures (N, n), rad or m.

    Returns
    -------
    inertia : ndarray
        Relative standard deviation of the diagonal of the mass matrix, median of the postures, (n,).
    gravity : ndarray
        Standard deviation of the gravity torque, mean of the postures, (n,), N m or N.
    """
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


def _moving_rows(
    prepared: Prepared,
    blocks: Sequence[ExperimentEquations],
    decimation: Decimation,
    moving: Mask,
    noise: Sequence[ArModel] | None,
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Regressor (R, b), torques (R,) in residual standard deviations, and joint (R,), of the joints that move."""
    regressors = mapped(lambda b: b.x, blocks)
    if not moving.all():
        blocks = prepared.equations(decimation)
        still = (_held(s, moving) for s in prepared.signals)
        regressors = kept((filtered_regressor(prepared.model, s, decimation) for s in still), like=blocks)
    x, y, joints = [], [], []
    for j in np.flatnonzero(moving).tolist():
        power = np.concatenate([b.y[b.keep[:, j], j] for b in blocks]).var() if noise is None else noise[j].variance
        std = max(float(np.sqrt(power)), 1e-150)
        for block, regressor in zip(blocks, regressors, strict=True):
            rows = block.keep[:, j]
            x.append(regressor[rows, j] / std)
            y.append(block.y[rows, j] / std)
            joints.append(np.full(int(rows.sum()), j))
    return np.concatenate(x), np.concatenate(y), np.concatenate(joints)


def _held(signals: Derivatives, moving: Mask) -> Derivatives:
    """Motion with the joints at rest held at their mean position."""
    q = np.where(moving, signals.q, signals.q.mean(axis=0))
    return replace(signals, q=q, qd=np.where(moving, signals.qd, 0.0), qdd=np.where(moving, signals.qdd, 0.0))


def _percent(share: float) -> str:
    return "over 1000 %" if not share < 10.0 else f"{100 * share:.0f} %"
