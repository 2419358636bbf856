"""State of the matcher: the SYNCs of every bus that drives must answer, and the answers received."""

from collections.abc import Sequence
from typing import NamedTuple

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

# Columns of MatcherState.progress, per stream and joint: recent maximum of answers minus rows; row at which it was
# reached; number of consecutive rows at this maximum; number of consecutive rows without outstanding answers; row at
# which these were counted last; 1 if answers to discarded rows may still arrive; row at which late answers were held
# back because one of them may be a repetition; number of rows at this maximum since it was
# reached, and the last of them.
BALANCE, BALANCE_AT, BALANCE_RUN, IN_STEP_RUN, COUNTED_AT, STALE, HELD_AT, BALANCE_COUNT, BALANCE_LAST = range(9)

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
    "i8[:, :, ::1], *[i8[:, ::1]] * 8, i8[:, :, ::1], u8[:, :, :, ::1], u1[:, :, ::1], "
    "i8[:, ::1], i8[:, :, :, ::1], u1[:, :, ::1], u8[:, :, :, ::1]"
)
class MatcherState(NamedTuple):
    """Rows to be answered and answers received; B buses, S streams, n joints, rows as ordinals ``u`` per stream.

    Row ``u`` of stream ``s`` is in ring slot ``(u - watermark[s, BASE]) % C`` until every joint has settled it. When no
    row is open the ring restarts, so that memory is only touched if answers are late.

    Parameters
    ----------
    bus_state
        State of each bus (`SYNC` and following), (B, 7).
    slack
        SYNCs by which a bus may be behind another one before it counts as silent, (B,).
    sync_times
        Ring of receive times by SYNC number, ns UTC, (B, R).
    send_times
        Ring of send times of the own producer, ns UTC, (`SEND_TIMES`,); used where SYNCs are lost.
    sends_known
        Number of SYNCs before which ``send_times`` is valid, (1,); -1: none.
    counts
        Counters (`COUNT_NAMES`).
    config
        Shape and windows of each stream (`EVERY` and following), (S, 7).
    watermark
        Row ordinals of each stream (`TOP` and following), (S, 4).
    bus_of
        Bus of each joint's drive, (n,).
    channel_of
        ``s n + j`` by bus and COB-ID of a TPDO, or -1, (B, 2048).
    writes_to
        Joint by bus and COB-ID of an SDO request, or -1, (B, 2048).
    head
        Rows to be answered by the SYNCs of each bus, (B, S).
    gap_end
        Row before which a frame is known to be missing, (B, S).
    progress
        Progress of each drive (`BALANCE` and following), (S, n, 9).
    settled
        Rows settled, (S, n).
    pending
        Answers received for later rows, (S, n).
    since_sync
        Those received since the last SYNC, (S, n).
    wrong_length
        TPDOs of the wrong length, (S, n).
    lag, lag_at
        Largest recent number of outstanding answers, and its row, (S, n).
    ambiguous_before
        Row before which a match is ambiguous, (S, n).
    unverified
        Time span in which TPDOs may have another mapping, ns UTC, (n, 2).
    newest_row
        Newest row of the bus when each pending answer was received, (S, n, A).
    answer, answer_code
        Data as 64-bit words, (S, n, A, words), and state of each pending answer, (S, n, A).
    row_sync
        SYNC number of each row, (S, C).
    row_t
        Receive times of the SYNCs of each row, (S, C, pack, B); `NEVER` if not received.
    row_code, row_data
        State, (S, C, n), and data as 64-bit words, (S, C, n, words), of each row.
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
    progress: NDArray[np.int64]
    settled: NDArray[np.int64]
    pending: NDArray[np.int64]
    since_sync: NDArray[np.int64]
    wrong_length: NDArray[np.int64]
    lag: NDArray[np.int64]
    lag_at: NDArray[np.int64]
    ambiguous_before: NDArray[np.int64]
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
    """Decided samples; S streams, n joints, space for N rows.

    ``rows``: number of rows of each stream, (S,); ``sync``: SYNC numbers, (S, N); ``t_ns``: receive time on the first
    bus that received the SYNC, ns UTC, (S, N); ``code``: state of each sample, (S, N, n); ``data``: data as 64-bit
    words, (S, N, n, words).
    """

    rows: NDArray[np.int64]
    sync: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    code: NDArray[np.uint8]
    data: NDArray[np.uint64]


class StreamShape(NamedTuple):
    """Frames of a stream.

    ``every``: number of SYNCs from one frame to the next; ``pack``: samples in a frame; ``size``: bytes of a sample;
    ``length``: bytes of a frame.
    """

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
    """Return the state before the first frame.

    Parameters
    ----------
    window, long_window, short_window
        Of each stream, the rows by which an answer may be late: in general, if all drives are late, and if the drive is
        in step again beside others.
    bus_of
        Number of the bus of each joint's drive, (n,).
    channel_of
        ``s n + j`` by bus and COB-ID of a TPDO, or -1, (B, 2048).
    writes_to
        Joint by bus and COB-ID of an SDO request, or -1, (B, 2048).
    """
    buses, streams, n = len(channel_of), len(shapes), len(bus_of)
    rows = 2 * max(long_window) + 8
    answers = rows + 64
    words = max(-(-shape.length // 8) for shape in shapes)
    pack = max(shape.pack for shape in shapes)
    slack = max(w * s.every for w, s in zip(window, shapes, strict=True))
    sync_times = SYNC_TIMES if buses == 1 else SYNC_TIMES + 2 * slack
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
        progress=np.tile(np.array([NEVER, 0, 0, 0, 0, 0, NEVER, 0, 0]), (streams, n, 1)),
        settled=np.zeros((streams, n), np.int64),
        pending=np.zeros((streams, n), np.int64),
        since_sync=np.zeros((streams, n), np.int64),
        wrong_length=np.zeros((streams, n), np.int64),
        lag=np.zeros((streams, n), np.int64),
        lag_at=np.zeros((streams, n), np.int64),
        ambiguous_before=np.zeros((streams, n), np.int64),
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
    """Return buffers for all samples that can be decided after more SYNCs.

    ``syncs``: largest number of SYNCs to come.
    """
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
