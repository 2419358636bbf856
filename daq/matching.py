"""The compiled part of the assembler: which TPDO answers which SYNC.

A TPDO carries no number, only an order: each drive answers its SYNCs one after the other. So per drive and TPDO,
SYNCs and answers are matched first to first. As long as a drive owes nothing when the books are closed (at the next
SYNC of its bus) the match is certain, however late the answers came. A drive that owes while another has answered, for
longer than a window of SYNCs, has lost something; then every answer is taken as prompt (the latest SYNC it can belong
to), and where answers also came in bursts the matter is undecidable and the samples in question are given up as
``AMBIGUOUS``, never guessed. While all drives owe at every SYNC and no frame is known to be missing, the buses are
behind and nothing is lost: then the window is ``patience`` SYNCs.

Several buses carry the same SYNC numbers: a row is one SYNC of all axes. Where SYNC is not ours the buses are aligned
by its counter and the time at which it came. A bus on which no SYNC comes while others go on is silent: its SYNCs are
missing, and its drives owe nothing for them.
"""

from typing import Any

import numpy as np
from numba import njit

from daq.books import (
    AMBIGUOUS,
    BORROWED,
    COUNTER,
    FRAMES,
    FRAMES_UNKNOWN,
    LOST,
    NO_SYNC,
    ORIGIN,
    RECEIVED,
    RECENT,
    SYNC,
    SYNC_MISALIGNED,
    SYNC_MISSING,
    SYNC_REPEATED,
    SYNC_SEEN,
    TIME,
    TPDO_DUPLICATE,
    TPDO_EARLY,
    TPDO_LATE,
    TPDO_WRONG_LENGTH,
    UNSEEN,
    WRONG_LENGTH,
    Books,
    Decided,
)

_DISORDER = 8
"""A SYNC counter that goes back by less than this is a repeated SYNC, not a long gap."""
_MISALIGNED = 2.0
"""SYNCs of equal counters on two buses that are farther apart than so many periods are not the same SYNC."""


@njit(cache=True, nogil=True)
def sync_step(counter: int, previous: int, elapsed: float, overflow: int, longest: int) -> int:
    """By how many SYNCs the counter advanced; zero or less for a repeated SYNC.

    Known modulo ``overflow``; whole turns of the counter are told from ``elapsed`` periods, up to ``longest``.
    """
    step = (counter - previous) % overflow
    turns = int(np.rint((elapsed - step) / overflow))
    if turns > 0 and step + turns * overflow <= longest:
        return int(step + turns * overflow)
    if turns < 0 and step >= overflow - _DISORDER:
        return int(step - overflow)
    return int(step)


@njit(cache=True, nogil=True)
def _begin(state: Any, bus: int, counter: int, t_ns: int, period_ns: int, overflow: int) -> int:
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
            if abs(elapsed - ahead) > _MISALIGNED:
                return -1
        state[bus, ORIGIN] = state[other, ORIGIN]
        return int(max(0, state[other, SYNC] + ahead + 1))
    if counter >= 0:
        state[bus, ORIGIN] = counter
    return 1


@njit(cache=True, nogil=True)
def _advance(state: Any, bus: int, counter: int, t_ns: int, period_ns: int, overflow: int, longest: int) -> int:
    """By how many SYNCs a bus advances with this one, after which ``state`` says so; nothing changes if it does not."""
    elapsed = (t_ns - state[bus, TIME]) / period_ns if state[bus, TIME] != UNSEEN else 0.0
    if state[bus, SYNC] < 0 and state[bus, COUNTER] < 0:
        step = _begin(state, bus, counter, t_ns, period_ns, overflow)
    elif counter >= 0 and state[bus, COUNTER] >= 0 and state[bus, BORROWED]:
        # What had waited on this bus may be older than what others had meanwhile.
        step = (counter - state[bus, COUNTER]) % overflow
        step += int(overflow * np.rint((elapsed - step) / overflow))
    elif counter >= 0 and state[bus, COUNTER] >= 0:
        step = sync_step(counter, state[bus, COUNTER], elapsed, overflow, longest)
    elif counter < 0 and state.shape[0] > 1:
        # Without a counter, time alone keeps the buses together.
        step = min(max(1, int(np.rint(elapsed))), max(1, longest))
    else:
        step = 1
    if step > 0:
        state[bus, SYNC] += step
        state[bus, TIME] = t_ns
        state[bus, BORROWED] = 0
        if counter >= 0:
            state[bus, COUNTER] = counter
    return int(step)


@njit(cache=True, nogil=True)
def _slot(b: Books, s: int, u: int) -> int:
    return int((u - b.base[s]) % b.row_sync.shape[1])


@njit(cache=True, nogil=True)
def _place(b: Books, s: int, j: int, u: int, i: int) -> None:
    slot = _slot(b, s, u)
    for w in range(b.answer.shape[3]):
        b.row_data[s, slot, j, w] = b.answer[s, j, i, w]
    b.row_code[s, slot, j] = b.answer_code[s, j, i]
    if b.label[s, j, i] > u and b.row_t[s, slot, b.pack[s] - 1, b.bus_of[j]] != UNSEEN:
        b.counts[TPDO_LATE] += 1


