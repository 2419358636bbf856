"""Compiled numbering of the SYNCs of every bus, by their counter and, where it is ambiguous, by their time."""

from typing import Any

import numpy as np

from armident.compiled import UNCOUNTED, compiled
from armident.daq.matching.state import (
    COUNTER,
    INCOMPLETE,
    INFERRED,
    IRREGULAR,
    IRREGULAR_DECAY,
    NEVER,
    ORIGIN,
    SYNC,
    TIME,
)

_EARLY = 0.25
"""Share of a counter turn by which the time between two SYNCs may be too short, by their time stamps."""
_MOST_REORDERED = 8
"""A SYNC counter that goes back by less than this is a repeated SYNC, not a long gap."""
_ON_TIME, _DRIFT = 2.0, 1e-4
"""Largest deviation of a SYNC from its period grid: periods, and share of the time since the last SYNC."""
UNKNOWN_STEP = -(1 << 60)
"""Value of a step that could not be determined."""
_IRREGULAR_LIMIT = (3 << IRREGULAR_DECAY) // 2
"""Limit of ``IRREGULAR`` above which a master counts as irregular: two late SYNCs in a few seconds at 5 kHz."""
_MISALIGNED = 2.0
"""Largest time between the same SYNC on two buses, periods."""


@compiled(**UNCOUNTED)
def turns_in(periods: float, overflow: int) -> int:
    """Return the number of whole counter turns in SYNC periods; SYNCs may be late, but at most a quarter turn early."""
    return int(np.floor(periods / overflow + _EARLY))


@compiled(**UNCOUNTED)
def _is_delayed(counter: int, previous: int, elapsed: float, irregular: bool, overflow: int) -> bool:
    """Return True if the time between counters is no multiple of turns; an ``irregular`` master's tells nothing."""
    step = (counter - previous) % overflow
    deviation = elapsed - step - turns_in(elapsed - step, overflow) * overflow
    return bool(step == 1 and (irregular or abs(deviation) > _ON_TIME + _DRIFT * elapsed))


@compiled(**UNCOUNTED)
def sync_step(counter: int, previous: int, elapsed: float, overflow: int, longest: int) -> int:
    """Return the number of SYNCs by which the counter advanced; zero or less for a repeated SYNC.

    The counter gives it modulo ``overflow``, ``elapsed`` (SYNC periods) the whole turns, at most ``longest`` SYNCs.
    """
    step = (counter - previous) % overflow
    turns = turns_in(elapsed - step, overflow)
    if turns > 0 and step + turns * overflow <= longest:
        return int(step + turns * overflow)
    if turns < 0 and step >= overflow - _MOST_REORDERED:
        return int(step - overflow)
    return int(step)


@compiled(**UNCOUNTED)
def _first_step(buses: Any, sync_times: Any, bus: int, counter: int, t_ns: int, period_ns: int, overflow: int) -> int:
    """Number a bus's first SYNC, 0 or by another bus; return the step: 0 before SYNC 0, < 0 if counters disagree."""
    for other in range(buses.shape[0]):
        if buses[other, SYNC] < 0:
            continue
        elapsed = (t_ns - buses[other, TIME]) / period_ns
        ahead = int(np.rint(elapsed))
        if counter >= 0 and buses[other, COUNTER] >= 0:
            step = (counter - buses[other, COUNTER]) % overflow
            ahead = int(step + overflow * np.rint((elapsed - step) / overflow))
            error = abs(elapsed - ahead)
            k = buses[other, SYNC] + ahead
            kept = sync_times.shape[1]
            if ahead <= 0 <= k and ahead > -kept and sync_times[other, k % kept] != NEVER:
                # Receive time on the other bus is known: later delays of the master do not matter.
                error = abs(t_ns - sync_times[other, k % kept]) / period_ns
            if error > _MISALIGNED:
                return -1
        buses[bus, ORIGIN] = buses[other, ORIGIN]
        return int(max(0, buses[other, SYNC] + ahead + 1))
    if counter >= 0:
        buses[bus, ORIGIN] = counter
    return 1


