"""Iterations of an estimator, and the rules that end them."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from armident.arrays import Array

ITERATIONS = 20
"""Most iterations of an iterative estimator."""

TOLERANCE = 1e-4
"""Relative change of theta and of the residual norm that ends the iterations; far below one standard deviation."""

EXACT = 1e-10
"""Relative change of theta that ends the iterations whatever the residual does: data without noise leave rounding."""


class Iterations(NamedTuple):
    """End of an iteration: last or best theta (b,), convergence, and the rule that ended it, as a sentence."""

    theta: Array
    done: int
    converged: bool
    reason: str


def iterate(
    step: Callable[[Array, int], tuple[Array, float]],
    start: Array,
    iterations: int = ITERATIONS,
    tolerance: float = TOLERANCE,
) -> Iterations:
    """Repeat ``step(theta, k)`` until theta and the residual norm change by at most ``tolerance``, relative.

    Else the iterate of the smallest residual norm is kept. Equations without a finite solution end the iterations.
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
