"""Screening of effects on recorded torques, such as delays, over values too large for a first-order expansion."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy import optimize

from armident.arrays import Array
from armident.identify.diagnosis.candidates import Candidate, ColumnCache
from armident.identify.diagnosis.regression import IvFit
from armident.identify.diagnosis.study import NOISE_ORDER, PERTURBATION
from armident.identify.effects.drive import Correction, motor_limit
from armident.identify.regression.ar_noise import ar_models
from armident.identify.regression.whitening import whitened, whitened_series

Look = tuple[float, float]
"""Largest value of a criterion, and the parameter there."""

REFINEMENTS = 10
"""Evaluations of the refinement between two values of the grid."""


def screened_correction(fit: IvFit, candidate: Candidate, column_cache: ColumnCache) -> tuple[Look, Look]:
    """Two looks at an effect on the recorded torque of a motor: a score statistic, and twice a gain of log-likelihood.

    The score statistic is the reduction of the squared whitened residual by the change of the predicted torque at the
    simulated, noise-free motion. The likelihood is that of the corrected torques: for effects so large that predicted
    torque or simulated motion are far from the true ones. It is no evidence: smoothing favours low-pass filtered noise.
    """
    study, effect, motor = fit.study, candidate.effect, candidate.place.joint
    assert isinstance(effect, Correction)
    limit = motor_limit(study.robot, motor)
    shaft = np.linalg.inv(study.robot.transmission_matrix)[:, motor]
    recorded = np.concatenate([s.torque @ shaft for s in study.train])
    grid = [float(value) for value in effect.values_to_test(recorded, study.dt, limit)]
    none = float(_likelihoods(fit, effect, motor, limit, [0.0])[0])
    return (
        _largest(fit, lambda values: _at_simulated(fit, effect, motor, limit, column_cache, values), grid),
        _largest(fit, lambda values: _likelihoods(fit, effect, motor, limit, values) - none, grid),
    )


def _at_simulated(
    fit: IvFit, effect: Correction, motor: int, limit: float, column_cache: ColumnCache, values: Sequence[float]
) -> Array:
    """Reduction of the squared whitened residual by the change of the predicted torque at each value, (k,)."""
    study, transmission = fit.study, fit.study.robot.transmission_matrix[motor]
    joints, changes = np.flatnonzero(transmission), []
    for s in study.train:
        motion = column_cache.motion(s, "simulated")
        torque = motion.motor_torque[motion.lead :, motor]
        change = torque[:, None] - _true(effect, torque, values, study.dt, limit)
        at_joints = study.decimation(change)[:, None] * transmission[joints][:, None]
        changes.append(at_joints * s.weights[:, joints, None])
    series = whitened_series(changes, [fit.noise[j] for j in joints])
    columns = [(int(j), np.concatenate(parts)) for j, parts in zip(joints, series, strict=True)]
    gram, score = fit.regression.orthogonal_products(columns, len(values))
    return np.asarray(2.0 * score[:, 0] - gram[:, 0, 0])


def _likelihoods(fit: IvFit, effect: Correction, motor: int, limit: float, values: Sequence[float]) -> Array:
    """Twice the log-likelihood (k,) of the torques corrected for each value, without a constant.

    Parameters and the noise model of the motor's joint are estimated again: a strong correction changes its spectrum.
    """
    study, transmission = fit.study, fit.study.robot.transmission_matrix
    own = [s.torque @ np.linalg.inv(transmission)[:, motor] for s in study.train]
    size = PERTURBATION * float(np.concatenate(own).std())
    changes, disturbed = [], []
    for torque, s in zip(own, study.train, strict=True):
        noise = size * np.random.default_rng(0).standard_normal(torque.size)
        true = _true(effect, torque, values, study.dt, limit)
        moved = _true(effect, torque + noise, values, study.dt, limit) - true
        both = study.decimation(np.hstack([true - torque[:, None], moved]))
        at_joints = both[:, None, : len(values)] * transmission[motor][:, None]
        changes.append(at_joints * s.weights[:, :, None])
        disturbed.append(both[:, len(values) :])
    left = fit.residual[:, None] + fit.regression.without_model(whitened(changes, fit.noise))
    rows = fit.regression.rows_of[int(np.argmax(np.abs(transmission[motor])))]
    elsewhere = np.sum(left**2, axis=0) - np.sum(left[rows] ** 2, axis=0)
    # By the theorem of Szegoe, see `log_volume`: noise that a correction makes smaller is no better model.
    ratio = np.log(_innovations([left[rows]]) / _innovations(disturbed))
    return np.asarray(-elsewhere - (rows.stop - rows.start) * ratio)


def _true(effect: Correction, torque: Array, values: Sequence[float], dt: float, limit: float) -> Array:
    """True torques of a recorded one at each value, (N, k)."""
    return np.stack([effect.true_torque(torque, value, dt, limit) for value in values], axis=1)


def _innovations(parts: Sequence[Array]) -> Array:
    """Innovation variances of the noise in each column, (k,)."""
    return np.array([ar.variance for ar in ar_models(parts, NOISE_ORDER)])


def _largest(fit: IvFit, criterion: Callable[[Sequence[float]], Array], grid: Sequence[float]) -> Look:
    """Look at a criterion, twice a gain of log-likelihood: best of the grid, refined if it promises a finding."""
    tried = criterion(grid)
    most, best = float(tried.max()), grid[int(np.argmax(tried))]
    if most < 2.0 * fit.study.criteria.promising * fit.study.criteria.needed_gain(1):
        return most, best
    near = [abs(value) for value in grid if value * best > 0.0]
    k, side = near.index(abs(best)), float(np.sign(best))
    low, high = near[max(k - 1, 0)], near[min(k + 1, len(near) - 1)]
    found = optimize.minimize_scalar(
        lambda x: -float(criterion([side * float(np.exp(x))])[0]), bounds=(np.log(low), np.log(high)),
        method="bounded", options={"maxiter": REFINEMENTS},
    )  # fmt: skip
    return max((most, best), (-float(found.fun), side * float(np.exp(found.x))))