@compiled(**UNCOUNTED)
def _step_by_other_bus(
    buses: Any, sync_times: Any, bus: int, step: int, t_ns: int, period_ns: int, overflow: int
) -> int:
    """Return the advance of a bus, ``step`` and whole turns, to the SYNC that another bus received at this time.

    A delayed master keeps no period, but all buses receive its SYNC at the same time. If the delay is between buses,
    this SYNC lies between two of another bus. ``UNKNOWN_STEP`` if no bus received one.
    """
    best, nearest, kept = UNKNOWN_STEP, _MISALIGNED * period_ns, sync_times.shape[1]
    for other in range(buses.shape[0]):
        last = buses[other, SYNC]
        if other == bus or last < 0:
            continue
        # First number with this counter whose time the other bus may still have.
        k = max(0, last - kept + 1)
        k += (buses[bus, SYNC] + step - k) % overflow
        while k <= last:
            time = sync_times[other, k % kept]
            if time != NEVER and abs(t_ns - time) <= nearest:
                best, nearest = k - buses[bus, SYNC], float(abs(t_ns - time))
            elif best == UNKNOWN_STEP and last - kept + 1 < k < last:
                before, after = sync_times[other, (k - 1) % kept], sync_times[other, (k + 1) % kept]
                if before != NEVER and after != NEVER and before < t_ns < after:
                    best = k - buses[bus, SYNC]
            k += overflow
    return int(best)


@compiled(**UNCOUNTED)
def _bus_ahead(buses: Any, bus: int, number: int, t_ns: int, period_ns: int, overflow: int) -> int:
    """Return a bus that is farther ahead of this SYNC's number than the time allows; -1 if there is none."""
    for other in range(buses.shape[0]):
        ahead = buses[other, SYNC] - number
        if ahead <= overflow // 2 or other == bus or buses[other, INFERRED]:
            continue
        if ahead - (buses[other, TIME] - t_ns) / period_ns > overflow // 2:
            return other
    return -1


@compiled(**UNCOUNTED)
def _step_to_bus(buses: Any, bus: int, other: int, counter: int, t_ns: int, period_ns: int, overflow: int) -> int:
    """Return the advance of a bus to the SYNC that is nearest in time to the last one of another bus."""
    elapsed = (t_ns - buses[other, TIME]) / period_ns
    step = (counter - buses[other, COUNTER]) % overflow
    return int(buses[other, SYNC] + step + overflow * np.rint((elapsed - step) / overflow) - buses[bus, SYNC])


@compiled(**UNCOUNTED)
def _step_by_send_time(
    send_times: Any, sent: int, last: int, step: int, t_ns: int, half_turn_ns: int, overflow: int
) -> int:
    """Return the advance of a bus, ``step`` and whole turns, to the SYNC sent by this program at this time.

    It is the first SYNC sent no earlier than half a turn before it was received. ``UNKNOWN_STEP`` if there is none, or
    the SYNC before it was sent later: then it is older than the bus's last number, which came from other buses.
    """
    k, kept = last + step, send_times.size
    # The SYNC being sent has no time yet.
    while k < sent and (k < sent - kept or send_times[k % kept] < t_ns - half_turn_ns):
        k += overflow
    if k > sent or (k - 1 >= max(0, sent - kept) and send_times[(k - 1) % kept] > t_ns + half_turn_ns):
        return UNKNOWN_STEP
    return int(k - last)


