"""Nonlinear parameters of a candidate by instrumental variables, as the linear ones are.

A search at simulated signals finds roughly where they are, but the simulated loop does not have the candidate in it:
its motor does not leap while the teeth are apart. The candidate's columns are right at measured signals only; the
simulated ones say along which directions to look at them (two-stage least squares, Amemiya 1974, J. Econometrics 2).
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from armident.identify.diagnosis.candidates import Candidate, Shapes, Workshop
from armident.identify.diagnosis.regression import Fit
from armident.identify.diagnosis.trial import directions_beside, replaced
from armident.identify.diagnosis.whitening import whitened

Array = NDArray[np.float64]

FIRST_LOOKS = 6
"""Values over the range of a parameter that are tried before the best of them is refined."""
REFINEMENTS = 8
"""Evaluations of that refinement."""


def both_ends(fit: Fit, candidate: Candidate, workshop: Workshop, shapes: Shapes) -> tuple[Shapes, ...]:
    """Shapes as simulated signals have them, and as measured ones do where that is not the same: either may be astray.

    Simulated signals are those of a loop without the effect, and measured ones hold noise that it amplifies.
    """
    found = instrumented(fit, candidate, workshop, shapes)
    return (shapes,) if found == shapes else (found, shapes)


def instrumented(fit: Fit, candidate: Candidate, workshop: Workshop, shapes: Shapes) -> Shapes:
    """Continuous nonlinear parameters, one after the other, between the neighbours on the grid of where they are.

    Of effects that depend on nothing but the motion they stay: that motion is simulated well, and measured velocities
    are least sure around standstill, where friction changes most.

    Parameters
    ----------
    shapes
        Where to begin: the best at simulated signals.
    """
    found = shapes
    if not candidate.effect.predicts:
        return found
    for k, free in enumerate(candidate.effect.refinable(fit.study.robot, candidate.place)):
        values = np.array(sorted({grid[k][1] for grid in candidate.grid}))
        if not free or values.size < 2:
            continue
        at = int(np.argmin(np.abs(np.log(values / found[k][1]))))
        low, high = float(values[max(at - 1, 0)]), float(values[min(at + 1, values.size - 1)])
        explained = _explained(fit, candidate, workshop, found, k, (low, found[k][1], high))
        if explained is not None:
            found = replaced(found, k, _highest(explained, low, high))
    return found


def _explained(
    fit: Fit, candidate: Candidate, workshop: Workshop, shapes: Shapes, k: int, probes: tuple[float, ...]
) -> Callable[[float], float] | None:
    """Power of the training residual that measured columns explain along the directions of simulated ones."""
    effect, place = candidate.effect, candidate.place
    instruments = [workshop.instruments(effect, place, replaced(shapes, k, v), fit.noise) for v in probes]
    basis = directions_beside(fit, np.concatenate(instruments, axis=1))
    if basis is None:
        return None
    u = basis[0]
    score = u.T @ fit.residual

    def explained(value: float) -> float:
        band = workshop.band(effect, place, replaced(shapes, k, value), "train", "measured", keep=False)
        along = u.T @ whitened(band, fit.noise)
        coefficients = np.linalg.lstsq(along, score, rcond=None)[0]
        return float(score @ (along @ coefficients))

    return explained


def _highest(explained: Callable[[float], float], low: float, high: float) -> float:
    """Where a function of a positive parameter is highest, on a logarithmic scale."""
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
