"""Clipped torques behind noise: the model needs more than the largest recorded torque wherever that is reached.

Soft saturation is no mistake but an effect (`drive_gain_saturation`): the better fit of both laws decides, if it is
better by more than chance (Vuong, Econometrica 57, 1989, section 5).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from armident.arrays import Array
from armident.identify.setup.bench import Bench
from armident.identify.setup.fit import Hypothesis, equations, fit_rows

NEAR = 0.94
"""Torque over its largest value from which on a row may be clipped: noise and filters blur the level."""

LEAST_ROWS = 0.03
"""Least share of rows near the level for a test."""

LEAST_FREE = 0.1
"""Least share of rows below the level that must be left for the fit."""

LEAST_EXCESS = 1.04
"""Median of the predicted torque over the level from which on it counts as clipped."""

LEAST_IMPROVEMENT = 1.5
"""Factor by which the residual power of the rows below the level must fall without the rows near it."""

MOST_LEVERAGE = 4.0
"""Largest median leverage of the rows near the level, by the other rows: from there on the fit does not determine the
torque that is needed there, and extrapolates. The predicted torque is then twice as uncertain as a row."""

MOST_SLOPE = 0.3
"""Largest slope of recorded over predicted torques near the level: 0 where they are clipped, near 1 elsewhere."""

LEVELS = np.linspace(NEAR, 1.03, 10)
"""Levels of clipping that are tried, over the quantile of the magnitude."""

SHARPNESS = (2.0, 4.0)
"""Powers p of the soft saturations ``y = m / (1 + |m / s|^p)^(1/p)`` that are tried: 2 is the law of
`drive_gain_saturation`, and clipping is the limit of large ones."""

SATURATIONS = (0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98)
"""Values of ``|y / s|^p`` at the largest recorded torque y that are tried."""

DECIDED = 1.645
"""Least statistic of Vuong's test for clipping: at equal fit it is passed in 5 % of the cases."""

BLOCKS = 20
"""Blocks of rows whose sums give the standard error of that statistic: neighbouring rows are correlated."""

MOST_CERTAIN = 0.99
"""Largest probability of a clip: the laws of both alternatives are simplified."""

LEVEL_QUANTILE = 0.98
"""Quantile of the magnitude of the torques that stands for the level: single peaks of noise lie above it."""


@dataclass(frozen=True)
class Clip:
    """A clipped torque: level, N m or N, share of rows there, median torque that the model needs there, probability."""

    joint: int
    level: float
    share: float
    needed: float
    probability: float


def clipped_torques(bench: Bench, h: Hypothesis) -> list[Clip]:
    """Return the torques whose largest values lie where the model, fitted to the other rows, needs clearly more.

    Dry friction is also nearly constant over long times, but there the model needs no more than recorded.
    """
    x, y, physical = equations(bench.everywhere, h)
    found = []
    for k in np.flatnonzero(bench.moving):
        level = float(np.quantile(np.abs(y[:, k]), LEVEL_QUANTILE))
        near = np.abs(y[:, k]) > NEAR * level
        share = float(near.mean())
        if share < LEAST_ROWS or 1.0 - share < LEAST_FREE:
            continue
        used = np.ones(y.shape, dtype=np.bool_)
        whole = fit_rows(x, y, used, physical, bench.moving)
        used[near, k] = False
        below = fit_rows(x, y, used, physical, bench.moving)
        residual = [np.mean((y[~near, k] - x[~near, k] @ theta) ** 2) for theta in (whole, below)]
        needed = float(np.median((x[near, k] @ below) * np.sign(y[near, k]))) / level
        if _leverage(x, used, near, int(k)) > MOST_LEVERAGE:
            continue
        flat = _slope(np.abs(x[near, k] @ below), np.abs(y[near, k])) < MOST_SLOPE
        if not (flat and needed > LEAST_EXCESS and residual[0] > LEAST_IMPROVEMENT * residual[1]):
            continue
        clipped = _least(y[:, k] - np.clip(x[:, k] @ below, -top, top) for top in level * LEVELS)
        decided = preference(clipped, _soft_errors(x, y, int(k), physical, bench.moving))
        if decided > DECIDED:
            found.append(Clip(int(k), level, share, needed, min(float(ndtr(decided)), MOST_CERTAIN)))
    return found


def _least(errors: Iterable[Array]) -> Array:
    """Return the errors (N,) with the least mean square."""
    return min(errors, key=lambda each: float(np.mean(each**2)))


def preference(first: Array, second: Array) -> float:
    """Return Vuong's statistic of two laws by their errors (N,), positive if the first one fits better."""
    variances = [float(np.mean(errors**2)) for errors in (first, second)]
    if min(variances) == 0.0:
        return np.inf * (variances[1] - variances[0]) if max(variances) else 0.0
    gain = 0.5 * (np.log(variances[1] / variances[0]) + second**2 / variances[1] - first**2 / variances[0])
    sums = np.array([part.sum() for part in np.array_split(gain, BLOCKS)])
    return float(sums.sum() / (np.sqrt(BLOCKS) * max(sums.std(ddof=1), 1e-300)))


def _soft_errors(x: Array, y: Array, k: int, physical: Array, moving: NDArray[np.bool_]) -> Array:
    """Return the errors (N,) of torque k if it saturates softly, with the best of some saturations."""
    every = np.ones(y.shape, dtype=np.bool_)
    size = np.abs(y[:, k]) / np.max(np.abs(y[:, k]))
    errors = []
    for power, share in product(SHARPNESS, SATURATIONS):
        left = 1.0 - share * size**power
        # The equations of the true torque, with errors in units of the recorded one.
        rows, torque = x.copy(), y.copy()
        rows[:, k] *= left[:, None] ** (1.0 + 1.0 / power)
        torque[:, k] *= left
        needed = x[:, k] @ fit_rows(rows, torque, every, physical, moving)
        loss = share / np.max(np.abs(y[:, k])) ** power
        given = needed / (1.0 + loss * np.abs(needed) ** power) ** (1.0 / power)
        errors.append(y[:, k] - given)
    return _least(errors)


def _leverage(x: Array, used: NDArray[np.bool_], near: NDArray[np.bool_], k: int) -> float:
    """Median leverage of the rows near the level: variance of their predicted torque over that of an error."""
    rows = x[used]
    size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    inverse = np.linalg.pinv((rows / size).T @ (rows / size), rcond=1e-12, hermitian=True)
    at = x[near, k] / size
    return float(np.median(np.einsum("mi,ij,mj->m", at, inverse, at)))


def _slope(x: Array, y: Array) -> float:
    """Slope of the regression line of y on x; 1 if x does not vary."""
    spread = x - x.mean()
    power = float(spread @ spread)
    return float(spread @ y) / power if power > 0 else 1.0
