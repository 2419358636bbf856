"""Compiled decision about answers: certain, ambiguous or lost, and output of the decided rows."""

from typing import Any

import numpy as np

from armident.compiled import UNCOUNTED, compiled
from armident.daq.matching.state import (
    ALIGNED_SYNCS,
    ALL_BEHIND,
    AMBIGUOUS,
    BALANCE,
    BALANCE_AT,
    BALANCE_COUNT,
    BALANCE_LAST,
    BALANCE_RUN,
    BASE,
    CLEAR_FROM,
    COUNTED_AT,
    EMITTED,
    HELD_AT,
    IN_STEP_RUN,
    LAG,
    LAG_AT,
    LENGTH,
    LONG_WINDOW,
    LONGEST_LOSS,
    NEVER,
    NO_SYNC,
    OPEN,
    PACK,
    PENDING,
    RECEIVED,
    SETTLED,
    SHORT_WINDOW,
    SINCE_SYNC,
    SIZE,
    STALE,
    TOP,
    TPDO_DUPLICATE,
    TPDO_LATE,
    WINDOW,
    MatchedSamples,
    MatcherState,
)


@compiled(**UNCOUNTED)
def slot_of(m: MatcherState, s: int, u: int) -> int:
    """Return the ring slot of a row. ``s``: number of the stream; ``u``: ordinal of the row."""
    return int((u - m.watermark[s, BASE]) % m.row_sync.shape[1])


@compiled(**UNCOUNTED)
def _is_received(m: MatcherState, s: int, j: int, u: int) -> bool:
    """Return True if the SYNC of row ``u`` was received on the bus of a joint."""
    return bool(m.row_t[s, slot_of(m, s, u), m.config[s, PACK] - 1, m.bus_of[j]] != NEVER)


@compiled(**UNCOUNTED)
def _assign(m: MatcherState, s: int, j: int, u: int, i: int) -> None:
    """Assign answer ``i`` of a drive to row ``u``."""
    slot = slot_of(m, s, u)
    for w in range(m.answer.shape[3]):
        m.row_data[s, slot, j, w] = m.answer[s, j, i, w]
    m.row_code[s, slot, j] = m.answer_code[s, j, i] if u >= m.drives[s, j, CLEAR_FROM] else AMBIGUOUS
    if m.newest_row[s, j, i] > u and _is_received(m, s, j, u):
        m.counts[TPDO_LATE] += 1


