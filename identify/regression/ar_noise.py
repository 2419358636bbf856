"""Autoregressive noise models, whitening and whiteness (thesis section 6.1.3)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.compiled import ARITHMETIC, compiled
from armident.identify.regression.fir import filter_columns

LEAST_VARIANCE = 1e-300
"""Variance of a residual that is zero, in squared units of the series: its inverse is finite."""

PIECE = 4096
"""Numbers multiplied at a time: they stay in the cache."""


@dataclass(frozen=True, eq=False)
class ArModel:
    """Noise model ``C(z^-1) xi = e`` with ``C = 1 + c_1 z^-1 + ...`` (6.19), ``e`` white; ``aic``: see (6.24)."""

    coefficients: Array
    variance: float
    aic: float

    @property
    def order(self) -> int:
        """Number of coefficients."""
        return self.coefficients.size

    @property
    def whitening(self) -> Array:
        """Impulse response of the filter ``C(z^-1) / lambda``, shape (l + 1,)."""
        response: Array = np.append(1.0, self.coefficients) / np.sqrt(self.variance)
        return response

    def whiten(self, x: Array) -> Array:
        """``C(z^-1) x / lambda`` along the first axis, (M, ...) to (M - order or 0, ...), without an initial state."""
        rows = x.shape[0] - self.order
        if rows < 1:
            return np.empty((0, *x.shape[1:]))
        return filter_columns(self.whitening, x.reshape(x.shape[0], -1)).reshape((rows, *x.shape[1:]))

    def widened(self, samples: int) -> "ArModel":
        """The same filter, its variance times ``((N + l) / (N - l))^2``: for weights and covariances of an estimate.

        The information ``X' Omega^-1 X`` has two relative errors of ``2 l / N`` (N: all ``samples``). On other
        residuals the filter's error has ``(N + l) / (N - l)`` times the variance (Akaike, Fitting autoregressive models
        for prediction, 1969). A weighted estimate scatters by the relative variance of an AR spectrum, ``2 l / N`` on
        the average of the frequencies (Berk, Consistent autoregressive spectral estimates, 1974).
        """
        factor = ((samples + self.order) / (samples - self.order)) ** 2
        return replace(self, variance=factor * self.variance)


WHITE = ArModel(np.empty(0), 1.0, 0.0)
"""The initial noise model, ``H = 1`` and ``lambda = 1`` (section 6.2.2, step 1)."""


@dataclass(frozen=True)
class WhitenessTest:
    """Autocorrelation of residuals at lags 1..L, with the half width ``bound`` of the 2-sigma band of white noise."""

    autocorrelation: Array
    bound: float

    @property
    def lags(self) -> int:
        """Number of lags tested."""
        return self.autocorrelation.size

    @property
    def fraction_outside(self) -> float:
        """Share of the lags outside the band; white noise has about 0.05."""
        return float(np.mean(np.abs(self.autocorrelation) > self.bound))


def ar_models(
    errors: Sequence[Array],
    max_order: int,
    *,
    keep: Sequence[NDArray[np.bool_]] | None = None,
    parameters: float = 0.0,
    absorbed: Sequence[Array] | None = None,
) -> list[ArModel]:
    """AR model of the errors (M, n) of each joint (2.25, 2.26, 6.21 to 6.25); order at most a tenth of the samples.

    ``parameters``: number of estimated ones, which widens all variances: enough for weights and comparisons.
    ``absorbed``: autocovariances of the noise that they took from each joint (see `fit_ar`), for every frequency.
    ``keep`` (M, n): for white noise alone, as a filter needs a gapless record.
    """
    if keep is not None and max_order:
        raise ValueError("coloured noise needs a record without gaps")
    models, equations = [], 0
    for j in range(errors[0].shape[1]):
        series = [e[:, j] if keep is None else e[keep[k][:, j], j] for k, e in enumerate(errors)]
        models.append(fit_ar(series, max_order, None if absorbed is None else absorbed[j]))
        equations += sum(s.size for s in series)
    equations = max(equations, 1)
    free = max(1.0 - parameters / equations, 1.0 / equations)
    return [replace(ar, variance=ar.variance / free) for ar in models]


def fit_ar(series: Sequence[Array], max_order: int, absorbed: Array | None = None) -> ArModel:
    """AR model of residuals by Levinson-Durbin on the Yule-Walker equations, order by AIC (6.21 to 6.25).

    The order is at most a tenth of the samples. ``absorbed``: autocovariance sums, lags 0.., that parameters took out.
    """
    total = sum(s.size for s in series)
    max_order = max(0, min(max_order, total // 10, min(s.size for s in series) - 1))
    r = np.zeros(max_order + 1) if absorbed is None else absorbed[: max_order + 1].copy()
    for s in series:
        r += lagged_sums(s[:, None], max_order)
    r /= max(total, 1)
    if r[0] <= LEAST_VARIANCE:
        return ArModel(np.empty(0), LEAST_VARIANCE, -np.inf)
    return lowest_aic(r, total)


def lowest_aic(r: Array, samples: int) -> ArModel:
    """AR model of the order with the lowest Akaike criterion (6.24, 6.25), from autocovariances ``r``, ``r[0] > 0``."""
    return ArModel(*_lowest_aic(r, samples))


def fit_spectrum(power: Array, order: int) -> ArModel:
    """Stable AR model, of at most an order, whose ``variance / |C|^2`` follows a spectrum from zero to Nyquist."""
    r = np.fft.irfft(power)[: order + 1]
    coefficients, variances = levinson_durbin(r)
    last = variances.size - 1
    return ArModel(coefficients[last, :last].copy(), float(variances[last]), -np.inf)


@compiled("f8[::1]", **ARITHMETIC)
def levinson_durbin(r: Array) -> tuple[Array, Array]:
    """Yule-Walker coefficients (P + 1, L) and variances (P + 1,) of every order by Levinson-Durbin (6.21 to 6.23).

    ``r``: autocovariances at lags 0..L, ``r[0] > 0``. P is L, or less where a model of order P + 1 would be exact.
    """
    highest = r.size - 1
    coefficients, variances = np.zeros((highest + 1, highest)), np.zeros(highest + 1)
    variances[0] = r[0]
    for order in range(1, highest + 1):
        c = coefficients[order - 1]
        reflected = r[order]
        for i in range(order - 1):
            reflected += c[i] * r[order - 1 - i]
        reflection = -reflected / variances[order - 1]
        for i in range(order - 1):
            coefficients[order, i] = c[i] + reflection * c[order - 2 - i]
        coefficients[order, order - 1] = reflection
        variances[order] = variances[order - 1] * (1 - reflection**2)
        if variances[order] <= 1e-14 * r[0]:
            return coefficients[:order], variances[:order]
    return coefficients, variances


def lagged_sums(x: Array, max_lag: int, first: int = 0) -> Array:
    """``sum_t x(t) . x(t - k)`` of ``x`` (M, m) for lags 0..max_lag, shape (max_lag + 1,)."""
    return _lagged_sums(np.ascontiguousarray(x, dtype=np.float64), max_lag, first)


def whiteness(series: Sequence[Array], lags: int = 20) -> WhitenessTest:
    """Autocorrelation of residuals pooled over experiments, with the bound ``2 / sqrt(M)``."""
    total = sum(s.size for s in series)
    mean = sum(float(s.sum()) for s in series) / total
    r = np.zeros(lags + 1)
    for s in series:
        centred = s - mean
        for lag in range(min(lags, centred.size - 1) + 1):
            r[lag] += centred[lag:] @ centred[: centred.size - lag]
    return WhitenessTest(r[1:] / r[0] if r[0] > 0 else np.zeros(lags), 2 / float(np.sqrt(total)))


@compiled("f8[::1], i8", **ARITHMETIC)
def _lowest_aic(r: Array, samples: int) -> tuple[Array, float, float]:
    """Coefficients, variance and criterion of the model with the lowest AIC."""
    coefficients, variances = levinson_durbin(r)
    best, lowest = 0, np.inf
    for order in range(variances.size):
        criterion = 2 * order + samples * np.log(variances[order])
        if criterion < lowest:
            best, lowest = order, criterion
    return coefficients[best, :best].copy(), variances[best], lowest


@compiled("f8[:, ::1], i8, i8", **ARITHMETIC)
def _lagged_sums(x: Array, max_lag: int, first: int) -> Array:
    samples, width = x.shape
    # The previous sample is the previous row of the array: one long sum per lag, in pieces that stay in the cache.
    flat, rows = x.ravel(), max(1, PIECE // width)
    sums = np.zeros(max_lag + 1)
    for begin in range(0, samples, rows):
        end = min(begin + rows, samples)
        for lag in range(max_lag + 1):
            start = max(begin, first, lag)
            if start < end:
                sums[lag] += np.dot(
                    flat[start * width : end * width], flat[(start - lag) * width : (end - lag) * width]
                )
    return sums
