"""Noise models of a residual of which functions that a missing effect may follow have been taken out.

Otherwise they whiten the effect away: the weight of a spring, for example, is forty times too small. The selection uses
`noise_beyond_shapes` (smooth functions of a joint's motion), the lack of fit `noise_beyond` (dependences found).
"""

from collections.abc import Sequence

import numpy as np
from scipy import fft

from armident.arrays import Array
from armident.identify.diagnosis.candidates import ColumnCache
from armident.identify.diagnosis.regression import MAX_AR_ORDER, IvFit
from armident.identify.diagnosis.study import Study
from armident.identify.effects.free_shapes import hats
from armident.identify.regression.ar_noise import ArModel, ar_models, lagged_sums, levinson_durbin, lowest_aic
from armident.identify.robot.motion import Motion

KNOTS = 7
"""Knots of each smooth function of the selection."""

PASSES = 4
"""Iterations between the noise model and the noise that the functions take away."""

RANK = 1e-8
"""Power of a direction, relative to a unit column, below which functions do not span it."""

LEAST_ROWS = 110
"""Rows of a stretch from which the size of its noise is estimated: 7 % accurate."""

SPAN = 1e-8
"""Singular value, relative to the largest, from which smooth functions span a direction."""


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
    parts, taken = _beyond_shapes(fit, column_cache)
    return ar_models(parts, MAX_AR_ORDER, parameters=fit.theta.size + taken)


def noise_sizes(fit: IvFit, column_cache: ColumnCache) -> Array:
    """Size of the noise of each training stretch and joint beside that of all stretches, (S, n); 1 for few rows.

    The rest that smooth functions of the motion leave is larger in one motion than in another, as all models err.
    """
    parts, _ = _beyond_shapes(fit, column_cache)
    noise = ar_models(parts, MAX_AR_ORDER)
    rows = np.array([np.count_nonzero(s.moving, axis=0) for s in fit.study.train])
    squares = [[np.sum(ar.whiten(e) ** 2) for ar, e in zip(noise, part.T, strict=True)] for part in parts]
    squares = np.array(squares) / np.maximum(rows, 1)
    used = (rows >= LEAST_ROWS) & (squares > 0.0)
    logarithms = np.where(used, 0.5 * np.log(np.where(used, squares, 1.0)), 0.0)
    mean = np.sum(rows * logarithms, axis=0) / np.maximum(np.sum(rows * used, axis=0), 1)
    sizes = np.exp(np.where(used, logarithms - mean, 0.0))
    return np.asarray(sizes * [s.noise for s in fit.study.train])


def _beyond_shapes(fit: IvFit, column_cache: ColumnCache) -> tuple[list[Array], int]:
    """Residual of every stretch without smooth functions of each joint's own motion, and their number."""
    study, errors = fit.study, fit.errors(fit.theta, held=False)
    # The measured motion is the same for all models: one factorisation serves them.
    sizes_of_noise = tuple(np.concatenate([s.noise for s in study.train]))
    key = ("smooth functions", *(s.measured for s in study.train), tuple(study.robot.sign_smoothing), sizes_of_noise)
    motions = (column_cache.motion(s, "measured") for s in study.train)
    *spans, sizes = study.regressors.get(key, lambda: _spans(_smooth_functions(study, list(motions))))
    every = np.concatenate(errors)
    left = np.stack([e - span @ (span.T @ e) for e, span in zip(every.T, spans, strict=True)], axis=1)
    return np.split(left, np.cumsum([e.shape[0] for e in errors])[:-1]), int(sizes.sum())


def _spans(columns: Sequence[Sequence[Array]]) -> tuple[Array, ...]:
    """Orthonormal functions (M, r) with the span of those of each joint in all stretches, and their numbers (n,)."""
    stacked = [np.concatenate(own) for own in zip(*columns, strict=True)]
    spans = []
    for own in stacked:
        span, power, _ = np.linalg.svd(own, full_matrices=False)
        spans.append(span[:, power > SPAN * power[0]])
    return (*spans, np.array([own.shape[1] for own in stacked]))


def _smooth_functions(study: Study, motions: Sequence[Motion]) -> list[list[Array]]:
    """Hat functions of position, of position by direction, of velocity and of time, (M, k) per stretch and joint."""
    rows = sum(s.y.shape[0] for s in study.train)
    knots = max(3, min(KNOTS, rows // (4 * study.criteria.rows_per_function)))
    when = _quantile_hats([m.t for m in motions], knots)
    out: list[list[Array]] = [[] for _ in motions]
    for j in range(study.robot.n):
        places, speeds = (_quantile_hats([getattr(m, name)[:, j] for m in motions], knots) for name in ("q", "qd"))
        for own, s, motion, place, speed, time in zip(out, study.train, motions, places, speeds, when, strict=True):
            side = motion.sign[:, j, None]
            functions = [place, place * side, speed, time, time * side]
            own.append(study.decimation(np.concatenate(functions, axis=1)) / s.noise[j])
    return out


def _quantile_hats(values: Sequence[Array], knots: int) -> list[Array]:
    """Piecewise linear functions, one at their own knot and zero at the others; knots at quantiles of all values."""
    at = np.unique(np.quantile(np.concatenate(values), np.linspace(0, 1, knots)))
    return [hats(one, at) for one in values]
