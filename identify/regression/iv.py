"""Instrumental variables: products of whitened equations, their solution and its covariance (thesis 2.33, 4.34, 6.30).

Whitened rows are many times as large as the recording: joint by joint, a few at a time, they are summed and forgotten.
Nearly orthonormal instruments make plain sums as accurate as a triangularisation.
"""

import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from armident.arrays import Array
from armident.compiled import ARITHMETIC, compiled
from armident.identify.regression.ar_noise import WHITE, ArModel
from armident.identify.regression.equations import InstrumentedEquations
from armident.identify.regression.fir import filter_columns
from armident.identify.regression.least_squares import column_norms
from armident.identify.regression.qr import triangularize, triangularize_parts
from armident.identify.regression.whitening import nonzero_columns, whitened
from armident.identify.signals.decimate import Decimation
from armident.identify.signals.recursive import recursive_filter

SAMPLE = 64
"""Rows per parameter, at least, from which the combinations of the instruments are found."""

CHUNK_ROWS = 2048
"""Rows whitened at a time."""

ORTHOGONAL_ENOUGH = 1e3
"""Condition number of normalised instruments up to which plain products, losing six digits of sixteen, will do."""

NEGLIGIBLE = 1e-14
"""Share of an instrument, beside the others, that counts as rounding: such a one is left as it is."""


@dataclass(frozen=True, eq=False)
class IvProducts:
    """Products of whitened rows: ``Q' Q``, ``Q' X D`` (b, b) and ``Q' y`` (b,) with ``Q = Z T`` of norm one."""

    gram: Array
    cross: Array
    projected: Array
    scale: Array

    @cached_property
    def _factors(self) -> tuple[Array, NDArray[np.int32]]:
        lu, pivots, info = linalg.lapack.dgetrf(self.cross)
        if info > 0:
            raise np.linalg.LinAlgError("the instruments do not determine all parameters")
        return lu, pivots

    def parameters(self, through: Array) -> Array:
        """Parameters (b,) or (b, k) of torques with ``Q' torques`` = ``through``; LinAlgError if singular."""
        solved: Array = linalg.lu_solve(self._factors, through, check_finite=False)
        return (solved.T / self.scale).T

    def projection_weights(self, through: Array) -> Array:
        """Weights W (b, k) of the combinations with ``X' Q W`` = ``through``; LinAlgError if singular.

        Instruments less ``Q W`` are orthogonal to the regressor, where ``through`` are their products with it.
        """
        weights: Array = linalg.lu_solve(self._factors, through / self.scale[:, None], trans=1, check_finite=False)
        return weights

    @cached_property
    def theta(self) -> Array:
        """The solution (b,) of ``Z' W (y - X theta) = 0`` (2.33, 6.30); LinAlgError if singular."""
        return self.parameters(self.projected)

    @cached_property
    def covariance(self) -> Array:
        """``(Z' W X)^-1 Z' W Z (X' W Z)^-1`` (4.34), shape (b, b); LinAlgError if singular.

        Equals ``(Z' W Z)^-1`` (2.34, 6.31) with an exact simulator, and stays valid with an approximate controller.
        """
        covariance = self.parameters(self.parameters(self.gram).T)
        return (covariance + covariance.T) / 2


def factored(z: Array, x: Array, y: Array) -> IvProducts:
    """Products of whitened rows with orthonormal instruments, by the QR factors of ``z``, without ``z' x``."""
    return factored_parts([(z, x, y)], x.shape[1])


def factored_parts(parts: Iterable[tuple[Array, Array, Array]], b: int) -> IvProducts:
    """`factored` of rows that come in parts, of which one is in memory; b parameters."""
    top, norms = triangularize_parts(parts, columns=b)
    scale = norms[b : 2 * b]
    return IvProducts(np.eye(b), top[:, b : 2 * b] / scale, top[:, 2 * b], scale)


def instrumented_parts(
    blocks: Iterable[InstrumentedEquations], noise: Sequence[ArModel]
) -> Iterator[tuple[Array, Array, Array]]:
    """Yield whitened instruments, regressor (rows, b) and torques (rows,) of one experiment after the other."""
    for block in blocks:
        z, x, y = (whitened([values], noise, [block.keep]) for values in (block.z, block.x, block.y))
        yield z, x, y


