"""The regression behind a diagnosis: training and held-out equations, whitened joint by joint."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from configs import DataError, RobotConfig
from identify.discrepancy.catalogue import JointSignals, effect_names, effect_regressor, joint_signals
from identify.estimators.noise import ArModel, fit_ar
from identify.estimators.regression import (
    Block,
    filtered_regressor,
    joint_variances,
    require_excitation,
    residuals,
    weighted_rows,
)
from identify.experiment import Experiment
from identify.model.arm import ArmModel
from identify.signals.decimate import Decimation, design
from identify.signals.differentiate import Derivatives, Method, differentiate

Array = NDArray[np.float64]

HELD_OUT_SHARE = 0.35
"""Last part of every experiment kept for judging, where no other recording is given for it."""
CUTOFF_OF_BANDWIDTH = 4.0
"""Frequency up to which model and data are compared, as a multiple of the closed-loop bandwidth."""
UNKNOWN_BANDWIDTH_HZ = 10.0
"""Closed-loop bandwidth assumed of an arm whose configuration says none."""
MAX_AR_ORDER = 30
REWEIGHTINGS = 3
"""Passes between the parameters and the noise models; the third changes neither visibly."""


@dataclass(frozen=True)
class Piece:
    """One uninterrupted stretch of motion, SI on the joint side.

    ``signals`` (N, n) are smoothed positions, velocities and accelerations, ``tau`` (N, n) the torques aligned
    with them.
    """

    signals: Derivatives
    tau: Array
    block: Block


@dataclass(frozen=True)
class Problem:
    """Training and held-out equations of a model, with the noise model of each joint (thesis section 6.1.3)."""

    robot: RobotConfig
    model: ArmModel
    names: tuple[str, ...]
    decimation: Decimation
    train: tuple[Piece, ...]
    held_out: tuple[Piece, ...]


@dataclass(frozen=True)
class Fit:
    """Generalised least squares of a problem.

    Parameters
    ----------
    theta
        Base parameters and those of the effects, shape (p,).
    noise
        AR model of each joint.
    q, r
        QR factors of the whitened, column-scaled training regressor; ``scale`` (p,) undoes the scaling.
    residual
        Whitened training residual, shape (rows,).
    held_x, held_residual
        Whitened held-out regressor (rows, p) and residual (rows,).
    """

    theta: Array
    noise: tuple[ArModel, ...]
    q: Array
    r: Array
    scale: Array
    residual: Array
    held_x: Array
    held_residual: Array

    def solve(self, rows: Array) -> Array:
        """Parameters (p, k) whose predictions are closest to whitened training rows (rows, k)."""
        solution: Array = linalg.solve_triangular(self.r, self.q.T @ rows) / self.scale[:, None]
        return solution

    def covariance(self) -> Array:
        """Covariance (p, p) of the parameters."""
        inverse = linalg.solve_triangular(self.r, np.eye(self.r.shape[0])) / self.scale[:, None]
        return np.asarray(inverse @ inverse.T, dtype=np.float64)

    def held_spread(self, delta: Array) -> float:
        """``|delta' X_h|`` weighed with the covariance of theta: what the training noise adds to a projection."""
        half = linalg.solve_triangular(self.r, (delta @ self.held_x) / self.scale, trans="T")
        return float(half @ half)


def build_problem(
    training: Sequence[Experiment],
    validation: Sequence[Experiment],
    robot: RobotConfig,
    derivatives: Method = "irwsm",
) -> Problem:
    """Differentiate, split and filter the experiments.

    Parameters
    ----------
    training
        Experiments to fit; without ``validation`` their last part is held out.
    validation
        Experiments to judge by, or none.

    Raises
    ------
    DataError
        If the motion is too short or does not determine the parameters of the model.
    """
    model = ArmModel.from_config(robot)
    dt = training[0].dt
    if any(abs(e.dt - dt) > 1e-9 for e in (*training, *validation)):
        raise DataError("the recordings have different sampling rates; diagnose them separately")
    bandwidth = robot.bandwidth_hz or UNKNOWN_BANDWIDTH_HZ
    decimation = design(dt, min(CUTOFF_OF_BANDWIDTH * bandwidth, 0.25 / dt))
    train, held = [], []
    for experiment in training:
        whole = _derived(experiment, derivatives, bandwidth)
        if validation:
            train.append(_piece(whole, slice(0, None), model, decimation, dt))
        else:
            cut = int((1 - HELD_OUT_SHARE) * whole[1].shape[0])
            train.append(_piece(whole, slice(0, cut), model, decimation, dt))
            held.append(_piece(whole, slice(cut, None), model, decimation, dt))
    for experiment in validation:
        held.append(_piece(_derived(experiment, derivatives, bandwidth), slice(0, None), model, decimation, dt))
    return Problem(robot, model, tuple(model.base.names), decimation, tuple(train), tuple(held))


