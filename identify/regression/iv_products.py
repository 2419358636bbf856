"""Products of the instrumental-variable equations 6.30, joint by joint: rows are whitened, summed and forgotten.

At the recorded rate the whitened regressor and instruments of six joints are many times as large as the recording.
Their orthogonal triangularisation costs more than everything else. Instruments in nearly orthonormal combinations,
found from a share of the rows, make plain sums of products as accurate.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.equations import ExperimentEquations
from armident.identify.regression.fir import filter_columns
from armident.identify.regression.tall_qr import triangularize
from armident.identify.signals.decimate import Decimation

Array = NDArray[np.float64]

SAMPLE = 64
"""Rows per parameter, at least, from which the combinations of the instruments are found."""

CHUNK_ROWS = 2048
"""Rows whitened at a time."""

ORTHOGONAL_ENOUGH = 1e3
"""Condition number of normalised instruments up to which plain products, losing six digits of sixteen, will do."""

NEGLIGIBLE = 1e-14
"""Share of an instrument, beside the others, that counts as rounding: such a one is left as it is."""


@dataclass(frozen=True)
class IvProducts:
    """Sums over the whitened rows, with combinations ``Q = Z T`` of the instruments and columns ``X D`` of norm one.

    Parameters
    ----------
    gram
        ``Q' Q``, shape (b, b).
    cross
        ``Q' X D``, shape (b, b).
    projected
        ``Q' y``, shape (b,).
    scale
        Norms of the columns of X, shape (b,).
    """

    gram: Array
    cross: Array
    projected: Array
    scale: Array

    @property
    def theta(self) -> Array:
        """The solution of ``Z' W (y - X theta) = 0`` (6.30), shape (b,)."""
        theta: Array = np.linalg.solve(self.cross, self.projected) / self.scale
        return theta

    @property
    def covariance(self) -> Array:
        """``(Z' W X)^-1 Z' W Z (X' W Z)^-1`` (4.34), shape (b, b)."""
        bread = np.linalg.inv(self.cross) / self.scale[:, None]
        covariance: Array = bread @ self.gram @ bread.T
        return (covariance + covariance.T) / 2


def iv_products(
    instruments: Sequence[Array], blocks: Sequence[ExperimentEquations], noise: Sequence[ArModel]
) -> IvProducts:
    """Whiten every joint by its noise model and sum the products that the IV equations need.

    Parameters
    ----------
    instruments
        Regressor at simulated signals, one (M, n, b) array per experiment.
    blocks
        The equations, with the regressor at measured signals.
    noise
        Noise model of each joint.
    """
    combine = _combinations(instruments, blocks, noise)

    def of_series(joint_and_experiment: tuple[int, int]) -> list[Array]:
        j, number = joint_and_experiment
        taps, block = _whitening(noise[j]), blocks[number]
        z, x, y, kept = instruments[number][:, j], block.x[:, j], block.y[:, j, None], block.keep[:, j]
        b = x.shape[1]
        sums = [np.zeros((b, b)), np.zeros((b, b)), np.zeros(b), np.zeros(b)]
        # A few rows at a time, which stay in cache.
        for first in range(0, x.shape[0] - taps.size + 1, CHUNK_ROWS):
            span = slice(first, first + CHUNK_ROWS + taps.size - 1)
            use = kept[span][taps.size - 1 :]
            q = _rows(filter_columns(taps, z[span]), use)
            q = q * combine if combine.ndim == 1 else q @ combine
            p = _rows(filter_columns(taps, x[span]), use)
            e = _rows(filter_columns(taps, y[span]), use)[:, 0]
            for total, term in zip(sums, (q.T @ q, q.T @ p, q.T @ e, np.einsum("ij,ij->j", p, p)), strict=True):
                total += term
        return sums

    series = [(j, number) for j in range(len(noise)) for number in range(len(blocks))]
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        # Summed in the order of the joints, so that the same data give the same bits.
        gram, cross, projected, squares = (sum(terms) for terms in zip(*pool.map(of_series, series), strict=True))
    scale = np.sqrt(squares)
    scale[scale == 0.0] = 1.0
    return IvProducts(gram, cross / scale, projected, scale)


def _combinations(
    instruments: Sequence[Array], blocks: Sequence[ExperimentEquations], noise: Sequence[ArModel]
) -> Array:
    """``T`` (b, b) that makes the columns of ``Z T`` nearly orthonormal, from every so many whitened rows.

    Only its diagonal (b,), of the inverse norms, where the columns are far enough from dependent as they are.
    """
    b = instruments[0].shape[2]
    total = sum(int(block.keep.sum()) for block in blocks)
    every = max(1, total // (SAMPLE * b))
    parts = []
    for j, ar in enumerate(noise):
        thinned = Decimation(every, _whitening(ar)[::-1])
        for zeta, block in zip(instruments, blocks, strict=True):
            parts.append(_rows(thinned(zeta[:, j]), block.keep[ar.order :: every, j]))
    rows = np.concatenate(parts)
    norms = np.sqrt(np.einsum("ij,ij->j", rows, rows))
    norms[norms == 0.0] = 1.0
    factor = triangularize(rows / norms, columns=b)
    if np.linalg.cond(factor) < ORTHOGONAL_ENOUGH:
        inverse_norms: Array = 1.0 / norms
        return inverse_norms
    weak = np.abs(np.diag(factor)) < NEGLIGIBLE
    factor[weak, weak] = 1.0
    combined: Array = linalg.solve_triangular(factor, np.eye(b)) / norms[:, None]
    return combined


def _whitening(ar: ArModel) -> Array:
    """Impulse response of ``1 / (lambda H)``."""
    response: Array = np.append(1.0, ar.coefficients) / np.sqrt(ar.variance)
    return response


def _rows(values: Array, kept: NDArray[np.bool_]) -> Array:
    return values if kept.all() else values[kept]
