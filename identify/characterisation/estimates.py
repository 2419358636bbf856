"""Weighted least squares of series whose noise has its own colour and size in each of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armident.arrays import Array
from armident.identify.regression.ar_noise import ArModel, fit_ar
from armident.identify.regression.orders import MAX_AR_ORDER

RATE_HZ = 200.0
"""Rate of block means of the signals: friction of an arm under feedback acts below a fifth of it."""
LEVEL = 0.01
"""Probability that something is seen that is not there."""
SEEN = -2.0 * float(np.log(LEVEL))
"""Twice the gain of log likelihood by two parameters that noise reaches with this probability."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """Estimate (k,) with its covariance, the noise model, and the scale (S,) of each series' noise over it.

    ``columns``, ``residual``: whitened, (W, k) and (W,), of unit variance.
    """

    theta: Array
    covariance: Array
    noise: ArModel
    scale: Array
    columns: Array
    residual: Array

    @property
    def std(self) -> Array:
        """Standard deviations, (k,)."""
        return np.sqrt(np.diag(self.covariance))

    def whiten(self, series: Sequence[Array]) -> Array:
        """Return series (M, ...) one after the other, in standard deviations of their noise."""
        return np.concatenate([self.noise.whiten(s) / size for s, size in zip(series, self.scale, strict=True)])


def fitted(columns: Sequence[Array], values: Sequence[Array]) -> Fitted:
    """Fit values (M,) by columns (M, k) in each series, with the autocorrelation of the residual (thesis 2.3.1).

    Series longer than the noise model share it, each with its own variance: slow motion sticks, and fast motion shakes.
    """
    theta = solved(np.concatenate(columns), np.concatenate(values))
    errors = [y - a @ theta for a, y in zip(columns, values, strict=True)]
    equal = [e / max(float(np.std(e)), 1e-9) for e in errors]
    noise = fit_ar(equal, min(MAX_AR_ORDER, min(e.size for e in errors) // 2))
    white = [noise.whiten(e) for e in errors]
    rest = max(sum(w.size for w in white) - theta.size, 1)
    free = rest / sum(w.size for w in white)
    scale = np.array([max(float(np.sqrt(np.mean(w**2) / free)), 1e-9) for w in white])
    # Few rows may look quiet by chance: none counts more than usual.
    scale = np.maximum(scale, np.median(scale))
    first = Fitted(theta, np.empty((0, 0)), noise, scale, np.empty((0, 0)), np.empty(0))
    a, y = first.whiten(columns), first.whiten(values)
    covariance = np.asarray(np.linalg.pinv(a.T @ a), dtype=np.float64)
    theta = covariance @ (a.T @ y)
    return Fitted(theta, covariance, noise, scale, a, y - a @ theta)


def solved(columns: Array, values: Array) -> Array:
    """Return the least-squares solution (k,) of values (M,) by columns (M, k)."""
    return np.asarray(np.linalg.lstsq(columns, values, rcond=None)[0], dtype=np.float64)


def averaged(x: Array, block: int) -> Array:
    """Return means (M // block, ...) of blocks of rows (M, ...)."""
    whole = x.shape[0] // block * block
    means: Array = x[:whole].reshape(-1, block, *x.shape[1:]).mean(axis=1)
    return means
