"""State of the matcher: the SYNCs of every bus that drives must answer, and the answers received."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from armident.compiled import structure

LOST, RECEIVED, WRONG_LENGTH, AMBIGUOUS, NO_SYNC, WRONG_MAPPING = range(6)
"""States of one joint's sample at one SYNC."""

NEVER = int(np.iinfo(np.int64).min)
"""Time of a SYNC that was not received."""

# Positions in MatcherState.bus_state, per bus: number, counter and time (ns UTC) of the last SYNC; counter of SYNC 0; 1
# if the last SYNC number comes from other buses and was not received on this one; frames known to be missing (1: after
# the last SYNC, 2: among the present frames); recent number of late or early SYNCs, times ``2**IRREGULAR_DECAY``.
SYNC, COUNTER, TIME, ORIGIN, INFERRED, INCOMPLETE, IRREGULAR = range(7)

# Columns of MatcherState.config: SYNCs per frame, samples per frame, bytes per sample, bytes per frame, and the number
# of rows by which an answer may be late: if its drive has not been in step since, if all drives are late, and if it is
# in step again beside others.
EVERY, PACK, SIZE, LENGTH, WINDOW, LONG_WINDOW, SHORT_WINDOW = range(7)

# Columns of MatcherState.watermark, row ordinals of each stream: rows to be answered, row in the first slot of the
# ring, last row at which all joints lacked answers, rows emitted.
TOP, BASE, ALL_BEHIND, EMITTED = range(4)

# Columns of MatcherState.drives, per stream and joint: rows settled, answers to later rows, and answers since SYNC;
# largest recent number of outstanding answers, and its row; row before which a match is ambiguous; TPDOs of wrong
# length.
SETTLED, PENDING, SINCE_SYNC, LAG, LAG_AT, CLEAR_FROM, WRONG_LENGTHS = range(7)
# Progress: recent maximum of answers minus rows; row at which it was reached; number of consecutive rows at this
# maximum; number of consecutive rows without outstanding answers; row at which these were counted last; 1 if answers
# to discarded rows may still arrive; row at which late answers were held back because one of them may be a repetition;
# number of rows at this maximum since it was reached, and the last of them.
BALANCE, BALANCE_AT, BALANCE_RUN, IN_STEP_RUN, COUNTED_AT, STALE, HELD_AT, BALANCE_COUNT, BALANCE_LAST = range(7, 16)

OPEN: Any = np.bool_(False)
FINAL: Any = np.bool_(True)
"""State of a drive's rows: answers may follow, or not. As Python's bool, each would compile its own functions."""

ALIGNED_SYNCS = 8
"""Number of consecutive rows with unchanged balance after which a drive counts as answering every SYNC.

A drive that is often a row late seldom has as many: then rows that are not consecutive count, for a longer time."""

LONGEST_LOSS = 3
"""Number of consecutive unanswered rows above which a drive has paused rather than lost each answer."""

COUNT_NAMES = (
    "sync_seen",
    "sync_missing",
    "sync_repeated",
    "sync_misaligned",
    "frames",
    "frames_unknown",
    "tpdo_early",
    "tpdo_late",
    "tpdo_duplicate",
    "tpdo_wrong_length",
)
(
    SYNC_SEEN, SYNC_MISSING, SYNC_REPEATED, SYNC_MISALIGNED, FRAMES, FRAMES_UNKNOWN,
    TPDO_EARLY, TPDO_LATE, TPDO_DUPLICATE, TPDO_WRONG_LENGTH,
) = range(10)  # fmt: skip

IRREGULAR_DECAY = 14
"""Base-2 logarithm of the number of SYNCs over which `IRREGULAR` decays."""

SYNC_TIMES = 256
"""Least number of SYNC times kept, for packed samples: more than a turn of the counter (CiA 301, 1019h: up to 240).

With several buses, twice the slack is added, so that a bus with delayed frames finds its numbers by these times."""

SEND_TIMES = 1 << 16
"""Number of SYNCs of the own producer whose send times are kept."""


@structure(
    "i8[:, ::1], i8[::1], i8[:, ::1], *[i8[::1]] * 3, *[i8[:, ::1]] * 2, i8[::1], *[i8[:, ::1]] * 4, "
    "i8[:, :, ::1], i8[:, ::1], i8[:, :, ::1], u8[:, :, :, ::1], u1[:, :, ::1], "
    "i8[:, ::1], i8[:, :, :, ::1], u1[:, :, ::1], u8[:, :, :, ::1]"
)
class MatcherState(NamedTuple):
    """Rows to be answered and answers received; B buses, S streams, n joints, rows as ordinals ``u`` per stream.

    Row ``u`` of stream ``s`` is in ring slot ``(u - watermark[s, BASE]) % C`` until every joint has settled it. When no
    row is open the ring restarts, so that memory is only touched if answers are late.

    ``bus_state`` (B, 7): `SYNC` and following; ``config`` (S, 7): `EVERY` ...; ``watermark`` (S, 4): `TOP` ...
    ``drives`` (S, n, 16): `SETTLED` ... of each drive; ``counts``: `COUNT_NAMES`; ``bus_of`` (n,).
    ``slack`` (B,): SYNCs behind another bus before a bus counts as silent; ``sync_times`` (B, R): ring, ns UTC.
    ``send_times`` (`SEND_TIMES`,): used where SYNCs are lost; valid before SYNC ``sends_known``, -1: none.
    ``channel_of`` (B, 2048): ``s n + j`` by COB-ID of a TPDO; ``writes_to``: joint by COB-ID of an SDO request; or -1.
    ``head``, ``gap_end`` (B, S): number of rows to be answered, and row before which a frame is known to be missing.
    ``unverified`` (n, 2): span of another mapping, ns UTC; ``newest_row`` (S, n, A): of the bus at each answer.
    ``answer`` (S, n, A, words), ``answer_code`` (S, n, A): 64-bit words, and states, of the pending answers.
    ``row_sync`` (S, C), ``row_t`` (S, C, pack, B) or `NEVER`, ``row_code`` (S, C, n), ``row_data`` (S, C, n, words).
    """

    bus_state: NDArray[np.int64]
    slack: NDArray[np.int64]
    sync_times: NDArray[np.int64]
    send_times: NDArray[np.int64]
    sends_known: NDArray[np.int64]
    counts: NDArray[np.int64]
    config: NDArray[np.int64]
    watermark: NDArray[np.int64]
    bus_of: NDArray[np.int64]
    channel_of: NDArray[np.int64]
    writes_to: NDArray[np.int64]
    head: NDArray[np.int64]
    gap_end: NDArray[np.int64]
    drives: NDArray[np.int64]
    unverified: NDArray[np.int64]
    newest_row: NDArray[np.int64]
    answer: NDArray[np.uint64]
    answer_code: NDArray[np.uint8]
    row_sync: NDArray[np.int64]
    row_t: NDArray[np.int64]
    row_code: NDArray[np.uint8]
    row_data: NDArray[np.uint64]


