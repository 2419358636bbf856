"""Corrections for several tests at once."""

import numpy as np

from armident.arrays import Array


def holm(p: Array) -> Array:
    """P-values (k,), adjusted by Holm's step-down procedure: reject if at most the level of the whole family.

    Source: Holm, A simple sequentially rejective multiple test procedure, Scandinavian Journal of Statistics 6, 1979.
    """
    order = np.argsort(p, kind="stable")
    stepped = np.maximum.accumulate(p[order] * (p.size - np.arange(p.size)))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(stepped, 1.0)
    return adjusted
