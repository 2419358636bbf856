"""Running variance of the residuals, with an allowance for their serial correlation."""

import math

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.monitoring.recursive.kernels import add_residuals
from armident.identify.monitoring.recursive.settings import RecursiveSettings


class RunningNoise:
    """Long-run variance of each joint's residuals, by Newey and West's estimator with exponential forgetting.

    Slow residuals disturb friction, nearly constant within a move, as white noise of this variance does.
    """

    _saved = ("past", "known", "sums", "counts", "seen")

    def __init__(self, n: int, rate_hz: float, settings: RecursiveSettings) -> None:
        memory = settings.noise_memory_s * rate_hz
        self.lags = max(1, math.ceil(settings.noise_correlation_s * rate_hz))
        self._keep = math.exp(-1.0 / memory)
        self._least = max(2 * self.lags, round(settings.noise_least_s * rate_hz))
        self._weights = 2.0 * (1.0 - np.arange(self.lags + 1) / (self.lags + 1.0))
        self._weights[0] = 1.0
        self._n = n
        self.reset()

    def reset(self) -> None:
        """Forget all residuals."""
        self.past = np.zeros((self.lags, self._n))
        self.known = np.zeros((self.lags, self._n), np.bool_)
        self.sums = np.zeros((self.lags + 1, self._n))
        self.counts = np.zeros((self.lags + 1, self._n))
        self.seen = np.zeros(self._n, np.int64)

    def interrupt(self) -> None:
        """Forget the last residuals: the next one does not follow them."""
        self.known[:] = False

    def add(self, residual: Array, use: NDArray[np.bool_]) -> None:
        """Add the residuals (n,), N m or N, of an instant, and the mask (n,) of those that count."""
        self.seen += use
        add_residuals(residual, use, self._keep, self.past, self.known, self.sums, self.counts)

    @property
    def ready(self) -> NDArray[np.bool_]:
        """Mask (n,) of the joints with enough residuals."""
        return self.seen >= self._least

    @property
    def short_run(self) -> Array:
        """Variance of the residuals, (n,), (N m)^2 or N^2; NaN without residuals."""
        count = self.counts[0]
        return np.where(count > 0, self.sums[0] / np.where(count > 0, count, 1.0), np.nan)

    @property
    def variance(self) -> Array:
        """Long-run variance (n,), (N m)^2 or N^2, at least the variance; NaN without residuals."""
        covariances = self.sums / np.maximum(self.counts, 1e-300)
        total: Array = (self._weights[:, None] * covariances).sum(axis=0)
        return np.maximum(total, self.short_run)