@compiled(**UNCOUNTED)
def _step_by_counter(
    buses: Any, sync_times: Any, send_times: Any, sends_known: Any,
    bus: int, counter: int, t_ns: int, period_ns: int, overflow: int, longest: int,
) -> int:  # fmt: skip
    """Return the advance of a bus whose last and present SYNC have a counter."""
    elapsed = (t_ns - buses[bus, TIME]) / period_ns if buses[bus, TIME] != NEVER else 0.0
    step = (counter - buses[bus, COUNTER]) % overflow
    if sends_known[0] > buses[bus, SYNC]:
        half_turn_ns = period_ns * overflow // 2
        sent = _step_by_send_time(send_times, sends_known[0], buses[bus, SYNC], step, t_ns, half_turn_ns, overflow)
        if sent != UNKNOWN_STEP:
            return sent
    if buses[bus, INFERRED]:
        # Delayed frames of this bus may be older than SYNCs that other buses have received since.
        found = _step_by_other_bus(buses, sync_times, bus, step, t_ns, period_ns, overflow)
        return found if found != UNKNOWN_STEP else int(step + overflow * turns_in(elapsed - step, overflow))
    irregular = buses[bus, IRREGULAR] > _IRREGULAR_LIMIT
    if not buses[bus, INCOMPLETE] and _is_delayed(counter, buses[bus, COUNTER], elapsed, irregular, overflow):
        longest = 0
    counted = sync_step(counter, buses[bus, COUNTER], elapsed, overflow, longest)
    found = 0
    if counted > overflow:
        found = _step_by_other_bus(buses, sync_times, bus, step, t_ns, period_ns, overflow)
    else:
        # The time of one bus may be wrong; the bus that is behind can still skip numbers.
        other = _bus_ahead(buses, bus, buses[bus, SYNC] + counted, t_ns, period_ns, overflow)
        if other >= 0 and buses[other, COUNTER] >= 0:
            found = _step_to_bus(buses, bus, other, counter, t_ns, period_ns, overflow)
    return int(found) if found > 0 else int(counted)


@compiled(**UNCOUNTED)
def advance(
    buses: Any, sync_times: Any, send_times: Any, sends_known: Any,
    bus: int, counter: int, t_ns: int, period_ns: int, overflow: int, longest: int,
) -> int:  # fmt: skip
    """Number a received SYNC, update ``buses``, and return the advance of its bus; nothing changes at zero or less.

    ``buses``: ``bus_state``, or a copy; with three arrays of the state, which as a whole takes longer to pass.
    ``counter``: -1 if it has none. ``t_ns``: receive time, ns UTC.
    ``longest``: largest advance with whole counter turns, SYNCs.
    """
    if buses[bus, SYNC] < 0 and buses[bus, COUNTER] < 0:
        step = _first_step(buses, sync_times, bus, counter, t_ns, period_ns, overflow)
    elif counter >= 0 and buses[bus, COUNTER] >= 0:
        step = _step_by_counter(
            buses, sync_times, send_times, sends_known, bus, counter, t_ns, period_ns, overflow, longest
        )
    elif counter < 0 and sends_known[0] > buses[bus, SYNC]:
        step = _step_by_send_time(send_times, sends_known[0], buses[bus, SYNC], 1, t_ns, period_ns // 2, 1)
        step = max(1, step)
    elif counter < 0 and (buses.shape[0] > 1 or buses[bus, INCOMPLETE]):
        # Without a counter, time alone keeps the buses together, and shows how many of the lost frames were SYNCs.
        elapsed = (t_ns - buses[bus, TIME]) / period_ns if buses[bus, TIME] != NEVER else 0.0
        step = min(max(1, int(np.rint(elapsed))), max(1, longest))
    else:
        step = 1
    if step > 0:
        if buses[bus, TIME] != NEVER:
            buses[bus, IRREGULAR] -= buses[bus, IRREGULAR] >> IRREGULAR_DECAY
            if abs(t_ns - buses[bus, TIME] - step * period_ns) > (_ON_TIME + _DRIFT * step) * period_ns:
                buses[bus, IRREGULAR] += 1 << IRREGULAR_DECAY
        buses[bus, SYNC] += step
        buses[bus, TIME] = t_ns
        buses[bus, INFERRED] = 0
        if buses[bus, INCOMPLETE] == 1:
            buses[bus, INCOMPLETE] = 0
        if counter >= 0:
            buses[bus, COUNTER] = counter
    return int(step)
