"""The compiled part of the assembler: which TPDO answers which SYNC.

A TPDO carries no number, only an order: each drive answers its SYNCs one after the other. So per drive and TPDO,
SYNCs and answers are matched first to first. As long as a drive owes nothing when the books are closed (at the next
SYNC of its bus) the match is certain, however late the answers came. A drive that answers every SYNC again and still
owes while another on its bus owes nothing has lost something, and so has one that stays silent beside such another, or
owes for longer than a window of SYNCs. Then every answer is taken as prompt (the latest SYNC it can belong to), and
where answers also came in bursts the matter is undecidable and the samples in question are given up as ``AMBIGUOUS``,
never guessed. While all drives owe at every SYNC and no frame is known to be missing, the buses are behind and nothing
is lost: then the window is ``patience`` SYNCs.

Answers to rows that were given up, of a drive that was silent or a bus that was off, may come all the same. So until
such a drive keeps step for some SYNCs, as many answers as SYNCs prove nothing; the first ones too many are then those.

Several buses carry the same SYNC numbers: a row is one SYNC of all axes. Where SYNC is not ours the buses are aligned
by its counter and the time at which it came. A bus on which no SYNC comes while others go on is silent: its SYNCs are
missing, and its drives owe nothing for them.
"""

from typing import Any

import numpy as np
from numba import njit

from armident.daq.matching.resolve import settle_all, slot_of
from armident.daq.matching.state import (
    BORROWED,
    COUNTER,
    EVERY,
    FRAMES,
    FRAMES_UNKNOWN,
    LENGTH,
    LOST,
    NEVER,
    ORIGIN,
    PACK,
    RECEIVED,
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
    WRONG_MAPPING,
    MatchedSamples,
    MatcherState,
)
from armident.daq.matching.sync_unwrap import advance
from armident.drivers.canopen.objects import PDOS, SDO_DOWNLOAD, TPDO_COMMUNICATION, TPDO_MAPPING

EVER = int(np.iinfo(np.int64).max)


@njit(cache=True, nogil=True)
def _owe(b: MatcherState, bus: int, k: int, s: int) -> None:
    """SYNC ``k`` of a bus asks for an answer, if the stream sends on it."""
    if (b.state[bus, ORIGIN] + k) % b.kind[s, EVERY]:
        return
    slot = slot_of(b, s, b.head[bus, s])
    if b.head[bus, s] == b.mark[s, TOP]:
        b.mark[s, TOP] += 1
        b.row_sync[s, slot] = k
        # Loops, not slices: this runs once per SYNC.
        for i in range(b.kind[s, PACK]):
            for other in range(b.state.shape[0]):
                b.row_t[s, slot, i, other] = NEVER
        for j in range(b.settled.shape[1]):
            b.row_code[s, slot, j] = LOST
    for i in range(b.kind[s, PACK]):
        b.row_t[s, slot, i, bus] = b.recent[bus, (k - b.kind[s, PACK] + 1 + i) % b.recent.shape[1]]
    b.head[bus, s] += 1


