"""Selection of the candidates for a full test, with noise models that a missing effect does not bias.

An autoregressive model of a residual that contains a missing effect takes the effect for noise and whitens it away. The
weight of a spring, for example, is forty times too small. So the noise models of the selection come from a residual
without smooth functions of position, speed and time. The full tests start from them and end with noise models of
their own.
"""

import numpy as np
from numpy.typing import NDArray

from armident.identify.diagnosis.candidates import Candidate, Shapes, Workshop
from armident.identify.diagnosis.maps import hats
from armident.identify.diagnosis.regression import MAX_AR_ORDER, Fit, noise_models
from armident.identify.diagnosis.shaping import both_ends
from armident.identify.diagnosis.trial import refined, screened
from armident.identify.regression.ar_noise import ArModel
from armident.identify.robot.motion import Motion

Array = NDArray[np.float64]

KNOTS = 7
"""Knots of each smooth function."""
ROWS_PER_COLUMN = 12
"""Least number of equations per column of these functions, against overfitting of short recordings."""


def shortlist(
    fit: Fit, workshop: Workshop, every: list[Candidate], most: int
) -> tuple[list[tuple[Candidate, Shapes]], frozenset[tuple[str, int, int | None]], tuple[ArModel, ...]]:
    """The candidates that fit the training data best.

    Parameters
    ----------
    fit
        Fit of the model.
    workshop
        Cache of the columns of the same fit.
    every
        All candidates.
    most
        Number of candidates to select.

    Returns
    -------
    tuple
        Candidates with their nonlinear parameters, best first, some with two sets; the keys of those that cannot be
        tested; and the noise models of the selection, one for each joint.
    """
    calm = fit.renoised(noise_beyond_shapes(fit, workshop))
    looks: list[tuple[float, Candidate, Shapes]] = []
    hidden = set()
    for candidate in every:
        look = screened(calm, candidate, workshop)
        if look is None:
            hidden.add(candidate.key)
        else:
            looks.append((look[0], candidate, look[1]))
    looks.sort(key=lambda look: len(look[1].effect.linear) - look[0])
    best: list[tuple[Candidate, Shapes]] = []
    for score, candidate, shapes in looks[:most]:
        own = refined(calm, candidate, workshop, (score, shapes))
        best += [(candidate, ends) for ends in both_ends(calm, candidate, workshop, own)]
    return best, frozenset(hidden), calm.noise


def noise_beyond_shapes(fit: Fit, workshop: Workshop) -> list[ArModel]:
    """Noise models of the residual without smooth functions of each joint's own motion.

    Parameters
    ----------
    fit
        Fit of the model.
    workshop
        Cache of the columns of the same fit.
    """
    errors = fit.errors(fit.theta, held=False)
    columns = [
        _smooth_functions(workshop, workshop.motion(s, "measured"), sum(e.shape[0] for e in errors))
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
    return noise_models(left, fit.theta.size + used, MAX_AR_ORDER)


def _smooth_functions(workshop: Workshop, motion: Motion, rows: int) -> list[Array]:
    """Hat functions of position, of position by direction, of velocity and of time, (M, k) for each joint."""
    knots = max(3, min(KNOTS, rows // (4 * ROWS_PER_COLUMN)))
    out = []
    for j in range(motion.n):
        q, qd, side = motion.q[:, j], motion.qd[:, j], motion.sign[:, j, None]
        place = _hats(q, knots)
        when = _hats(motion.t, knots)
        out.append(
            workshop.study.decimation(
                np.concatenate([place, place * side, _hats(qd, knots), when, when * side], axis=1)
            )
        )
    return out


def _hats(values: Array, knots: int) -> Array:
    """Piecewise linear functions, one at their own knot and zero at the others; knots at quantiles of the values."""
    places = np.unique(np.quantile(values, np.linspace(0, 1, knots)))
    if places.size < 2:
        return np.ones((values.size, 1))
    return hats(values, places)
