"""Penalized splines with confidence bands; the smoothing strength is estimated from the data (thesis 7.3.2)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from armident.identify.diagnosis.candidates import Columns
from armident.identify.diagnosis.regression import Fit
from armident.identify.diagnosis.trial import directions_beside

Array = NDArray[np.float64]

UNPENALISED = 1e-9
"""Roughness, relative to the roughest direction, below which a direction counts as smooth altogether."""

CONTAINED = 0.1
"""Relative norm orthogonal to the model below which a direction is no part of a shape: the model contains it."""

STRENGTHS = np.geomspace(1e-8, 1e8, 129)
"""Smoothing strengths tried, relative to the data's."""


def smoothed(fit: Fit, columns: Columns, basis: Array, pieces: Sequence[Array]) -> tuple[Array, Array]:
    """Free shape fitted on the training data in addition to the model, with the most likely smoothing strength.

    State-dependent parameters are smoothed as integrated random walks, whose noise-variance ratio is found by maximum
    likelihood (thesis section 7.3.2; Young, McKenna, Bruun 2001, Int. J. Control 74(18)). That is a spline penalised on
    its second differences; here its coefficients are estimated with instruments.

    Parameters
    ----------
    fit
        Fit of the model.
    columns
        Whitened columns of the shape's basis.
    basis
        The basis at the points of the curve, (G, k).
    pieces
        Rows of the basis at the parts of the curve that are smooth each, (G', k).

    Returns
    -------
    value, band : ndarray
        The shape and two standard deviations of it, (G,). The part that the model itself can represent is not included.
    """
    found = directions_beside(fit, columns.z)
    if found is None:
        return np.zeros(basis.shape[0]), np.zeros(basis.shape[0])
    u, right, scale = found
    left = np.linalg.norm(fit.beside((columns.z / scale) @ right), axis=0)
    u, right = u[:, left > CONTAINED], right[:, left > CONTAINED]
    if right.shape[1] == 0:
        return np.zeros(basis.shape[0]), np.zeros(basis.shape[0])
    through = np.linalg.solve((u.T @ (columns.x / scale) @ right).T, right.T).T / scale[:, None]
    # In these coordinates the estimate has unit variance in every direction.
    estimate = u.T @ fit.residual
    bends = np.concatenate([np.diff(piece @ through, 2, axis=0) for piece in pieces])
    roughness, axes = np.linalg.eigh(bends.T @ bends)
    roughness = np.maximum(roughness, 0.0)
    seen = axes.T @ estimate
    weight = _shrinkage(seen, roughness)
    shape = basis @ through @ axes
    value: Array = shape @ (weight * seen)
    return value, 2.0 * np.sqrt(shape**2 @ weight)


def _shrinkage(seen: Array, roughness: Array) -> Array:
    """Factor of each coordinate (k,) at the smoothing strength of the largest likelihood."""
    rough = roughness > UNPENALISED * max(float(roughness.max()), 1e-300)
    weight = np.ones_like(seen)
    if not rough.any():
        return weight
    relative = roughness[rough] / np.median(roughness[rough])

    def loss(strength: float) -> float:
        spread = 1.0 + 1.0 / (strength * relative)
        return float(np.sum(np.log(spread) + seen[rough] ** 2 / spread))

    best = STRENGTHS[int(np.argmin([loss(strength) for strength in STRENGTHS]))]
    weight[rough] = 1.0 / (1.0 + best * relative)
    return weight
