"""Least squares of tall, narrow systems, and the excitation that it needs (thesis 2.3.1)."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from scipy import linalg

from armident.arrays import Array
from armident.configs import DataError
from armident.identify.regression.qr import triangularize_parts

RANK_TOLERANCE = 1e-10
"""Smallest singular value of the column-normalised regressor, relative to the greatest, that counts as excited."""


@dataclass(frozen=True, eq=False)
class Triangle:
    """QR factors (b, b), projections (b,) and column norms (b,) of a column-normalised regressor with torques."""

    factor: Array
    projected: Array
    scale: Array

    @classmethod
    def of(cls, parts: Iterable[tuple[Array, Array]]) -> "Triangle":
        """Factors of regressor (rows, b) and torques (rows,) that come in parts, at least one."""
        rows = iter(parts)
        first = next(rows)
        b = first[0].shape[1]
        top, norms = triangularize_parts(chain([first], rows), columns=b)
        return cls(top[:, :b] / norms[:b], top[:, b], norms[:b])

    @property
    def theta(self) -> Array:
        """Solution (b,) of ``min |y - x theta|`` (2.22)."""
        solved: Array = linalg.solve_triangular(self.factor, self.projected) / self.scale
        return solved

    @property
    def inverse_gram(self) -> Array:
        """``(x' x)^-1``, (b, b)."""
        inverse = linalg.solve_triangular(self.factor, np.eye(self.scale.size)) / self.scale[:, None]
        gram: Array = inverse @ inverse.T
        return gram


def least_squares(x: Array, y: Array) -> Array:
    """Solution (b,) of ``min |y - x theta|`` by QR of the column-normalised regressor (2.22)."""
    return Triangle.of([(x, y)]).theta


def inverse_gram(x: Array) -> Array:
    """``(x' x)^-1`` from the triangular factor of ``x``."""
    return Triangle.of([(x, np.zeros(x.shape[0]))]).inverse_gram


def column_norms(x: Array) -> Array:
    """Norm of each column, 1 where a column is zero."""
    norms = np.sqrt(np.einsum("ij,ij->j", x, x))
    return np.where(norms > 0.0, norms, 1.0)


def require_excitation(rows: Triangle, names: Sequence[str]) -> int:
    """Rank of the stacked regressor; DataError names the parameters that the motion leaves undetermined."""
    dead = [name for name, used in zip(names, np.any(rows.factor, axis=0).tolist(), strict=True) if not used]
    if not dead:
        _, s, vt = np.linalg.svd(rows.factor)
        rank = int(np.sum(s > RANK_TOLERANCE * s[0]))
        if rank == len(names):
            return rank
        weak = np.abs(vt[rank:]).max(axis=0)
        dead = [names[k] for k in np.argsort(-weak)[: len(names) - rank + 2] if weak[k] > 0.1]
    raise DataError(
        f"the motion does not determine all {len(names)} base parameters; not excited: {', '.join(sorted(dead))}"
    )
