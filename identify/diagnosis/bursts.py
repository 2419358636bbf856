"""Bursts: torques that come for moments, at times that nothing in the motion tells.

What comes for a moment leaves no mark where noise is looked for: over a whole recording it is a small part of the
residual's power, and it repeats with nothing. It shows in how the residual is distributed: noise of currents and
encoders is a sum of many small things and so is Gaussian, what comes in bursts has heavier tails. The test is that of
the fourth moment, with the number of samples that a Gaussian series of the same autocorrelation is worth.
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
"""Highest frequency that is looked at, over the bandwidth of the motion: above it the noise drowns what an arm does."""

LEAST = 50.0
"""Independent samples under which the tails of a distribution cannot be judged."""

MEDIAN = float(stats.chi2.ppf(0.5, 1))
"""Median of the power of Gaussian noise over its mean."""

QUIET = 0.05
"""Power that noise is taken to have at any speed, over its mean power, at least."""

MATERIAL = 0.05
"""Share of the residual's power, as smoothed, that must be more than noise of its usual power for it to be a gap."""

RARE = 1e-3
"""Chance of noise to reach beyond the band of the curve, in each moment."""


@dataclass(frozen=True)
class Bursts:
    """What a joint's residual has of bursts.

    Parameters
    ----------
    share
        Share of its power, as smoothed, that is more than noise of its usual power.
    p_value
        That Gaussian noise of the same autocorrelation has such tails.
    t, amplitude, noise
        Middle of moments of the recording, s, the root mean square of the smoothed residual in each, and what noise of
        the usual power exceeds in one of a thousand, N m or N, (G,) each.
    """

    share: float
    p_value: float
    t: Array
    amplitude: Array
    noise: Array


def bursts(fit: Fit, alpha: float = 0.01) -> dict[int, Bursts]:
    """Bursts of the joints whose residual has any that matter.

    Parameters
    ----------
    alpha
        Chance of a false alarm over all joints.
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
    """What the residual of one joint has of bursts; ``None`` where too little was recorded to say.

    Noise that is stronger at some speeds of the joint than at others, or in one stretch than in another, is none. The
    variance of the fourth moment of a Gaussian series is that of Lomnicki (1961), its distribution from there on that
    of Anscombe and Glynn (1983).

    Parameters
    ----------
    residual, speed, times
        Torque that the model leaves, N m or N, absolute velocity of the joint, and instants, s: (N,) of each stretch.
    dt
        Their sampling period, s.
    bandwidth
        Of the motion, Hz.
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
    """Residual of a stretch (N,), its usual power at each instant, and itself made even: of unit power at any speed."""

    own: Array
    usual: Array
    even: Array
    t: Array

    @classmethod
    def of(cls, residual: Array, speed: Array, t: Array) -> "_Piece":
        own = residual - residual.mean()
        basis = hats(speed, np.array(SIDE) * max(float(speed.max()), 1e-12))
        level, _ = optimize.nnls(basis, own**2)
        usual = np.maximum(basis @ level, max(QUIET * float(np.mean(own**2)), 1e-300))
        even = own / np.sqrt(usual)
        return cls(own, usual, even / max(float(np.sqrt(np.mean(even**2))), 1e-150), t)

    def moments(self, window: int) -> Array:
        """Time, power and usual power of moments of so many samples, (3, G)."""
        count = self.own.size // window
        signals = np.stack([self.t, self.own**2, self.usual])[:, : count * window]
        return np.asarray(signals.reshape(3, count, window).mean(axis=2))


def _correlated(x: Array, power: int) -> float:
    """How many samples of a series are worth an independent one where moments of that power matter."""
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
    # Tails so light that the formula has no value for them are no bursts.
    cubed = (1.0 - 2.0 / a) / max(1.0 + x * np.sqrt(2.0 / (a - 4.0)), 1e-9)
    return float((1.0 - 2.0 / (9.0 * a) - np.cbrt(cubed)) / np.sqrt(2.0 / (9.0 * a)))