@structure("i8[::1], i8[:, ::1], i8[:, ::1], u1[:, :, ::1], u8[:, :, :, ::1]")
class MatchedSamples(NamedTuple):
    """Decided samples of S streams and n joints, ``rows`` (S,) of the N that have space.

    ``sync`` (S, N); ``t_ns`` (S, N): receive time on the first bus that received the SYNC, ns UTC; ``code`` (S, N, n):
    state; ``data`` (S, N, n, words): 64-bit words.
    """

    rows: NDArray[np.int64]
    sync: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    code: NDArray[np.uint8]
    data: NDArray[np.uint64]


class StreamShape(NamedTuple):
    """Frames of a stream: one per ``every`` SYNCs, of ``length`` bytes, with ``pack`` samples of ``size`` bytes."""

    every: int
    pack: int
    size: int
    length: int


def new_state(
    shapes: Sequence[StreamShape],
    window: list[int],
    long_window: list[int],
    short_window: list[int],
    bus_of: Sequence[int],
    channel_of: NDArray[np.int64],
    writes_to: NDArray[np.int64],
) -> MatcherState:
    """Return the state before the first frame; ``bus_of``, ``channel_of`` and ``writes_to`` as in `MatcherState`.

    Windows of each stream are rows by which an answer may be late: in general, if all drives are late
    (``long_window``), and if the drive is in step again beside others (``short_window``).
    """
    buses, streams, n = len(channel_of), len(shapes), len(bus_of)
    rows = 2 * max(long_window) + 8
    answers = rows + 64
    words = max(-(-shape.length // 8) for shape in shapes)
    pack = max(shape.pack for shape in shapes)
    slack = max(w * s.every for w, s in zip(window, shapes, strict=True))
    sync_times = SYNC_TIMES if buses == 1 else SYNC_TIMES + 2 * slack
    drives = np.zeros((streams, n, 16), np.int64)
    drives[:, :, [BALANCE, HELD_AT]] = NEVER
    return MatcherState(
        bus_state=np.tile(np.array([-1, -1, NEVER, 1, 0, 0, 0]), (buses, 1)),
        slack=np.full(buses, slack, np.int64),
        sync_times=np.full((buses, sync_times), NEVER, np.int64),
        send_times=np.full(SEND_TIMES, NEVER, np.int64),
        sends_known=np.array([-1]),
        counts=np.zeros(len(COUNT_NAMES), np.int64),
        config=np.array(
            [
                [s.every, s.pack, s.size, s.length, w, p, short]
                for s, w, p, short in zip(shapes, window, long_window, short_window, strict=True)
            ],
            np.int64,
        ),
        watermark=np.zeros((streams, 4), np.int64),
        bus_of=np.array(bus_of, np.int64),
        channel_of=channel_of,
        writes_to=writes_to,
        head=np.zeros((buses, streams), np.int64),
        gap_end=np.zeros((buses, streams), np.int64),
        drives=drives,
        unverified=np.tile(np.array([0, NEVER]), (n, 1)),
        newest_row=np.zeros((streams, n, answers), np.int64),
        answer=np.zeros((streams, n, answers, words), np.uint64),
        answer_code=np.zeros((streams, n, answers), np.uint8),
        row_sync=np.zeros((streams, rows), np.int64),
        row_t=np.zeros((streams, rows, pack, buses), np.int64),
        row_code=np.zeros((streams, rows, n), np.uint8),
        row_data=np.zeros((streams, rows, n, words), np.uint64),
    )


def output_buffers(matcher: MatcherState, syncs: int) -> MatchedSamples:
    """Return buffers for all samples that can be decided after at most ``syncs`` more SYNCs."""
    streams, _, n = matcher.row_code.shape
    rows = (
        int(((matcher.watermark[:, TOP] - matcher.watermark[:, EMITTED] + 1) * matcher.config[:, PACK]).max()) + syncs
    )
    words = int(-(-matcher.config[:, SIZE] // 8).max())
    return MatchedSamples(
        rows=np.zeros(streams, np.int64),
        sync=np.empty((streams, rows), np.int64),
        t_ns=np.empty((streams, rows), np.int64),
        code=np.empty((streams, rows, n), np.uint8),
        data=np.empty((streams, rows, n, words), np.uint64),
    )