def serial_covariance(
    zeta: Sequence[Array],
    x: Sequence[Array],
    keep: Sequence[NDArray[np.bool_]],
    weights: Sequence[ArModel],
    noise: Sequence[ArModel],
) -> Array:
    """Covariance (b, b) of an IV estimate with weights 2.24 whose residuals are serially correlated.

    ``A Omega A'`` with ``A = (Z' W X)^-1 Z' W`` and ``Omega`` of the AR models ``noise``: ``Z' W Omega W Z`` is the
    Gram matrix of ``H' W Z``. ``zeta``, ``x`` (M, n, b) and ``keep`` (M, n): per experiment.
    """
    b = zeta[0].shape[2]
    squares, cross, meat = np.zeros(b), np.zeros((b, b)), np.zeros((b, b))
    for z, regressor, used in zip(zeta, x, keep, strict=True):
        rows = whitened([z], weights, [used])
        squares += np.einsum("ij,ij->j", rows, rows)
        cross += rows.T @ whitened([regressor], weights, [used])
        for j, (weight, ar) in enumerate(zip(weights, noise, strict=True)):
            acting = nonzero_columns(z[:, j])
            own = z[:, j, acting] * used[:, j, None] / weight.variance
            coloured = recursive_filter([np.sqrt(ar.variance)], np.append(1.0, ar.coefficients), own[::-1])
            meat[np.ix_(acting, acting)] += coloured.T @ coloured
    zs = np.sqrt(np.where(squares > 0.0, squares, 1.0))
    return IvProducts(meat / np.outer(zs, zs), cross / np.outer(zs, zs), np.zeros(b), zs).covariance


@dataclass(frozen=True, eq=False)
class Columns:
    """Rows ``[X, Z, y]`` of one joint in one experiment, collected from the ``chosen`` columns when they are used."""

    x: Array
    z: Array
    y: Array
    chosen: tuple[NDArray[np.int64], NDArray[np.int64]]

    def __len__(self) -> int:
        return self.y.size

    def __getitem__(self, rows: slice) -> Array:
        return _side_by_side(self.x[rows], self.z[rows], self.y[rows], *self.chosen)


@dataclass(frozen=True, eq=False)
class JointEquations:
    """Equations of one joint without the columns that are zero there: a link acts on the joints before it only.

    ``x``, ``z``: numbers of the columns. ``parts``: rows ``[X, Z, y]``, (M, x + z + 1) per experiment. ``keep``: (M,).
    """

    x: NDArray[np.int64]
    z: NDArray[np.int64]
    parts: tuple[Columns | Array, ...]
    keep: tuple[NDArray[np.bool_] | None, ...]

    @classmethod
    def of(cls, blocks: Sequence[InstrumentedEquations], joint: int, *, copied: bool) -> "JointEquations":
        """Equations of a joint; ``copied``: columns side by side, faster to whiten many times."""
        x = np.unique(np.concatenate([nonzero_columns(b.x[:, joint]) for b in blocks]))
        z = np.unique(np.concatenate([nonzero_columns(b.z[:, joint]) for b in blocks]))
        parts = [Columns(b.x[:, joint], b.z[:, joint], b.y[:, joint], (x, z)) for b in blocks]
        keep = [None if b.keep[:, joint].all() else b.keep[:, joint] for b in blocks]
        return cls(x, z, tuple(part[:] if copied else part for part in parts), tuple(keep))

    def whitened(self, ar: ArModel) -> Iterator[Array]:
        """Rows whitened by a noise model, (m, x + z + 1), a few at a time, which stay in the cache."""
        for part, kept in zip(self.parts, self.keep, strict=True):
            for first in range(0, len(part) - ar.order, CHUNK_ROWS):
                span = slice(first, first + CHUNK_ROWS + ar.order)
                rows = filter_columns(ar.whitening, part[span])
                yield rows if kept is None else rows[kept[span][ar.order :]]

    @cached_property
    def plain(self) -> Array:
        """`products` of the rows without weights: over its variance, those under any white noise."""
        return self.products(self.whitened(WHITE))

    def products(self, rows: Iterable[Array], combine: Array | None = None) -> Array:
        """``Q' [X, Q, y]`` (q, x + q + 1) of whitened rows ``[X, Z, y]``; ``Q = Z T``, or ``Z`` without T (b, b)."""
        width = self.x.size
        count = self.z.size if combine is None else combine.shape[1]
        sums = np.zeros((count, width + count + 1))
        for white in rows:
            own = white[:, width:-1]
            if combine is None:
                sums += own.T @ white
                continue
            own = own @ combine[self.z]
            sums[:, :width] += own.T @ white[:, :width]
            sums[:, width:-1] += own.T @ own
            sums[:, -1] += own.T @ white[:, -1]
        return sums


