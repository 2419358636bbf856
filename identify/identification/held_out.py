"""Torque error on held-out data: each part of the recordings predicted by least squares from the rest."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from armident.arrays import Array
from armident.identify.regression.equations import ExperimentEquations

FOLDS = 5
"""Number of parts, each one stretch of time of every experiment: a fit to four fifths of the data has standard
deviations 12 % larger (``sqrt(5 / 4)``) than one to all. The score of a diagnosis compares models, for which more and
shorter parts count; its folds are instrumental-variable fits (`armident.identify.diagnosis.predictive_score`)."""

SINGULAR = 1e-12
"""Ratio of the smallest to the largest eigenvalue of the scaled normal equations below which they are singular."""


def held_out_errors(blocks: Sequence[ExperimentEquations], theta: Array) -> tuple[float, Array] | None:
    """``|y - X theta| / |y|``, percent, on held-out stretches, overall and per joint (n,); ``None`` if undetermined."""
    # Blocks of a long recording are on disk: one at a time is in memory.
    n = len(blocks[0].y[0])
    squares, used = np.zeros(n), np.zeros(n)
    for block in blocks:
        squares += np.sum(np.where(block.keep, block.y - block.x @ theta, 0.0) ** 2, axis=0)
        used += block.keep.sum(axis=0)
    weights = 1.0 / np.sqrt(np.maximum(squares / np.maximum(used, 1), 1e-300))
    grams, rights = np.zeros((FOLDS, theta.size, theta.size)), np.zeros((FOLDS, theta.size))
    for block in blocks:
        for k, part in enumerate(_parts(block)):
            gram, right = _products(*part, weights)
            grams[k] += gram
            rights[k] += right
    if not np.isfinite(grams).all():
        return None
    scale = np.sqrt(np.maximum(np.diag(grams.sum(axis=0)), 1e-300))
    estimates = []
    for gram, right in zip(grams.sum(axis=0) - grams, rights.sum(axis=0) - rights, strict=True):
        rest = gram / np.outer(scale, scale)
        eigenvalues = linalg.eigvalsh(rest)
        if not eigenvalues[0] > SINGULAR * eigenvalues[-1]:
            return None
        estimates.append(linalg.solve(rest, right / scale, assume_a="pos") / scale)
    missed, power = np.zeros(n), np.zeros(n)
    for block in blocks:
        for (x, y, keep), estimate in zip(_parts(block), estimates, strict=True):
            missed += np.sum(np.where(keep, y - x @ estimate, 0.0) ** 2, axis=0)
            power += np.sum(np.where(keep, y, 0.0) ** 2, axis=0)
    overall = 100 * float(np.sqrt(missed.sum() / max(power.sum(), 1e-300)))
    return overall, 100 * np.sqrt(missed / np.maximum(power, 1e-300))


def _parts(block: ExperimentEquations) -> list[tuple[Array, Array, NDArray[np.bool_]]]:
    """Regressor, torque and mask of kept equations of each stretch of an experiment."""
    edges = np.linspace(0, block.y.shape[0], FOLDS + 1).astype(int)
    return [(block.x[first:last], block.y[first:last], block.keep[first:last]) for first, last in pairwise(edges)]


def _products(x: Array, y: Array, keep: NDArray[np.bool_], weights: Array) -> tuple[Array, Array]:
    """Weighted normal equations of one stretch: X'X (b, b) and X'y (b,)."""
    rows = ((np.where(keep, 1.0, 0.0) * weights)[:, :, None] * x).reshape(-1, x.shape[2])
    return rows.T @ rows, rows.T @ (np.where(keep, y, 0.0) * weights).ravel()
