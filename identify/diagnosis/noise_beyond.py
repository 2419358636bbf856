"""Noise models of a residual of which functions that a missing effect may follow have been taken out.

Otherwise they whiten the effect away: the weight of a spring, for example, is forty times too small. The selection uses
`noise_beyond_shapes` (smooth functions of a joint's motion), the lack of fit `noise_beyond` (dependences found).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from armident.identify.diagnosis.candidates import ColumnCache
from armident.identify.diagnosis.regression import MAX_AR_ORDER, IvFit
from armident.identify.effects.free_shapes import hats
from armident.identify.regression.ar_noise import ArModel, ar_models, lagged_sums, levinson_durbin, lowest_aic
from armident.identify.robot.motion import Motion

Array = NDArray[np.float64]

KNOTS = 7
"""Knots of each smooth function of the selection."""

PASSES = 4
"""Iterations between the noise model and the noise that the functions take away."""

RANK = 1e-8
"""Power of a direction, relative to a unit column, below which functions do not span it."""


def noise_beyond(errors: Sequence[Array], functions: Sequence[Array]) -> ArModel:
    """Autoregressive noise model of one joint, of the residual (M,) of every stretch beyond functions (M, k).

    Expected autocovariances of the noise that least squares removes with them, by the model itself, are added.
    """
    span = _orthonormal(functions)
    inside = sum(q.T @ e for q, e in zip(span, errors, strict=True))
    left = [e - q @ inside for q, e in zip(span, errors, strict=True)]
    rows = sum(int(np.count_nonzero(e)) for e in errors)
    highest = max(0, min(MAX_AR_ORDER, rows // 10, min(e.size for e in left) - 1))
    sums = np.asarray(sum(lagged_sums(e[:, None], highest) for e in left))
    if sums[0] <= 0:
        return ArModel(np.empty(0), np.finfo(np.float64).tiny, -np.inf)
    noise = lowest_aic(sums / rows, rows)
    for _ in range(PASSES):
        covariances = (sums + _taken(noise, span, highest)) / rows
        # A sum of an observed and an expected part need not be an autocovariance.
        if not np.all(levinson_durbin(covariances)[1] > 0.0):
            break
        noise = lowest_aic(covariances, rows)
    return noise


def _orthonormal(columns: Sequence[Array]) -> list[Array]:
    """Orthonormal functions with the same span, (M, r) of every stretch."""
    size = np.sqrt(sum(np.einsum("mk,mk->k", c, c) for c in columns))
    size = np.where(size > 0, size, np.inf)
    scaled = [c / size for c in columns]
    power, right = np.linalg.eigh(sum(c.T @ c for c in scaled))
    kept = power > RANK
    return [c @ (right[:, kept] / np.sqrt(power[kept])) for c in scaled]


def _taken(noise: ArModel, span: Sequence[Array], highest: int) -> Array:
    """Expected sums of lagged products, lags 0 to ``highest``, that least squares on a span takes out of noise.

    Sums along the diagonals of ``P W + W P - P W P``: projector P on the span, covariance W of the noise.
    """
    size = fft.next_fast_len(2 * max(q.shape[0] for q in span), real=True)
    gain = np.fft.rfft(np.append(1.0, noise.coefficients), size)
    density = noise.variance / np.abs(gain[:, None]) ** 2
    spectra = [fft.rfft(q, size, axis=0) for q in span]
    coloured = [fft.irfft(a * density, size, axis=0)[: q.shape[0]] for a, q in zip(spectra, span, strict=True)]
    gram = sum(q.T @ w for q, w in zip(span, coloured, strict=True))
    total = np.zeros(size // 2 + 1)
    for a, q, w in zip(spectra, span, coloured, strict=True):
        other = fft.rfft(2.0 * w - q @ gram, size, axis=0)
        total += np.sum((other * a.conj()).real, axis=1)
    return np.asarray(fft.irfft(total, size)[: highest + 1])


def noise_beyond_shapes(fit: IvFit, column_cache: ColumnCache) -> list[ArModel]:
    """Noise models of the residual of a fit without smooth functions of each joint's own motion."""
    errors = fit.errors(fit.theta, held=False)
    columns = [
        _smooth_functions(column_cache, column_cache.motion(s, "measured"), sum(e.shape[0] for e in errors))
        for s in fit.study.train
    ]
    left = [e.copy() for e in errors]
    used = 0
    for j in range(fit.study.robot.n):
        stacked = np.concatenate([c[j] for c in columns])
        shapes = np.linalg.lstsq(stacked, np.concatenate([e[:, j] for e in errors]), rcond=1e-8)[0]
        for e, c in zip(left, columns, strict=True):
            e[:, j] -= c[j] @ shapes
        used += shapes.size
    return ar_models(left, MAX_AR_ORDER, parameters=fit.theta.size + used)


def _smooth_functions(column_cache: ColumnCache, motion: Motion, rows: int) -> list[Array]:
    """Hat functions of position, of position by direction, of velocity and of time, (M, k) for each joint."""
    knots = max(3, min(KNOTS, rows // (4 * column_cache.study.criteria.rows_per_function)))
    out = []
    for j in range(motion.n):
        q, qd, side = motion.q[:, j], motion.qd[:, j], motion.sign[:, j, None]
        place = _quantile_hats(q, knots)
        when = _quantile_hats(motion.t, knots)
        out.append(
            column_cache.study.decimation(
                np.concatenate([place, place * side, _quantile_hats(qd, knots), when, when * side], axis=1)
            )
        )
    return out


def _quantile_hats(values: Array, knots: int) -> Array:
    """Piecewise linear functions, one at their own knot and zero at the others; knots at quantiles of the values."""
    return hats(values, np.unique(np.quantile(values, np.linspace(0, 1, knots))))
