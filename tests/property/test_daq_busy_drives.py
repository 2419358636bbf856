"""Drives that stand still at times, answer in order when they go on, and fall silent: no answer is taken for another."""

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.unit.test_daq_doubt import assembled

PERIOD_US = 1000
JOINTS = (0x181, 0x182)


def moved(at: int, stalls: list[tuple[int, int]]) -> int:
    """When a drive goes on that would have done something at a time, us."""
    for begin, took in sorted(stalls):
        if begin <= at < begin + took:
            at = begin + took
    return at


def events(count: int, stalls: list[tuple[int, int]], silent_us: int, seed: int) -> list[tuple[int, int, bytes]]:
    """SYNCs, and the answers of two drives until they fall silent ``silent_us`` before the end."""
    rng = np.random.default_rng(seed)
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


@st.composite
def stalls(draw: st.DrawFn) -> tuple[int, list[tuple[int, int]]]:
    """How many SYNCs, and when the host of both drives does not let them run: from, and for how long, us."""
    count = draw(st.integers(60, 200))
    begins = draw(st.lists(st.integers(0, PERIOD_US * count), min_size=1, max_size=5))
    return count, [(begin, draw(st.integers(100, 12_000))) for begin in begins]


@settings(max_examples=300, deadline=None)
@given(stalls(), st.integers(0, 3000), st.integers(0, 1 << 30))
@example((86, [(75_300, 9_400)]), 1500, 3)
def test_no_answer_before_a_silence_is_taken_for_another(
    some: tuple[int, list[tuple[int, int]]], silent_us: int, seed: int
) -> None:
    count, when = some
    assembler, sync, value = assembled(events(count, when, silent_us, seed), count)
    assert np.array_equal(value, sync)
    assert assembler.counters["samples.expected"] == count
    # What is in doubt is near a time at which they stood still.
    near = np.zeros(count + 60, bool)
    for begin, took in [*when, (PERIOD_US * count - silent_us, silent_us)]:
        near[begin // PERIOD_US : (begin + took) // PERIOD_US + 60] = True
    assert np.all(np.isin(np.flatnonzero(~near[:count]), sync))