@compiled(**UNCOUNTED)
def _are_equal(m: MatcherState, s: int, j: int, i: int, k: int) -> bool:
    """Return True if two answers of a drive have the same bytes."""
    same = m.answer_code[s, j, i] == m.answer_code[s, j, k]
    for w in range(-(-m.config[s, LENGTH] // 8)):
        # Bytes behind the data of a short frame are undefined.
        unused = np.uint64(8 * max(0, 8 * w + 8 - m.config[s, LENGTH]))
        same = same and ((m.answer[s, j, i, w] ^ m.answer[s, j, k, w]) << unused) == 0
    return bool(same)


@compiled(**UNCOUNTED)
def _drop_repetitions(m: MatcherState, s: int, j: int, outstanding: int) -> None:
    """Drop repeated frames if there are more answers than SYNCs; mark all as ambiguous if they cannot be identified."""
    count = m.drives[s, j, PENDING]
    m.counts[TPDO_DUPLICATE] += count - outstanding
    distinct = 0
    for i in range(count):
        if i == 0 or not _are_equal(m, s, j, i, i - 1):
            distinct += 1
    if distinct != outstanding and distinct > 1:
        m.drives[s, j, CLEAR_FROM] = max(m.drives[s, j, CLEAR_FROM], m.drives[s, j, SETTLED] + outstanding)
    elif distinct == outstanding:
        kept = 0
        for i in range(count):
            if i == 0 or not _are_equal(m, s, j, i, i - 1):
                m.newest_row[s, j, kept] = m.newest_row[s, j, i]
                m.answer_code[s, j, kept] = m.answer_code[s, j, i]
                for w in range(m.answer.shape[3]):
                    m.answer[s, j, kept, w] = m.answer[s, j, i, w]
                kept += 1
    m.drives[s, j, PENDING] = outstanding


@compiled(**UNCOUNTED)
def _record_lag(m: MatcherState, s: int, j: int, rows: int) -> None:
    """Record that a drive had this number of outstanding answers."""
    if rows >= m.drives[s, j, LAG] or m.head[m.bus_of[j], s] - m.drives[s, j, LAG_AT] > 2 * m.config[s, WINDOW]:
        m.drives[s, j, LAG] = rows
        m.drives[s, j, LAG_AT] = m.head[m.bus_of[j], s]


@compiled(**UNCOUNTED)
def _update_progress(m: MatcherState, s: int, j: int) -> None:
    """Update the progress of a drive: its best balance of answers and rows, and for how many rows it has kept it."""
    head = m.head[m.bus_of[j], s]
    balance = m.drives[s, j, PENDING] - (head - m.drives[s, j, SETTLED])
    best = m.drives[s, j, BALANCE]
    if balance > best or (balance < best and head - m.drives[s, j, BALANCE_LAST] > m.config[s, SHORT_WINDOW]):
        m.drives[s, j, BALANCE], m.drives[s, j, BALANCE_AT] = balance, head
        m.drives[s, j, BALANCE_RUN], m.drives[s, j, BALANCE_COUNT] = 0, 0
    if m.drives[s, j, COUNTED_AT] == head:
        return
    m.drives[s, j, COUNTED_AT] = head
    at_best = balance == m.drives[s, j, BALANCE]
    if at_best:
        m.drives[s, j, BALANCE_LAST] = head
    m.drives[s, j, BALANCE_RUN] = m.drives[s, j, BALANCE_RUN] + 1 if at_best else 0
    m.drives[s, j, BALANCE_COUNT] += at_best
    m.drives[s, j, IN_STEP_RUN] = m.drives[s, j, IN_STEP_RUN] + 1 if balance == 0 and not m.drives[s, j, STALE] else 0


@compiled(**UNCOUNTED)
def _is_aligned(m: MatcherState, s: int, j: int, head: int) -> bool:
    """Return True if the surplus is that of answers to discarded rows, the largest one: drives never answer early."""
    if m.drives[s, j, BALANCE_RUN] >= ALIGNED_SYNCS:
        return True
    lasting = head - m.drives[s, j, BALANCE_AT] >= m.config[s, SHORT_WINDOW] // 2
    return bool(lasting and m.drives[s, j, BALANCE_RUN] > 0 and m.drives[s, j, BALANCE_COUNT] >= ALIGNED_SYNCS)


@compiled(**UNCOUNTED)
def _close_rows(m: MatcherState, s: int, j: int, until: int, stale: bool) -> None:
    """Settle the rows before ``until``; ``stale``: answers to discarded rows may still arrive."""
    m.drives[s, j, SETTLED], m.drives[s, j, PENDING] = until, 0
    m.drives[s, j, BALANCE], m.drives[s, j, BALANCE_RUN], m.drives[s, j, STALE] = NEVER, 0, int(stale)


@compiled(**UNCOUNTED)
def _drop_stale(m: MatcherState, s: int, j: int, count: int) -> None:
    """Drop the first answers, which belong to discarded rows; with repeated frames, their number is ambiguous."""
    for i in range(1, m.drives[s, j, PENDING]):
        if _are_equal(m, s, j, i, i - 1):
            m.drives[s, j, CLEAR_FROM] = max(
                m.drives[s, j, CLEAR_FROM], m.drives[s, j, SETTLED] + m.drives[s, j, PENDING] - count
            )
    m.drives[s, j, PENDING] -= count
    m.counts[TPDO_LATE] += count
    for i in range(m.drives[s, j, PENDING]):
        m.newest_row[s, j, i] = m.newest_row[s, j, i + count]
        m.answer_code[s, j, i] = m.answer_code[s, j, i + count]
        for w in range(m.answer.shape[3]):
            m.answer[s, j, i, w] = m.answer[s, j, i + count, w]


@compiled(**UNCOUNTED)
def _may_hold_repetition(m: MatcherState, s: int, j: int) -> bool:
    """Return True if one of the late answers may be a repetition; the next SYNC then shows a surplus."""
    found = False
    for i in range(1, m.drives[s, j, PENDING]):
        found = found or (m.newest_row[s, j, i] == m.newest_row[s, j, i - 1] and _are_equal(m, s, j, i, i - 1))
    return found


@compiled(**UNCOUNTED)
def _count_prompt(m: MatcherState, s: int, j: int) -> int:
    """Return the number of answers certainly sent in time; all if no recent lag of the drive is known."""
    count, prompt = m.drives[s, j, PENDING], 0
    while (
        prompt < count and not m.drives[s, j, STALE] and m.newest_row[s, j, prompt] == m.drives[s, j, SETTLED] + prompt
    ):
        prompt += 1
    lags = m.drives[s, j, LAG] > 0 and m.head[m.bus_of[j], s] - m.drives[s, j, LAG_AT] <= 2 * m.config[s, WINDOW]
    previous = m.drives[s, j, SETTLED] + prompt - 1
    for i in range(prompt, count):
        # Two answers at once, or so many consecutive rows missing that the drive has paused.
        lags = lags or m.newest_row[s, j, i] == previous or m.newest_row[s, j, i] - previous > LONGEST_LOSS
        previous = m.newest_row[s, j, i]
    return prompt if lags else count


@compiled(**UNCOUNTED)
def _settle(m: MatcherState, s: int, j: int, final: bool, peer_in_step: bool) -> None:
    """Decide the open rows of one TPDO of one drive: match certain answers, discard rows no longer answered."""
    bus = m.bus_of[j]
    head, stale = m.head[bus, s], m.drives[s, j, STALE] != 0
    outstanding = head - m.drives[s, j, SETTLED]
    if m.drives[s, j, PENDING] > outstanding and not stale:
        _drop_repetitions(m, s, j, outstanding)
    m.drives[s, j, SINCE_SYNC] = 0
    balance, balance_run = m.drives[s, j, PENDING] - outstanding, m.drives[s, j, BALANCE_RUN]
    # If answers to discarded rows may arrive, equal numbers prove nothing until the drive is in step.
    if (balance == 0 and not stale) or (balance >= 0 and stale and _is_aligned(m, s, j, head)):
        if balance > 0:
            _drop_stale(m, s, j, balance)
        elif not stale and not final and m.drives[s, j, HELD_AT] != head - 1 and _may_hold_repetition(m, s, j):
            m.drives[s, j, HELD_AT] = head
            return
        for i in range(outstanding):
            if m.newest_row[s, j, i] > m.drives[s, j, SETTLED] + i and _is_received(m, s, j, m.newest_row[s, j, i]):
                _record_lag(m, s, j, outstanding)
            _assign(m, s, j, m.drives[s, j, SETTLED] + i, i)
        if m.drives[s, j, SETTLED] < m.gap_end[bus, s]:
            _discard_near_gap(m, s, j, outstanding)
        _close_rows(m, s, j, head, OPEN)
        return
    count = m.drives[s, j, PENDING]
    last = m.newest_row[s, j, count - 1] + 1 if count else m.drives[s, j, SETTLED]
    # The drive answers every SYNC but does not catch up, while others lack no answer: its missing answers are lost.
    in_step = (
        balance < 0 and balance_run >= ALIGNED_SYNCS and head - m.drives[s, j, BALANCE_AT] >= m.config[s, SHORT_WINDOW]
    )
    in_step = in_step and (peer_in_step or m.drives[s, j, SETTLED] < m.gap_end[bus, s])
    silent = peer_in_step and head - last > 2 * m.config[s, SHORT_WINDOW]
    late = outstanding > m.config[s, WINDOW] and head - m.watermark[s, ALL_BEHIND] > m.config[s, WINDOW]
    if not (late or outstanding > m.config[s, LONG_WINDOW] or final or in_step or silent):
        return
    if balance > 0:
        _drop_stale(m, s, j, balance)
        count -= balance
    keep = head if final else head - m.config[s, WINDOW]
    if silent:
        keep = max(keep, head - 2 * m.config[s, SHORT_WINDOW])
    keep = max(keep, m.drives[s, j, SETTLED])
    u, repeated, answered = head, False, m.drives[s, j, SETTLED]
    ending = (final or silent) and not in_step
    first_late = _count_prompt(m, s, j)
    for i in range(count - 1, -1, -1):
        after, u = u, min(m.newest_row[s, j, i], u - 1)
        answered = max(answered, u + 1)
        _assign(m, s, j, u, i)
        # A drive that lagged before it fell silent: its last answers may be late, or earlier ones lost.
        for v in range(u + 1, after):
            ending = ending or not _is_received(m, s, j, v)
        if ending and i >= first_late:
            m.row_code[s, slot_of(m, s, u), j] = AMBIGUOUS
        # A repeated frame looks like two late answers, which shifts the ones before.
        repeated = u < m.newest_row[s, j, i] and (
            repeated or (m.newest_row[s, j, i] == m.newest_row[s, j, i + 1] and _are_equal(m, s, j, i, i + 1))
        )
        if repeated:
            m.row_code[s, slot_of(m, s, u), j] = AMBIGUOUS
    _discard_ambiguous(m, s, j, count)
    # A drive answers in order: no answer to an earlier row can follow.
    _close_rows(m, s, j, max(keep, answered), keep > answered or (stale and not in_step))


@compiled(**UNCOUNTED)
def _discard_near_gap(m: MatcherState, s: int, j: int, count: int) -> None:
    """Discard answers as ambiguous where frames were missing recently: one may be lost and a later one repeated."""
    repeated, differ = -1, False
    for i in range(1, count):
        if m.newest_row[s, j, i] == m.newest_row[s, j, i - 1] and _are_equal(m, s, j, i, i - 1):
            repeated = i
    for i in range(1, repeated + 1):
        differ = differ or not _are_equal(m, s, j, i, i - 1)
    for i in range(repeated + 1 if differ else 0):
        m.row_code[s, slot_of(m, s, m.drives[s, j, SETTLED] + i), j] = AMBIGUOUS


@compiled(**UNCOUNTED)
def _discard_ambiguous(m: MatcherState, s: int, j: int, count: int) -> None:
    """Discard answers that were taken as prompt but may be late, where one was lost."""
    # Answers in a burst after a pause: with one of them lost, their SYNCs are ambiguous.
    previous = m.drives[s, j, SETTLED] - 1
    for i in range(count):
        newest = m.newest_row[s, j, i]
        if i + 1 < count and m.newest_row[s, j, i + 1] == newest:
            if _is_received(m, s, j, newest):
                _record_lag(m, s, j, newest - previous)
            for v in range(previous + 1, newest + 1):
                m.row_code[s, slot_of(m, s, v), j] = AMBIGUOUS
        else:
            previous = newest
    # A drive that lagged recently may have lagged when an answer was lost: later answers are then late.
    if m.head[m.bus_of[j], s] - m.drives[s, j, LAG_AT] > 2 * m.config[s, WINDOW]:
        m.drives[s, j, LAG] = 0
    previous = m.drives[s, j, SETTLED] - 1
    for i in range(count):
        newest = m.newest_row[s, j, i]
        if i + 1 < count and m.newest_row[s, j, i + 1] == newest:
            # After a burst the drive has caught up.
            m.drives[s, j, CLEAR_FROM] = min(m.drives[s, j, CLEAR_FROM], newest + 1)
        elif m.drives[s, j, LAG] > 1 and newest > previous + 1:
            m.drives[s, j, CLEAR_FROM] = max(m.drives[s, j, CLEAR_FROM], newest + m.drives[s, j, LAG] - 1)
        for v in range(max(previous + 1, m.drives[s, j, SETTLED]), min(newest + 1, m.drives[s, j, CLEAR_FROM])):
            if m.row_code[s, slot_of(m, s, v), j] == RECEIVED:
                m.row_code[s, slot_of(m, s, v), j] = AMBIGUOUS
        previous = newest


@compiled(**UNCOUNTED)
def _sample(m: MatcherState, s: int, slot: int, j: int, i: int, word: int) -> Any:
    """Return eight bytes of sample ``i`` of a packed answer."""
    value = np.uint64(0)
    for octet in range(8 * word, min(m.config[s, SIZE], 8 * word + 8)):
        at = i * m.config[s, SIZE] + octet
        taken = (m.row_data[s, slot, j, at >> 3] >> np.uint64(8 * (at & 7))) & np.uint64(0xFF)
        value |= taken << np.uint64(8 * (octet & 7))
    return value


@compiled(**UNCOUNTED)
def _emit(m: MatcherState, s: int, end: int, out: MatchedSamples) -> None:
    """Output the rows before ``end``; a packed row is several samples."""
    pack, buses = m.config[s, PACK], m.bus_state.shape[0]
    words = -(-m.config[s, SIZE] // 8)
    while m.watermark[s, EMITTED] < end:
        slot = slot_of(m, s, m.watermark[s, EMITTED])
        for i in range(pack):
            k = m.row_sync[s, slot] - pack + 1 + i
            if k < 0:
                continue
            o = out.rows[s]
            out.sync[s, o] = k
            out.t_ns[s, o] = NEVER
            for bus in range(buses - 1, -1, -1):
                if m.row_t[s, slot, i, bus] != NEVER:
                    out.t_ns[s, o] = m.row_t[s, slot, i, bus]
            for j in range(m.drives.shape[1]):
                seen = m.row_t[s, slot, i, m.bus_of[j]] != NEVER
                out.code[s, o, j] = m.row_code[s, slot, j] if seen else NO_SYNC
                for w in range(words):
                    out.data[s, o, j, w] = m.row_data[s, slot, j, w] if pack == 1 else _sample(m, s, slot, j, i, w)
            out.rows[s] += 1
        m.watermark[s, EMITTED] += 1
    if m.watermark[s, EMITTED] == m.watermark[s, TOP]:
        m.watermark[s, BASE] = m.watermark[s, TOP]


@compiled(**UNCOUNTED)
def settle_all(m: MatcherState, bus: int, s: int, final: bool, out: MatchedSamples) -> None:
    """Decide the open rows of a bus's drives in stream ``s``, and output the settled; ``final``: no answers follow."""
    n = m.drives.shape[1]
    head = m.head[bus, s]
    slot = (head - 1 - m.watermark[s, BASE]) % m.row_sync.shape[1]
    all_behind, complete = n > 1, True
    here = in_step_here = in_step = 0
    for j in range(n):
        if m.bus_of[j] == bus:
            here += 1
            # Common case, one answer to one SYNC, inline: passing the state to a function costs more than all of it.
            if (
                m.drives[s, j, PENDING] == 1
                and m.drives[s, j, SETTLED] == head - 1
                and not m.drives[s, j, STALE]
                and head > m.gap_end[bus, s]
            ):
                for w in range(m.answer.shape[3]):
                    m.row_data[s, slot, j, w] = m.answer[s, j, 0, w]
                m.row_code[s, slot, j] = m.answer_code[s, j, 0] if head > m.drives[s, j, CLEAR_FROM] else AMBIGUOUS
                m.drives[s, j, SETTLED], m.drives[s, j, PENDING], m.drives[s, j, SINCE_SYNC] = head, 0, 0
                m.drives[s, j, BALANCE], m.drives[s, j, BALANCE_RUN] = NEVER, 0
                if m.drives[s, j, COUNTED_AT] != head:
                    m.drives[s, j, COUNTED_AT] = head
                    m.drives[s, j, IN_STEP_RUN] += 1
            else:
                _update_progress(m, s, j)
        all_behind = all_behind and m.drives[s, j, SETTLED] + m.drives[s, j, PENDING] < m.head[m.bus_of[j], s]
        complete = complete and m.drives[s, j, SETTLED] >= m.gap_end[m.bus_of[j], s]
        # Buses are read one after the other: only the state of another bus at this row counts.
        run_start, run_end = m.drives[s, j, COUNTED_AT] - m.drives[s, j, IN_STEP_RUN], m.drives[s, j, COUNTED_AT]
        if run_start <= head - ALIGNED_SYNCS and run_end >= head - 1:
            in_step += 1
            in_step_here += m.bus_of[j] == bus
    if all_behind and complete:
        m.watermark[s, ALL_BEHIND] = head
    end = m.watermark[s, TOP]
    for j in range(n):
        if m.bus_of[j] == bus and (m.drives[s, j, SETTLED] < head or m.drives[s, j, PENDING]):
            # A drive without outstanding answers shows that neither the host nor the bus is delayed.
            _settle(m, s, j, final, in_step_here > 0 if here > 1 else in_step > 0)
        end = min(end, m.drives[s, j, SETTLED])
    if end > m.watermark[s, EMITTED]:
        _emit(m, s, end, out)
