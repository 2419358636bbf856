"""Candidates compete: fitted on the training data, judged by what they predict on data they have not seen."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from identify.discrepancy.catalogue import CATALOGUE, JointSignals
from identify.discrepancy.problem import Fit, Problem, joint_columns, whitened_rows

Array = NDArray[np.float64]

FALSE_ALARMS = 0.01
"""Chance, over all tests of a diagnosis, that a plant without a missing effect is said to have one."""
NEWEY_WEST_LAGS = 20
RANK_TOLERANCE = 1e-4
"""Candidate columns that the model nearly contains (relative norm left after projection) are not testable."""


@dataclass(frozen=True)
class Trial:
    """How a candidate did.

    Parameters
    ----------
    effect, joint, shape
        The candidate; ``joint`` counts from 0.
    coefficients
        Linear parameters fitted on the training data.
    score
        Gain in held-out log-likelihood.
    p_value
        That a candidate without merit fits the training residual so well and then predicts the held-out residual so
        well: both tests combined by Fisher's method, the first times the number of shapes tried.
    share
        Share of the joint's whitened held-out residual variance that it takes away.
    """

    effect: str
    joint: int
    shape: dict[str, float]
    coefficients: Array
    score: float
    p_value: float
    share: float


@dataclass(frozen=True)
class Shape:
    """An anonymous function of one quantity, for saying what an unexplained residual varies with."""

    varies_with: str
    columns: Callable[[JointSignals], Array]


def try_catalogue(problem: Problem, fit: Fit) -> list[Trial]:
    """All effects of the catalogue on all joints that the recording can tell from the model, best first."""
    present = {(stanza.effect, stanza.joint) for stanza in problem.robot.effects}
    trials = []
    for joint, configured in enumerate(problem.robot.joints):
        for effect in CATALOGUE.values():
            if (effect.name, configured.name) in present:
                continue
            best: tuple[float, Trial] | None = None
            grid = effect.grid()
            for shape in grid:
                columns = partial(effect.columns, **shape)
                result = attempt(problem, fit, joint, columns, effect.name, shape, len(grid))
                if result is not None and (best is None or result[0] > best[0]):
                    best = result
            if best is not None:
                trials.append(best[1])
    return sorted(trials, key=lambda trial: -trial.score)


def try_shapes(problem: Problem, fit: Fit) -> list[Trial]:
    """Anonymous functions of speed, position, load and time on all joints, largest share first."""
    trials = []
    for joint in range(problem.robot.n):
        for shape in _shapes(problem, joint):
            result = attempt(problem, fit, joint, shape.columns, shape.varies_with, {})
            if result is not None:
                trials.append(result[1])
    return sorted(trials, key=lambda trial: -trial.share)


def attempt(
    problem: Problem,
    fit: Fit,
    joint: int,
    columns: Callable[[JointSignals], Array],
    name: str,
    shape: dict[str, float],
    shapes: int = 1,
) -> tuple[float, Trial] | None:
    """Fit a candidate beside the model on the training data and judge it on the held-out data.

    The judge is the projection of the held-out residual of the model without the candidate on the change of prediction
    that the candidate asks for. Without merit it has mean zero; its spread comes from the whitened noise, from theta
    (estimated from the training data), and from what serial correlation is left (Newey-West).

    Returns
    -------
    tuple or None
        Drop of the training sum of squares and the trial; ``None`` if the model already contains the candidate.
    """
    rows = whitened_rows(
        problem, fit.noise, joint, joint_columns(problem, joint, columns, held_out=False), held_out=False
    )
    inside = fit.q.T @ rows
    beside = rows - fit.q @ inside
    scale = np.linalg.norm(rows, axis=0)
    if np.any(scale == 0):
        return None
    u, s, vt = np.linalg.svd(beside / scale, full_matrices=False)
    kept = s > RANK_TOLERANCE
    if not kept.any():
        return None
    projected = u[:, kept].T @ fit.residual
    coefficients = (vt[kept].T @ (projected / s[kept])) / scale
    dropped = float(projected @ projected)

    held = whitened_rows(
        problem, fit.noise, joint, joint_columns(problem, joint, columns, held_out=True), held_out=True
    )
    delta = held @ coefficients - fit.held_x @ (fit.solve(rows) @ coefficients)
    before = fit.held_residual
    gain = float(before @ before - (before - delta) @ (before - delta))
    noise_power = max(1.0, float(np.mean(before**2)))
    independent = noise_power * (float(delta @ delta) + fit.held_spread(delta))
    spread = np.sqrt(max(independent, _newey_west(delta * before) + noise_power * fit.held_spread(delta)))
    statistic = float(delta @ before) / float(spread) if spread > 0 else 0.0
    own = _rows_of(problem, fit, joint)
    share = gain / max(float(before[own] @ before[own]), 1e-300)
    fitted = min(1.0, shapes * float(stats.chi2.sf(dropped, int(kept.sum()))))
    predicted = float(stats.norm.sf(statistic))
    p_value = float(stats.combine_pvalues([max(fitted, 1e-300), max(predicted, 1e-300)], method="fisher").pvalue)
    return dropped, Trial(name, joint, shape, coefficients, gain / (2 * noise_power), p_value, share)


def _rows_of(problem: Problem, fit: Fit, joint: int) -> slice:
    lengths = [sum(int(p.block.keep[ar.order :, j].sum()) for p in problem.held_out) for j, ar in enumerate(fit.noise)]
    first = sum(lengths[:joint])
    return slice(first, first + lengths[joint])


def _newey_west(products: Array) -> float:
    """Variance of a sum of serially correlated terms of mean zero, with Bartlett weights."""
    total = float(products @ products)
    for lag in range(1, min(NEWEY_WEST_LAGS, products.size - 1) + 1):
        total += 2 * (1 - lag / (NEWEY_WEST_LAGS + 1)) * float(products[lag:] @ products[:-lag])
    return max(total, 0.0)


def _shapes(problem: Problem, joint: int) -> list[Shape]:
    """Hat functions over the range that the training motion covers."""
    q = np.concatenate([piece.signals.q[:, joint] for piece in problem.train])
    qd = np.concatenate([piece.signals.qd[:, joint] for piece in problem.train])
    return [
        Shape("speed", lambda s: _hats(s.qd, _knots(qd))),
        Shape("position", lambda s: _hats(s.q, _knots(q))),
        Shape("position and direction", lambda s: _hats(s.q, _knots(q)) * s.sign[:, None]),
    ]


def _knots(values: Array) -> Array:
    return np.unique(np.quantile(values, np.linspace(0, 1, 8)))


def _hats(values: Array, knots: Array) -> Array:
    """Piecewise linear functions that are one at their own knot and zero at the others."""
    if knots.size < 3:
        return values[:, None]
    return np.stack([np.interp(values, knots, row) for row in np.eye(knots.size)], axis=1)
