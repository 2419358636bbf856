"""The compiled part that closes the books: which answers are certain, which given up, and the samples given out."""

from typing import Any

import numpy as np
from numba import njit

from daq.books import (
    AMBIGUOUS,
    BASE,
    BEHIND,
    EMITTED,
    HOLE,
    NO_SYNC,
    PACK,
    PATIENCE,
    SIZE,
    TOP,
    TPDO_DUPLICATE,
    TPDO_LATE,
    UNSEEN,
    WINDOW,
    Books,
    Decided,
)


@njit(cache=True, nogil=True)
def slot_of(b: Books, s: int, u: int) -> int:
    """Where row ``u`` stands in the ring of its stream."""
    return int((u - b.mark[s, BASE]) % b.row_sync.shape[1])


@njit(cache=True, nogil=True)
def _place(b: Books, s: int, j: int, u: int, i: int) -> None:
    slot = slot_of(b, s, u)
    for w in range(b.answer.shape[3]):
        b.row_data[s, slot, j, w] = b.answer[s, j, i, w]
    b.row_code[s, slot, j] = b.answer_code[s, j, i]
    if b.label[s, j, i] > u and b.row_t[s, slot, b.kind[s, PACK] - 1, b.bus_of[j]] != UNSEEN:
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
    late = owed > b.kind[s, WINDOW] and head - b.mark[s, BEHIND] > b.kind[s, WINDOW]
    if not (late or owed > b.kind[s, PATIENCE] or final):
        return
    keep = head if final else head - b.kind[s, WINDOW]
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
                b.row_code[s, slot_of(b, s, v), j] = AMBIGUOUS
        else:
            previous = label
    b.pending[s, j] = 0
    b.settled[s, j] = keep


@njit(cache=True, nogil=True)
def _sample(b: Books, s: int, slot: int, j: int, i: int, word: int) -> Any:
    """Eight bytes of sample ``i`` of a packed answer."""
    value = np.uint64(0)
    for octet in range(8 * word, min(b.kind[s, SIZE], 8 * word + 8)):
        at = i * b.kind[s, SIZE] + octet
        taken = (b.row_data[s, slot, j, at >> 3] >> np.uint64(8 * (at & 7))) & np.uint64(0xFF)
        value |= taken << np.uint64(8 * (octet & 7))
    return value


@njit(cache=True, nogil=True)
def _emit(b: Books, s: int, end: int, out: Decided) -> None:
    """Give out the rows before ``end``; a packed one is as many samples."""
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
        b.mark[s, EMITTED] += 1
    if b.mark[s, EMITTED] == b.mark[s, TOP]:
        b.mark[s, BASE] = b.mark[s, TOP]


@njit(cache=True, nogil=True)
def settle_all(b: Books, bus: int, s: int, final: bool, out: Decided) -> None:
    """Close the books of the drives on one bus, and give out what all drives have settled."""
    n = b.settled.shape[1]
    oldest, all_owe = b.head[bus, s], n > 1
    for j in range(n):
        oldest = min(oldest, b.settled[s, j])
        all_owe = all_owe and b.settled[s, j] + b.pending[s, j] < b.head[b.bus_of[j], s]
    if all_owe and oldest >= b.mark[s, HOLE]:
        b.mark[s, BEHIND] = b.head[bus, s]
    end = b.mark[s, TOP]
    for j in range(n):
        if b.bus_of[j] == bus:
            _settle(b, s, j, final)
        end = min(end, b.settled[s, j])
    if end > b.mark[s, EMITTED]:
        _emit(b, s, end, out)
