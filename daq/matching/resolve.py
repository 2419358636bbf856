"""Compiled decision about answers: certain, ambiguous or lost, and output of the decided rows."""

from typing import Any

import numpy as np
from numba import njit

from armident.daq.matching.state import (
    ALIGNED_SYNCS,
    AMBIGUOUS,
    BASE,
    BEHIND,
    BEST,
    BEST_AT,
    CALM,
    EMITTED,
    HELD,
    LENGTH,
    NEVER,
    NO_SYNC,
    PACED,
    PACK,
    PATIENCE,
    RECEIVED,
    SHORT,
    SIZE,
    STILL,
    STOOD,
    TOP,
    TPDO_DUPLICATE,
    TPDO_LATE,
    UNSURE,
    WINDOW,
    MatchedSamples,
    MatcherState,
)


@njit(cache=True, nogil=True)
def slot_of(b: MatcherState, s: int, u: int) -> int:
    """Return the ring slot of a row.

    Parameters
    ----------
    b
        State of the matcher.
    s
        Number of the stream.
    u
        Ordinal of the row.
    """
    return int((u - b.mark[s, BASE]) % b.row_sync.shape[1])


@njit(cache=True, nogil=True)
def _seen(b: MatcherState, s: int, j: int, u: int) -> bool:
    """Return whether the SYNC of row ``u`` was received on the bus of a joint."""
    return bool(b.row_t[s, slot_of(b, s, u), b.kind[s, PACK] - 1, b.bus_of[j]] != NEVER)


@njit(cache=True, nogil=True)
def _place(b: MatcherState, s: int, j: int, u: int, i: int) -> None:
    slot = slot_of(b, s, u)
    for w in range(b.answer.shape[3]):
        b.row_data[s, slot, j, w] = b.answer[s, j, i, w]
    b.row_code[s, slot, j] = b.answer_code[s, j, i] if u >= b.doubt[s, j] else AMBIGUOUS
    if b.label[s, j, i] > u and _seen(b, s, j, u):
        b.counts[TPDO_LATE] += 1


