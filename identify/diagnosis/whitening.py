"""Autoregressive noise of all joints at once: models, whitening and its transpose.

The same estimates as `armident.identify.regression.ar_noise`, fast enough for thousands of candidates.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from armident.identify.regression.ar_noise import ArModel, lowest_aic
from armident.identify.robot.compiled import compiled

Array = NDArray[np.float64]


def ar_models(errors: Sequence[Array], max_order: int) -> list[ArModel]:
    """AR model of each joint by the Yule-Walker equations, order by AIC (6.21 to 6.25), as `fit_ar` makes it.

    Parameters
    ----------
    errors
        Residuals, (M, n) per stretch.
    max_order
        Highest order tried; limited to a tenth of the samples.
    """
    total = sum(e.shape[0] for e in errors)
    highest = max(0, min(max_order, total // 10, min(e.shape[0] for e in errors) - 1))
    models = []
    for j in range(errors[0].shape[1]):
        r = np.zeros(highest + 1)
        for e in errors:
            _add_lagged_sums(np.ascontiguousarray(e[:, j]), r)
        if r[0] <= 0:
            models.append(ArModel(np.empty(0), np.finfo(np.float64).tiny, -np.inf))
            continue
        models.append(lowest_aic(r / total, total))
    return models


def whitened(values: Sequence[Array], noise: Sequence[ArModel]) -> Array:
    """Values of all joints, one below the other, each whitened by its noise model, shape (R,) or (R, k).

    Parameters
    ----------
    values
        One (M, n) or (M, n, k) array per stretch.
    noise
        Noise model of each joint.
    """
    lengths = [[value.shape[0] - ar.order for value in values] for ar in noise]
    out = np.zeros((sum(map(sum, lengths)), *values[0].shape[2:]))
    acts = [range(len(noise)) if value.ndim == 2 else joints_of(value) for value in values]
    begin = 0
    for j, (ar, sizes) in enumerate(zip(noise, lengths, strict=True)):
        for value, there, size in zip(values, acts, sizes, strict=True):
            # Columns of one joint are zero at all others.
            if j in there:
                out[begin : begin + size] = ar.whiten(value[:, j])
            begin += size
    return out


def joints_of(columns: Array) -> list[int]:
    """Numbers of the joints at which columns (M, n, k) are not all zero."""
    return [int(j) for j in np.flatnonzero(_acting(columns))]


def rows_of_joints(lengths: Sequence[int], noise: Sequence[ArModel]) -> list[slice]:
    """Rows of each joint in the result of `whitened`.

    Parameters
    ----------
    lengths
        M of every stretch.
    noise
        Noise model of each joint.
    """
    ends = np.cumsum([sum(length - ar.order for length in lengths) for ar in noise])
    return [slice(int(begin), int(end)) for begin, end in zip([0, *ends[:-1]], ends, strict=True)]


def summed_backwards(direction: Array, noise: Sequence[ArModel], lengths: Sequence[int]) -> list[Array]:
    """Weights (M, n) of each stretch with ``direction' whitened(values) = sum(weights * values)``.

    Parameters
    ----------
    direction
        Weights of the whitened rows, (R,).
    noise
        Noise model of each joint.
    lengths
        M of every stretch.
    """
    weights = [np.empty((length, len(noise))) for length in lengths]
    begin = 0
    for j, ar in enumerate(noise):
        backwards = np.append(ar.coefficients[::-1], 1.0) / math.sqrt(ar.variance)
        for weight in weights:
            size = weight.shape[0] - ar.order
            weight[:, j] = np.convolve(direction[begin : begin + size], backwards)
            begin += size
    return weights


@compiled
def _acting(columns: Array) -> NDArray[np.bool_]:
    acting = np.zeros(columns.shape[1], np.bool_)
    for j in range(columns.shape[1]):
        for m in range(columns.shape[0]):
            for k in range(columns.shape[2]):
                if columns[m, j, k] != 0.0:
                    acting[j] = True
                    break
            if acting[j]:
                break
    return acting


@compiled
def _add_lagged_sums(x: Array, sums: Array) -> None:
    for lag in range(sums.size):
        sums[lag] += np.dot(x[lag:], x[: x.size - lag])
