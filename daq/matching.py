"""The compiled part of the assembler: which TPDO answers which SYNC.

A TPDO carries no number, only an order: each drive answers its SYNCs one after the other. So per drive and TPDO,
SYNCs and answers are matched first to first. As long as a drive owes nothing when the books are closed (at the next
SYNC) the match is certain, however late the answers came. A drive that owes while another has answered, for longer
than a window of SYNCs, has lost something; then every answer is taken as prompt (the latest SYNC it can belong to),
and where answers also came in bursts the matter is undecidable and the samples in question are given up as
``AMBIGUOUS``, never guessed. While all drives owe at every SYNC and no frame is known to be missing, the bus is
behind and nothing is lost: then the window is ``patience`` SYNCs.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

LOST, RECEIVED, WRONG_LENGTH, AMBIGUOUS = 0, 1, 2, 3
"""What is known of one joint's sample at one SYNC."""

UNSEEN = int(np.iinfo(np.int64).min)
"""The time of a SYNC that was not received."""

# Positions in Books.state: number, counter and time of the last SYNC, counter of SYNC 0.
SYNC, COUNTER, TIME, ORIGIN = 0, 1, 2, 3

COUNT_NAMES = (
    "sync_seen",
    "sync_missing",
    "sync_repeated",
    "frames",
    "frames_unknown",
    "tpdo_early",
    "tpdo_duplicate",
    "tpdo_wrong_length",
)
SYNC_SEEN, SYNC_MISSING, SYNC_REPEATED, FRAMES, FRAMES_UNKNOWN, TPDO_EARLY, TPDO_DUPLICATE, TPDO_WRONG_LENGTH = range(8)

_DISORDER = 8
"""A SYNC counter that goes back by less than this is a repeated SYNC, not a long gap."""


class Books(NamedTuple):
    """What is owed and what has come; streams ``s``, joints ``j``, a stream's own SYNCs counted by ordinals ``u``.

    Rows ``u`` of stream ``s`` stand in ring slots ``(u - base) % C`` until every joint has settled them; with nothing
    open the ring begins anew, so that memory is only touched where answers are late. ``behind`` is the last ordinal
    at which all joints owed, ``hole`` the last before which a frame is known to be missing.
    """

    state: NDArray[np.int64]
    counts: NDArray[np.int64]
    every: NDArray[np.int64]
    window: NDArray[np.int64]
    patience: NDArray[np.int64]
    length: NDArray[np.int64]
    channel_of: NDArray[np.int64]
    head: NDArray[np.int64]
    base: NDArray[np.int64]
    behind: NDArray[np.int64]
    hole: NDArray[np.int64]
    emitted: NDArray[np.int64]
    settled: NDArray[np.int64]
    pending: NDArray[np.int64]
    fresh: NDArray[np.int64]
    label: NDArray[np.int64]
    answer: NDArray[np.uint64]
    answer_code: NDArray[np.uint8]
    row_sync: NDArray[np.int64]
    row_t: NDArray[np.int64]
    row_code: NDArray[np.uint8]
    row_data: NDArray[np.uint64]


class Decided(NamedTuple):
    """Rows whose fate is decided, ``rows[s]`` of each stream."""

    rows: NDArray[np.int64]
    sync: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    code: NDArray[np.uint8]
    data: NDArray[np.uint64]


def open_books(
    every: list[int],
    window: list[int],
    patience: list[int],
    length: list[int],
    channel_of: NDArray[np.int64],
    n: int,
) -> Books:
    """Empty books for streams of ``n`` joints; ``channel_of`` maps a COB-ID to ``s n + j``, or -1."""
    streams, rows = len(every), 2 * max(patience) + 8
    answers = rows + 64
    return Books(
        state=np.array([-1, -1, UNSEEN, 1]),
        counts=np.zeros(len(COUNT_NAMES), np.int64),
        every=np.array(every),
        window=np.array(window),
        patience=np.array(patience),
        length=np.array(length),
        channel_of=channel_of,
        head=np.zeros(streams, np.int64),
        base=np.zeros(streams, np.int64),
        behind=np.zeros(streams, np.int64),
        hole=np.zeros(streams, np.int64),
        emitted=np.zeros(streams, np.int64),
        settled=np.zeros((streams, n), np.int64),
        pending=np.zeros((streams, n), np.int64),
        fresh=np.zeros((streams, n), np.int64),
        label=np.zeros((streams, n, answers), np.int64),
        answer=np.zeros((streams, n, answers), np.uint64),
        answer_code=np.zeros((streams, n, answers), np.uint8),
        row_sync=np.zeros((streams, rows), np.int64),
        row_t=np.zeros((streams, rows), np.int64),
        row_code=np.zeros((streams, rows, n), np.uint8),
        row_data=np.zeros((streams, rows, n), np.uint64),
    )


