"""Jitter of SYNC: deviation of the intervals between its time stamps from the period."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.drivers.canopen.objects import COB_SYNC

BIN_NS = 1_000
"""Width of a bin of the histogram, ns."""
BINS = 50_000
"""Number of bins; the last one also counts all larger deviations."""
LONGEST_WITHOUT_COUNTER = 240
"""Longest interval that counts where SYNC has no counter, SYNC periods: a longer one is a pause of the master."""
PERCENTILES = (50.0, 99.0, 99.9)
"""Reported percentiles of the absolute deviation, %."""


class SyncJitter:
    """Jitter over all SYNCs of one bus; ``overflow`` of the counter (CiA 301, 1019h; 0: none) shows missing SYNCs."""

    def __init__(self, period_ns: int, overflow: int) -> None:
        self._period, self._overflow = period_ns, overflow
        self._last: tuple[int, int] | None = None
        self._histogram = np.zeros(BINS, np.int64)
        self._count, self._sum, self._squares = 0, 0.0, 0.0
        self._max = 0

    def take(self, frames: NDArray[Any]) -> None:
        """Add frames of the bus. ``frames``: frames (N,) in the order of reception; all but SYNC are ignored."""
        sync = frames[frames["can_id"] == COB_SYNC]
        if sync.size == 0:
            return
        t_ns = sync["t_ns"].astype(np.int64)
        counter = np.where((sync["length"] > 0) & (self._overflow > 0), sync["data"][:, 0].astype(np.int64), -1)
        if self._last is not None:
            t_ns, counter = np.r_[self._last[0], t_ns], np.r_[self._last[1], counter]
        self._last = int(t_ns[-1]), int(counter[-1])
        elapsed = np.diff(t_ns)
        steps = np.where(counter[1:] >= 0, np.diff(counter) % (self._overflow or 1), 1)
        # A repeated SYNC, or a loss of a whole turn of the counter, gives no interval.
        near = (steps > 0) & (elapsed < (self._overflow or LONGEST_WITHOUT_COUNTER) * self._period)
        error = (elapsed - steps * self._period)[near].astype(np.float64)
        if error.size == 0:
            return
        self._count += error.size
        self._sum += float(error.sum())
        self._squares += float(np.square(error).sum())
        size = np.abs(error).astype(np.int64)
        self._max = max(self._max, int(size.max()))
        # Only as far as the largest deviation: a batch changes few bins of the histogram.
        counts = np.bincount(np.minimum(size // BIN_NS, BINS - 1))
        self._histogram[: counts.size] += counts

    def statistics(self) -> dict[str, float]:
        """Return ``std``, ``p50``, ``p99``, ``p99.9`` and ``max`` of the deviation, us; empty before two SYNCs."""
        if self._count == 0:
            return {}
        mean = self._sum / self._count
        found = {"std": max(0.0, self._squares / self._count - mean * mean) ** 0.5 / 1000}
        total = np.cumsum(self._histogram)
        for percent in PERCENTILES:
            at = int(np.searchsorted(total, percent / 100 * self._count))
            found[f"p{percent:g}"] = min((at + 0.5) * BIN_NS, self._max) / 1000
        return found | {"max": self._max / 1000}


def worst(jitters: list[SyncJitter]) -> dict[str, float]:
    """Return the largest of each statistic over several buses, us."""
    statistics = [found for jitter in jitters if (found := jitter.statistics())]
    names = list(statistics[0]) if statistics else []
    return {name: max(found[name] for found in statistics) for name in names}
