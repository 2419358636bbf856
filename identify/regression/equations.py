"""The stacked regression ``y = X theta + e`` of all joints and experiments, and its solution (thesis 2.3)."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, signal

from armident.configs import DataError
from armident.identify.regression.ar_noise import WHITE, ArModel, fit_ar, lagged_sums
from armident.identify.regression.tall_qr import triangularize
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.kernels import fill_regressor
from armident.identify.signals.decimate import Decimation
from armident.identify.signals.differentiate import Derivatives

ITERATIONS = 20
"""Most iterations of an iterative estimator."""

TOLERANCE = 1e-4
"""Relative change of theta and of the residual norm that ends the iterations; far below one standard deviation."""

EXACT = 1e-10
"""Relative change of theta that ends the iterations whatever the residual does: data without noise leave rounding."""

MAX_AR_ORDER = 60
"""Highest order tried for the noise models."""

COVARIANCE_PASSES = 3
"""Noise model and covariance need each other; the third pass changes standard deviations by less than 1 %."""

LONG_SERIES, SAMPLED, EVERY = 16_384, 128, 4
"""Rows of a long series; rows of a stretch of it; one stretch in so many estimates the part absorbed by parameters."""

RANK_TOLERANCE = 1e-10
"""Smallest singular value of the column-normalised regressor, relative to the greatest, that counts as excited."""

PIECE = 128
"""Samples whose regressors are in the cache together; they enter the filter as one product of matrices."""

ROWS_PER_TASK, SAMPLES_PER_TASK = 256, 4096
"""Least filtered rows, and least samples, that one thread processes at a time."""


@dataclass(frozen=True)
class ExperimentEquations:
    """Equations of one experiment after the parallel filter (thesis 2.3.1).

    Parameters
    ----------
    y
        Torques, shape (M, n), N m or N.
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
    """Result of an estimator.

    Parameters
    ----------
    theta, covariance
        Base parameters (b,) and their covariance (b, b), SI units.
    noise
        Noise model of each joint; its variance is the sigma_j^2 of 2.25.
    residuals
        Whitened residuals of each joint, one array per experiment, in standard deviations.
    iterations
        Iterations done.
    converged
        True if the iterations converged.
    stop_reason
        Rule that ended the iterations, as a sentence.
    warnings
        Lines for the user.
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
    """Base regressor after the parallel filter, shape (M, n, b).

    It is computed piece by piece, so that unfiltered rows stay in the cache, and on all processors: neither kernel nor
    product holds the interpreter lock. Terms of the model may depend on the past, so they get the whole motion at once.

    Parameters
    ----------
    model
        The arm.
    signals
        Positions and derivatives, (N, n) each.
    decimation
        Parallel filter.
    sharp_sign
        True for ``sign`` of the velocity in the friction; false for the smoothed sign of the configuration.

    Raises
    ------
    ValueError
        If the model has terms and the signals no sampling period.
    """
    count = decimation.count(signals.q.shape[0])
    rows = max(ROWS_PER_TASK, SAMPLES_PER_TASK // decimation.factor)
    if count == 0:
        decimation(signals.q)

    if decimation.passes_all and not model.terms:
        return model.rigid_regressor(signals.q, signals.qd, signals.qdd, sharp_sign=sharp_sign)

    rigid = model.base.b - model.e
    filtered = np.empty((count, model.n, model.base.b))
    if model.terms:
        if signals.dt is None:
            raise ValueError("the terms of a model need the sampling period of the signals")
        motion = model.motion(signals.q, signals.qd, signals.qdd, signals.dt, signals.start, sharp_sign=sharp_sign)
        filtered[:, :, rigid:] = decimation(model.term_regressor(motion))

    smoothing = np.zeros(model.n) if sharp_sign else model.smoothing
    q, qd, qdd = (np.ascontiguousarray(x, dtype=np.float64) for x in (signals.q, signals.qd, signals.qdd))

    def fill(first: int) -> None:
        last = min(first + rows, count)
        end = (last - 1) * decimation.factor + decimation.taps.size
        if decimation.taps.size == 1:
            kept = slice(first * decimation.factor, end, decimation.factor)
            phi = model.rigid_regressor(signals.q[kept], signals.qd[kept], signals.qdd[kept], sharp_sign=sharp_sign)
            filtered[first:last, :, :rigid] = decimation.taps[0] * phi
            return
        total, piece = np.zeros((last - first, model.n * rigid)), np.zeros((PIECE, model.n, rigid))
        for begin in range(first * decimation.factor, end, PIECE):
            stop = min(begin + PIECE, end)
            # The kernel writes the same elements every time: all others stay zero.
            span, phi = slice(begin, stop), piece[: stop - begin]
            fill_regressor(model.chain, model.base_columns, smoothing, q[span], qd[span], qdd[span], phi)
            touched = decimation.rows_of(begin, stop)
            touched = slice(max(touched.start, first), min(touched.stop, last))
            weights = decimation.weights(touched, begin, stop)
            total[touched.start - first : touched.stop - first] += weights @ phi.reshape(stop - begin, -1)
        filtered[first:last, :, :rigid] = total.reshape(-1, model.n, rigid)

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        for _ in pool.map(fill, range(0, count, rows)):
            pass
    return filtered


def weighted_rows(
    values: Sequence[NDArray[np.float64]], keep: Sequence[NDArray[np.bool_]], noise: Sequence[ArModel]
) -> NDArray[np.float64]:
    """Stack values joint by joint as in 2.21, each joint whitened by its noise model; shape (rows,) or (rows, b).

    Parameters
    ----------
    values
        One (M, n) or (M, n, b) array per experiment.
    keep
        Equations to use, (M, n) per experiment.
    noise
        Noise model of each joint.
    """
    rows = []
    for j, ar in enumerate(noise):
        for value, kept in zip(values, keep, strict=True):
            rows.append(ar.whiten(value[:, j])[kept[ar.order :, j]])
    return np.concatenate(rows)


def stacked(
    blocks: Sequence[ExperimentEquations], noise: Sequence[ArModel]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Regressor (rows, b) and torques (rows,) of 2.20 and 2.21, whitened, without the equations left out.

    Parameters
    ----------
    blocks
        Equations of every experiment.
    noise
        Noise model of each joint.
    """
    keep = [b.keep for b in blocks]
    return weighted_rows([b.x for b in blocks], keep, noise), weighted_rows([b.y for b in blocks], keep, noise)