def room_for(books: Books, syncs: int) -> Decided:
    """Room for what can be decided when ``syncs`` more SYNC are known of."""
    streams, _, n = books.row_code.shape
    rows = int((books.head - books.emitted).max()) + syncs
    return Decided(
        rows=np.zeros(streams, np.int64),
        sync=np.empty((streams, rows), np.int64),
        t_ns=np.empty((streams, rows), np.int64),
        code=np.empty((streams, rows, n), np.uint8),
        data=np.empty((streams, rows, n), np.uint64),
    )


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
def _slot(b: Books, s: int, u: int) -> int:
    return int((u - b.base[s]) % b.row_sync.shape[1])


@njit(cache=True, nogil=True)
def _place(b: Books, s: int, j: int, u: int, i: int) -> None:
    slot = _slot(b, s, u)
    b.row_data[s, slot, j] = b.answer[s, j, i]
    b.row_code[s, slot, j] = b.answer_code[s, j, i]


@njit(cache=True, nogil=True)
def _settle(b: Books, s: int, j: int, final: bool) -> None:
    """Close the books of one TPDO of one drive: match what is certain, give up what is older than the window."""
    owed = b.head[s] - b.settled[s, j]
    count = b.pending[s, j]
    if count > owed:
        b.counts[TPDO_DUPLICATE] += count - owed
        count = owed
        b.pending[s, j] = owed
    b.fresh[s, j] = 0
    if count == owed:
        for i in range(count):
            _place(b, s, j, b.settled[s, j] + i, i)
        b.settled[s, j] = b.head[s]
        b.pending[s, j] = 0
        return
    late = owed > b.window[s] and b.head[s] - b.behind[s] > b.window[s]
    if not (late or owed > b.patience[s] or final):
        return
    keep = b.head[s] if final else b.head[s] - b.window[s]
    u = b.head[s]
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
def _settle_all(b: Books, s: int, final: bool, out: Decided) -> None:
    n, end = b.settled.shape[1], b.head[s]
    oldest, all_owe = end, n > 1
    for j in range(n):
        oldest = min(oldest, b.settled[s, j])
        all_owe = all_owe and b.settled[s, j] + b.pending[s, j] < b.head[s]
    if all_owe and oldest >= b.hole[s]:
        b.behind[s] = b.head[s]
    for j in range(n):
        _settle(b, s, j, final)
        end = min(end, b.settled[s, j])
    while b.emitted[s] < end:
        slot = _slot(b, s, b.emitted[s])
        o = out.rows[s]
        out.sync[s, o] = b.row_sync[s, slot]
        out.t_ns[s, o] = b.row_t[s, slot]
        for j in range(b.settled.shape[1]):
            out.code[s, o, j] = b.row_code[s, slot, j]
            out.data[s, o, j] = b.row_data[s, slot, j]
        out.rows[s] += 1
        b.emitted[s] += 1
    if b.emitted[s] == b.head[s]:
        b.base[s] = b.head[s]


@njit(cache=True, nogil=True)
def _owe(b: Books, s: int, k: int, t_ns: int) -> None:
    """SYNC ``k`` asks for an answer, if the stream sends on it."""
    if (b.state[ORIGIN] + k) % b.every[s] == 0:
        slot = _slot(b, s, b.head[s])
        b.row_sync[s, slot] = k
        b.row_t[s, slot] = t_ns
        for j in range(b.settled.shape[1]):
            b.row_code[s, slot, j] = LOST
        b.head[s] += 1


