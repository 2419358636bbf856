"""Plausibility of units: recorded signals against the limits of the configuration."""

import numpy as np
from numpy.typing import NDArray

from armident.identify.setup.bench import Bench
from armident.identify.setup.fit import Hypothesis

Array = NDArray[np.float64]

POSITION_MOST = 1.2
"""Largest position over the limit that is plausible: limits of a configuration are often rounded."""

VELOCITY = (0.01, 2.0)
"""Plausible range of the largest velocity over the limit: 1 % is a very slow motion of a robot."""

TORQUE = (0.02, 1.5)
"""Plausible range of the largest torque over the limit: 2 % is less than friction and gravity of usual robots take."""

RATE_LEAST_HZ = 20.0
"""Sampling rate below which a recording of a robot is implausible, Hz: ten samples per period of a 2 Hz motion."""

SPREAD = float(np.log(2.0))
"""Standard deviation of the logarithm of these ratios beyond the range."""

LEAST_ODDS = float(np.log(99.0))
"""Least gain for a finding, nats: posterior odds of 99 to 1, a false alarm in less than 1 %."""

NO_LIMIT = 1e6
"""Limits from this value on are placeholders of a file format."""


def position_ratio(bench: Bench, h: Hypothesis) -> float:
    """Geometric mean over the moving joints of the largest position over its limit."""
    return _mean(*_positions(bench, h), bench.moving)


def velocity_ratio(bench: Bench, h: Hypothesis) -> float:
    """Geometric mean over the moving joints of the largest velocity over its limit."""
    return _mean(*_velocities(bench, h), bench.moving)


def torque_ratio(bench: Bench, h: Hypothesis) -> float:
    """Geometric mean over the moving joints of the largest torque over its limit."""
    return _mean(*_torques(bench, h), bench.moving)


def _positions(bench: Bench, h: Hypothesis) -> tuple[Array, Array]:
    """Largest position of each joint over its limit, and the limits."""
    limits = bench.limits[0]
    return _largest(bench, 0, h.position) / limits, limits


def _velocities(bench: Bench, h: Hypothesis) -> tuple[Array, Array]:
    """Largest velocity of each joint over its limit, and the limits."""
    limits = bench.limits[1]
    return _largest(bench, 1, h.position) / h.clock / limits, limits


def _torques(bench: Bench, h: Hypothesis) -> tuple[Array, Array]:
    """Largest torque of each joint over its limit, and the limits."""
    limits = bench.limits[2]
    return _largest(bench, 2, h.torque) / limits, limits


def _largest(bench: Bench, signal: int, correction: Array) -> Array:
    """Largest magnitude (n,) of each corrected signal: positions, velocities or torques, by number."""
    if np.count_nonzero(correction) == bench.n and np.all(np.any(correction, axis=1)):
        return np.asarray(np.abs(correction) @ bench.peaks[signal])
    return np.asarray(np.abs(bench.recorded[signal] @ correction.T).max(axis=0))


def plausible_factor(bench: Bench, h: Hypothesis) -> float:
    """Common factor that brings the torques to the middle of their plausible range, 1 unless they are far from it."""
    ratio = torque_ratio(bench, h)
    return 1.0 if _beyond(ratio, *TORQUE) >= -LEAST_ODDS else float(np.sqrt(TORQUE[0] * TORQUE[1])) / ratio


def log_plausibility(bench: Bench, h: Hypothesis) -> float:
    """Logarithm of the plausibility of the corrected signals against the limits, 0 or less."""
    rate = 1.0 / (bench.period * h.clock)
    return (
        _beyond(position_ratio(bench, h), 0.0, POSITION_MOST)
        + _beyond(velocity_ratio(bench, h), *VELOCITY)
        + _beyond(torque_ratio(bench, h), *TORQUE)
        + _beyond(rate, RATE_LEAST_HZ, np.inf)
    )


def worst_change(bench: Bench, old: Hypothesis, new: Hypothesis) -> float:
    """Smallest change over the moving joints of the log plausibility of their own signals; negative if one gets worse.

    A wrong unit of one joint hardly changes the mean over all joints.
    """

    def each(h: Hypothesis) -> Array:
        sums = np.zeros(bench.n)
        for (ratios, limits), (least, most) in (
            (_positions(bench, h), (0.0, POSITION_MOST)),
            (_velocities(bench, h), VELOCITY),
            (_torques(bench, h), TORQUE),
        ):
            usable = (limits < NO_LIMIT) & (ratios > 0)
            sums += [_beyond(r, least, most) if u else 0.0 for r, u in zip(ratios, usable, strict=True)]
        return sums[bench.moving]

    return float((each(new) - each(old)).min(initial=0.0))


def _mean(ratios: Array, limits: Array, moving: NDArray[np.bool_]) -> float:
    """Geometric mean; 1 if no limit is usable."""
    used = moving & (limits < NO_LIMIT) & (ratios > 0)
    return float(np.exp(np.mean(np.log(ratios[used])))) if used.any() else 1.0


def _beyond(ratio: float, least: float, most: float) -> float:
    """Logarithm of a normal density of the logarithm beyond a range, 0 inside it."""
    excess = max(np.log(ratio / most) if np.isfinite(most) else 0.0, np.log(least / ratio) if least > 0 else 0.0, 0.0)
    return -0.5 * float(excess / SPREAD) ** 2