@njit(cache=True, nogil=True)
def _settle(b: Books, s: int, j: int, final: bool) -> None:
    """Close the books of one TPDO of one drive: match what is certain, give up what is older than the window."""
    head = b.head[b.bus_of[j], s]
    owed = head - b.settled[s, j]
    count = b.pending[s, j]
    if count > owed:
        b.counts[TPDO_DUPLICATE] += count - owed
        count = owed
        b.pending[s, j] = owed
    b.fresh[s, j] = 0
    if count == owed:
        for i in range(count):
            _place(b, s, j, b.settled[s, j] + i, i)
        b.settled[s, j] = head
        b.pending[s, j] = 0
        return
    late = owed > b.window[s] and head - b.behind[s] > b.window[s]
    if not (late or owed > b.patience[s] or final):
        return
    keep = head if final else head - b.window[s]
    u = head
    for i in range(count - 1, -1, -1):
        u = min(b.label[s, j, i], u - 1)
        keep = max(keep, u + 1)
        _place(b, s, j, u, i)
    # Answers that came in a burst after a silence: with one of them lost, none can be told from the next.
    previous = b.settled[s, j] - 1
    for i in range(count):
        label = b.label[s, j, i]
        if i + 1 < count and b.label[s, j, i + 1] == label:
            for v in range(previous + 1, label + 1):
                b.row_code[s, _slot(b, s, v), j] = AMBIGUOUS
        else:
            previous = label
    b.pending[s, j] = 0
    b.settled[s, j] = keep


@njit(cache=True, nogil=True)
def _sample(b: Books, s: int, slot: int, j: int, i: int, word: int) -> Any:
    """Eight bytes of sample ``i`` of a packed answer."""
    value = np.uint64(0)
    for octet in range(8 * word, min(b.size[s], 8 * word + 8)):
        at = i * b.size[s] + octet
        taken = (b.row_data[s, slot, j, at >> 3] >> np.uint64(8 * (at & 7))) & np.uint64(0xFF)
        value |= taken << np.uint64(8 * (octet & 7))
    return value


