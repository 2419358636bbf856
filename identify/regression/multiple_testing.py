"""Corrections for several tests at once."""

import numpy as np
from numpy.typing import NDArray


def holm(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """P-values adjusted for the number of tests by Holm's step-down procedure.

    A test is rejected at level alpha of the whole family if its adjusted p-value is at most alpha.

    ``p``: P-values of the single tests, shape (k,). Returns adjusted p-values in the same order, shape (k,), at most 1.

    Notes
    -----
    Source: Holm, A simple sequentially rejective multiple test procedure, Scandinavian Journal of Statistics 6, 1979.
    """
    order = np.argsort(p, kind="stable")
    stepped = np.maximum.accumulate(p[order] * (p.size - np.arange(p.size)))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(stepped, 1.0)
    return adjusted
