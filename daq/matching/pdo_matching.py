"""Compiled matching of TPDOs to the SYNCs that they answer.

A TPDO has no number, only an order: per drive and TPDO, SYNCs and answers are matched first to first. If the drive has
answered all SYNCs by the next SYNC, the match is certain, however late the answers were. An answer is lost if a drive

- answers every SYNC again and still lacks answers while another drive on its bus lacks none,
- is silent beside such a drive, or
- lacks answers for longer than a window of SYNCs.

Then every answer is taken as prompt (the latest SYNC that it can belong to). If answers also came in bursts, the
samples in question are discarded as ``AMBIGUOUS``, never guessed. While all drives lack answers at every SYNC and no
frame is known to be missing, the buses are delayed: then the window is ``LONG_WINDOW`` SYNCs.

Answers to discarded rows, of a drive that was silent or a bus that was off, may still arrive: the first surplus answers
belong to them, and equal numbers of answers and SYNCs prove nothing. They do once the drive has answered each of some
consecutive SYNCs, or has kept its largest surplus of answers at as many SYNCs of a longer time.

A row is one SYNC of all axes on all buses. With another master, buses are aligned by counter and receive time; a bus
without SYNC while others receive it is silent, and its drives have nothing to answer.
"""

from typing import Any

import numpy as np

from armident.compiled import UNCOUNTED, compiled
from armident.daq.matching.resolve import settle_all, slot_of
from armident.daq.matching.state import (
    COUNTER,
    EVERY,
    FINAL,
    FRAMES,
    FRAMES_UNKNOWN,
    INFERRED,
    LENGTH,
    LOST,
    NEVER,
    OPEN,
    ORIGIN,
    PACK,
    PENDING,
    RECEIVED,
    SINCE_SYNC,
    SYNC,
    SYNC_MISALIGNED,
    SYNC_MISSING,
    SYNC_REPEATED,
    SYNC_SEEN,
    TIME,
    TOP,
    TPDO_DUPLICATE,
    TPDO_EARLY,
    TPDO_WRONG_LENGTH,
    WINDOW,
    WRONG_LENGTH,
    WRONG_LENGTHS,
    WRONG_MAPPING,
    MatchedSamples,
    MatcherState,
)
from armident.daq.matching.sync_unwrap import advance
from armident.drivers.canopen.objects import PDOS, SDO_DOWNLOAD, TPDO_COMMUNICATION, TPDO_MAPPING

OPEN_END = int(np.iinfo(np.int64).max)
"""End of a time span that is still open, ns."""


@compiled(**UNCOUNTED)
def _add_row(m: MatcherState, bus: int, k: int, s: int) -> None:
    """Add SYNC ``k`` of a bus to the rows to be answered, if the stream sends on it."""
    if (m.bus_state[bus, ORIGIN] + k) % m.config[s, EVERY]:
        return
    slot = slot_of(m, s, m.head[bus, s])
    if m.head[bus, s] == m.watermark[s, TOP]:
        m.watermark[s, TOP] += 1
        m.row_sync[s, slot] = k
        # Loops, not slices: this runs once per SYNC.
        for i in range(m.config[s, PACK]):
            for other in range(m.bus_state.shape[0]):
                m.row_t[s, slot, i, other] = NEVER
        for j in range(m.drives.shape[1]):
            m.row_code[s, slot, j] = LOST
    for i in range(m.config[s, PACK]):
        m.row_t[s, slot, i, bus] = m.sync_times[bus, (k - m.config[s, PACK] + 1 + i) % m.sync_times.shape[1]]
    m.head[bus, s] += 1


