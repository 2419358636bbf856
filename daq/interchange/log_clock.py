"""Comparison of the SYNC period in a log with that of the session."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError, SessionConfig
from armident.drivers.can.frames import Frames
from armident.drivers.canopen.objects import COB_SYNC

PERIOD_TOLERANCE = 0.02
"""Largest difference of both periods, relative.

Clocks of computers and adapters agree to 0.1 %; the next period that a session can mean differs by far more.
"""
_FEWEST = 10
"""SYNCs below which a log tells no period."""
_CLOCK_STEP_NS = 20_000_000
"""Difference of times and SYNC numbers above which a clock was set: masters are late by less on an idle machine, ns."""
_HOLE_PERIODS = 10
"""Steps longer than this number of usual ones are not counted: SYNCs may be lacking there."""


def clock_steps(numbers: NDArray[np.int64], t_ns: NDArray[np.int64], session: SessionConfig) -> list[str]:
    """Return a sentence if the times of SYNCs step where their numbers do not.

    ``numbers``: numbers of the SYNCs, (N,), increasing; ``t_ns``: their times, ns, (N,); ``session``: with SYNC period
    and counter.
    """
    period = session.sync.period_us * 1000
    late = np.diff(t_ns) - np.diff(numbers) * period
    limit = max(_CLOCK_STEP_NS, (session.sync.counter or 0) * period * 0.9)
    steps = np.flatnonzero(np.abs(late) > limit)
    if not steps.size:
        return []
    k = int(steps[0])
    more = f" (and at {steps.size - 1} more)" if steps.size > 1 else ""
    turns = ", or whole turns of the counter are missing there" if session.sync.counter and late[k] > 0 else ""
    return [
        f"times step by {late[k] * 1e-9:+.4g} s at SYNC {numbers[k + 1]}{more}, where the SYNCs go on: "
        f"the clock was set{turns}"
    ]


def check_sync_period(path: Path, frames: Frames, session: SessionConfig) -> None:
    """Refuse a log whose SYNCs come at another period than that of the session.

    ``path``: the log, for messages; ``frames``: its frames of one bus, (N,); ``session``: with SYNC period and counter.
    Raises DataError if both periods differ; the message states both.
    """
    syncs = frames[frames["can_id"] == COB_SYNC]
    found = sync_period_ns(syncs["t_ns"], _steps(syncs, session.sync.counter))
    if found is None:
        return
    period, uncertainty = found
    expected = session.sync.period_us * 1000
    if abs(period - expected) > PERIOD_TOLERANCE * expected + uncertainty:
        raise DataError(
            f"{path}: SYNC comes every {period * 1e-6:.4g} ms ({1e9 / period:.4g} Hz) in this log, "
            f"but the session says {expected * 1e-6:.4g} ms (sync.period_us: {session.sync.period_us}): "
            "use the session that the log was recorded with"
        )


def sync_period_ns(t_ns: NDArray[np.int64], steps: NDArray[np.int64] | None) -> tuple[float, float] | None:
    """Return the mean SYNC period and its uncertainty, ns; ``None`` if there are too few SYNCs.

    ``t_ns``: times of the SYNCs, (N,), ns. ``steps``: number of periods from each SYNC to the next by its counter,
    (N - 1,); ``None``: one each.
    """
    if t_ns.size < _FEWEST:
        return None
    elapsed = np.diff(t_ns).astype(np.float64)
    periods = np.ones(elapsed.size) if steps is None else steps.astype(np.float64)
    # Coarse time stamps make a median of 0.
    usual = float(np.median(elapsed)) or float(np.mean(elapsed))
    counted = (elapsed >= 0) & (elapsed <= _HOLE_PERIODS * max(usual, 1.0)) & (periods > 0) & (periods <= _HOLE_PERIODS)
    total = float(periods[counted].sum())
    if counted.sum() < _FEWEST - 1 or not total:
        return None
    period = float(elapsed[counted].sum()) / total
    if period <= 0:
        return None
    late = np.cumsum(np.where(counted, elapsed - period * periods, 0.0))
    spread = float(np.quantile(late, 0.95) - np.quantile(late, 0.05))
    return period, spread / total


def _steps(syncs: Frames, overflow: int) -> NDArray[np.int64] | None:
    """Return the number of periods between SYNCs by their counter, or ``None`` if they have none."""
    if not overflow or not np.all(syncs["length"] > 0):
        return None
    counter = syncs["data"][:, 0].astype(np.int64)
    return np.diff(counter) % overflow
