"""The stacked regression ``y = X theta + e`` of all joints and experiments, and how it is solved."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, signal

from configs import DataError
from identify.estimators.noise import WHITE, ArModel, fit_ar, lagged_sums
from identify.model.arm import ArmModel
from identify.signals.decimate import Decimation
from identify.signals.differentiate import Derivatives

RANK_TOLERANCE = 1e-10
"""Smallest singular value of the column-normalised regressor, relative to the greatest, that counts as excited."""

_CHUNK_ROWS = 4096


@dataclass(frozen=True)
class Block:
    """One experiment after the parallel filter.

    Parameters
    ----------
    y
        Torques, shape (M, n).
    x
        Regressor at measured signals, shape (M, n, b).
    keep
        Equations to use, shape (M, n).
    t
        Instants, s, shape (M,).
    """

    y: NDArray[np.float64]
    x: NDArray[np.float64]
    keep: NDArray[np.bool_]
    t: NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """What every estimator returns.

    Parameters
    ----------
    theta, covariance
        Base parameters (b,) and their covariance (b, b).
    noise
        Noise model of each joint; its variance is the sigma_j^2 of 2.25.
    residuals
        Whitened residuals of each joint, one array per experiment, in standard deviations.
    """

    theta: NDArray[np.float64]
    covariance: NDArray[np.float64]
    noise: tuple[ArModel, ...]
    residuals: tuple[tuple[NDArray[np.float64], ...], ...]
    iterations: int = 1
    converged: bool = True
    stop_reason: str = "linear in the parameters: solved in one step"
    warnings: tuple[str, ...] = ()

    @property
    def std(self) -> NDArray[np.float64]:
        """Standard deviations, shape (b,)."""
        return np.sqrt(np.diag(self.covariance))


def filtered_regressor(
    model: ArmModel, signals: Derivatives, decimation: Decimation, *, sharp_sign: bool = False
) -> NDArray[np.float64]:
    """Base regressor after the parallel filter, shape (M, n, b), chunk by chunk so that memory stays small."""
    samples = signals.q.shape[0]
    count = decimation.count(samples)
    rows = max(1, _CHUNK_ROWS // decimation.factor)
    parts = []
    for first in range(0, count, rows):
        last = min(first + rows, count)
        span = slice(first * decimation.factor, (last - 1) * decimation.factor + decimation.taps.size)
        phi = model.base_regressor(signals.q[span], signals.qd[span], signals.qdd[span], sharp_sign=sharp_sign)
        parts.append(decimation(phi))
    if not parts:
        decimation(signals.q)
    return np.concatenate(parts)


def weighted_rows(
    values: Sequence[NDArray[np.float64]], keep: Sequence[NDArray[np.bool_]], noise: Sequence[ArModel]
) -> NDArray[np.float64]:
    """Stack (M, n) or (M, n, b) joint by joint as in 2.21, each joint whitened by its noise model."""
    rows = []
    for j, ar in enumerate(noise):
        for value, kept in zip(values, keep, strict=True):
            rows.append(ar.whiten(value[:, j])[kept[ar.order :, j]])
    return np.concatenate(rows)


def residuals(blocks: Sequence[Block], theta: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """``tau - phi theta`` of each experiment, shape (M, n)."""
    return [block.y - block.x @ theta for block in blocks]


def joint_variances(blocks: Sequence[Block], theta: NDArray[np.float64]) -> list[ArModel]:
    """Serially uncorrelated noise with the residual variance of each joint (2.25, 2.26).

    The degrees of freedom spent on the parameters are shared by the joints in proportion to their equations.
    """
    n = blocks[0].y.shape[1]
    errors = residuals(blocks, theta)
    total = sum(int(b.keep.sum()) for b in blocks)
    free = max(1 - theta.size / total, 1.0 / total)
    models = []
    for j in range(n):
        e = np.concatenate([r[b.keep[:, j], j] for r, b in zip(errors, blocks, strict=True)])
        models.append(ArModel(np.empty(0), max(float(e @ e) / (e.size * free), 1e-300), 0.0))
    return models


def noise_models(
    blocks: Sequence[Block], theta: NDArray[np.float64], covariance: NDArray[np.float64], max_order: int
) -> list[ArModel]:
    """AR model of each joint's noise from the residuals (6.21 to 6.25).

    The residuals lack what the parameters have absorbed, and they absorb the low frequencies, where the motion is and
    the precision is decided: ``cov(e - X d) = Omega - X C X'`` for an efficient estimate of covariance C. The
    autocovariances of ``X C X'`` are given back; without, standard deviations of the virtual TX40 come
    out 9 % too small (median, 20 seeds).
    """
    errors = residuals(blocks, theta)
    factor = _square_root(covariance)
    models = []
    for j in range(blocks[0].y.shape[1]):
        series = [e[:, j] for e in errors]
        longest = min(max_order, min(s.size for s in series) - 1)
        absorbed = sum((lagged_sums(b.x[:, j] @ factor, longest) for b in blocks), np.zeros(longest + 1))
        models.append(fit_ar(series, longest, absorbed))
    return models


def _square_root(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """``F`` with ``F F' = covariance``, also where rounding has taken its definiteness."""
    scale = np.sqrt(np.diag(covariance))
    values, vectors = linalg.eigh(covariance / np.outer(scale, scale))
    factor: NDArray[np.float64] = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return factor