@njit(cache=True, nogil=True)
def _miss(b: MatcherState, bus: int, first: int, until: int, out: MatchedSamples) -> None:
    """SYNCs ``first`` to before ``until`` were sent on the bus, but not received."""
    if until <= first:
        return
    streams = b.kind.shape[0]
    before = b.head[bus].copy()
    for s in range(streams):
        b.hole[bus, s] = max(b.hole[bus, s], b.head[bus, s] + (until - first) // b.kind[s, EVERY] + 1)
        if (until - first) // b.kind[s, EVERY] > b.kind[s, WINDOW] // 2:
            settle_all(b, bus, s, False, out)
    for k in range(first, until):
        b.recent[bus, k % b.recent.shape[1]] = NEVER
        for s in range(streams):
            _owe(b, bus, k, s)
            if (until - first) // b.kind[s, EVERY] > b.kind[s, WINDOW] // 2:
                settle_all(b, bus, s, False, out)
    for s in range(streams):
        if (until - first) // b.kind[s, EVERY] > b.kind[s, WINDOW] // 2 or b.head[bus, s] == before[s]:
            continue
        # What came since the last SYNC seen may answer the missed ones too.
        for j in range(b.settled.shape[1]):
            if b.bus_of[j] == bus:
                for i in range(b.pending[s, j] - b.fresh[s, j], b.pending[s, j]):
                    b.label[s, j, i] = b.head[bus, s] - 1


@njit(cache=True, nogil=True)
def _skip_silent(
    b: MatcherState, bus: int, k: int, t_ns: int, period_ns: int, overflow: int, out: MatchedSamples
) -> None:
    """With SYNC ``k`` of a bus, those are missing that buses farther behind than their slack should have had."""
    for other in range(b.state.shape[0]):
        last = b.state[other, SYNC]
        until = k + 1 - b.slack[other]
        if other == bus or until <= last + 1:
            continue
        if last < 0:
            b.state[other, ORIGIN] = b.state[bus, ORIGIN]
        # What has come answers SYNCs that were seen, not those that are missing.
        for s in range(b.kind.shape[0]):
            settle_all(b, other, s, True, out)
        _miss(b, other, last + 1, until, out)
        b.counts[SYNC_MISSING] += until - last - 1
        b.state[other, SYNC] = until - 1
        b.state[other, BORROWED] = 1
        b.state[other, TIME] = t_ns - (k + 1 - until) * period_ns
        if b.state[bus, COUNTER] >= 0:
            b.state[other, COUNTER] = (b.state[other, ORIGIN] + until - 1) % overflow
        for s in range(b.kind.shape[0]):
            settle_all(b, other, s, True, out)
            # All rows of the hole are settled: on those behind it the bus was up.
            b.hole[other, s] = min(b.hole[other, s], b.head[other, s])


@njit(cache=True, nogil=True)
def _notice_write(b: MatcherState, j: int, request: Any, t_ns: int) -> None:
    """An SDO request to the drive of a joint: one that writes what its TPDOs hold makes them suspect from now on."""
    index = np.int64((request >> np.uint64(8)) & np.uint64(0xFFFF))
    writes = np.int64((request >> np.uint64(5)) & np.uint64(7)) == SDO_DOWNLOAD
    if writes and TPDO_COMMUNICATION <= index < TPDO_MAPPING + PDOS and t_ns > b.suspect[j, 1]:
        b.suspect[j, 0] = t_ns
        b.suspect[j, 1] = EVER


@njit(cache=True, nogil=True)
def count_sync(
    count: int, can_id: Any, length: Any, t_ns: Any, data: Any, sync_id: int, period_ns: int, overflow: int,
    bus: int, longest: int, b: MatcherState,
) -> int:  # fmt: skip
    """How many SYNC numbers the frames may cover; changes nothing."""
    total, state = 0, b.state.copy()
    for i in range(count):
        if can_id[i] == sync_id:
            counter = int(np.int64(data[i, 0] & np.uint64(0xFF))) if length[i] > 0 else -1
            total += max(0, advance(state, b, bus, counter, t_ns[i], period_ns, overflow, longest))
    return int(total)


@njit(cache=True, nogil=True)
def match(
    count: int, can_id: Any, length: Any, t_ns: Any, data: Any, sync_id: int, period_ns: int, overflow: int,
    bus: int, longest: int, b: MatcherState, out: MatchedSamples,
) -> None:  # fmt: skip
    """Take ``count`` frames of one bus in the order they came; samples whose fate is decided go to ``out``."""
    n = b.settled.shape[1]
    words = min(data.shape[1], b.answer.shape[3])
    for i in range(count):
        b.counts[FRAMES] += 1
        identifier = np.int64(can_id[i])
        if identifier == sync_id:
            counter = int(np.int64(data[i, 0] & np.uint64(0xFF))) if length[i] > 0 else -1
            last = b.state[bus, SYNC]
            step = advance(b.state, b, bus, counter, t_ns[i], period_ns, overflow, longest)
            if step <= 0:
                unlike = last < 0 and step < 0
                b.counts[SYNC_MISALIGNED if unlike else SYNC_REPEATED] += 1
                continue
            k = last + step
            if step > 1:
                _miss(b, bus, last + 1, k, out)
            b.recent[bus, k % b.recent.shape[1]] = t_ns[i]
            for s in range(b.kind.shape[0]):
                settle_all(b, bus, s, False, out)
                _owe(b, bus, k, s)
            b.counts[SYNC_SEEN] += 1
            b.counts[SYNC_MISSING] += step - 1
            # A call hands all the books over, which costs more than most of what it does.
            if b.state.shape[0] > 1:
                _skip_silent(b, bus, k, t_ns[i], period_ns, overflow, out)
            continue
        channel = b.channel_of[bus, identifier] if identifier < b.channel_of.shape[1] else np.int64(-1)
        if channel < 0 and identifier < b.channel_of.shape[1] and b.writes_to[bus, identifier] >= 0:
            _notice_write(b, b.writes_to[bus, identifier], data[i, 0], t_ns[i])
            continue
        if channel < 0:
            b.counts[FRAMES_UNKNOWN] += 1
            continue
        s, j = channel // n, channel % n
        slot = b.pending[s, j]
        if b.head[bus, s] == 0:
            b.counts[TPDO_EARLY] += 1
        elif slot >= b.label.shape[2]:
            b.counts[TPDO_DUPLICATE] += 1
        else:
            right = length[i] == b.kind[s, LENGTH]
            if not right:
                b.counts[TPDO_WRONG_LENGTH] += 1
                b.wrong[s, j] += 1
            for w in range(words):
                b.answer[s, j, slot, w] = data[i, w]
            b.answer_code[s, j, slot] = RECEIVED if right else WRONG_LENGTH
            if b.suspect[j, 0] <= t_ns[i] < b.suspect[j, 1]:
                b.answer_code[s, j, slot] = WRONG_MAPPING
            b.label[s, j, slot] = b.head[bus, s] - 1
            b.pending[s, j] += 1
            b.fresh[s, j] += 1


@njit(cache=True, nogil=True)
def finish(total: int, b: MatcherState, out: MatchedSamples) -> None:
    """No more frames come: SYNCs ``0 .. total - 1`` were sent, and what is still owed is lost."""
    for bus in range(b.state.shape[0]):
        last = b.state[bus, SYNC]
        for other in range(b.state.shape[0] if last < 0 else 0):
            if b.state[other, COUNTER] >= 0:
                b.state[bus, ORIGIN] = b.state[other, ORIGIN]
        if total > last + 1:
            _miss(b, bus, last + 1, total, out)
            b.counts[SYNC_MISSING] += total - 1 - last
            b.state[bus, SYNC] = total - 1
        for s in range(b.kind.shape[0]):
            settle_all(b, bus, s, True, out)
