"""Plausibility of units: recorded signals against the limits of the configuration."""

import math

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.setup.bench import Bench
from armident.identify.setup.fit import Hypothesis

POSITION_MOST = 1.2
"""Largest position over the limit that is plausible: limits of a configuration are often rounded."""

VELOCITY = (0.01, 2.0)
"""Plausible range of the largest velocity over the limit: 1 % is a very slow motion of a robot."""

TORQUE = (0.02, 1.5)
"""Plausible range of the largest torque over the limit: 2 % is less than friction and gravity of usual robots take."""

USUAL = ((0.0, POSITION_MOST), VELOCITY, TORQUE)
"""Plausible ranges of positions, velocities and torques over their limits."""

RATE_LEAST_HZ = 20.0
"""Sampling rate below which a recording of a robot is implausible, Hz: ten samples per period of a 2 Hz motion."""

SPREAD = float(np.log(2.0))
"""Standard deviation of the logarithm of these ratios beyond the range."""

LEAST_ODDS = float(np.log(99.0))
"""Least gain for a finding, nats: posterior odds of 99 to 1, a false alarm in less than 1 %."""

NO_LIMIT = 1e6
"""Limits from this value on are placeholders of a file format."""


def ratios(bench: Bench, h: Hypothesis) -> Array:
    """Geometric means over moving joints of the largest position, velocity and torque over their limits; 1 without."""
    return np.exp(_means(bench, h))


def plausible_factor(bench: Bench, h: Hypothesis) -> float:
    """Common factor that brings the torques to the middle of their plausible range, 1 unless they are far from it."""
    ratio = float(ratios(bench, h)[2])
    return 1.0 if _beyond(np.log(ratio), *TORQUE) >= -LEAST_ODDS else float(np.sqrt(TORQUE[0] * TORQUE[1])) / ratio


def equal_shares(bench: Bench, h: Hypothesis) -> Array:
    """Logarithms (n,) of the factors that bring all torques to their limits, as far as these are usable."""
    (*_, logs), (*_, usable) = _logs(bench, h)
    return np.asarray(np.where(usable, -logs, -np.median(logs[usable]) if usable.any() else 0.0))


def log_plausibility(bench: Bench, h: Hypothesis) -> float:
    """Logarithm of the plausibility of the corrected signals against the limits, 0 or less."""
    rate = -math.log(bench.period * h.clock)
    signals = sum(_beyond(mean, *usual) for mean, usual in zip(_means(bench, h), USUAL, strict=True))
    return signals + _beyond(rate, RATE_LEAST_HZ, math.inf)


def passed_limits(bench: Bench, h: Hypothesis) -> NDArray[np.bool_]:
    """Mask (n,) of the moving joints whose corrected positions pass their limits by more than rounding."""
    logs, usable = _logs(bench, h)
    return np.asarray(usable[0] & (logs[0] > math.log(POSITION_MOST)))


def worst_change(bench: Bench, old: Hypothesis, new: Hypothesis) -> float:
    """Smallest change over the moving joints of the log plausibility of their own signals; negative if one gets worse.

    A wrong unit of one joint hardly changes the mean over all joints.
    """

    def each(h: Hypothesis) -> Array:
        logs, usable = _logs(bench, h)
        beyond = [[_beyond(one, *usual) for one in own] for own, usual in zip(logs, USUAL, strict=True)]
        return np.asarray(np.where(usable, beyond, 0.0).sum(axis=0))

    return float((each(new) - each(old)).min(initial=0.0))


def _means(bench: Bench, h: Hypothesis) -> list[float]:
    """Mean logarithms of the largest position, velocity and torque over their limits; 0 if no limit is usable."""
    logs, usable = _logs(bench, h)
    means: list[float] = (logs.sum(axis=1) / np.maximum(usable.sum(axis=1), 1)).tolist()
    return means


def _logs(bench: Bench, h: Hypothesis) -> tuple[Array, NDArray[np.bool_]]:
    """Logarithms (3, n) of the largest positions, velocities and torques over their limits, and usable ones; else 0."""
    limits = bench.limits
    sizes = np.stack([_largest(bench, 0, h.position), _largest(bench, 1, h.position), _largest(bench, 2, h.torque)])
    sizes[1] /= h.clock
    usable = bench.moving & (limits < NO_LIMIT) & (sizes > 0.0)
    return np.log(np.where(usable, sizes / limits, 1.0)), usable


def _largest(bench: Bench, signal: int, correction: Array) -> Array:
    """Largest magnitude (n,) of each corrected signal: positions, velocities or torques, by number."""
    if np.count_nonzero(correction) == bench.n and correction.any(axis=1).all():
        return np.asarray(np.abs(correction) @ bench.peaks[signal])
    return np.asarray(np.abs(bench.recorded[signal] @ correction.T).max(axis=0))


def _beyond(ratio: float, least: float, most: float) -> float:
    """Logarithm of a normal density of the logarithm of a ratio beyond a range, 0 inside it."""
    excess = max(ratio - math.log(most), (math.log(least) if least > 0.0 else -math.inf) - ratio, 0.0)
    return -0.5 * (excess / SPREAD) ** 2
