"""Sequential test of each joint's friction: CUSUM of the log-likelihood ratio of window estimates (Page 1954)."""

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.monitoring.recursive.settings import RecursiveSettings

SPREAD_WINDOWS = 50.0
"""Memory of the spread of successive windows, in windows: of so many squares it is known to 20 %."""
SPREAD_PRIOR = 10.0
"""Weight of the expected spread at the start, in windows: the first one moves the spread by at most 0.74."""
LARGEST_SQUARE = 9.0
"""Largest squared difference of two windows, in variances (three standard deviations): a step in friction is no
spread."""
LEVEL_STD = 0.01
"""Standard deviation of a window from which on it moves the level with its full weight, 1: half of
`RecursiveSettings.excitation_std`."""


class FrictionTest:
    """Two CUSUMs per joint: more friction, and less, than the slow level of the joint.

    For a change c with standard deviation s, level l, tolerated a and sought b, each grows by the log-likelihood ratio
    ``(b - a) / s^2 (c - l - (a + b) / 2)``, limited, so that an alarm needs several windows. The mean number of windows
    to a false alarm is at least ``exp(h)`` for the threshold h (Lorden 1971).
    """

    _saved = ("sums", "level", "spread", "spread_weight", "last", "last_std", "alarm", "alarm_change", "windows")

    def __init__(self, n: int, settings: RecursiveSettings) -> None:
        self._n, self._settings = n, settings
        self.threshold = settings.threshold(n)
        self.reset()

    def reset(self) -> None:
        """Forget all windows, levels and alarms."""
        n = self._n
        self.sums = np.zeros((2, n))
        self.level = np.zeros(n)
        self.spread, self.spread_weight = np.ones(n), np.full(n, SPREAD_PRIOR)
        self.last, self.last_std = np.full(n, np.nan), np.full(n, np.inf)
        self.alarm = np.full(n, -1, np.int64)
        self.alarm_change = np.full(n, np.nan)
        self.windows = 0

    def add(self, change: Array, std: Array, instant: int, valid: NDArray[np.bool_]) -> None:
        """Add a window, dated by ``instant``: relative change and std (n,), 1; only ``valid`` joints raise alarms."""
        self.windows += 1
        known = np.isfinite(change) & np.isfinite(std)
        self._add_spread(change, std, known)
        variance = np.where(known, std, 1.0) ** 2 * np.maximum(self.spread, 1.0)
        s = self._settings
        middle, width = 0.5 * (s.tolerated + s.sought), s.sought - s.tolerated
        most = self.threshold / s.least_windows
        for row, sign in enumerate((1.0, -1.0)):
            distance = sign * (np.where(known, change, 0.0) - self.level) - middle
            growth = np.where(known, np.minimum(width / variance * distance, most), 0.0)
            self.sums[row] = np.maximum(self.sums[row] + growth, 0.0)
        # Least windows of the threshold may add up to a rounding error below it.
        over = (self.sums.max(axis=0) >= self.threshold * (1.0 - 1e-12)) & valid & (self.alarm < 0)
        self.alarm[over] = instant
        self.alarm_change[over] = change[over] - self.level[over]
        self._move_level(change, variance, known)

    def _add_spread(self, change: Array, std: Array, known: NDArray[np.bool_]) -> None:
        """Compare successive windows: their spread beyond the standard deviations is model error."""
        both = known & np.isfinite(self.last) & np.isfinite(self.last_std)
        square = np.where(both, (change - self.last) ** 2 / np.where(both, std**2 + self.last_std**2, 1.0), 1.0)
        keep = np.where(both, 1.0 - 1.0 / SPREAD_WINDOWS, 1.0)
        weight = keep * self.spread_weight + both
        self.spread = (keep * self.spread_weight * self.spread + both * np.minimum(square, LARGEST_SQUARE)) / weight
        self.spread_weight = weight
        self.last = np.where(known, change, self.last)
        self.last_std = np.where(known, std, self.last_std)

    def _move_level(self, change: Array, variance: Array, known: NDArray[np.bool_]) -> None:
        """Follow slow changes, but not those of a joint in alarm."""
        s = self._settings
        gain = s.window_s / s.level_memory_s * np.minimum(LEVEL_STD**2 / variance, 1.0)
        step = np.clip(np.where(known, change, 0.0) - self.level, -s.sought, s.sought)
        self.level = self.level + np.where(known & (self.alarm < 0), gain * step, 0.0)