def residuals(blocks: Sequence[ExperimentEquations], theta: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """``tau - phi theta`` of each experiment, shape (M, n).

    Parameters
    ----------
    blocks
        Equations of every experiment.
    theta
        Base parameters, shape (b,).
    """
    return [block.y - block.x @ theta for block in blocks]


def joint_variances(blocks: Sequence[ExperimentEquations], theta: NDArray[np.float64]) -> list[ArModel]:
    """Serially uncorrelated noise with the residual variance of each joint (2.25, 2.26).

    Parameters
    ----------
    blocks
        Equations of every experiment.
    theta
        Base parameters, shape (b,).
    """
    return error_variances(residuals(blocks, theta), [b.keep for b in blocks], theta.size)


def residual_norm(blocks: Sequence[ExperimentEquations], theta: NDArray[np.float64], scale: Sequence[ArModel]) -> float:
    """Norm of the residuals, each joint in the units of ``scale``.

    Parameters
    ----------
    blocks
        Equations of every experiment.
    theta
        Base parameters, shape (b,).
    scale
        Noise model of each joint that scales its residuals.
    """
    keep = [b.keep for b in blocks]
    return float(np.linalg.norm(weighted_rows(residuals(blocks, theta), keep, scale)))


def error_variances(
    errors: Sequence[NDArray[np.float64]], keep: Sequence[NDArray[np.bool_]], parameters: int
) -> list[ArModel]:
    """White noise with the variance of each joint's errors (2.25, 2.26).

    The degrees of freedom spent on the parameters are shared by the joints in proportion to their equations.

    Parameters
    ----------
    errors
        One (M, n) array per experiment.
    keep
        Equations to use, (M, n) per experiment.
    parameters
        Number of estimated parameters.
    """
    total = sum(int(kept.sum()) for kept in keep)
    free = max(1 - parameters / total, 1.0 / total)
    models = []
    for j in range(errors[0].shape[1]):
        e = np.concatenate([error[kept[:, j], j] for error, kept in zip(errors, keep, strict=True)])
        models.append(ArModel(np.empty(0), max(float(e @ e) / (max(e.size, 1) * free), 1e-300), 0.0))
    return models


def noise_models(
    blocks: Sequence[ExperimentEquations], theta: NDArray[np.float64], covariance: NDArray[np.float64], max_order: int
) -> list[ArModel]:
    """AR model of each joint's noise from the residuals (6.21 to 6.25).

    The residuals lack the noise that the parameters have absorbed. They absorb the low frequencies, which hold the
    motion and decide the precision: ``cov(e - X d) = Omega - X C X'`` for an efficient estimate of covariance C. The
    autocovariances of ``X C X'`` are added again. Without them, standard deviations of the virtual TX40 are 9 % too
    small (median, 20 seeds). The variances are widened because the coefficients are estimates themselves
    (:meth:`ArModel.widened`).

    Parameters
    ----------
    blocks
        Equations of every experiment.
    theta, covariance
        Base parameters (b,) and their covariance (b, b).
    max_order
        Highest order tried.
    """
    errors = residuals(blocks, theta)
    factor = _square_root(covariance)

    def of_joint(j: int) -> ArModel:
        series = [e[:, j] for e in errors]
        longest = min(max_order, min(s.size for s in series) - 1)
        absorbed = sum((absorbed_sums(b.x[:, j], factor, longest) for b in blocks), np.zeros(longest + 1))
        return fit_ar(series, longest, absorbed).widened(sum(s.size for s in series))

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        return list(pool.map(of_joint, range(blocks[0].y.shape[1])))


def absorbed_sums(x: NDArray[np.float64], factor: NDArray[np.float64], max_lag: int) -> NDArray[np.float64]:
    """``sum_t f(t) . f(t - k)`` for lags 0..max_lag of ``f = x factor``, shape (max_lag + 1,).

    They correct the autocovariances of the residuals by the share b / M. One stretch in ``EVERY`` of a long series is
    accurate enough for that: ``SAMPLED`` rows, after those that its lags need.

    Parameters
    ----------
    x
        Regressor of one joint, shape (M, b).
    factor
        Factor of the covariance, shape (b, b).
    max_lag
        Highest lag k.
    """
    rows = x.shape[0]
    stretch = max_lag + SAMPLED
    if rows < LONG_SERIES or rows < 2 * EVERY * stretch:
        return lagged_sums(x @ factor, max_lag)
    begins = range(0, rows - stretch + 1, EVERY * stretch)
    found = np.zeros(max_lag + 1)
    for begin in begins:
        found += lagged_sums(x[begin : begin + stretch] @ factor, max_lag, max_lag)
    scaled: NDArray[np.float64] = found * ((rows - np.arange(max_lag + 1)) / (len(begins) * SAMPLED))
    return scaled


def _square_root(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """``F`` with ``F F' = covariance``, also where the covariance is not positive definite by rounding."""
    scale = np.sqrt(np.diag(covariance))
    values, vectors = linalg.eigh(covariance / np.outer(scale, scale))
    factor: NDArray[np.float64] = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return factor


def whitened_residuals(
    blocks: Sequence[ExperimentEquations], theta: NDArray[np.float64], noise: Sequence[ArModel]
) -> tuple[tuple[NDArray[np.float64], ...], ...]:
    """Residuals of each joint in standard deviations of its noise model, one array per experiment.

    Parameters
    ----------
    blocks
        Equations of every experiment.
    theta
        Base parameters, shape (b,).
    noise
        Noise model of each joint.
    """
    return whitened(residuals(blocks, theta), [b.keep for b in blocks], noise)


def whitened(
    errors: Sequence[NDArray[np.float64]], keep: Sequence[NDArray[np.bool_]], noise: Sequence[ArModel]
) -> tuple[tuple[NDArray[np.float64], ...], ...]:
    """Errors of each joint in standard deviations of its noise model, one array per experiment.

    Parameters
    ----------
    errors
        One (M, n) array per experiment.
    keep
        Equations to use, (M, n) per experiment.
    noise
        Noise model of each joint.
    """
    return tuple(
        tuple(ar.whiten(e[:, j])[kept[ar.order :, j]] for e, kept in zip(errors, keep, strict=True))
        for j, ar in enumerate(noise)
    )


def least_squares(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solution (b,) of ``min |y - x theta|`` by QR of the column-normalised regressor (2.22).

    Parameters
    ----------
    x
        Regressor, shape (rows, b).
    y
        Torques, shape (rows,).
    """
    b = x.shape[1]
    scale = column_norms(x)
    top = triangularize(x, y, columns=b, scales=(scale,))
    theta: NDArray[np.float64] = linalg.solve_triangular(top[:, :b], top[:, b]) / scale
    return theta


def instrumental_variable(
    z: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Solution (b,) of ``z' (y - x theta) = 0`` (2.33) through the QR factors of ``z``: no product ``z' x`` is formed.

    Parameters
    ----------
    z, x
        Instruments and regressor, shape (rows, b).
    y
        Torques, shape (rows,).
    """
    b = x.shape[1]
    scale = column_norms(x)
    top = triangularize(z, x, y, columns=b, scales=(column_norms(z), scale))
    theta: NDArray[np.float64] = np.linalg.solve(top[:, b : 2 * b], top[:, 2 * b]) / scale
    return theta


def inverse_gram(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """``(x' x)^-1`` from the triangular factor of ``x``."""
    scale = column_norms(x)
    factor = triangularize(x, columns=x.shape[1], scales=(scale,))
    inverse = linalg.solve_triangular(factor, np.eye(x.shape[1])) / scale[:, None]
    gram: NDArray[np.float64] = inverse @ inverse.T
    return gram


def iv_covariance(z: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance ``(z' x)^-1 z' z (x' z)^-1`` of an IV estimate, for whitened rows (4.34), shape (b, b).

    It equals ``(z' z)^-1`` (2.34, 6.31) where the simulator is exact. It stays valid where the controller is only
    approximate, as an identified impulse response is.

    Parameters
    ----------
    z, x
        Instruments and regressor, shape (rows, b).
    """
    scale = column_norms(x)
    top = triangularize(z, x, columns=x.shape[1], scales=(column_norms(z), scale))
    inverse = np.linalg.inv(top[:, x.shape[1] :]) / scale[:, None]
    covariance: NDArray[np.float64] = inverse @ inverse.T
    return covariance


def column_norms(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Norm of each column, 1 where a column is zero."""
    norms = np.sqrt(np.einsum("ij,ij->j", x, x))
    return np.where(norms > 0.0, norms, 1.0)


def serial_covariance(
    zeta: Sequence[NDArray[np.float64]],
    x: Sequence[NDArray[np.float64]],
    keep: Sequence[NDArray[np.bool_]],
    weights: Sequence[ArModel],
    noise: Sequence[ArModel],
) -> NDArray[np.float64]:
    """Covariance (b, b) of an IV estimate with weights 2.24 whose residuals are serially correlated.

    ``A = (Z' W X)^-1 Z' W`` maps the noise to the estimate and ``A Omega A'`` is its covariance, with ``Omega`` given
    by the AR model of each joint: ``Z' W Omega W Z`` is the Gram matrix of ``H' W Z``.

    Parameters
    ----------
    zeta, x
        Instruments and regressor, one (M, n, b) array per experiment.
    keep
        Equations to use, (M, n) per experiment.
    weights
        White noise models by which the estimate weights its rows, one per joint.
    noise
        Noise model of the residuals of each joint.
    """
    z = weighted_rows(zeta, keep, weights)
    zs = column_norms(z)
    bread = np.linalg.inv((z / zs).T @ weighted_rows(x, keep, weights))
    meat = np.zeros((zs.size, zs.size))
    for j, (weight, ar) in enumerate(zip(weights, noise, strict=True)):
        for value, kept in zip(zeta, keep, strict=True):
            rows = value[:, j] * kept[:, j, None] / (weight.variance * zs)
            coloured = signal.lfilter([np.sqrt(ar.variance)], np.append(1.0, ar.coefficients), rows[::-1], axis=0)
            meat += coloured.T @ coloured
    covariance: NDArray[np.float64] = bread @ meat @ bread.T
    return covariance


def require_excitation(x: NDArray[np.float64], names: Sequence[str]) -> int:
    """Rank of the stacked regressor; a motion that leaves parameters undetermined is an error.

    Parameters
    ----------
    x
        Regressor, shape (rows, b).
    names
        Base parameters, shape (b,), for the message.

    Raises
    ------
    DataError
        Naming the parameters that the motion did not excite.
    """
    dead = [name for name, used in zip(names, np.any(x, axis=0).tolist(), strict=True) if not used]
    if not dead:
        _, s, vt = np.linalg.svd(triangularize(x / column_norms(x), columns=x.shape[1]))
        rank = int(np.sum(s > RANK_TOLERANCE * s[0]))
        if rank == len(names):
            return rank
        weak = np.abs(vt[rank:]).max(axis=0)
        dead = [names[k] for k in np.argsort(-weak)[: len(names) - rank + 2] if weak[k] > 0.1]
    raise DataError(
        f"the motion does not determine all {len(names)} base parameters; not excited: {', '.join(sorted(dead))}"
    )


class Iterations(NamedTuple):
    """End of an iteration.

    Parameters
    ----------
    theta
        Last or best iterate, shape (b,).
    done
        Iterations done.
    converged
        True if the iterates settled.
    reason
        Rule that ended the iteration, as a sentence.
    """

    theta: NDArray[np.float64]
    done: int
    converged: bool
    reason: str


def iterate(
    step: Callable[[NDArray[np.float64], int], tuple[NDArray[np.float64], float]],
    start: NDArray[np.float64],
    iterations: int = ITERATIONS,
    tolerance: float = TOLERANCE,
) -> Iterations:
    """Repeat a step until neither theta nor the residual norm changes by more than ``tolerance``.

    Where that does not happen, the iterate of the smallest residual norm is kept. Equations without a finite
    solution end the iterations.

    Parameters
    ----------
    step
        ``step(theta, k) -> (theta, residual norm)`` of iteration k, from 1 on.
    start
        First theta, shape (b,).
    iterations
        Most iterations.
    tolerance
        Relative change that ends the iterations.
    """
    theta, norm = start, np.inf
    best, least = start, np.inf
    for k in range(1, iterations + 1):
        try:
            new, new_norm = step(theta, k)
        except np.linalg.LinAlgError:
            new, new_norm = np.full_like(start, np.nan), np.nan
        if not (np.isfinite(new).all() and np.isfinite(new_norm)):
            return Iterations(best, k, False, f"the equations of iteration {k} have no finite solution")
        change = float(np.linalg.norm(new - theta)) / max(float(np.linalg.norm(new)), 1e-300)
        drift = abs(new_norm - norm) / max(new_norm, 1e-300)
        theta, norm = new, new_norm
        if norm < least:
            best, least = theta, norm
        if change < EXACT:
            return Iterations(theta, k, True, f"theta changed by {change:.1e} (relative), which is rounding")
        if change < tolerance and drift < tolerance:
            reason = f"theta changed by {change:.1e} and the residual norm by {drift:.1e} (relative)"
            return Iterations(theta, k, True, reason)
    return Iterations(best, iterations, False, f"stopped after {iterations} iterations")


def unweighted(n: int) -> list[ArModel]:
    """The initial noise models of n joints."""
    return [WHITE] * n
