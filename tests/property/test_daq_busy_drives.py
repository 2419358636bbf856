"""Drives that pause at times, then answer in order, and fall silent: no answer is matched to another SYNC."""

import numpy as np
import pytest

from tests.unit.daq.test_matching_ambiguous import assembled

PERIOD_US = 1000
JOINTS = (0x181, 0x182)
Stalls = list[tuple[int, int]]
"""From when, and for how long, us, the host of the drives does not let them run."""


def moved(at: int, stalls: Stalls) -> int:
    """Time of an action after the pauses of a drive, us."""
    for begin, took in sorted(stalls):
        if begin <= at < begin + took:
            at = begin + took
    return at


def events(rng: np.random.Generator, count: int, stalls: Stalls, silent_us: int) -> list[tuple[int, int, bytes]]:
    """SYNCs, and the answers of two drives until they fall silent ``silent_us`` before the end."""
    cost_us = int(rng.choice([30, 200, 600, 900]))
    out = [(PERIOD_US * k, 0x80, bytes([k % 240 + 1])) for k in range(count)]
    for can_id in JOINTS:
        at = 0
        for k in range(count):
            at = moved(max(PERIOD_US * k + int(rng.integers(20, 60)), at), stalls) + int(rng.integers(5, cost_us))
            if at >= PERIOD_US * count - silent_us:
                break
            out.append((at, can_id, k.to_bytes(8, "little")))
    return sorted(out, key=lambda event: event[0])


@pytest.mark.slow
@pytest.mark.parametrize("captures", [200, pytest.param(3000, marks=pytest.mark.nightly)])
def test_no_answer_before_a_silence_is_matched_to_another_sync(captures: int) -> None:
    """Ambiguous samples are near a pause."""
    for seed in range(captures):
        rng = np.random.default_rng(seed)
        count, silent_us = int(rng.integers(60, 200)), int(rng.integers(0, 3000))
        stalls = [
            (int(rng.integers(PERIOD_US * count)), int(rng.integers(100, 12_000))) for _ in range(rng.integers(1, 6))
        ]
        assembler, sync, value = assembled(events(rng, count, stalls, silent_us), count)
        assert np.array_equal(value, sync), seed
        assert assembler.counters["samples.expected"] == count
        near = np.zeros(count + 60, bool)
        for begin, took in [*stalls, (PERIOD_US * count - silent_us, silent_us)]:
            near[begin // PERIOD_US : (begin + took) // PERIOD_US + 60] = True
        assert np.all(np.isin(np.flatnonzero(~near[:count]), sync)), seed