@njit(cache=True, nogil=True)
def _miss(b: Books, s: int, until: int, out: Decided) -> None:
    """The SYNCs after the last one and before ``until`` were sent, but not received."""
    first = b.state[SYNC] + 1
    if until > first:
        b.hole[s] = b.head[s] + (until - first) // b.every[s] + 1
    long = (until - first) // b.every[s] > b.window[s] // 2
    if long:
        _settle_all(b, s, False, out)
    before = b.head[s]
    for k in range(first, until):
        _owe(b, s, k, UNSEEN)
        if long:
            _settle_all(b, s, False, out)
    if not long and b.head[s] > before:
        # What came since the last SYNC seen may answer the missed ones too.
        for j in range(b.settled.shape[1]):
            for i in range(b.pending[s, j] - b.fresh[s, j], b.pending[s, j]):
                b.label[s, j, i] = b.head[s] - 1


@njit(cache=True, nogil=True)
def count_sync(
    can_id: Any, length: Any, t_ns: Any, data: Any, sync_id: int, period_ns: int, overflow: int, longest: int, b: Books
) -> int:
    """How many SYNC numbers the frames may cover; changes nothing."""
    total, counter, time = 0, b.state[COUNTER], b.state[TIME]
    for i in range(can_id.size):
        if can_id[i] == sync_id:
            step = 1
            if length[i] > 0:
                if counter >= 0:
                    elapsed = (t_ns[i] - time) / period_ns if time != UNSEEN else 0.0
                    step = sync_step(int(np.int64(data[i] & np.uint64(0xFF))), counter, elapsed, overflow, longest)
                if step > 0:
                    counter = int(np.int64(data[i] & np.uint64(0xFF)))
            if step > 0:
                time = t_ns[i]
                total += step
    return int(total)


@njit(cache=True, nogil=True)
def match(
    can_id: Any,
    length: Any,
    t_ns: Any,
    data: Any,
    sync_id: int,
    period_ns: int,
    overflow: int,
    longest: int,
    b: Books,
    out: Decided,
) -> None:
    """Take frames in the order they came; rows whose fate is decided go to ``out``."""
    n = b.settled.shape[1]
    for i in range(can_id.size):
        b.counts[FRAMES] += 1
        identifier = np.int64(can_id[i])
        if identifier == sync_id:
            step = 1
            if length[i] > 0:
                counter = int(np.int64(data[i] & np.uint64(0xFF)))
                if b.state[COUNTER] >= 0:
                    elapsed = (t_ns[i] - b.state[TIME]) / period_ns if b.state[TIME] != UNSEEN else 0.0
                    step = sync_step(counter, b.state[COUNTER], elapsed, overflow, longest)
                else:
                    b.state[ORIGIN] = counter
                if step > 0:
                    b.state[COUNTER] = counter
            if step <= 0:
                b.counts[SYNC_REPEATED] += 1
                continue
            k = b.state[SYNC] + step
            for s in range(b.every.size):
                _miss(b, s, k, out)
                _settle_all(b, s, False, out)
                _owe(b, s, k, t_ns[i])
            b.counts[SYNC_SEEN] += 1
            b.counts[SYNC_MISSING] += step - 1
            b.state[SYNC] = k
            b.state[TIME] = t_ns[i]
            continue
        channel = b.channel_of[identifier] if identifier < b.channel_of.size else np.int64(-1)
        if channel < 0:
            b.counts[FRAMES_UNKNOWN] += 1
            continue
        s, j = channel // n, channel % n
        slot = b.pending[s, j]
        if b.head[s] == 0:
            b.counts[TPDO_EARLY] += 1
        elif slot >= b.label.shape[2]:
            b.counts[TPDO_DUPLICATE] += 1
        else:
            right = length[i] == b.length[s]
            if not right:
                b.counts[TPDO_WRONG_LENGTH] += 1
            b.answer[s, j, slot] = data[i]
            b.answer_code[s, j, slot] = RECEIVED if right else WRONG_LENGTH
            b.label[s, j, slot] = b.head[s] - 1
            b.pending[s, j] += 1
            b.fresh[s, j] += 1


@njit(cache=True, nogil=True)
def finish(total: int, b: Books, out: Decided) -> None:
    """No more frames come: SYNCs ``0 .. total - 1`` were sent, and what is still owed is lost."""
    for s in range(b.every.size):
        if total > b.state[SYNC] + 1:
            _miss(b, s, total, out)
        _settle_all(b, s, True, out)
    if total > b.state[SYNC] + 1:
        b.counts[SYNC_MISSING] += total - 1 - b.state[SYNC]
        b.state[SYNC] = total - 1
