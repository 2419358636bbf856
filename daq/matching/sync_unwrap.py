"""The compiled part that numbers the SYNCs of every bus: by their counter, and where that is not enough by time."""

from typing import Any

import numpy as np
from numba import njit

from armident.daq.matching.state import BORROWED, COUNTER, FORGOTTEN, NEVER, ORIGIN, STRAYED, SYNC, TIME, TORN

_EARLY = 0.25
"""By how much of a turn of the counter the time between two SYNCs may be too short, as their stamps say."""
_DISORDER = 8
"""A SYNC counter that goes back by less than this is a repeated SYNC, not a long gap."""
_ON_TIME, _DRIFT = 2.0, 1e-4
"""By how many periods, and which share of the time since, SYNC comes earlier or later than its grid at most."""
NOWHERE = -(1 << 60)
"""No step at all."""
_OFTEN = (3 << FORGOTTEN) // 2
"""A master that has been late more often than this lately is late all the time: twice in a few seconds at 5 kHz."""
_MISALIGNED = 2.0
"""SYNCs of equal counters on two buses that are farther apart than so many periods are not the same SYNC."""


@njit(cache=True, nogil=True)
def turns_in(periods: float, overflow: int) -> int:
    """Whole turns of the counter in a time: SYNCs come late, when their master was held up, but not too early."""
    return int(np.floor(periods / overflow + _EARLY))


@njit(cache=True, nogil=True)
def _was_held_up(counter: int, previous: int, elapsed: float, often: bool, overflow: int) -> bool:
    """Whether a counter that goes on without a seam is that of a master that was held up: not a time of whole turns.

    Of one that is held up ``often`` no time says anything else.
    """
    step = (counter - previous) % overflow
    off = elapsed - step - turns_in(elapsed - step, overflow) * overflow
    return bool(step == 1 and (often or abs(off) > _ON_TIME + _DRIFT * elapsed))


@njit(cache=True, nogil=True)
def sync_step(counter: int, previous: int, elapsed: float, overflow: int, longest: int) -> int:
    """By how many SYNCs the counter advanced; zero or less for a repeated SYNC.

    Known modulo ``overflow``; whole turns of the counter are told from ``elapsed`` periods, up to ``longest``.
    """
    step = (counter - previous) % overflow
    turns = turns_in(elapsed - step, overflow)
    if turns > 0 and step + turns * overflow <= longest:
        return int(step + turns * overflow)
    if turns < 0 and step >= overflow - _DISORDER:
        return int(step - overflow)
    return int(step)


@njit(cache=True, nogil=True)
def _begin(state: Any, recent: Any, bus: int, counter: int, t_ns: int, period_ns: int, overflow: int) -> int:
    """The first SYNC of a bus: number 0, or what those of another bus say; the step to it, 0 for one before number 0.

    Less than 0 where counters of the buses do not agree.
    """
    for other in range(state.shape[0]):
        if state[other, SYNC] < 0:
            continue
        elapsed = (t_ns - state[other, TIME]) / period_ns
        ahead = int(np.rint(elapsed))
        if counter >= 0 and state[other, COUNTER] >= 0:
            step = (counter - state[other, COUNTER]) % overflow
            ahead = int(step + overflow * np.rint((elapsed - step) / overflow))
            apart = abs(elapsed - ahead)
            k = state[other, SYNC] + ahead
            room = recent.shape[1]
            if ahead <= 0 <= k and ahead > -room and recent[other, k % room] != NEVER:
                # Known when the other bus had it: a master that was held up since does not matter.
                apart = abs(t_ns - recent[other, k % room]) / period_ns
            if apart > _MISALIGNED:
                return -1
        state[bus, ORIGIN] = state[other, ORIGIN]
        return int(max(0, state[other, SYNC] + ahead + 1))
    if counter >= 0:
        state[bus, ORIGIN] = counter
    return 1


@njit(cache=True, nogil=True)
def _heard_elsewhere(state: Any, recent: Any, bus: int, step: int, t_ns: int, period_ns: int, overflow: int) -> int:
    """By how many SYNCs, ``step`` and whole turns, a bus advances to the SYNC that another one had at this time.

    A master that is held up keeps to no period, but all buses have its SYNC at once, or one of them between two that
    another has if it is held up between buses. ``NOWHERE`` if none had one.
    """
    best, nearest, room = NOWHERE, _MISALIGNED * period_ns, recent.shape[1]
    for other in range(state.shape[0]):
        last = state[other, SYNC]
        if other == bus or last < 0:
            continue
        # The first such number that the other bus may still have the time of.
        k = max(0, last - room + 1)
        k += (state[bus, SYNC] + step - k) % overflow
        while k <= last:
            at = recent[other, k % room]
            if at != NEVER and abs(t_ns - at) <= nearest:
                best, nearest = k - state[bus, SYNC], float(abs(t_ns - at))
            elif best == NOWHERE and last - room + 1 < k < last:
                before, after = recent[other, (k - 1) % room], recent[other, (k + 1) % room]
                if before != NEVER and after != NEVER and before < t_ns < after:
                    best = k - state[bus, SYNC]
            k += overflow
    return int(best)


