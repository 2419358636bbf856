"""The equations ``y = X theta + e`` of all joints and experiments, their residuals and noise models (thesis 2.3)."""

import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from armident.arrays import Array
from armident.identify.regression.ar_noise import ArModel, ar_models, lagged_sums
from armident.identify.regression.whitening import whitened, whitened_series
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.kernels import fill_regressor
from armident.identify.signals.decimate import Decimation
from armident.identify.signals.differentiate import Derivatives
from armident.identify.signals.streamed import mapped

COVARIANCE_PASSES = 3
"""Noise model and covariance need each other; the third pass changes standard deviations by less than 1 %."""

LONG_SERIES, SAMPLED, EVERY = 16_384, 128, 4
"""Rows of a long series; rows of a stretch of it; one stretch in so many estimates the part absorbed by parameters."""

PIECE = 128
"""Samples whose regressors are in the cache together; they enter the filter as one product of matrices."""

ROWS_PER_TASK, SAMPLES_PER_TASK = 256, 4096
"""Least filtered rows, and least samples, that one thread processes at a time."""


@dataclass(frozen=True)
class ExperimentEquations:
    """Equations of one experiment after the parallel filter (thesis 2.3.1), with instants ``t`` (M,), s.

    ``y`` (M, n): torques; ``x`` (M, n, b): regressor at measured signals; ``keep`` (M, n): equations to use.
    """

    y: Array
    x: Array
    keep: NDArray[np.bool_]
    t: Array


@dataclass(frozen=True)
class InstrumentedEquations(ExperimentEquations):
    """Equations of one experiment with instruments. ``z``: regressor at simulated signals, shape (M, n, b)."""

    z: Array


@dataclass(frozen=True)
class Estimate:
    """Result of an estimator: base parameters (b,) and their covariance (b, b), SI.

    ``noise``: the sigma_j^2 of 2.25. ``residuals``: whitened, per joint and experiment, in standard deviations.
    """

    theta: Array
    covariance: Array
    noise: tuple[ArModel, ...]
    residuals: tuple[tuple[Array, ...], ...]
    iterations: int = 1
    converged: bool = True
    stop_reason: str = "linear in the parameters: solved in one step"
    warnings: tuple[str, ...] = ()

    @property
    def std(self) -> Array:
        """Standard deviations, shape (b,)."""
        return np.sqrt(np.diag(self.covariance))


