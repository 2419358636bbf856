"""Kurtosis test for transient disturbances that are independent of the motion.

Transients are a small part of the power of the residual over a whole recording, and they do not repeat. So tests of
power and of repeated motion miss them. They change the distribution of the residual: noise of currents and encoders
is a sum of many small contributions and so is Gaussian, transients have heavier tails. The test is that of the fourth
moment, with the effective sample size of a Gaussian series of the same autocorrelation.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from armident.identify.diagnosis.lines import lowest_frequency, residuals
from armident.identify.diagnosis.maps import SIDE, hats
from armident.identify.diagnosis.regression import Fit
from armident.identify.signals.decimate import design

Array = NDArray[np.float64]

BANDWIDTHS = 2.0
"""Highest frequency of the test, over the bandwidth of the motion: above it the noise dominates."""

LEAST = 50.0
"""Least number of independent samples for a test of the tails."""

MEDIAN = float(stats.chi2.ppf(0.5, 1))
"""Median of the power of Gaussian noise over its mean."""

QUIET = 0.05
"""Least power of the noise at any speed, over its mean power."""

MATERIAL = 0.05
"""Least share of the power of the smoothed residual in excess of usual noise for a finding."""

RARE = 1e-3
"""Probability that noise exceeds the band of the curve, in each window."""


@dataclass(frozen=True)
class Bursts:
    """Transients in the residual of one joint.

    Parameters
    ----------
    share
        Share of its power, as smoothed, in excess of noise of its usual power.
    p_value
        Probability of such tails for Gaussian noise of the same autocorrelation.
    t, amplitude, noise
        Centres of the windows, s; root mean square of the smoothed residual in each; level that noise of the usual
        power exceeds in one window of a thousand, N m or N, (G,) each.
    """

    share: float
    p_value: float
    t: Array
    amplitude: Array
    noise: Array


def bursts(fit: Fit, alpha: float = 0.01) -> dict[int, Bursts]:
    """Transients of the joints with a significant and material share of them.

    Parameters
    ----------
    fit
        Fit whose residuals are tested.
    alpha
        Probability of a false alarm over all joints.
    """
    study = fit.study
    stretches = (*study.train, *study.held)
    every = [*residuals(study, study.train, fit.theta), *residuals(study, study.held, fit.theta)]
    times = [np.asarray(s.measured.start + study.dt * np.arange(s.rows.size), dtype=np.float64) for s in stretches]
    found: dict[int, Bursts] = {}
    for j in range(study.robot.n):
        speeds = [np.abs(s.measured.qd[:, j]) for s in stretches]
        own = bursts_of([e[:, j] for e in every], speeds, times, study.dt, lowest_frequency(study))
        if own is not None and own.p_value < alpha / study.robot.n and own.share >= MATERIAL:
            found[j] = own
    return found


def bursts_of(
    residual: Sequence[Array], speed: Sequence[Array], times: Sequence[Array], dt: float, bandwidth: float
) -> Bursts | None:
    """Transients in the residual of one joint; ``None`` where the recording is too short for a test.

    Noise whose power depends on the speed of the joint, or on the stretch, does not count. The variance of the fourth
    moment of a Gaussian series is that of Lomnicki (1961); its distribution follows Anscombe and Glynn (1983).

    Parameters
    ----------
    residual, speed, times
        Residual torque, N m or N, absolute velocity of the joint, and instants, s: (N,) of each stretch.
    dt
        Their sampling period, s.
    bandwidth
        Bandwidth of the motion, Hz.
    """
    smooth = design(dt, min(BANDWIDTHS * bandwidth, 0.25 / dt))
    window = max(1, round(0.5 / (bandwidth * dt * smooth.factor)))
    pieces: list[_Piece] = []
    for e, v, t in zip(residual, speed, times, strict=True):
        if smooth.count(e.size) >= max(2 * window, 2 * len(SIDE)):
            kept = smooth.instants(e.size)
            pieces.append(_Piece.of(smooth(e), v[kept], t[kept]))
    worth = sum(piece.even.size / _correlated(piece.even, 4) for piece in pieces)
    if worth < LEAST:
        return None
    even = np.concatenate([piece.even for piece in pieces])
    usual = min(1.0, float(np.median(even**2)) / MEDIAN)
    free = max(1.0, window / _correlated(pieces[0].even, 2))
    highest = usual * float(stats.chi2.isf(RARE, free)) / free
    t, power, noise = np.concatenate([piece.moments(window) for piece in pieces], axis=1)
    p = float(stats.norm.sf(_anscombe_glynn(float(np.mean(even**4)), worth)))
    return Bursts(1.0 - usual, p, t, np.sqrt(power), np.sqrt(highest * noise))


@dataclass(frozen=True, eq=False)
class _Piece:
    """Residual of a stretch (N,), its usual power at each instant, and the residual scaled to unit power."""

    own: Array
    usual: Array
    even: Array
    t: Array

    @classmethod
    def of(cls, residual: Array, speed: Array, t: Array) -> "_Piece":
        """Return the piece of a residual.

        Parameters
        ----------
        residual
            Residual of one joint, N m or N, shape (N,).
        speed
            Speed of the joint, on which the usual power depends, rad/s or m/s, shape (N,).
        t
            Instants, s, shape (N,).
        """
        own = residual - residual.mean()
        basis = hats(speed, np.array(SIDE) * max(float(speed.max()), 1e-12))
        level, _ = optimize.nnls(basis, own**2)
        usual = np.maximum(basis @ level, max(QUIET * float(np.mean(own**2)), 1e-300))
        even = own / np.sqrt(usual)
        return cls(own, usual, even / max(float(np.sqrt(np.mean(even**2))), 1e-150), t)

    def moments(self, window: int) -> Array:
        """Mean time, power and usual power of windows of ``window`` samples, (3, G)."""
        count = self.own.size // window
        signals = np.stack([self.t, self.own**2, self.usual])[:, : count * window]
        return np.asarray(signals.reshape(3, count, window).mean(axis=2))


def _correlated(x: Array, power: int) -> float:
    """Number of samples of a series per independent one, for moments of that power."""
    spectrum = np.abs(np.fft.rfft(x, 2 * x.size)) ** 2
    correlation = np.fft.irfft(spectrum)[: x.size]
    return float(1.0 + 2.0 * np.sum((correlation[1:] / correlation[0]) ** power)) if correlation[0] > 0 else 1.0


def _anscombe_glynn(kurtosis: float, n: float) -> float:
    """Standard normal deviate of the kurtosis of ``n`` independent Gaussian samples."""
    mean = 3.0 * (n - 1) / (n + 1)
    variance = 24.0 * n * (n - 2) * (n - 3) / ((n + 1) ** 2 * (n + 3) * (n + 5))
    x = (kurtosis - mean) / np.sqrt(variance)
    skew = 6.0 * (n * n - 5 * n + 2) / ((n + 7) * (n + 9)) * np.sqrt(6.0 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3)))
    a = 6.0 + 8.0 / skew * (2.0 / skew + np.sqrt(1.0 + 4.0 / skew**2))
    # The formula has no value for very light tails, which are no transients.
    cubed = (1.0 - 2.0 / a) / max(1.0 + x * np.sqrt(2.0 / (a - 4.0)), 1e-9)
    return float((1.0 - 2.0 / (9.0 * a) - np.cbrt(cubed)) / np.sqrt(2.0 / (9.0 * a)))
