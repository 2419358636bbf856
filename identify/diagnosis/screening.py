"""Which candidates deserve a trial of their own: a quick look with a noise model that the gap cannot fool.

An autoregressive model of a residual that contains a missing effect takes the effect for noise and whitens it away; a
spring is weighed forty times too lightly. So the noise for the look comes from a residual that smooth functions of
position, speed and time have been taken out of. Trials start from it and end with a noise of their own.
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
"""Of each smooth function."""
ROWS_PER_COLUMN = 12
"""Equations that each of their columns must have, so that short recordings are not overfitted."""


def shortlist(
    fit: Fit, workshop: Workshop, every: list[Candidate], most: int
) -> tuple[list[tuple[Candidate, Shapes]], frozenset[tuple[str, int, int | None]], tuple[ArModel, ...]]:
    """The candidates that fit the training data best.

    Returns
    -------
    tuple
        Candidates with their shapes, best first, some with two; the keys of those that cannot be tried; and the noise
        models, one for each joint, that they were looked at with.
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
    """Noise models of the residual that smooth functions of each joint's own motion leave."""
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
    """Piecewise linear functions, one at their own knot and zero at the others; knots at equal shares of the values."""
    places = np.unique(np.quantile(values, np.linspace(0, 1, knots)))
    if places.size < 2:
        return np.ones((values.size, 1))
    return hats(values, places)