@compiled(**UNCOUNTED)
def _add_missing_syncs(m: MatcherState, bus: int, first: int, until: int, out: MatchedSamples) -> None:
    """Count SYNCs ``first`` to before ``until`` of a bus as sent, but not received."""
    if until <= first:
        return
    streams = m.config.shape[0]
    origin = m.bus_state[bus, ORIGIN]
    for s in range(streams):
        m.gap_end[bus, s] = max(m.gap_end[bus, s], m.head[bus, s] + (until - first) // m.config[s, EVERY] + 1)
        if (until - first) // m.config[s, EVERY] > m.config[s, WINDOW] // 2:
            settle_all(m, bus, s, OPEN, out)
    for k in range(first, until):
        m.sync_times[bus, k % m.sync_times.shape[1]] = NEVER
        for s in range(streams):
            _add_row(m, bus, k, s)
            if (until - first) // m.config[s, EVERY] > m.config[s, WINDOW] // 2:
                settle_all(m, bus, s, OPEN, out)
    for s in range(streams):
        every = m.config[s, EVERY]
        rows = (origin + until - 1) // every - (origin + first - 1) // every
        if (until - first) // every > m.config[s, WINDOW] // 2 or rows == 0:
            continue
        # Answers since the last received SYNC may belong to the missed SYNCs too.
        for j in range(m.drives.shape[1]):
            if m.bus_of[j] == bus:
                for i in range(m.drives[s, j, PENDING] - m.drives[s, j, SINCE_SYNC], m.drives[s, j, PENDING]):
                    m.newest_row[s, j, i] = m.head[bus, s] - 1


@compiled(**UNCOUNTED)
def _pass_silent_buses(
    m: MatcherState, bus: int, k: int, t_ns: int, period_ns: int, overflow: int, out: MatchedSamples
) -> None:
    """At SYNC ``k`` of a bus, count the SYNCs of buses that are farther behind than their slack as missing."""
    for other in range(m.bus_state.shape[0]):
        last = m.bus_state[other, SYNC]
        until = k + 1 - m.slack[other]
        if other == bus or until <= last + 1:
            continue
        if last < 0:
            m.bus_state[other, ORIGIN] = m.bus_state[bus, ORIGIN]
        # Answers received so far belong to received SYNCs, not to missing ones.
        for s in range(m.config.shape[0]):
            settle_all(m, other, s, FINAL, out)
        _add_missing_syncs(m, other, last + 1, until, out)
        m.counts[SYNC_MISSING] += until - last - 1
        m.bus_state[other, SYNC] = until - 1
        m.bus_state[other, INFERRED] = 1
        m.bus_state[other, TIME] = t_ns - (k + 1 - until) * period_ns
        if m.bus_state[bus, COUNTER] >= 0:
            m.bus_state[other, COUNTER] = (m.bus_state[other, ORIGIN] + until - 1) % overflow
        for s in range(m.config.shape[0]):
            settle_all(m, other, s, FINAL, out)
            # All rows of the outage are settled; the bus was up for later ones.
            m.gap_end[other, s] = min(m.gap_end[other, s], m.head[other, s])


@compiled(**UNCOUNTED)
def _check_sdo_write(m: MatcherState, j: int, request: Any, t_ns: int) -> None:
    """Mark a joint's TPDOs as unverified if an SDO request writes their parameters (CiA 301, 1800h-1BFFh)."""
    index = np.int64((request >> np.uint64(8)) & np.uint64(0xFFFF))
    writes = np.int64((request >> np.uint64(5)) & np.uint64(7)) == SDO_DOWNLOAD
    if writes and TPDO_COMMUNICATION <= index < TPDO_MAPPING + PDOS and t_ns > m.unverified[j, 1]:
        m.unverified[j, 0] = t_ns
        m.unverified[j, 1] = OPEN_END


@compiled("i8, u4[:], u1[:], i8[:], u8[:, :], i8, i8, i8, i8, i8, i8[:, ::1], MatcherState", **UNCOUNTED)
def count_sync(
    count: int, can_id: Any, length: Any, t_ns: Any, data: Any, sync_id: int, period_ns: int, overflow: int,
    bus: int, longest: int, bus_state: Any, m: MatcherState,
) -> int:  # fmt: skip
    """Return the number of SYNCs that the frames may cover; ``bus_state`` is a copy, which changes. Rest as `match`."""
    total = 0
    for i in range(count):
        if can_id[i] == sync_id:
            counter = int(np.int64(data[i, 0] & np.uint64(0xFF))) if length[i] > 0 and overflow > 0 else -1
            step = advance(
                bus_state,
                m.sync_times,
                m.send_times,
                m.sends_known,
                bus,
                counter,
                t_ns[i],
                period_ns,
                overflow,
                longest,
            )
            total += max(0, step)
    return int(total)


@compiled("i8, u4[:], u1[:], i8[:], u8[:, :], i8, i8, i8, i8, i8, MatcherState, MatchedSamples", **UNCOUNTED)
def match(
    count: int, can_id: Any, length: Any, t_ns: Any, data: Any, sync_id: int, period_ns: int, overflow: int,
    bus: int, longest: int, m: MatcherState, out: MatchedSamples,
) -> None:  # fmt: skip
    """Match frames of one bus, in the order of reception, and append the decided samples to ``out``.

    ``can_id``, ``length``, ``t_ns`` (ns UTC): (count,) or longer; ``data``: 64-bit words, (count, words). ``overflow``:
    of the SYNC counter (CiA 301, 1019h; 0: none). ``longest``: largest advance with whole counter turns, SYNCs.
    """
    n = m.drives.shape[1]
    words = min(data.shape[1], m.answer.shape[3])
    for i in range(count):
        m.counts[FRAMES] += 1
        identifier = np.int64(can_id[i])
        if identifier == sync_id:
            counter = int(np.int64(data[i, 0] & np.uint64(0xFF))) if length[i] > 0 and overflow > 0 else -1
            last = m.bus_state[bus, SYNC]
            step = advance(
                m.bus_state, m.sync_times, m.send_times, m.sends_known,
                bus, counter, t_ns[i], period_ns, overflow, longest,
            )  # fmt: skip
            if step <= 0:
                misaligned = last < 0 and step < 0
                m.counts[SYNC_MISALIGNED if misaligned else SYNC_REPEATED] += 1
                continue
            k = last + step
            if step > 1:
                _add_missing_syncs(m, bus, last + 1, k, out)
            m.sync_times[bus, k % m.sync_times.shape[1]] = t_ns[i]
            for s in range(m.config.shape[0]):
                settle_all(m, bus, s, OPEN, out)
                _add_row(m, bus, k, s)
            m.counts[SYNC_SEEN] += 1
            m.counts[SYNC_MISSING] += step - 1
            # Skip the call on a single bus: passing the state costs more than the function itself.
            if m.bus_state.shape[0] > 1:
                _pass_silent_buses(m, bus, k, t_ns[i], period_ns, overflow, out)
            continue
        channel = m.channel_of[bus, identifier] if identifier < m.channel_of.shape[1] else np.int64(-1)
        if channel < 0 and identifier < m.channel_of.shape[1] and m.writes_to[bus, identifier] >= 0:
            _check_sdo_write(m, m.writes_to[bus, identifier], data[i, 0], t_ns[i])
            continue
        if channel < 0:
            m.counts[FRAMES_UNKNOWN] += 1
            continue
        s, j = channel // n, channel % n
        slot = m.drives[s, j, PENDING]
        if m.head[bus, s] == 0:
            m.counts[TPDO_EARLY] += 1
        elif slot >= m.newest_row.shape[2]:
            m.counts[TPDO_DUPLICATE] += 1
        else:
            length_ok = length[i] == m.config[s, LENGTH]
            if not length_ok:
                m.counts[TPDO_WRONG_LENGTH] += 1
                m.drives[s, j, WRONG_LENGTHS] += 1
            for w in range(words):
                m.answer[s, j, slot, w] = data[i, w]
            m.answer_code[s, j, slot] = RECEIVED if length_ok else WRONG_LENGTH
            if m.unverified[j, 0] <= t_ns[i] < m.unverified[j, 1]:
                m.answer_code[s, j, slot] = WRONG_MAPPING
            m.newest_row[s, j, slot] = m.head[bus, s] - 1
            m.drives[s, j, PENDING] += 1
            m.drives[s, j, SINCE_SYNC] += 1


@compiled("i8, MatcherState, MatchedSamples", **UNCOUNTED)
def finish(total: int, m: MatcherState, out: MatchedSamples) -> None:
    """Settle all rows after the last frame, of ``total`` SYNCs that were sent: unanswered SYNCs are lost."""
    for bus in range(m.bus_state.shape[0]):
        last = m.bus_state[bus, SYNC]
        for other in range(m.bus_state.shape[0] if last < 0 else 0):
            if m.bus_state[other, COUNTER] >= 0:
                m.bus_state[bus, ORIGIN] = m.bus_state[other, ORIGIN]
        if total > last + 1:
            _add_missing_syncs(m, bus, last + 1, total, out)
            m.counts[SYNC_MISSING] += total - 1 - last
            m.bus_state[bus, SYNC] = total - 1
        for s in range(m.config.shape[0]):
            settle_all(m, bus, s, FINAL, out)