def with_effects(problem: Problem, robot: RobotConfig) -> Problem:
    """Build the same problem with the effects of ``robot`` as further columns."""

    def extended(piece: Piece) -> Piece:
        extra = problem.decimation(effect_regressor(robot, piece.signals.q, piece.signals.qd))
        base = piece.block.x[:, :, : problem.model.base.b]
        block = Block(piece.block.y, np.concatenate([base, extra], axis=2), piece.block.keep, piece.block.t)
        return Piece(piece.signals, piece.tau, block)

    names = (*problem.model.base.names, *effect_names(robot))
    train, held = tuple(map(extended, problem.train)), tuple(map(extended, problem.held_out))
    return Problem(robot, problem.model, names, problem.decimation, train, held)


def fit(problem: Problem) -> Fit:
    """Alternate generalised least squares and AR noise models, then keep the factors for the tests.

    Raises
    ------
    DataError
        If the training motion leaves parameters undetermined.
    """
    blocks = [piece.block for piece in problem.train]
    x, y, keep = [b.x for b in blocks], [b.y for b in blocks], [b.keep for b in blocks]
    flat = np.concatenate([b.reshape(-1, b.shape[-1]) for b in x])
    require_excitation(flat, problem.names)
    theta = np.linalg.lstsq(flat, np.concatenate([b.reshape(-1) for b in y]), rcond=None)[0]
    noise: list[ArModel] = joint_variances(blocks, theta)
    for _ in range(REWEIGHTINGS):
        rows, target = weighted_rows(x, keep, noise), weighted_rows(y, keep, noise)
        scale = np.linalg.norm(rows, axis=0)
        q, r = linalg.qr(rows / scale, mode="economic")
        theta = linalg.solve_triangular(r, q.T @ target) / scale
        residual = target - rows @ theta
        final = noise
        noise = _noise_models(blocks, theta)
    held = [piece.block for piece in problem.held_out]
    held_x = weighted_rows([b.x for b in held], [b.keep for b in held], final)
    held_y = weighted_rows([b.y for b in held], [b.keep for b in held], final)
    return Fit(theta, tuple(final), q, r, scale, residual, held_x, held_y - held_x @ theta)


def joint_columns(
    problem: Problem, joint: int, columns: Callable[[JointSignals], Array], *, held_out: bool
) -> list[Array]:
    """Filtered columns (M, k) that a function of the signals of one joint adds to that joint's equations."""
    pieces = problem.held_out if held_out else problem.train
    return [
        problem.decimation(columns(joint_signals(problem.robot, joint, piece.signals.q, piece.signals.qd, "smooth")))
        for piece in pieces
    ]


def whitened_rows(
    problem: Problem, noise: Sequence[ArModel], joint: int, columns: list[Array], *, held_out: bool
) -> Array:
    """Columns of one joint as rows of the whitened stack: zero in the equations of the other joints."""
    pieces = problem.held_out if held_out else problem.train
    rows = []
    for j, ar in enumerate(noise):
        for piece, column in zip(pieces, columns, strict=True):
            kept = piece.block.keep[ar.order :, j]
            white = ar.whiten(column) if j == joint else np.zeros((kept.size, column.shape[1]))
            rows.append(white[kept])
    return np.concatenate(rows)


def relative_errors(problem: Problem, theta: Array, *, held_out: bool) -> tuple[float, list[float]]:
    """Relative torque error in percent, of all joints together and of each, after the parallel filter."""
    pieces = problem.held_out if held_out else problem.train
    error = np.concatenate([piece.block.y - piece.block.x @ theta for piece in pieces])
    torque = np.concatenate([piece.block.y for piece in pieces])
    each = 100 * np.linalg.norm(error, axis=0) / np.maximum(np.linalg.norm(torque, axis=0), 1e-300)
    return 100 * float(np.linalg.norm(error) / np.linalg.norm(torque)), [float(v) for v in each]


def _noise_models(blocks: Sequence[Block], theta: Array) -> list[ArModel]:
    """AR model of each joint's residual (6.21 to 6.25), its variance corrected for the parameters estimated."""
    errors = residuals(blocks, theta)
    free = 1 - theta.size / sum(block.y.size for block in blocks)
    models = [fit_ar([e[:, j] for e in errors], MAX_AR_ORDER) for j in range(blocks[0].y.shape[1])]
    return [ArModel(ar.coefficients, ar.variance / free, ar.aic) for ar in models]


def _derived(experiment: Experiment, method: Method, bandwidth: float) -> tuple[Derivatives, Array]:
    # A torque is held from one sample to the next: the mean of two neighbours sits at the sample between them.
    tau = experiment.tau.copy()
    tau[1:] = (experiment.tau[1:] + experiment.tau[:-1]) / 2
    return differentiate(experiment.q, experiment.dt, method, bandwidth_hz=bandwidth), tau


def _piece(whole: tuple[Derivatives, Array], span: slice, model: ArmModel, decimation: Decimation, dt: float) -> Piece:
    derived, tau = whole[0], np.ascontiguousarray(whole[1][span])
    signals = Derivatives(
        np.ascontiguousarray(derived.q[span]),
        np.ascontiguousarray(derived.qd[span]),
        np.ascontiguousarray(derived.qdd[span]),
        None,
    )
    y = decimation(tau)
    x = filtered_regressor(model, signals, decimation)
    t = np.asarray(decimation.instants(tau.shape[0]) * dt, dtype=np.float64)
    return Piece(signals, tau, Block(y, x, np.ones(y.shape, dtype=bool), t))
