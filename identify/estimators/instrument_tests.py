"""Tests of instruments: their relevance for each parameter, and whether least squares would be biased without them.

Both use the equations as the estimator weights them (thesis 2.24, 6.30).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import chdtrc

from armident.arrays import Array
from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.equations import ExperimentEquations
from armident.identify.regression.hac import newey_west
from armident.identify.regression.iv import factored
from armident.identify.regression.least_squares import inverse_gram, least_squares
from armident.identify.regression.whitening import whitened
from armident.identify.signals.recursive import recursive_filter

SIGNIFICANCE = 0.05
"""Probability of rejecting a true hypothesis, in every test of an estimate except those of its residuals."""

WEAK_F = 23.1
"""Robust first-stage F below which an instrument is weak: bias over 10 % of the worst case cannot be excluded at 5 %
(Montiel Olea and Pflueger 2013, table 1, one instrument per regressor)."""

LAGS_PER_ROOT_SAMPLE = 1.3
"""Lags of the Newey-West variance of M samples over ``sqrt(M)`` (Lazarus, Lewis, Stock and Watson 2018)."""

SAME = 1e-8
"""Share of the IV variance below which the two estimators of the endogeneity test count as identical."""


@dataclass(frozen=True)
class Relevance:
    """First stage of one parameter.

    ``partial_r2``: Shea's, variance of least squares over that of the instruments, 0 to 1. ``first_stage_f``: F of the
    instruments given all other regressors (Sanderson and Windmeijer 2016), robust against serial and cross-joint
    correlation; ``inf`` where the instruments are the regressors. ``weak``: F is below `WEAK_F`.
    """

    parameter: str
    partial_r2: float
    first_stage_f: float
    weak: bool


@dataclass(frozen=True)
class Endogeneity:
    """Durbin-Wu-Hausman test of exogeneity: least squares and instruments differ by chance alone.

    ``statistic``: chi-square with the ``degrees`` in which the two differ at all. ``largest_shift``: greatest
    difference, in standard deviations of the IV estimate, and its ``parameter``: the size of the bias of least squares,
    while the statistic measures its significance. ``verdict``: the result as a sentence.
    """

    statistic: float
    degrees: int
    p_value: float
    largest_shift: float
    parameter: str
    rejected: bool
    verdict: str


def instrument_relevance(
    names: Sequence[str],
    blocks: Sequence[ExperimentEquations],
    instruments: Sequence[Array],
    weights: Sequence[ArModel],
) -> tuple[Relevance, ...]:
    """Shea's partial R^2 and the conditional first-stage F of every parameter.

    With ``Xp = Z (Z'Z)^-1 Z' X`` and ``A = (Xp'Xp)^-1`` the part of ``Xp`` that is new in column k is ``w_k = Xp A[:,
    k] / A_kk`` and the first-stage error left beside it ``v_k = (X - Xp) A[:, k] / A_kk``: the second stage of
    Sanderson and Windmeijer without a second regression. ``F_k = |w_k|^4 / S_k`` with ``S_k`` the long-run variance of
    ``w_k v_k`` summed over the joints at each instant (Newey and West 1987).
    """
    keep = [b.keep for b in blocks]
    x = whitened([b.x for b in blocks], weights, keep)
    q, _ = linalg.qr(normalised(whitened(instruments, weights, keep)), mode="economic")
    projected = q.T @ x
    a = inverse_gram(projected)
    r2 = np.diag(inverse_gram(x)) / np.diag(a)
    direction = a / np.diag(a)
    new = q @ (projected @ direction)
    error = (x - q @ projected) @ direction
    scores = _by_instant(new * error, keep, weights)
    strength = np.sum(new**2, axis=0)
    with np.errstate(divide="ignore"):
        f = strength**2 / np.maximum(_long_run_variance(scores), np.finfo(np.float64).eps ** 2 * strength**2)
    f[f > 1 / np.finfo(np.float64).eps] = np.inf
    return tuple(
        Relevance(name, float(min(share, 1.0)), float(value), bool(value < WEAK_F))
        for name, share, value in zip(names, r2, f, strict=True)
    )


def durbin_wu_hausman(
    names: Sequence[str],
    blocks: Sequence[ExperimentEquations],
    instruments: Sequence[Array],
    weights: Sequence[ArModel],
    noise: Sequence[ArModel],
) -> Endogeneity:
    """Durbin-Wu-Hausman test of least squares against instruments, on the same weighted equations.

    ``noise``: models of the residuals, the same as the ``weights`` or richer. Both estimates are linear in the noise,
    so their difference is ``D e`` with ``D = (Z'WX)^-1 Z'W - (X'WX)^-1 X'W`` and its covariance ``D Omega D'``: never
    indefinite, also with serially correlated residuals. Directions in which the two are the same carry no information;
    they are left out, and the degrees of freedom with them.
    """
    keep = [b.keep for b in blocks]
    x = whitened([b.x for b in blocks], weights, keep)
    z = whitened(instruments, weights, keep)
    y = whitened([b.y for b in blocks], weights, keep)
    shift = factored(z, x, y).theta - least_squares(x, y)
    maps = _estimator_maps(z, x)
    # H' W A' for both estimators at once: its Gram matrix holds their covariances and their cross-covariance.
    coloured = _coloured(maps, keep, weights, noise)
    b = len(names)
    difference = coloured[:, :b] - coloured[:, b:]
    scale = np.linalg.norm(coloured[:, :b], axis=0)
    _, singular, directions = np.linalg.svd(difference / scale, full_matrices=False)
    distinct = singular**2 > SAME
    degrees = int(distinct.sum())
    if degrees == 0:
        return Endogeneity(
            0.0, 0, 1.0, 0.0, "", False, "instruments and regressors are the same: nothing can be said of endogeneity"
        )
    statistic = float(np.sum((directions[distinct] @ (shift / scale) / singular[distinct]) ** 2))
    p = float(chdtrc(degrees, statistic))
    shifts = np.abs(shift) / scale
    worst = int(np.argmax(shifts))
    rejected = p < SIGNIFICANCE
    if rejected:
        verdict = (
            f"least squares is biased on these equations: it differs from the instruments by more than chance "
            f"(p = {p:.2g}), most in {names[worst]}, by {shifts[worst]:.1f} standard deviations"
        )
    else:
        verdict = f"no sign that least squares is biased on these equations (p = {p:.2g})"
    return Endogeneity(statistic, degrees, p, float(shifts[worst]), names[worst], rejected, verdict)


def normalised(x: Array) -> Array:
    """Return a matrix (rows, b), no column of which is zero, with columns of norm 1."""
    return np.asarray(x / np.linalg.norm(x, axis=0))


def _estimator_maps(z: Array, x: Array) -> Array:
    """``A'`` of the IV estimate and of least squares, side by side (R, 2 b): the estimates are ``A y``."""
    scale = np.linalg.norm(x, axis=0)
    qz, _ = linalg.qr(normalised(z), mode="economic")
    qx, r = linalg.qr(x / scale, mode="economic")
    by_instruments = qz @ linalg.inv(qz.T @ (x / scale)).T
    by_least_squares = linalg.solve_triangular(r, qx.T).T
    return np.hstack([by_instruments / scale, by_least_squares / scale])


def _slices(keep: Sequence[NDArray[np.bool_]], weights: Sequence[ArModel]) -> list[tuple[int, int, slice]]:
    """Joint, experiment and place of every series in the rows of `whitened`."""
    places, first = [], 0
    for j, ar in enumerate(weights):
        for number, kept in enumerate(keep):
            last = first + int(kept[ar.order :, j].sum())
            places.append((j, number, slice(first, last)))
            first = last
    return places


def _coloured(
    maps: Array, keep: Sequence[NDArray[np.bool_]], weights: Sequence[ArModel], noise: Sequence[ArModel]
) -> Array:
    """``H' W' maps``: its Gram matrix is the covariance of ``maps' W e`` where ``e = H white`` by the noise models."""
    parts = []
    for j, number, place in _slices(keep, weights):
        weight, ar, kept = weights[j], noise[j], keep[number][:, j].copy()
        kept[: weight.order] = False
        rows = np.zeros((kept.size, maps.shape[1]))
        rows[kept] = maps[place]
        numerator = np.sqrt(ar.variance / weight.variance) * np.append(1.0, weight.coefficients)
        parts.append(recursive_filter(numerator, np.append(1.0, ar.coefficients), rows[::-1]))
    return np.concatenate(parts)


def _by_instant(rows: Array, keep: Sequence[NDArray[np.bool_]], weights: Sequence[ArModel]) -> list[Array]:
    """Rows of `whitened` (R, b) summed over the joints at each instant, one (M, b) per experiment."""
    sums = [np.zeros((kept.shape[0], rows.shape[1])) for kept in keep]
    for j, number, place in _slices(keep, weights):
        order = weights[j].order
        sums[number][order:][keep[number][order:, j]] += rows[place]
    return sums


def _long_run_variance(scores: Sequence[Array]) -> Array:
    """Variance of the sum of serially correlated scores (b,), ``LAGS_PER_ROOT_SAMPLE sqrt(M)`` lags."""
    total = sum(s.shape[0] for s in scores)
    lags = min([math.ceil(LAGS_PER_ROOT_SAMPLE * math.sqrt(total)), *(s.shape[0] - 1 for s in scores)])
    return newey_west(scores, lags)