@njit(cache=True, nogil=True)
def _same(b: MatcherState, s: int, j: int, i: int, k: int) -> bool:
    """Return whether two answers of a drive have the same bytes."""
    same = b.answer_code[s, j, i] == b.answer_code[s, j, k]
    for w in range(-(-b.kind[s, LENGTH] // 8)):
        # Bytes behind the data of a short frame are undefined.
        unused = np.uint64(8 * max(0, 8 * w + 8 - b.kind[s, LENGTH]))
        same = same and ((b.answer[s, j, i, w] ^ b.answer[s, j, k, w]) << unused) == 0
    return bool(same)


@njit(cache=True, nogil=True)
def _without_repeats(b: MatcherState, s: int, j: int, owed: int) -> None:
    """Drop repeated frames if there are more answers than SYNCs; mark all as uncertain if they cannot be identified."""
    count = b.pending[s, j]
    b.counts[TPDO_DUPLICATE] += count - owed
    unlike = 0
    for i in range(count):
        if i == 0 or not _same(b, s, j, i, i - 1):
            unlike += 1
    if unlike != owed and unlike > 1:
        b.doubt[s, j] = max(b.doubt[s, j], b.settled[s, j] + owed)
    elif unlike == owed:
        kept = 0
        for i in range(count):
            if i == 0 or not _same(b, s, j, i, i - 1):
                b.label[s, j, kept] = b.label[s, j, i]
                b.answer_code[s, j, kept] = b.answer_code[s, j, i]
                for w in range(b.answer.shape[3]):
                    b.answer[s, j, kept, w] = b.answer[s, j, i, w]
                kept += 1
    b.pending[s, j] = owed


@njit(cache=True, nogil=True)
def _was_behind(b: MatcherState, s: int, j: int, rows: int) -> None:
    """Record that a drive had this number of outstanding answers."""
    if rows >= b.behind[s, j] or b.head[b.bus_of[j], s] - b.behind_at[s, j] > 2 * b.kind[s, WINDOW]:
        b.behind[s, j] = rows
        b.behind_at[s, j] = b.head[b.bus_of[j], s]


@njit(cache=True, nogil=True)
def _keep_pace(b: MatcherState, s: int, j: int) -> None:
    """Update the progress of a drive: its best balance of answers and rows, and for how many rows it has kept it."""
    head = b.head[b.bus_of[j], s]
    balance = b.pending[s, j] - (head - b.settled[s, j])
    best = b.pace[s, j, BEST]
    if balance > best or (balance < best and head - b.pace[s, j, BEST_AT] > b.kind[s, SHORT]):
        b.pace[s, j, BEST], b.pace[s, j, BEST_AT], b.pace[s, j, STOOD] = balance, head, 0
    if b.pace[s, j, PACED] == head:
        return
    b.pace[s, j, PACED] = head
    b.pace[s, j, STOOD] = b.pace[s, j, STOOD] + 1 if balance == b.pace[s, j, BEST] else 0
    b.pace[s, j, CALM] = b.pace[s, j, CALM] + 1 if balance == 0 and not b.pace[s, j, UNSURE] else 0


@njit(cache=True, nogil=True)
def _close(b: MatcherState, s: int, j: int, until: int, unsure: bool) -> None:
    """Settle the rows before ``until``; ``unsure``: answers to discarded rows may still arrive."""
    b.settled[s, j], b.pending[s, j] = until, 0
    b.pace[s, j, BEST], b.pace[s, j, STOOD], b.pace[s, j, UNSURE] = NEVER, 0, int(unsure)


@njit(cache=True, nogil=True)
def _drop_first(b: MatcherState, s: int, j: int, count: int) -> None:
    """Drop the first answers, which belong to discarded rows; with repeated frames, their number is uncertain."""
    for i in range(1, b.pending[s, j]):
        if _same(b, s, j, i, i - 1):
            b.doubt[s, j] = max(b.doubt[s, j], b.settled[s, j] + b.pending[s, j] - count)
    b.pending[s, j] -= count
    b.counts[TPDO_LATE] += count
    for i in range(b.pending[s, j]):
        b.label[s, j, i] = b.label[s, j, i + count]
        b.answer_code[s, j, i] = b.answer_code[s, j, i + count]
        for w in range(b.answer.shape[3]):
            b.answer[s, j, i, w] = b.answer[s, j, i + count, w]


@njit(cache=True, nogil=True)
def _may_repeat(b: MatcherState, s: int, j: int) -> bool:
    """Return whether late answers came together of which one may be a repetition; the next SYNC shows a surplus."""
    found = False
    for i in range(1, b.pending[s, j]):
        found = found or (b.label[s, j, i] == b.label[s, j, i - 1] and _same(b, s, j, i, i - 1))
    return found


@njit(cache=True, nogil=True)
def _not_behind(b: MatcherState, s: int, j: int) -> int:
    """Return the number of answers certainly sent in time; all if the drive is not known to have been behind."""
    count, prompt = b.pending[s, j], 0
    while prompt < count and not b.pace[s, j, UNSURE] and b.label[s, j, prompt] == b.settled[s, j] + prompt:
        prompt += 1
    behind = b.behind[s, j] > 0 and b.head[b.bus_of[j], s] - b.behind_at[s, j] <= 2 * b.kind[s, WINDOW]
    previous = b.settled[s, j] + prompt - 1
    for i in range(prompt, count):
        # Two answers at once, or so many consecutive rows missing that the drive has paused.
        behind = behind or b.label[s, j, i] == previous or b.label[s, j, i] - previous > STILL
        previous = b.label[s, j, i]
    return prompt if behind else count


@njit(cache=True, nogil=True)
def _settle(b: MatcherState, s: int, j: int, final: bool, witness: bool) -> None:
    """Decide the open rows of one TPDO of one drive: match certain answers, discard rows no longer answered."""
    bus = b.bus_of[j]
    head, unsure = b.head[bus, s], b.pace[s, j, UNSURE] != 0
    owed = head - b.settled[s, j]
    if b.pending[s, j] > owed and not unsure:
        _without_repeats(b, s, j, owed)
    b.fresh[s, j] = 0
    balance, stood = b.pending[s, j] - owed, b.pace[s, j, STOOD]
    # If answers to discarded rows may arrive, equal numbers prove nothing until the drive is in step.
    if (balance == 0 and not unsure) or (balance >= 0 and unsure and stood >= ALIGNED_SYNCS):
        if balance > 0:
            _drop_first(b, s, j, balance)
        elif not unsure and not final and b.pace[s, j, HELD] != head - 1 and _may_repeat(b, s, j):
            b.pace[s, j, HELD] = head
            return
        for i in range(owed):
            if b.label[s, j, i] > b.settled[s, j] + i and _seen(b, s, j, b.label[s, j, i]):
                _was_behind(b, s, j, owed)
            _place(b, s, j, b.settled[s, j] + i, i)
        if b.settled[s, j] < b.hole[bus, s]:
            _give_up_refilled(b, s, j, owed)
        _close(b, s, j, head, False)
        return
    count = b.pending[s, j]
    last = b.label[s, j, count - 1] + 1 if count else b.settled[s, j]
    # The drive answers every SYNC but does not catch up, while others lack no answer: its missing answers are lost.
    in_step = balance < 0 and stood >= ALIGNED_SYNCS and head - b.pace[s, j, BEST_AT] >= b.kind[s, SHORT]
    in_step = in_step and (witness or b.settled[s, j] < b.hole[bus, s])
    silent = witness and head - last > 2 * b.kind[s, SHORT]
    late = owed > b.kind[s, WINDOW] and head - b.mark[s, BEHIND] > b.kind[s, WINDOW]
    if not (late or owed > b.kind[s, PATIENCE] or final or in_step or silent):
        return
    if balance > 0:
        _drop_first(b, s, j, balance)
        count -= balance
    keep = head if final else head - b.kind[s, WINDOW]
    if silent:
        keep = max(keep, head - 2 * b.kind[s, SHORT])
    keep = max(keep, b.settled[s, j])
    u, twice, answered = head, False, b.settled[s, j]
    ends = (final or silent) and not in_step
    caught_up = _not_behind(b, s, j)
    for i in range(count - 1, -1, -1):
        after, u = u, min(b.label[s, j, i], u - 1)
        answered = max(answered, u + 1)
        _place(b, s, j, u, i)
        # A drive that was behind before it fell silent: its last answers may be late, or earlier ones lost.
        for v in range(u + 1, after):
            ends = ends or not _seen(b, s, j, v)
        if ends and i >= caught_up:
            b.row_code[s, slot_of(b, s, u), j] = AMBIGUOUS
        # A repeated frame looks like two late answers, which shifts the ones before.
        twice = u < b.label[s, j, i] and (
            twice or (b.label[s, j, i] == b.label[s, j, i + 1] and _same(b, s, j, i, i + 1))
        )
        if twice:
            b.row_code[s, slot_of(b, s, u), j] = AMBIGUOUS
    _give_up_doubtful(b, s, j, count)
    # A drive answers in order: no answer to an earlier row can follow.
    _close(b, s, j, max(keep, answered), keep > answered or (unsure and not in_step))


@njit(cache=True, nogil=True)
def _give_up_refilled(b: MatcherState, s: int, j: int, count: int) -> None:
    """Discard answers as ambiguous where frames were missing recently: one may be lost and a later one repeated."""
    repeated, unlike = -1, False
    for i in range(1, count):
        if b.label[s, j, i] == b.label[s, j, i - 1] and _same(b, s, j, i, i - 1):
            repeated = i
    for i in range(1, repeated + 1):
        unlike = unlike or not _same(b, s, j, i, i - 1)
    for i in range(repeated + 1 if unlike else 0):
        b.row_code[s, slot_of(b, s, b.settled[s, j] + i), j] = AMBIGUOUS


@njit(cache=True, nogil=True)
def _give_up_doubtful(b: MatcherState, s: int, j: int, count: int) -> None:
    """Discard answers that were taken as prompt but may be late, where one was lost."""
    # Answers in a burst after a pause: with one of them lost, their SYNCs are ambiguous.
    previous = b.settled[s, j] - 1
    for i in range(count):
        label = b.label[s, j, i]
        if i + 1 < count and b.label[s, j, i + 1] == label:
            if _seen(b, s, j, label):
                _was_behind(b, s, j, label - previous)
            for v in range(previous + 1, label + 1):
                b.row_code[s, slot_of(b, s, v), j] = AMBIGUOUS
        else:
            previous = label
    # A drive that was behind recently may have been behind when an answer was lost: later answers are then late.
    if b.head[b.bus_of[j], s] - b.behind_at[s, j] > 2 * b.kind[s, WINDOW]:
        b.behind[s, j] = 0
    previous = b.settled[s, j] - 1
    for i in range(count):
        label = b.label[s, j, i]
        if i + 1 < count and b.label[s, j, i + 1] == label:
            # After a burst the drive has caught up.
            b.doubt[s, j] = min(b.doubt[s, j], label + 1)
        elif b.behind[s, j] > 1 and label > previous + 1:
            b.doubt[s, j] = max(b.doubt[s, j], label + b.behind[s, j] - 1)
        for v in range(max(previous + 1, b.settled[s, j]), min(label + 1, b.doubt[s, j])):
            if b.row_code[s, slot_of(b, s, v), j] == RECEIVED:
                b.row_code[s, slot_of(b, s, v), j] = AMBIGUOUS
        previous = label


@njit(cache=True, nogil=True)
def _sample(b: MatcherState, s: int, slot: int, j: int, i: int, word: int) -> Any:
    """Return eight bytes of sample ``i`` of a packed answer."""
    value = np.uint64(0)
    for octet in range(8 * word, min(b.kind[s, SIZE], 8 * word + 8)):
        at = i * b.kind[s, SIZE] + octet
        taken = (b.row_data[s, slot, j, at >> 3] >> np.uint64(8 * (at & 7))) & np.uint64(0xFF)
        value |= taken << np.uint64(8 * (octet & 7))
    return value


@njit(cache=True, nogil=True)
def _emit(b: MatcherState, s: int, end: int, out: MatchedSamples) -> None:
    """Output the rows before ``end``; a packed row is several samples."""
    pack, buses = b.kind[s, PACK], b.state.shape[0]
    words = -(-b.kind[s, SIZE] // 8)
    while b.mark[s, EMITTED] < end:
        slot = slot_of(b, s, b.mark[s, EMITTED])
        for i in range(pack):
            k = b.row_sync[s, slot] - pack + 1 + i
            if k < 0:
                continue
            o = out.rows[s]
            out.sync[s, o] = k
            out.t_ns[s, o] = NEVER
            for bus in range(buses - 1, -1, -1):
                if b.row_t[s, slot, i, bus] != NEVER:
                    out.t_ns[s, o] = b.row_t[s, slot, i, bus]
            for j in range(b.settled.shape[1]):
                seen = b.row_t[s, slot, i, b.bus_of[j]] != NEVER
                out.code[s, o, j] = b.row_code[s, slot, j] if seen else NO_SYNC
                for w in range(words):
                    out.data[s, o, j, w] = b.row_data[s, slot, j, w] if pack == 1 else _sample(b, s, slot, j, i, w)
            out.rows[s] += 1
        b.mark[s, EMITTED] += 1
    if b.mark[s, EMITTED] == b.mark[s, TOP]:
        b.mark[s, BASE] = b.mark[s, TOP]


@njit(cache=True, nogil=True)
def settle_all(b: MatcherState, bus: int, s: int, final: bool, out: MatchedSamples) -> None:
    """Decide the open rows of the drives on one bus, and output the rows that all drives have settled.

    Parameters
    ----------
    b
        State of the matcher.
    bus
        Number of the bus.
    s
        Number of the stream.
    final
        No more answers follow.
    out
        Output of decided samples.
    """
    n = b.settled.shape[1]
    head = b.head[bus, s]
    slot = (head - 1 - b.mark[s, BASE]) % b.row_sync.shape[1]
    all_owe, whole = n > 1, True
    here = calm_here = calm = 0
    for j in range(n):
        if b.bus_of[j] == bus:
            here += 1
            # Common case, one answer to one SYNC, inline: passing the state to a function costs more than all of it.
            if (
                b.pending[s, j] == 1
                and b.settled[s, j] == head - 1
                and not b.pace[s, j, UNSURE]
                and head > b.hole[bus, s]
            ):
                for w in range(b.answer.shape[3]):
                    b.row_data[s, slot, j, w] = b.answer[s, j, 0, w]
                b.row_code[s, slot, j] = b.answer_code[s, j, 0] if head > b.doubt[s, j] else AMBIGUOUS
                b.settled[s, j], b.pending[s, j], b.fresh[s, j] = head, 0, 0
                b.pace[s, j, BEST], b.pace[s, j, STOOD] = NEVER, 0
                if b.pace[s, j, PACED] != head:
                    b.pace[s, j, PACED] = head
                    b.pace[s, j, CALM] += 1
            else:
                _keep_pace(b, s, j)
        all_owe = all_owe and b.settled[s, j] + b.pending[s, j] < b.head[b.bus_of[j], s]
        whole = whole and b.settled[s, j] >= b.hole[b.bus_of[j], s]
        # Buses are read one after the other: only the state of another bus at this row counts.
        begun, ended = b.pace[s, j, PACED] - b.pace[s, j, CALM], b.pace[s, j, PACED]
        if begun <= head - ALIGNED_SYNCS and ended >= head - 1:
            calm += 1
            calm_here += b.bus_of[j] == bus
    if all_owe and whole:
        b.mark[s, BEHIND] = head
    end = b.mark[s, TOP]
    for j in range(n):
        if b.bus_of[j] == bus and (b.settled[s, j] < head or b.pending[s, j]):
            # A drive without outstanding answers shows that neither the host nor the bus is delayed.
            _settle(b, s, j, final, calm_here > 0 if here > 1 else calm > 0)
        end = min(end, b.settled[s, j])
    if end > b.mark[s, EMITTED]:
        _emit(b, s, end, out)