def together(
    products: Iterable[tuple[JointEquations, Array]], b: int, *, combined: bool = False, scale: Array | None = None
) -> IvProducts:
    """Products of the rows of all joints, added in this order, with combinations of the instruments of norm one.

    ``scale`` (b,): of the parameters' columns; ``None``: norms of the instruments.
    """
    gram, cross, projected = np.zeros((b, b)), np.zeros((b, b)), np.zeros(b)
    for joint, sums in products:
        q, width = np.arange(b) if combined else joint.z, joint.x.size
        cross[np.ix_(q, joint.x)] += sums[:, :width]
        gram[np.ix_(q, q)] += sums[:, width:-1]
        projected[q] += sums[:, -1]
    norms = np.sqrt(np.diag(gram))
    norms = np.where(norms == 0.0, 1.0, norms)
    scale = norms if scale is None else scale
    return IvProducts(gram / np.outer(norms, norms), cross / np.outer(norms, scale), projected / norms, scale)


def iv_products(blocks: Sequence[InstrumentedEquations], noise: Sequence[ArModel]) -> IvProducts:
    """Whiten every joint by its noise model and sum the products that the IV equations need."""
    combine, scale = _combinations(blocks, noise)

    def of_joint(block: InstrumentedEquations, j: int) -> tuple[JointEquations, Array]:
        joint = JointEquations.of([block], j, copied=False)
        return joint, joint.products(joint.whitened(noise[j]), combine)

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        # Summed in the order of experiments and joints, so that the same data give the same bits.
        sums = (pair for block in blocks for pair in pool.map(partial(of_joint, block), range(len(noise))))
        return together(sums, scale.size, combined=combine is not None, scale=scale)


def _combinations(blocks: Sequence[InstrumentedEquations], noise: Sequence[ArModel]) -> tuple[Array | None, Array]:
    """``T`` (b, b) that makes columns of ``Z T`` nearly orthonormal, and norms (b,), from every so many rows.

    ``T`` is ``None`` where the columns are far enough from dependent.
    """
    b = blocks[0].z.shape[2]
    total = sum(int(block.keep.sum()) for block in blocks)
    every = max(1, total // (SAMPLE * b))
    parts = []
    for block in blocks:
        for j, ar in enumerate(noise):
            thinned = Decimation(every, ar.whitening[::-1])
            parts.append(thinned(block.z[:, j])[block.keep[ar.order :: every, j]])
    rows = np.concatenate(parts)
    norms = column_norms(rows)
    factor = triangularize(rows / norms, columns=b)
    scale = norms * np.sqrt(every)
    if np.linalg.cond(factor) < ORTHOGONAL_ENOUGH:
        return None, scale
    weak = np.abs(np.diag(factor)) < NEGLIGIBLE
    factor[weak, weak] = 1.0
    combined: Array = linalg.solve_triangular(factor, np.eye(b)) / norms[:, None]
    return combined, scale


@compiled(
    "f8[:, :], f8[:, :], f8[:], i8[::1], i8[::1]",
    "f8[:, ::1], f8[:, ::1], f8[:], i8[::1], i8[::1]",
    "f8[:, ::1], f8[:, ::1], f8[::1], i8[::1], i8[::1]",
    **ARITHMETIC,
)
def _side_by_side(x: Array, z: Array, y: Array, of_x: NDArray[np.int64], of_z: NDArray[np.int64]) -> Array:
    out = np.empty((y.size, of_x.size + of_z.size + 1))
    for m in range(y.size):
        for i in range(of_x.size):
            out[m, i] = x[m, of_x[i]]
        for i in range(of_z.size):
            out[m, of_x.size + i] = z[m, of_z[i]]
        out[m, -1] = y[m]
    return out
