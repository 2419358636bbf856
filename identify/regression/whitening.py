"""Whitening of the equations of all joints, each joint by its noise model (thesis 2.3.1 and 6.1.3)."""

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.compiled import ARITHMETIC, compiled
from armident.identify.regression.ar_noise import ArModel


def whitened(
    values: Sequence[Array], noise: Sequence[ArModel], keep: Sequence[NDArray[np.bool_]] | None = None
) -> Array:
    """Values (M, n) or (M, n, k) of all joints (2.21) by experiment, whitened by their noise models, (R,) or (R, k)."""
    return np.concatenate([part for joint in whitened_series(values, noise, keep) for part in joint])


def whitened_series(
    values: Sequence[Array], noise: Sequence[ArModel], keep: Sequence[NDArray[np.bool_]] | None = None
) -> tuple[tuple[Array, ...], ...]:
    """Values of each joint in standard deviations of its noise model, one array per experiment."""
    acts = [range(len(noise)) if value.ndim == 2 else joints_of(value) for value in values]
    out = []
    for j, ar in enumerate(noise):
        series = []
        for k, value in enumerate(values):
            if j in acts[k]:
                part = ar.whiten(value[:, j])
            else:
                # Columns of one joint are zero at all others.
                part = np.broadcast_to(0.0, (max(value.shape[0] - ar.order, 0), *value.shape[2:]))
            series.append(part if keep is None else part[keep[k][ar.order :, j]])
        out.append(tuple(series))
    return tuple(out)


def rows_of_joints(counts: Iterable[int]) -> list[slice]:
    """Rows of each joint in the result of `whitened`."""
    ends = np.cumsum([0, *counts]).tolist()
    return [slice(begin, end) for begin, end in pairwise(ends)]


def joints_of(columns: Array) -> list[int]:
    """Numbers of the joints at which columns (M, n, k) are not all zero."""
    return [int(j) for j in np.flatnonzero(_acting(columns))]


def nonzero_columns(values: Array) -> NDArray[np.int64]:
    """Numbers of the columns of an array (M, k) that are not all zero."""
    return np.flatnonzero(_acting(values[:, :, None]))


@compiled("f8[:, :, :]", "f8[:, :, ::1]", "f8[::1, :, :]", **ARITHMETIC)
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
