"""Compiled numbering of the SYNCs of every bus, by their counter and, where it is ambiguous, by their time."""

from typing import Any

import numpy as np
from numba import njit

from armident.daq.matching.state import BORROWED, COUNTER, FORGOTTEN, NEVER, ORIGIN, STRAYED, SYNC, TIME, TORN

_EARLY = 0.25
"""Share of a counter turn by which the time between two SYNCs may be too short, by their time stamps."""
_DISORDER = 8
"""A SYNC counter that goes back by less than this is a repeated SYNC, not a long gap."""
_ON_TIME, _DRIFT = 2.0, 1e-4
"""Largest deviation of a SYNC from its period grid: periods, and share of the time since the last SYNC."""
NOWHERE = -(1 << 60)
"""Value of a step that could not be determined."""
_OFTEN = (3 << FORGOTTEN) // 2
"""Limit of ``STRAYED`` above which a master counts as always irregular: two late SYNCs in a few seconds at 5 kHz."""
_MISALIGNED = 2.0
"""Largest time between the same SYNC on two buses, periods."""


@njit(cache=True, nogil=True)
def turns_in(periods: float, overflow: int) -> int:
    """Return the number of whole counter turns in a time.

    SYNCs may be late, when their master was delayed, but at most a quarter of a turn early.

    Parameters
    ----------
    periods
        Time in SYNC periods.
    overflow
        Synchronous counter overflow value (CiA 301, 1019h).
    """
    return int(np.floor(periods / overflow + _EARLY))


@njit(cache=True, nogil=True)
def _was_held_up(counter: int, previous: int, elapsed: float, often: bool, overflow: int) -> bool:
    """Return whether the master of consecutive counters was delayed: the time is no multiple of counter turns.

    The time of a master that is ``often`` delayed is no evidence for missing turns.
    """
    step = (counter - previous) % overflow
    off = elapsed - step - turns_in(elapsed - step, overflow) * overflow
    return bool(step == 1 and (often or abs(off) > _ON_TIME + _DRIFT * elapsed))


@njit(cache=True, nogil=True)
def sync_step(counter: int, previous: int, elapsed: float, overflow: int, longest: int) -> int:
    """Return the number of SYNCs by which the counter advanced; zero or less for a repeated SYNC.

    The counter gives it modulo ``overflow``, the time the whole turns.

    Parameters
    ----------
    counter, previous
        Counters of this SYNC and the last one.
    elapsed
        Time between them, SYNC periods.
    overflow
        Synchronous counter overflow value (CiA 301, 1019h).
    longest
        Largest advance with whole turns, SYNCs.
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
    """Number the first SYNC of a bus: 0, or by the numbers of another bus.

    Return the step to it, 0 for a SYNC before number 0, less than 0 if the counters of the buses do not agree.
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
                # Receive time on the other bus is known: later delays of the master do not matter.
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
    """Advance of a bus, ``step`` and whole turns, to the SYNC that another bus received at this time.

    A delayed master keeps no period, but all buses receive its SYNC at the same time. If the delay is between buses,
    this SYNC lies between two that another bus received. ``NOWHERE`` if no bus received one.
    """
    best, nearest, room = NOWHERE, _MISALIGNED * period_ns, recent.shape[1]
    for other in range(state.shape[0]):
        last = state[other, SYNC]
        if other == bus or last < 0:
            continue
        # First number with this counter whose time the other bus may still have.
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
    """Return a bus that is farther ahead of this SYNC's number than the time allows; -1 if there is none."""
    for other in range(state.shape[0]):
        ahead = state[other, SYNC] - number
        if ahead <= overflow // 2 or other == bus or state[other, BORROWED]:
            continue
        if ahead - (state[other, TIME] - t_ns) / period_ns > overflow // 2:
            return other
    return -1


@njit(cache=True, nogil=True)
def _together(state: Any, bus: int, other: int, counter: int, t_ns: int, period_ns: int, overflow: int) -> int:
    """Return the advance of a bus to the SYNC that is nearest in time to the last one of another bus."""
    elapsed = (t_ns - state[other, TIME]) / period_ns
    step = (counter - state[other, COUNTER]) % overflow
    return int(state[other, SYNC] + step + overflow * np.rint((elapsed - step) / overflow) - state[bus, SYNC])


@njit(cache=True, nogil=True)
def _sent_then(sent_at: Any, sent: int, last: int, step: int, t_ns: int, half_turn_ns: int, overflow: int) -> int:
    """Advance of a bus, ``step`` and whole turns, to the SYNC sent by this program at this time.

    It is the first SYNC sent no earlier than half a turn before it was received; the one a turn earlier is much older.
    ``NOWHERE`` if there is none, or if the SYNC before it was sent later: then the received SYNC is older than the last
    number of this bus, which was taken from other buses.
    """
    k, room = last + step, sent_at.size
    # The SYNC being sent has no time yet.
    while k < sent and (k < sent - room or sent_at[k % room] < t_ns - half_turn_ns):
        k += overflow
    if k > sent or (k - 1 >= max(0, sent - room) and sent_at[(k - 1) % room] > t_ns + half_turn_ns):
        return NOWHERE
    return int(k - last)


@njit(cache=True, nogil=True)
def _told_by_counter(
    state: Any, b: Any, bus: int, counter: int, t_ns: int, period_ns: int, overflow: int, longest: int
) -> int:
    """Return the advance of a bus whose last and present SYNC have a counter."""
    elapsed = (t_ns - state[bus, TIME]) / period_ns if state[bus, TIME] != NEVER else 0.0
    step = (counter - state[bus, COUNTER]) % overflow
    if b.sent[0] > state[bus, SYNC]:
        half_turn_ns = period_ns * overflow // 2
        sent = _sent_then(b.sent_at, b.sent[0], state[bus, SYNC], step, t_ns, half_turn_ns, overflow)
        if sent != NOWHERE:
            return sent
    if state[bus, BORROWED]:
        # Delayed frames of this bus may be older than SYNCs that other buses have received since.
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
        # The time of one bus may be wrong; the bus that is behind can still skip numbers.
        other = _is_apart(state, bus, state[bus, SYNC] + told, t_ns, period_ns, overflow)
        if other >= 0 and state[other, COUNTER] >= 0:
            found = _together(state, bus, other, counter, t_ns, period_ns, overflow)
    return int(found) if found > 0 else int(told)


@njit(cache=True, nogil=True)
def advance(state: Any, b: Any, bus: int, counter: int, t_ns: int, period_ns: int, overflow: int, longest: int) -> int:
    """Number a received SYNC and update ``state``; return the number of SYNCs by which its bus advances.

    With zero or less, nothing changes: the SYNC is repeated, or the buses do not agree.

    Parameters
    ----------
    state
        ``MatcherState.state`` of ``b``, or a copy.
    b
        State of the matcher.
    bus
        Number of the bus.
    counter
        Counter of the SYNC; -1 if it has none.
    t_ns
        Receive time, ns UTC.
    period_ns
        SYNC period, ns.
    overflow
        Synchronous counter overflow value (CiA 301, 1019h).
    longest
        Largest advance with whole counter turns, SYNCs.
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
