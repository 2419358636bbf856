"""Jitter of SYNC from the time stamps of its frames."""

import numpy as np
import pytest

from armident.daq.capture.jitter import SyncJitter, worst
from armident.drivers.can.frames import Frames, frames

PERIOD_NS = 200_000


def syncs(t_ns: np.ndarray, numbers: np.ndarray) -> Frames:
    out = frames(2 * numbers.size)
    out["can_id"][::2], out["can_id"][1::2] = 0x80, 0x181
    out["length"][::2] = 1
    out["data"][::2, 0] = numbers % 240 + 1
    out["t_ns"][::2] = t_ns
    return out


@pytest.mark.parametrize("cuts", [[], [1, 2, 1001, 5000]])
def test_statistics_are_those_of_the_deviations_from_the_period(cuts: list[int]) -> None:
    rng = np.random.default_rng(3)
    numbers = np.arange(20_000)
    t_ns = 10**18 + numbers * PERIOD_NS + rng.normal(0, 8000, numbers.size).astype(np.int64)
    jitter = SyncJitter(PERIOD_NS, 240)
    for part in np.split(syncs(t_ns, numbers), cuts):
        jitter.take(part)
    error = np.diff(t_ns) - PERIOD_NS
    found = jitter.statistics()
    assert found["std"] == pytest.approx(error.std() / 1000, rel=1e-6)
    assert found["max"] == pytest.approx(np.abs(error).max() / 1000)
    for name, percent in (("p50", 50), ("p99", 99), ("p99.9", 99.9)):
        assert found[name] == pytest.approx(np.percentile(np.abs(error), percent) / 1000, abs=1.0)


def test_missing_syncs_and_an_outage_are_no_jitter() -> None:
    numbers = np.delete(np.arange(3000), np.r_[100, 500:510, 1000:1700])
    jitter = SyncJitter(PERIOD_NS, 240)
    jitter.take(syncs(10**18 + numbers * PERIOD_NS, numbers))
    assert jitter.statistics() == {"std": 0.0, "p50": 0.0, "p99": 0.0, "p99.9": 0.0, "max": 0.0}


def test_the_largest_jitter_of_several_buses_is_reported_and_nothing_without_sync() -> None:
    even, uneven, silent = (SyncJitter(PERIOD_NS, 240) for _ in range(3))
    numbers = np.arange(100)
    even.take(syncs(numbers * PERIOD_NS, numbers))
    uneven.take(syncs(numbers * PERIOD_NS + 5000 * (numbers % 2), numbers))
    assert worst([even, uneven, silent])["max"] == 5.0
    assert worst([silent]) == {}
