"""Test of one candidate: fitted on the training data, tested by its prediction on held-out data."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from armident.identify.diagnosis.candidates import Candidate, Columns, Shapes, Workshop
from armident.identify.diagnosis.regression import MAX_AR_ORDER, Fit, applied, noise_models
from armident.identify.diagnosis.whitening import joints_of, rows_of_joints
from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.hac import newey_west

Array = NDArray[np.float64]

CLOSE = float(np.log(20.0))
"""Difference in log-likelihood below which two candidates are ambiguous: odds of less than 20 to 1."""
NEWEY_WEST_LAGS = 20
LEAP = 4.0
"""Standard deviations beyond which a residual is no noise."""
MAD_TO_STD = 1.4826
"""Standard deviation of normal noise over its median absolute deviation."""
RANK_TOLERANCE = 1e-3
"""Relative norm orthogonal to the model below which columns cannot be tested."""
ALONE = 1e-2
"""Share of a column in the directions orthogonal to the model below which the model contains it."""
UNCHANGED = 1e-3
"""Power of a change over that of the errors below which their noise model is kept."""
CALM_PASSES = 2
"""Iterations between the parameters of a candidate and the noise models, from unbiased noise models."""
REFINEMENTS = 12
"""Evaluations of the golden-section search of a continuous shape between its neighbours on the grid."""


@dataclass(frozen=True)
class Trial:
    """Result of the test of a candidate.

    Parameters
    ----------
    candidate, shapes
        Candidate and its nonlinear parameters.
    values, std
        Linear parameters fitted on the training data together with the model, and their standard deviations, (k,).
    statistic
        Score statistic on the training data, chi-square of k degrees of freedom without merit.
    held_statistic
        Standardised projection of the held-out residual on the change of prediction by the candidate: standard normal
        without merit, large with it.
    gain
        Drop of the sum of squares of the whitened held-out residuals by that change.
    inflation
        Variance of the whitened residuals along the change, over that of white noise; at least 1.
    away
        Decrease of the model's own parameters with the candidate, (b,).
    beside
        The model's own parameters with the candidate, (b,).
    share
        Share of the whitened held-out residual's power that the change removes at a joint: at the joint with the
        largest share or, for effects with jumps, at the joint that it changes most.
    score
        Gain in log-likelihood over both parts, less the gain by fitting alone on the training part.
    contained
        Of every linear parameter, true if the model contains it; its value is zero then.
    """

    candidate: Candidate
    shapes: Shapes
    values: Array
    std: Array
    statistic: float
    held_statistic: float
    gain: float
    inflation: float
    away: Array
    beside: Array
    share: float
    score: float
    contained: tuple[bool, ...]

    @property
    def kept(self) -> Array:
        """The linear parameters that the model does not contain."""
        kept: Array = self.values[~np.array(self.contained)]
        return kept

    @property
    def forbidden(self) -> bool:
        """True if a linear parameter has a sign or a size that physics does not allow."""
        largest: dict[str, float] = {}
        for name, value in (pair for shapes in self.candidate.grid for pair in shapes):
            largest[name] = max(value, largest.get(name, value))
        return not self.candidate.effect.allows(self.values, self.std, dict(self.shapes), largest)

    @property
    def p_value(self) -> float:
        """P-value of a candidate without merit on both parts (Fisher's method)."""
        both = [max(self.p_train, 1e-300), max(self.p_held, 1e-300)]
        return float(stats.combine_pvalues(both, method="fisher").pvalue)

    @property
    def p_train(self) -> float:
        """P-value of the fit of the training residual, corrected for the number of combinations tried."""
        p = float(stats.chi2.sf(self.statistic / self.inflation, self.values.size))
        return min(1.0, p * max(len(self.candidate.grid), 1))

    @property
    def p_held(self) -> float:
        """P-value of the prediction of the held-out residual."""
        return float(stats.norm.sf(self.held_statistic))


def best_trial(fit: Fit, candidate: Candidate, workshop: Workshop) -> Trial | None:
    """Trial of a candidate at the nonlinear parameters that fit the training data best.

    Parameters
    ----------
    fit
        Fit of the model.
    candidate
        Candidate with its grid.
    workshop
        Cache of the columns of the same fit.

    Returns
    -------
    Trial or None
        ``None`` if the model already contains the candidate or the motion does not excite it.
    """
    found = screened(fit, candidate, workshop)
    if found is None:
        return None
    return judge(fit, candidate, refined(fit, candidate, workshop, found), workshop)


def screened(fit: Fit, candidate: Candidate, workshop: Workshop) -> tuple[float, Shapes] | None:
    """Best score statistic of a candidate on its grid, by the training data, and the nonlinear parameters there.

    Parameters
    ----------
    fit
        Fit of the model.
    candidate
        Candidate with its grid.
    workshop
        Cache of the columns of the same fit.
    """
    if not candidate.grid:
        return None
    # Columns that depend on theta are useless for the next model, and a grid of them is large.
    keep = not candidate.effect.predicts
    columns = workshop.grid(candidate.effect, candidate.place, candidate.grid, fit.noise, keep=keep)
    statistics = score_statistics(fit, columns, len(candidate.grid))
    if np.isnan(statistics).all():
        return None
    best = int(np.nanargmax(statistics))
    return float(statistics[best]), candidate.grid[best]


def score_statistics(fit: Fit, columns: Sequence[tuple[int, Array]], count: int) -> Array:
    """Power of the training residual along groups of instruments orthogonal to the model's own, (G,).

    Parameters
    ----------
    fit
        Fit of the model.
    columns
        Whitened instruments (R, G k) of each joint on which they act, with its number, group after group.
    count
        Number of groups, G.

    Returns
    -------
    ndarray
        Not a number where the model contains a group.
    """
    if not columns:
        return np.full(count, np.nan)
    size = np.sqrt(np.sum([np.einsum("ij,ij->j", own, own) for _, own in columns], axis=0))
    able = np.isfinite(size) & (size > 0.0)
    scale = np.where(able, size, np.inf)
    scaled = [(j, np.where(able, own, 0.0) / scale) for j, own in columns]
    gram, score = fit.products_beside(scaled, count)
    power, right = np.linalg.eigh(gram)
    kept = power > RANK_TOLERANCE**2
    along = np.einsum("gij,gi->gj", right, score)
    statistics = np.sum(np.where(kept, along**2 / np.where(kept, power, 1.0), 0.0), axis=1)
    usable = able.reshape(count, -1).all(axis=1) & kept.any(axis=1)
    return np.where(usable, statistics, np.nan)


def score_statistic(fit: Fit, columns: Sequence[tuple[int, Array]]) -> float | None:
    """Score statistic of one group of instruments; ``None`` if the model contains it.

    Parameters
    ----------
    fit
        Fit of the model.
    columns
        Whitened instruments (R, k) of each joint on which they act, with its number.
    """
    found = float(score_statistics(fit, columns, 1)[0])
    return None if np.isnan(found) else found


def judge(
    fit: Fit, candidate: Candidate, shapes: Shapes, workshop: Workshop, calm: Sequence[ArModel] | None = None
) -> Trial | None:
    """Trial of a candidate: fit by instrumental variables together with the model, and test on the held-out data.

    The test statistic is the projection of the held-out residual of the model without the candidate on the change of
    prediction by the candidate at simulated signals, which are independent of the noise. Without merit it has mean
    zero. Its variance comes from the noise, from the remaining serial correlation (Newey-West), and from theta,
    estimated from the training data.

    Parameters
    ----------
    fit
        Fit of the model.
    candidate, shapes
        Candidate and its nonlinear parameters.
    workshop
        Cache of the columns of the same fit.
    calm
        Noise models without the bias by the missing effect, as a second start at the joints on which the candidate
        acts: those of ``fit`` may take the missing effect for noise and whiten it away. The likelier result counts.
    """
    tried = [_judged(fit, fit, candidate, shapes, workshop, 1)]
    if calm is not None:
        start = _calmed(fit, candidate, shapes, workshop, calm)
        tried.append(_judged(fit, start, candidate, shapes, workshop, CALM_PASSES))
    return max((trial for trial in tried if trial is not None), key=lambda trial: trial.score, default=None)


def _judged(
    alone: Fit, fit: Fit, candidate: Candidate, shapes: Shapes, workshop: Workshop, passes: int
) -> Trial | None:
    """See `judge`; with the noise models of ``fit`` to start from."""
    # A missing effect must not count as noise: noise models come from the residual with the candidate in the model.
    for _ in range(passes):
        screening = _beside_model(fit, candidate, shapes, workshop)
        if screening is None:
            return None
        fit = alone.renoised(noise_with(fit, candidate, shapes, workshop, *screening))
    columns = workshop.columns(candidate.effect, candidate.place, shapes, fit.noise)
    solution = _values(fit, columns)
    if solution is None:
        return None
    statistic, values, std = solution
    away = fit.absorbed(columns.x @ values[:, None])[:, 0]
    change = columns.held_z @ values - fit.held_at_simulated(away)
    before, after = fit.held_residual, fit.held_residual - change
    size = float(change @ change)
    if size == 0.0:
        return None
    inflation = inflation_along(change, after)
    variance = size * inflation + fit.spread(change)
    gain = float(before @ before - after @ after)
    joints = rows_of_joints([s.y.shape[0] for s in fit.study.held], fit.noise)
    reached = joints_reached(candidate, change, joints)
    share = max(1.0 - float(after[r] @ after[r]) / max(float(before[r] @ before[r]), 1e-300) for r in reached)
    fitted = 0.5 * (values.size + len(shapes))
    supported = 0.5 * (statistic + gain)
    return Trial(
        candidate,
        shapes,
        values,
        std,
        statistic,
        float(change @ before) / float(np.sqrt(variance)),
        gain,
        inflation,
        away,
        fit.theta - away,
        share,
        supported - fitted,
        tuple(bool(there) for there in values == 0.0),
    )


def inflation_along(change: Array, residual: Array) -> float:
    """Variance of whitened residuals along a change of prediction, over that of white noise; at least 1.

    Parameters
    ----------
    change
        Change of prediction, (R,).
    residual
        Whitened residuals, (R,).
    """
    return max(1.0, variance_of_sum(change * _without_leaps(residual)) / float(change @ change))


def variance_of_sum(products: Array) -> float:
    """Variance of the sum of serially correlated terms (R,), their mean removed."""
    return float(newey_west([products - products.mean()], NEWEY_WEST_LAGS))


def deviations(fit: Fit, columns: Columns) -> Array | None:
    """Standard deviations (k,) of linear parameters fitted together with the model, zero of those that it contains.

    Parameters
    ----------
    fit
        Fit of the model.
    columns
        Whitened columns of the parameters.
    """
    solution = _values(fit, columns)
    return None if solution is None else np.where(solution[1] == 0.0, 0.0, solution[2])


def joints_reached(candidate: Candidate, change: Array, joints: Sequence[slice]) -> list[slice]:
    """Rows of the joints at which the share of an effect is evaluated.

    All joints: an elastic link changes the joint before it more than its own, and the model's own parameters may have
    adapted at other joints. Effects with jumps, which are their own instruments, count at the joint that they change
    most.

    Parameters
    ----------
    candidate
        Candidate.
    change
        Change of the held-out prediction, the model's own parameters included, (R,).
    joints
        Rows of every joint.
    """
    if candidate.effect.sudden:
        return [max(joints, key=lambda rows: float(change[rows] @ change[rows]))]
    return list(joints)


def _calmed(fit: Fit, candidate: Candidate, shapes: Shapes, workshop: Workshop, calm: Sequence[ArModel]) -> Fit:
    """Fit with the unbiased noise models at the joints on which a candidate acts."""
    columns = workshop.band(candidate.effect, candidate.place, shapes, "train", "simulated")
    acts = {j for c in columns for j in joints_of(c)}
    return fit.renoised([calm[j] if j in acts else own for j, own in enumerate(fit.noise)])


def _beside_model(fit: Fit, candidate: Candidate, shapes: Shapes, workshop: Workshop) -> tuple[Array, Array] | None:
    """Linear parameters of a candidate fitted together with the model, and the decrease of the model's own."""
    columns = workshop.columns(candidate.effect, candidate.place, shapes, fit.noise)
    solution = _values(fit, columns)
    if solution is None:
        return None
    return solution[1], fit.absorbed(columns.x @ solution[1][:, None])[:, 0]


def noise_with(
    fit: Fit, candidate: Candidate, shapes: Shapes, workshop: Workshop, values: Array, away: Array
) -> list[ArModel]:
    """Noise models of the training residual with a candidate in the model.

    Joints whose errors hardly change keep theirs.

    Parameters
    ----------
    fit
        Fit of the model.
    candidate, shapes
        Candidate and its nonlinear parameters.
    workshop
        Cache of the columns of the same fit.
    values
        Linear parameters of the candidate, (k,).
    away
        Parameters (b,) by which the model's own decrease with it.
    """
    columns = workshop.band(candidate.effect, candidate.place, shapes, "train", "measured")
    change = [applied(c, values) - applied(x, away) for (x, _, _), c in zip(fit.equations.train, columns, strict=True)]
    power, changed = (sum(np.einsum("mj,mj->j", part, part) for part in parts) for parts in (fit.left, change))
    other = np.flatnonzero(np.asarray(changed > UNCHANGED * power))
    left = [(e - c)[:, other] for e, c in zip(fit.left, change, strict=True)]
    # Each joint bears its part of the parameters.
    parameters = (fit.theta.size + values.size) * other.size / len(fit.noise)
    own = dict(zip(other.tolist(), noise_models(left, parameters, MAX_AR_ORDER), strict=True)) if other.size else {}
    return [own.get(j, kept) for j, kept in enumerate(fit.noise)]


def _values(fit: Fit, columns: Columns) -> tuple[float, Array, Array] | None:
    """Score statistic, linear parameters and their standard deviations; ``None`` if they are undetermined."""
    basis = directions_beside(fit, columns.z)
    if basis is None:
        return None
    u, right, scale = basis
    # A column that the model contains has no share in any direction that is kept.
    alone = np.linalg.norm(right, axis=1) > ALONE
    score = u.T @ fit.residual
    # (D~' C) in the coordinates of u: projection of the measured columns on the instruments.
    gram = u.T @ (columns.x / scale) @ right
    try:
        inverse = np.linalg.inv(gram)
    except np.linalg.LinAlgError:
        return None
    values = np.where(alone, (right @ (inverse @ score)) / scale, 0.0)
    std = np.sqrt(np.sum((right @ inverse) ** 2, axis=1)) / scale
    return float(score @ score), values, std


def directions_beside(fit: Fit, instruments: Array) -> tuple[Array, Array, Array] | None:
    """Orthonormal directions (R, r) of instruments orthogonal to the model's, and their map (k, r) with scales (k,).

    Parameters
    ----------
    fit
        Fit of the model.
    instruments
        Whitened instruments, (R, k).
    """
    scale = np.linalg.norm(instruments, axis=0)
    if np.any(scale == 0) or not np.isfinite(scale).all():
        return None
    beside = fit.beside(instruments / scale)
    # Through the small Gram matrix: candidates have a few columns and many rows.
    power, right = np.linalg.eigh(beside.T @ beside)
    kept = power > RANK_TOLERANCE**2
    if not kept.any():
        return None
    right = right[:, kept]
    return (beside @ right) / np.sqrt(power[kept]), right, scale


def refined(fit: Fit, candidate: Candidate, workshop: Workshop, best: tuple[float, Shapes]) -> Shapes:
    """Nonlinear parameters between those of the grid, one continuous parameter after the other, on a logarithmic scale.

    Parameters
    ----------
    fit
        Fit of the model.
    candidate
        Candidate with its grid.
    workshop
        Cache of the columns of the same fit.
    best
        Score statistic and nonlinear parameters of the grid, the start.
    """
    found = best
    for k, free in enumerate(candidate.effect.refinable(fit.study.robot, candidate.place)):
        values = sorted({grid[k][1] for grid in candidate.grid})
        if not free or len(values) < 2:
            continue
        at = int(np.argmin(np.abs(np.array(values) - found[1][k][1])))
        low, high = values[max(at - 1, 0)], values[min(at + 1, len(values) - 1)]

        start = found[1]

        def loss(logarithm: float, start: Shapes = start, k: int = k) -> float:
            shapes = replaced(start, k, float(np.exp(logarithm)))
            statistic = score_statistic(
                fit, workshop.grid(candidate.effect, candidate.place, (shapes,), fit.noise, keep=False)
            )
            return 0.0 if statistic is None else -statistic

        result = optimize.minimize_scalar(
            loss, bounds=(np.log(low), np.log(high)), method="bounded", options={"maxiter": REFINEMENTS}
        )
        if -result.fun > found[0]:
            found = -float(result.fun), replaced(start, k, float(np.exp(result.x)))
    return found[1]


def replaced(shapes: Shapes, k: int, value: float) -> Shapes:
    """Nonlinear parameters with another value of the k-th.

    Parameters
    ----------
    shapes
        Pairs of name and value.
    k, value
        Number of the parameter, and its new value.
    """
    return (*shapes[:k], (shapes[k][0], value), *shapes[k + 1 :])


def _without_leaps(residual: Array) -> Array:
    """Whitened residual (R,), clipped where noise does not reach.

    The remainder of a few hard impacts is correlated with a right candidate, and would inflate its variance.
    """
    deviation = MAD_TO_STD * float(np.median(np.abs(residual)))
    return np.clip(residual, -LEAP * deviation, LEAP * deviation)
