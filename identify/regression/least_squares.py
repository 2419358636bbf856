"""Least squares of tall, narrow systems, and the excitation that it needs (thesis 2.3.1)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from armident.configs import DataError
from armident.identify.regression.qr import triangularize

RANK_TOLERANCE = 1e-10
"""Smallest singular value of the column-normalised regressor, relative to the greatest, that counts as excited."""


def least_squares(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solution (b,) of ``min |y - x theta|`` by QR of the column-normalised regressor (2.22).

    Parameters
    ----------
    x
        Regressor, shape (rows, b).
    y
        Torques, shape (rows,).
    """
    b = x.shape[1]
    scale = column_norms(x)
    top = triangularize(x, y, columns=b, scales=(scale,))
    theta: NDArray[np.float64] = linalg.solve_triangular(top[:, :b], top[:, b]) / scale
    return theta


def inverse_gram(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """``(x' x)^-1`` from the triangular factor of ``x``."""
    scale = column_norms(x)
    factor = triangularize(x, columns=x.shape[1], scales=(scale,))
    inverse = linalg.solve_triangular(factor, np.eye(x.shape[1])) / scale[:, None]
    gram: NDArray[np.float64] = inverse @ inverse.T
    return gram


def column_norms(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Norm of each column, 1 where a column is zero."""
    norms = np.sqrt(np.einsum("ij,ij->j", x, x))
    return np.where(norms > 0.0, norms, 1.0)


def require_excitation(x: NDArray[np.float64], names: Sequence[str]) -> int:
    """Rank of the stacked regressor; a motion that leaves parameters undetermined is an error.

    Parameters
    ----------
    x
        Regressor, shape (rows, b).
    names
        Base parameters, shape (b,), for the message.

    Raises
    ------
    DataError
        Naming the parameters that the motion did not excite.
    """
    dead = [name for name, used in zip(names, np.any(x, axis=0).tolist(), strict=True) if not used]
    if not dead:
        _, s, vt = np.linalg.svd(triangularize(x / column_norms(x), columns=x.shape[1]))
        rank = int(np.sum(s > RANK_TOLERANCE * s[0]))
        if rank == len(names):
            return rank
        weak = np.abs(vt[rank:]).max(axis=0)
        dead = [names[k] for k in np.argsort(-weak)[: len(names) - rank + 2] if weak[k] > 0.1]
    raise DataError(
        f"the motion does not determine all {len(names)} base parameters; not excited: {', '.join(sorted(dead))}"
    )