@njit(cache=True, nogil=True)
def _is_apart(state: Any, bus: int, number: int, t_ns: int, period_ns: int, overflow: int) -> int:
    """Another bus that had later SYNCs than one that comes now, by more than there was time for; -1 if none had."""
    for other in range(state.shape[0]):
        ahead = state[other, SYNC] - number
        if ahead <= overflow // 2 or other == bus or state[other, BORROWED]:
            continue
        if ahead - (state[other, TIME] - t_ns) / period_ns > overflow // 2:
            return other
    return -1


@njit(cache=True, nogil=True)
def _together(state: Any, bus: int, other: int, counter: int, t_ns: int, period_ns: int, overflow: int) -> int:
    """By how many SYNCs a bus advances to the one nearest in time to the last of another bus."""
    elapsed = (t_ns - state[other, TIME]) / period_ns
    step = (counter - state[other, COUNTER]) % overflow
    return int(state[other, SYNC] + step + overflow * np.rint((elapsed - step) / overflow) - state[bus, SYNC])


@njit(cache=True, nogil=True)
def _sent_then(sent_at: Any, sent: int, last: int, step: int, t_ns: int, half_turn_ns: int, overflow: int) -> int:
    """By how many SYNCs, ``step`` and whole turns, a bus advances to the one that we had sent by this time.

    It is the first that was sent by no earlier time than it came, give or take what the bus and clocks need; a turn
    before it another one had been sent long ago. ``NOWHERE`` if there is none, or if the one before that was sent
    later: then it is older than the last of this bus, whose number is borrowed from others.
    """
    k, room = last + step, sent_at.size
    # The one that is being sent has no time yet.
    while k < sent and (k < sent - room or sent_at[k % room] < t_ns - half_turn_ns):
        k += overflow
    if k > sent or (k - 1 >= max(0, sent - room) and sent_at[(k - 1) % room] > t_ns + half_turn_ns):
        return NOWHERE
    return int(k - last)


@njit(cache=True, nogil=True)
def _told_by_counter(
    state: Any, b: Any, bus: int, counter: int, t_ns: int, period_ns: int, overflow: int, longest: int
) -> int:
    """By how many SYNCs a bus advances whose SYNC has a counter, as had the one before it."""
    elapsed = (t_ns - state[bus, TIME]) / period_ns if state[bus, TIME] != NEVER else 0.0
    step = (counter - state[bus, COUNTER]) % overflow
    if b.sent[0] > state[bus, SYNC]:
        half_turn_ns = period_ns * overflow // 2
        sent = _sent_then(b.sent_at, b.sent[0], state[bus, SYNC], step, t_ns, half_turn_ns, overflow)
        if sent != NOWHERE:
            return sent
    if state[bus, BORROWED]:
        # What had waited on this bus may be older than what others had meanwhile.
        found = _heard_elsewhere(state, b.recent, bus, step, t_ns, period_ns, overflow)
        return found if found != NOWHERE else int(step + overflow * turns_in(elapsed - step, overflow))
    often = state[bus, STRAYED] > _OFTEN
    if not state[bus, TORN] and _was_held_up(counter, state[bus, COUNTER], elapsed, often, overflow):
        longest = 0
    told = sync_step(counter, state[bus, COUNTER], elapsed, overflow, longest)
    found = 0
    if told > overflow:
        found = _heard_elsewhere(state, b.recent, bus, step, t_ns, period_ns, overflow)
    else:
        # Time may have deceived one of them; who is behind can still leave numbers out.
        other = _is_apart(state, bus, state[bus, SYNC] + told, t_ns, period_ns, overflow)
        if other >= 0 and state[other, COUNTER] >= 0:
            found = _together(state, bus, other, counter, t_ns, period_ns, overflow)
    return int(found) if found > 0 else int(told)


@njit(cache=True, nogil=True)
def advance(state: Any, b: Any, bus: int, counter: int, t_ns: int, period_ns: int, overflow: int, longest: int) -> int:
    """By how many SYNCs a bus advances with this one, after which ``state`` says so; nothing changes if it does not.

    ``state`` is that of the books ``b``, or a copy.
    """
    if state[bus, SYNC] < 0 and state[bus, COUNTER] < 0:
        step = _begin(state, b.recent, bus, counter, t_ns, period_ns, overflow)
    elif counter >= 0 and state[bus, COUNTER] >= 0:
        step = _told_by_counter(state, b, bus, counter, t_ns, period_ns, overflow, longest)
    elif counter < 0 and state.shape[0] > 1:
        # Without a counter, time alone keeps the buses together.
        elapsed = (t_ns - state[bus, TIME]) / period_ns if state[bus, TIME] != NEVER else 0.0
        step = min(max(1, int(np.rint(elapsed))), max(1, longest))
    else:
        step = 1
    if step > 0:
        if state[bus, TIME] != NEVER:
            state[bus, STRAYED] -= state[bus, STRAYED] >> FORGOTTEN
            if abs(t_ns - state[bus, TIME] - step * period_ns) > (_ON_TIME + _DRIFT * step) * period_ns:
                state[bus, STRAYED] += 1 << FORGOTTEN
        state[bus, SYNC] += step
        state[bus, TIME] = t_ns
        state[bus, BORROWED] = 0
        if state[bus, TORN] == 1:
            state[bus, TORN] = 0
        if counter >= 0:
            state[bus, COUNTER] = counter
    return int(step)