def whitened_residuals(
    blocks: Sequence[Block], theta: NDArray[np.float64], noise: Sequence[ArModel]
) -> tuple[tuple[NDArray[np.float64], ...], ...]:
    """Residuals of each joint in standard deviations of its noise model, one array per experiment."""
    errors = residuals(blocks, theta)
    return tuple(
        tuple(ar.whiten(e[:, j])[b.keep[ar.order :, j]] for e, b in zip(errors, blocks, strict=True))
        for j, ar in enumerate(noise)
    )


def least_squares(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve ``min |y - x theta|`` by QR of the column-normalised regressor."""
    scale = np.linalg.norm(x, axis=0)
    q, r = linalg.qr(x / scale, mode="economic")
    theta: NDArray[np.float64] = linalg.solve_triangular(r, q.T @ y) / scale
    return theta


def instrumental_variable(
    z: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Solve ``z' (y - x theta) = 0`` (2.33) through the QR factors of ``z``: no product ``z' x`` is formed."""
    q, _ = linalg.qr(z / np.linalg.norm(z, axis=0), mode="economic")
    scale = np.linalg.norm(x, axis=0)
    theta: NDArray[np.float64] = linalg.solve(q.T @ (x / scale), q.T @ y) / scale
    return theta


def inverse_gram(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """``(x' x)^-1`` from the triangular factor of ``x``."""
    scale = np.linalg.norm(x, axis=0)
    (r,) = linalg.qr(x / scale, mode="r")
    inverse = linalg.solve_triangular(r[: x.shape[1]], np.eye(x.shape[1])) / scale[:, None]
    gram: NDArray[np.float64] = inverse @ inverse.T
    return gram


def iv_covariance(z: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """``(z' x)^-1 z' z (x' z)^-1`` for whitened rows (4.34).

    It equals ``(z' z)^-1`` (2.34, 6.31) where the simulator is exact and stays right where the controller is only
    approximate, as an identified impulse response is.
    """
    zs, xs = np.linalg.norm(z, axis=0), np.linalg.norm(x, axis=0)
    q, _ = linalg.qr(z / zs, mode="economic")
    inverse = linalg.inv(q.T @ (x / xs)) / xs[:, None]
    covariance: NDArray[np.float64] = inverse @ inverse.T
    return covariance


def serial_covariance(
    zeta: Sequence[NDArray[np.float64]],
    x: Sequence[NDArray[np.float64]],
    keep: Sequence[NDArray[np.bool_]],
    weights: Sequence[ArModel],
    noise: Sequence[ArModel],
) -> NDArray[np.float64]:
    """Covariance of an IV estimate with weights 2.24 whose residuals are serially correlated.

    ``A = (Z' W X)^-1 Z' W`` maps the noise to the estimate and ``A Omega A'`` is its covariance, with ``Omega`` given
    by the AR model of each joint: ``Z' W Omega W Z`` is the Gram matrix of ``H' W Z``.
    """
    z = weighted_rows(zeta, keep, weights)
    zs = np.linalg.norm(z, axis=0)
    bread = linalg.inv((z / zs).T @ weighted_rows(x, keep, weights))
    meat = np.zeros((zs.size, zs.size))
    for j, (weight, ar) in enumerate(zip(weights, noise, strict=True)):
        for value, kept in zip(zeta, keep, strict=True):
            rows = value[:, j] * kept[:, j, None] / (weight.variance * zs)
            coloured = signal.lfilter([np.sqrt(ar.variance)], np.append(1.0, ar.coefficients), rows[::-1], axis=0)
            meat += coloured.T @ coloured
    covariance: NDArray[np.float64] = bread @ meat @ bread.T
    return covariance


def require_excitation(x: NDArray[np.float64], names: Sequence[str]) -> int:
    """Rank of the stacked regressor; refuses a recording that leaves parameters undetermined.

    Raises
    ------
    DataError
        Naming the parameters that the motion did not excite.
    """
    scale = np.linalg.norm(x, axis=0)
    dead = [name for name, s in zip(names, scale, strict=True) if s == 0]
    if not dead:
        _, s, vt = np.linalg.svd(x / scale, full_matrices=False)
        rank = int(np.sum(s > RANK_TOLERANCE * s[0]))
        if rank == len(names):
            return rank
        weak = np.abs(vt[rank:]).max(axis=0)
        dead = [names[k] for k in np.argsort(-weak)[: len(names) - rank + 2] if weak[k] > 0.1]
    raise DataError(
        f"the motion does not determine all {len(names)} base parameters; not excited: {', '.join(sorted(dead))}"
    )


def iterate(
    step: Callable[[NDArray[np.float64], int], tuple[NDArray[np.float64], float]],
    start: NDArray[np.float64],
    iterations: int,
    tolerance: float,
) -> tuple[NDArray[np.float64], int, bool, str]:
    """Repeat ``step(theta, k) -> (theta, residual norm)`` until neither changes by more than ``tolerance``.

    Returns
    -------
    tuple
        Last theta, iterations done, whether it converged, and which rule ended it.
    """
    theta, norm = start, np.inf
    for k in range(1, iterations + 1):
        new, new_norm = step(theta, k)
        change = float(np.linalg.norm(new - theta)) / max(float(np.linalg.norm(new)), 1e-300)
        drift = abs(new_norm - norm) / max(new_norm, 1e-300)
        theta, norm = new, new_norm
        if change < tolerance and drift < tolerance:
            return theta, k, True, f"theta changed by {change:.1e} and the residual norm by {drift:.1e} (relative)"
    return theta, iterations, False, f"stopped after {iterations} iterations"


def unweighted(n: int) -> list[ArModel]:
    """The initial noise models of n joints."""
    return [WHITE] * n