@njit(cache=True, nogil=True)
def _emit(b: Books, s: int, end: int, out: Decided) -> None:
    """Give out the rows before ``end``; a packed one is as many samples."""
    pack, buses = b.pack[s], b.state.shape[0]
    words = -(-b.size[s] // 8)
    while b.emitted[s] < end:
        slot = _slot(b, s, b.emitted[s])
        for i in range(pack):
            k = b.row_sync[s, slot] - pack + 1 + i
            if k < 0:
                continue
            o = out.rows[s]
            out.sync[s, o] = k
            out.t_ns[s, o] = UNSEEN
            for bus in range(buses - 1, -1, -1):
                if b.row_t[s, slot, i, bus] != UNSEEN:
                    out.t_ns[s, o] = b.row_t[s, slot, i, bus]
            for j in range(b.settled.shape[1]):
                seen = b.row_t[s, slot, i, b.bus_of[j]] != UNSEEN
                out.code[s, o, j] = b.row_code[s, slot, j] if seen else NO_SYNC
                for w in range(words):
                    out.data[s, o, j, w] = b.row_data[s, slot, j, w] if pack == 1 else _sample(b, s, slot, j, i, w)
            out.rows[s] += 1
        b.emitted[s] += 1
    if b.emitted[s] == b.top[s]:
        b.base[s] = b.top[s]


@njit(cache=True, nogil=True)
def _settle_all(b: Books, bus: int, s: int, final: bool, out: Decided) -> None:
    """Close the books of the drives on one bus, and give out what all drives have settled."""
    n = b.settled.shape[1]
    oldest, all_owe = b.head[bus, s], n > 1
    for j in range(n):
        oldest = min(oldest, b.settled[s, j])
        all_owe = all_owe and b.settled[s, j] + b.pending[s, j] < b.head[b.bus_of[j], s]
    if all_owe and oldest >= b.hole[s]:
        b.behind[s] = b.head[bus, s]
    end = b.top[s]
    for j in range(n):
        if b.bus_of[j] == bus:
            _settle(b, s, j, final)
        end = min(end, b.settled[s, j])
    _emit(b, s, end, out)


@njit(cache=True, nogil=True)
def _owe(b: Books, bus: int, k: int, s: int) -> None:
    """SYNC ``k`` of a bus asks for an answer, if the stream sends on it."""
    if (b.state[bus, ORIGIN] + k) % b.every[s]:
        return
    slot = _slot(b, s, b.head[bus, s])
    if b.head[bus, s] == b.top[s]:
        b.top[s] += 1
        b.row_sync[s, slot] = k
        b.row_t[s, slot] = UNSEEN
        b.row_code[s, slot] = LOST
    for i in range(b.pack[s]):
        b.row_t[s, slot, i, bus] = b.recent[bus, (k - b.pack[s] + 1 + i) % RECENT]
    b.head[bus, s] += 1


@njit(cache=True, nogil=True)
def _miss(b: Books, bus: int, first: int, until: int, out: Decided) -> None:
    """SYNCs ``first`` to before ``until`` were sent on the bus, but not received."""
    if until <= first:
        return
    streams = b.every.size
    before = b.head[bus].copy()
    for s in range(streams):
        b.hole[s] = max(b.hole[s], b.head[bus, s] + (until - first) // b.every[s] + 1)
        if (until - first) // b.every[s] > b.window[s] // 2:
            _settle_all(b, bus, s, False, out)
    for k in range(first, until):
        b.recent[bus, k % RECENT] = UNSEEN
        for s in range(streams):
            _owe(b, bus, k, s)
            if (until - first) // b.every[s] > b.window[s] // 2:
                _settle_all(b, bus, s, False, out)
    for s in range(streams):
        if (until - first) // b.every[s] > b.window[s] // 2 or b.head[bus, s] == before[s]:
            continue
        # What came since the last SYNC seen may answer the missed ones too.
        for j in range(b.settled.shape[1]):
            if b.bus_of[j] == bus:
                for i in range(b.pending[s, j] - b.fresh[s, j], b.pending[s, j]):
                    b.label[s, j, i] = b.head[bus, s] - 1


@njit(cache=True, nogil=True)
def _skip_silent(b: Books, bus: int, k: int, t_ns: int, period_ns: int, overflow: int, out: Decided) -> None:
    """With SYNC ``k`` of a bus, those are missing that buses farther behind than their slack should have had."""
    for other in range(b.state.shape[0]):
        last = b.state[other, SYNC]
        until = k + 1 - b.slack[other]
        if other == bus or until <= last + 1:
            continue
        if last < 0:
            b.state[other, ORIGIN] = b.state[bus, ORIGIN]
        # What has come answers SYNCs that were seen, not those that are missing.
        for s in range(b.every.size):
            _settle_all(b, other, s, True, out)
        _miss(b, other, last + 1, until, out)
        b.counts[SYNC_MISSING] += until - last - 1
        b.state[other, SYNC] = until - 1
        b.state[other, BORROWED] = 1
        b.state[other, TIME] = t_ns - (k + 1 - until) * period_ns
        if b.state[bus, COUNTER] >= 0:
            b.state[other, COUNTER] = (b.state[other, ORIGIN] + until - 1) % overflow
        for s in range(b.every.size):
            _settle_all(b, other, s, True, out)


@njit(cache=True, nogil=True)
def count_sync(
    count: int, can_id: Any, length: Any, t_ns: Any, data: Any, sync_id: int, period_ns: int, overflow: int,
    bus: int, longest: int, b: Books,
) -> int:  # fmt: skip
    """How many SYNC numbers the frames may cover; changes nothing."""
    total, state = 0, b.state.copy()
    for i in range(count):
        if can_id[i] == sync_id:
            counter = int(np.int64(data[i, 0] & np.uint64(0xFF))) if length[i] > 0 else -1
            total += max(0, _advance(state, bus, counter, t_ns[i], period_ns, overflow, longest))
    return int(total)


@njit(cache=True, nogil=True)
def match(
    count: int, can_id: Any, length: Any, t_ns: Any, data: Any, sync_id: int, period_ns: int, overflow: int,
    bus: int, longest: int, b: Books, out: Decided,
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
            step = _advance(b.state, bus, counter, t_ns[i], period_ns, overflow, longest)
            if step <= 0:
                unlike = last < 0 and step < 0
                b.counts[SYNC_MISALIGNED if unlike else SYNC_REPEATED] += 1
                continue
            k = last + step
            _miss(b, bus, last + 1, k, out)
            b.recent[bus, k % RECENT] = t_ns[i]
            for s in range(b.every.size):
                _settle_all(b, bus, s, False, out)
                _owe(b, bus, k, s)
            b.counts[SYNC_SEEN] += 1
            b.counts[SYNC_MISSING] += step - 1
            _skip_silent(b, bus, k, t_ns[i], period_ns, overflow, out)
            continue
        channel = b.channel_of[bus, identifier] if identifier < b.channel_of.shape[1] else np.int64(-1)
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
            right = length[i] == b.length[s]
            if not right:
                b.counts[TPDO_WRONG_LENGTH] += 1
                b.wrong[s, j] += 1
            for w in range(words):
                b.answer[s, j, slot, w] = data[i, w]
            b.answer_code[s, j, slot] = RECEIVED if right else WRONG_LENGTH
            b.label[s, j, slot] = b.head[bus, s] - 1
            b.pending[s, j] += 1
            b.fresh[s, j] += 1


@njit(cache=True, nogil=True)
def finish(total: int, b: Books, out: Decided) -> None:
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
        for s in range(b.every.size):
            _settle_all(b, bus, s, True, out)