def filtered_regressor(model: ArmModel, signals: Derivatives, decimation: Decimation) -> Array:
    """Base regressor (M, n, b) of signals (N, n) after the parallel filter.

    Piece by piece on all processors: unfiltered rows stay in the cache. Terms depend on the past: they get all at once.
    """
    count = decimation.count(signals.q.shape[0])
    rows = max(ROWS_PER_TASK, SAMPLES_PER_TASK // decimation.factor)
    if count == 0:
        decimation(signals.q)

    if decimation.passes_all and not model.terms:
        return model.rigid_regressor(signals.q, signals.qd, signals.qdd)

    rigid = model.base.b - model.e
    filtered = np.empty((count, model.n, model.base.b))
    if model.terms:
        if signals.dt is None:
            raise ValueError("the terms of a model need the sampling period of the signals")
        motion = model.motion(signals.q, signals.qd, signals.qdd, signals.dt, signals.start)
        filtered[:, :, rigid:] = decimation(model.term_regressor(motion))

    q, qd, qdd = (np.ascontiguousarray(x, dtype=np.float64) for x in (signals.q, signals.qd, signals.qdd))

    def fill(first: int) -> None:
        last = min(first + rows, count)
        end = (last - 1) * decimation.factor + decimation.taps.size
        if decimation.taps.size == 1:
            kept = slice(first * decimation.factor, end, decimation.factor)
            phi = model.rigid_regressor(signals.q[kept], signals.qd[kept], signals.qdd[kept])
            filtered[first:last, :, :rigid] = decimation.taps[0] * phi
            return
        total, piece = np.zeros((last - first, model.n * rigid)), np.zeros((PIECE, model.n, rigid))
        for begin in range(first * decimation.factor, end, PIECE):
            stop = min(begin + PIECE, end)
            # The kernel writes the same elements every time: all others stay zero.
            span, phi = slice(begin, stop), piece[: stop - begin]
            fill_regressor(model.chain, model.base_columns, model.smoothing, q[span], qd[span], qdd[span], phi)
            touched = decimation.rows_of(begin, stop)
            touched = slice(max(touched.start, first), min(touched.stop, last))
            weights = decimation.weights(touched, begin, stop)
            total[touched.start - first : touched.stop - first] += weights @ phi.reshape(stop - begin, -1)
        filtered[first:last, :, :rigid] = total.reshape(-1, model.n, rigid)

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        for _ in pool.map(fill, range(0, count, rows)):
            pass
    return filtered


def thinned_regressor(model: ArmModel, signals: Derivatives, decimation: Decimation) -> Array:
    """`filtered_regressor` at as few samples as a motion without noise needs: for instruments, not for equations.

    Dry friction has content beyond: it changes an instrument by percents where a joint turns round. Terms need all
    samples.
    """
    if model.terms or decimation.every == 1:
        return filtered_regressor(model, signals, decimation)
    q, qd, qdd = (decimation.thin(x) for x in (signals.q, signals.qd, signals.qdd))
    few = replace(signals, q=q, qd=qd, qdd=qdd)
    return filtered_regressor(model, few, decimation.of_thin)[: decimation.count(signals.q.shape[0])]


def stacked(blocks: Sequence[ExperimentEquations], noise: Sequence[ArModel]) -> tuple[Array, Array]:
    """Regressor (rows, b) and torques (rows,) of 2.20 and 2.21, whitened, without the equations left out."""
    keep = [b.keep for b in blocks]
    return whitened(mapped(lambda b: b.x, blocks), noise, keep), whitened([b.y for b in blocks], noise, keep)


def stacked_parts(blocks: Iterable[ExperimentEquations], noise: Sequence[ArModel]) -> Iterator[tuple[Array, Array]]:
    """Yield `stacked` of one experiment after the other: rows of a long recording are in memory one at a time."""
    for block in blocks:
        yield stacked([block], noise)


def instrumented(
    blocks: Sequence[ExperimentEquations], instruments: Sequence[Array]
) -> Sequence[InstrumentedEquations]:
    """Equations with instruments: the regressor at simulated signals, (M, n, b) per experiment."""
    return mapped(lambda b, z: InstrumentedEquations(b.y, b.x, b.keep, b.t, z), blocks, instruments)


def applied(columns: Array, values: Array) -> Array:
    """``columns @ values``, shape (M, n), as one product. ``columns``: shape (M, n, k); ``values``: shape (k,)."""
    product: Array = (columns.reshape(-1, columns.shape[2]) @ values).reshape(columns.shape[:2])
    return product


def instants(blocks: Sequence[ExperimentEquations], dt: float) -> list[NDArray[np.int64]]:
    """Numbers of the samples of the equations, (M,) per experiment."""
    return [np.rint(block.t / dt).astype(np.int64) for block in blocks]


def residuals(blocks: Sequence[ExperimentEquations], theta: Array) -> list[Array]:
    """``tau - phi theta`` of each experiment, shape (M, n). ``theta``: base parameters, shape (b,)."""
    return [block.y - applied(block.x, theta) for block in blocks]


def residuals_of(estimate: Estimate, numbers: Sequence[int]) -> Estimate:
    """Estimate with the residuals of some of its experiments. ``numbers``: numbers of the experiments, from 0."""
    return replace(estimate, residuals=tuple(tuple(series[k] for k in numbers) for series in estimate.residuals))


def joint_variances(blocks: Sequence[ExperimentEquations], theta: Array) -> list[ArModel]:
    """Serially uncorrelated noise with the residual variance of each joint (2.25, 2.26)."""
    return ar_models(residuals(blocks, theta), 0, keep=[b.keep for b in blocks], parameters=theta.size)


def residual_norm(blocks: Sequence[ExperimentEquations], theta: Array, scale: Sequence[ArModel]) -> float:
    """Norm of the residuals, each joint in the units of its noise model in ``scale``."""
    keep = [b.keep for b in blocks]
    return float(np.linalg.norm(whitened(residuals(blocks, theta), scale, keep)))


def noise_models(
    blocks: Sequence[ExperimentEquations], theta: Array, covariance: Array, max_order: int
) -> list[ArModel]:
    """AR model of each joint's noise from the residuals of an estimate (6.21 to 6.25).

    Parameters absorb low-frequency noise: ``cov(e - X d) = Omega - X C X'`` for an efficient estimate of covariance C.
    The autocovariances of ``X C X'`` are added again; without them, standard deviations of the virtual TX40 are 9 % too
    small (median, 20 seeds). Variances are widened (:meth:`ArModel.widened`).
    """
    errors = residuals(blocks, theta)
    factor = _square_root(covariance)

    samples = [e.shape[0] for e in errors]
    longest = min(max_order, min(samples) - 1)

    lost = np.zeros((errors[0].shape[1], longest + 1))
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        for block in blocks:
            joints = (block.x[:, j] for j in range(lost.shape[0]))
            lost += np.array(list(pool.map(lambda x: absorbed_sums(x, factor, longest), joints)))
    return [ar.widened(sum(samples)) for ar in ar_models(errors, longest, absorbed=list(lost))]


def absorbed_sums(x: Array, factor: Array, max_lag: int) -> Array:
    """``sum_t f(t) . f(t - k)`` for lags 0..max_lag of ``f = x factor`` (x: (M, b), factor: (b, b)).

    A correction by the share b / M: one stretch of ``SAMPLED`` rows in ``EVERY`` is accurate enough for that.
    """
    rows = x.shape[0]
    stretch = max_lag + SAMPLED
    if rows < LONG_SERIES or rows < 2 * EVERY * stretch:
        return lagged_sums(x @ factor, max_lag)
    begins = range(0, rows - stretch + 1, EVERY * stretch)
    found = np.zeros(max_lag + 1)
    for begin in begins:
        found += lagged_sums(x[begin : begin + stretch] @ factor, max_lag, max_lag)
    scaled: Array = found * ((rows - np.arange(max_lag + 1)) / (len(begins) * SAMPLED))
    return scaled


def _square_root(covariance: Array) -> Array:
    """``F`` with ``F F' = covariance``, also where the covariance is not positive definite by rounding."""
    scale = np.sqrt(np.diag(covariance))
    values, vectors = linalg.eigh(covariance / np.outer(scale, scale))
    factor: Array = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return factor


def whitened_residuals(
    blocks: Sequence[ExperimentEquations], theta: Array, noise: Sequence[ArModel]
) -> tuple[tuple[Array, ...], ...]:
    """Residuals of each joint in standard deviations of its noise model, one array per experiment."""
    return whitened_series(residuals(blocks, theta), noise, [b.keep for b in blocks])
