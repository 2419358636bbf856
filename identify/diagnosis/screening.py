"""Screening of candidates by score statistics of the training data."""

from collections.abc import Sequence

import numpy as np
from scipy import optimize

from armident.arrays import Array
from armident.identify.diagnosis.candidates import Candidate, ColumnCache, Shapes
from armident.identify.diagnosis.regression import IvFit

REFINEMENTS = 12
"""Evaluations of the golden-section search of a continuous shape between its neighbours on the grid."""


def screened(fit: IvFit, candidate: Candidate, column_cache: ColumnCache) -> tuple[float, Shapes] | None:
    """Best score statistic of a candidate on its grid, by the training data, and the nonlinear parameters there."""
    if not candidate.grid:
        return None
    # Columns that depend on theta are useless for the next model, and a grid of them is large.
    keep = not candidate.effect.depends_on_torque
    columns = column_cache.grid(candidate.effect, candidate.place, candidate.grid, fit.noise, keep=keep)
    statistics = score_statistics(fit, columns, len(candidate.grid), candidate.effect.sign)
    if np.isnan(statistics).all():
        return None
    best = int(np.nanargmax(statistics))
    return float(statistics[best]), candidate.grid[best]


def score_statistics(fit: IvFit, columns: Sequence[tuple[int, Array]], count: int, sign: int = 0) -> Array:
    """Power (G,) of the training residual along groups of instruments (R, G k) orthogonal to the model's own.

    ``sign``: that of a single parameter by physics, or 0. Wrong signs give zero; groups that the model contains, NaN.
    """
    if not columns:
        return np.full(count, np.nan)
    size = np.sqrt(np.sum([np.einsum("ij,ij->j", own, own) for _, own in columns], axis=0))
    able = np.isfinite(size) & (size > 0.0)
    scale = np.where(able, size, np.inf)
    scaled = [(j, np.where(able, own, 0.0) / scale) for j, own in columns]
    gram, score = fit.regression.orthogonal_products(scaled, count)
    power, right = np.linalg.eigh(gram)
    kept = power > fit.study.criteria.beyond_model**2
    along = np.einsum("gij,gi->gj", right, score)
    statistics = np.sum(np.where(kept, along**2 / np.where(kept, power, 1.0), 0.0), axis=1)
    if sign:
        statistics = np.where(sign * score[:, 0] > 0.0, statistics, 0.0)
    usable = able.reshape(count, -1).all(axis=1) & kept.any(axis=1)
    return np.where(usable, statistics, np.nan)


def score_statistic(fit: IvFit, columns: Sequence[tuple[int, Array]], sign: int = 0) -> float | None:
    """Score statistic of one group of instruments (R, k), see `score_statistics`; ``None`` if the model has it."""
    found = float(score_statistics(fit, columns, 1, sign)[0])
    return None if np.isnan(found) else found


def contained(fit: IvFit, candidate: Candidate, column_cache: ColumnCache, shapes: Shapes) -> tuple[str, ...]:
    """Linear parameters of a candidate whose torque the model can give without it, such as an inertia of two joints.

    None if these are all: an effect keeps one parameter, which is then zero.
    """
    columns = column_cache.grid(candidate.effect, candidate.place, (shapes,), fit.noise, keep=False)
    size = np.sqrt(np.sum([np.einsum("ij,ij->j", own, own) for _, own in columns], axis=0))
    size = np.where(size > 0.0, size, 1.0)
    gram = fit.regression.orthogonal_products([(j, own / size) for j, own in columns], 1)[0][0]
    kept: list[int] = []
    present = candidate.effect.present(dict(shapes))
    for k in present:
        along = gram[np.ix_(kept, [k])][:, 0]
        rest = gram[k, k] - along @ np.linalg.solve(gram[np.ix_(kept, kept)], along)
        kept += [k] if rest > fit.study.criteria.beyond_model**2 else []
    return tuple(candidate.effect.linear[k].name for k in present if kept and k not in kept)


def orthogonal_directions(fit: IvFit, instruments: Array) -> tuple[Array, Array, Array] | None:
    """Orthonormal directions (R, r) of instruments orthogonal to the model's, and their map (k, r) with scales (k,)."""
    scale = np.linalg.norm(instruments, axis=0)
    if np.any(scale == 0) or not np.isfinite(scale).all():
        return None
    free = fit.regression.orthogonalized(instruments / scale)
    # Through the small Gram matrix: candidates have a few columns and many rows.
    power, right = np.linalg.eigh(free.T @ free)
    kept = power > fit.study.criteria.beyond_model**2
    if not kept.any():
        return None
    right = right[:, kept]
    return (free @ right) / np.sqrt(power[kept]), right, scale


def refined(fit: IvFit, candidate: Candidate, column_cache: ColumnCache, best: tuple[float, Shapes]) -> Shapes:
    """Nonlinear parameters between those of the grid, one continuous one after the other, on a logarithmic scale."""
    found = best
    for k, free in enumerate(candidate.effect.refinable(fit.study.robot, candidate.place)):
        values = sorted({grid[k][1] for grid in candidate.grid if grid[k][1] > 0.0})
        if not free or len(values) < 2 or found[1][k][1] == 0.0:
            continue
        at = int(np.argmin(np.abs(np.array(values) - found[1][k][1])))
        low, high = values[max(at - 1, 0)], values[min(at + 1, len(values) - 1)]

        start = found[1]

        def loss(logarithm: float, start: Shapes = start, k: int = k) -> float:
            shapes = replaced(start, k, float(np.exp(logarithm)))
            columns = column_cache.grid(candidate.effect, candidate.place, (shapes,), fit.noise, keep=False)
            statistic = score_statistic(fit, columns, candidate.effect.sign)
            return 0.0 if statistic is None else -statistic

        result = optimize.minimize_scalar(
            loss, bounds=(np.log(low), np.log(high)), method="bounded", options={"maxiter": REFINEMENTS}
        )
        if -result.fun > found[0]:
            found = -float(result.fun), replaced(start, k, float(np.exp(result.x)))
    return found[1]


def replaced(shapes: Shapes, k: int, value: float) -> Shapes:
    """Nonlinear parameters with another value of the k-th."""
    return (*shapes[:k], (shapes[k][0], value), *shapes[k + 1 :])
