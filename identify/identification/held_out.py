"""Torque error on held-out data: each part of the recordings predicted by least squares from the rest."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from armident.identify.regression.equations import ExperimentEquations

Array = NDArray[np.float64]

FOLDS = 5
"""Number of parts, each one stretch of time of every experiment."""

SINGULAR = 1e-12
"""Ratio of the smallest to the largest eigenvalue of the scaled normal equations below which they are singular."""


def held_out_errors(blocks: Sequence[ExperimentEquations], theta: Array) -> tuple[float, Array] | None:
    """``|y - X theta| / |y|`` in percent on held-out parts, overall and per joint (n,).

    Parts are stretches of time, so that the correlation of the noise reaches over their ends only.

    Parameters
    ----------
    blocks
        Equations of every experiment.
    theta
        Base parameters (b,), SI; their residuals are the weights of the least squares.

    Returns
    -------
    tuple of float and ndarray, or None
        ``None`` if the rest of the recordings does not determine all parameters.
    """
    left = [np.where(block.keep, block.y - block.x @ theta, 0.0) for block in blocks]
    used = np.sum([block.keep.sum(axis=0) for block in blocks], axis=0)
    variance = np.sum([np.sum(each**2, axis=0) for each in left], axis=0) / np.maximum(used, 1)
    weights = 1.0 / np.sqrt(np.maximum(variance, 1e-300))
    parts = [part for block in blocks for part in _parts(block)]
    folds = [parts[k::FOLDS] for k in range(FOLDS)]
    products = [_products(fold, weights) for fold in folds]
    gram, right = (np.sum([each[k] for each in products], axis=0) for k in (0, 1))
    if not np.isfinite(gram).all():
        return None
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    missed, power = np.zeros(weights.size), np.zeros(weights.size)
    for fold, (own_gram, own_right) in zip(folds, products, strict=True):
        rest = (gram - own_gram) / np.outer(scale, scale)
        eigenvalues = linalg.eigvalsh(rest)
        if not eigenvalues[0] > SINGULAR * eigenvalues[-1]:
            return None
        theta = linalg.solve(rest, (right - own_right) / scale, assume_a="pos") / scale
        for x, y, keep in fold:
            missed += np.sum(np.where(keep, y - x @ theta, 0.0) ** 2, axis=0)
            power += np.sum(np.where(keep, y, 0.0) ** 2, axis=0)
    overall = 100 * float(np.sqrt(missed.sum() / max(power.sum(), 1e-300)))
    return overall, 100 * np.sqrt(missed / np.maximum(power, 1e-300))


def _parts(block: ExperimentEquations) -> list[tuple[Array, Array, NDArray[np.bool_]]]:
    """Regressor, torque and mask of kept equations of each stretch of an experiment."""
    edges = np.linspace(0, block.y.shape[0], FOLDS + 1).astype(int)
    return [(block.x[first:last], block.y[first:last], block.keep[first:last]) for first, last in pairwise(edges)]


def _products(fold: list[tuple[Array, Array, NDArray[np.bool_]]], weights: Array) -> tuple[Array, Array]:
    """Weighted normal equations of the stretches of one part: X'X (b, b) and X'y (b,)."""
    size = fold[0][0].shape[2]
    gram, right = np.zeros((size, size)), np.zeros(size)
    for x, y, keep in fold:
        rows = (np.where(keep, 1.0, 0.0) * weights)[:, :, None] * x
        rows = rows.reshape(-1, size)
        gram += rows.T @ rows
        right += rows.T @ (np.where(keep, y, 0.0) * weights).ravel()
    return gram, right
