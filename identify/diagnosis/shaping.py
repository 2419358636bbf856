"""Nonlinear parameters of a candidate by two-stage least squares (Amemiya 1974, J. Econometrics 2).

The simulated loop lacks the candidate: its columns are right at measured signals, with simulated ones as instruments.
"""

from collections.abc import Callable

import numpy as np
from scipy import optimize

from armident.identify.diagnosis.candidates import Candidate, ColumnCache, Shapes
from armident.identify.diagnosis.regression import IvFit
from armident.identify.diagnosis.screening import orthogonal_directions, replaced
from armident.identify.regression.whitening import whitened

FIRST_LOOKS = 6
"""Values over the range of a parameter before the refinement of the best one."""
REFINEMENTS = 8
"""Evaluations of that refinement."""


def shapes_of_both_signals(
    fit: IvFit, candidate: Candidate, column_cache: ColumnCache, shapes: Shapes
) -> tuple[Shapes, ...]:
    """Nonlinear parameters by measured signals and by simulated ones, where these differ; either may be wrong.

    Simulated signals are of a loop without the effect; measured ones contain noise that it amplifies.
    """
    found = instrumented_shapes(fit, candidate, column_cache, shapes)
    return (shapes,) if found == shapes else (found, shapes)


def instrumented_shapes(fit: IvFit, candidate: Candidate, column_cache: ColumnCache, shapes: Shapes) -> Shapes:
    """Continuous nonlinear parameters, one after the other, between their neighbours on the grid.

    Effects of the motion alone keep theirs: that is simulated well; measured velocities are least accurate at
    standstill.
    """
    found = shapes
    if not candidate.effect.depends_on_torque:
        return found
    for k, free in enumerate(candidate.effect.refinable(fit.study.robot, candidate.place)):
        values = np.array(sorted({grid[k][1] for grid in candidate.grid}))
        if not free or values.size < 2:
            continue
        at = int(np.argmin(np.abs(np.log(values / found[k][1]))))
        low, high = float(values[max(at - 1, 0)]), float(values[min(at + 1, values.size - 1)])
        explained = _explained(fit, candidate, column_cache, found, k, (low, found[k][1], high))
        if explained is not None:
            found = replaced(found, k, _highest(explained, low, high))
    return found


def _explained(
    fit: IvFit, candidate: Candidate, column_cache: ColumnCache, shapes: Shapes, k: int, probes: tuple[float, ...]
) -> Callable[[float], float] | None:
    """Power of the training residual that measured columns explain along the directions of simulated ones."""
    effect, place = candidate.effect, candidate.place
    instruments = [column_cache.instruments(effect, place, replaced(shapes, k, v), fit.noise) for v in probes]
    basis = orthogonal_directions(fit, np.concatenate(instruments, axis=1))
    if basis is None:
        return None
    u = basis[0]
    score = u.T @ fit.residual

    def explained(value: float) -> float:
        band = column_cache.band(effect, place, replaced(shapes, k, value), "train", "measured", keep=False)
        along = u.T @ whitened(band, fit.noise)
        coefficients = np.linalg.lstsq(along, score, rcond=None)[0]
        return float(score @ (along @ coefficients))

    return explained


def _highest(explained: Callable[[float], float], low: float, high: float) -> float:
    """Maximum of a function of a positive parameter, on a logarithmic scale."""
    looks = np.linspace(np.log(low), np.log(high), FIRST_LOOKS)
    powers = [explained(float(np.exp(x))) for x in looks]
    best = int(np.argmax(powers))
    result = optimize.minimize_scalar(
        lambda x: -explained(float(np.exp(x))),
        bounds=(looks[max(best - 1, 0)], looks[min(best + 1, FIRST_LOOKS - 1)]),
        method="bounded",
        options={"maxiter": REFINEMENTS},
    )
    return float(np.exp(result.x if -result.fun > powers[best] else looks[best]))
