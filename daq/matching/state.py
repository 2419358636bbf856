"""State of the matcher: the SYNCs of every bus that drives have to answer, and the answers received."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

LOST, RECEIVED, WRONG_LENGTH, AMBIGUOUS, NO_SYNC, WRONG_MAPPING = range(6)
"""States of one joint's sample at one SYNC."""

NEVER = int(np.iinfo(np.int64).min)
"""Time of a SYNC that was not received."""

# Positions in MatcherState.state, per bus: number, counter and time (ns UTC) of the last SYNC; counter of SYNC 0; 1 if
# the last SYNC number comes from other buses and was not received on this one; frames known to be missing (1: after
# the last SYNC, 2: among the present frames); recent number of late or early SYNCs, times two to the `FORGOTTEN`.
SYNC, COUNTER, TIME, ORIGIN, BORROWED, TORN, STRAYED = range(7)

# Columns of MatcherState.kind: SYNCs per frame, samples per frame, bytes per sample, bytes per frame, and the number of
# rows by which an answer may be late: if its drive has not been in step since, if all drives are late, and if it is in
# step again beside others.
EVERY, PACK, SIZE, LENGTH, WINDOW, PATIENCE, SHORT = range(7)

# Columns of MatcherState.mark, row ordinals of each stream: rows to be answered, row in the first slot of the ring,
# last row at which all joints lacked answers, rows given out.
TOP, BASE, BEHIND, EMITTED = range(4)

# Columns of MatcherState.pace, per stream and joint: recent maximum of answers minus rows; row at which it was reached;
# number of consecutive rows at this maximum; number of consecutive rows without outstanding answers; row at which these
# were counted last; 1 if answers to discarded rows may still arrive; row at which late answers were held back because
# one of them may be a repetition.
BEST, BEST_AT, STOOD, CALM, PACED, UNSURE, HELD = range(7)

ALIGNED_SYNCS = 8
"""Number of consecutive rows with unchanged balance after which a drive counts as answering every SYNC."""

STILL = 3
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

FORGOTTEN = 14
"""Base-2 logarithm of the number of SYNCs over which `STRAYED` decays."""

RECENT = 256
"""Least number of SYNC times kept, for packed samples: more than a turn of the counter (CiA 301, 1019h: up to 240).

With several buses, twice the slack is added: a bus with delayed frames finds its numbers by them."""

SENT_AT = 1 << 16
"""Number of SYNCs of the own producer whose send times are kept."""


class MatcherState(NamedTuple):
    """Rows to be answered and answers received; B buses, S streams, n joints, rows as ordinals ``u`` per stream.

    Row ``u`` of stream ``s`` is in ring slot ``(u - mark[s, BASE]) % C`` until every joint has settled it. When no row
    is open the ring restarts, so that memory is only touched if answers are late.

    Parameters
    ----------
    state
        State of each bus (`SYNC` and following), (B, 7).
    slack
        SYNCs by which a bus may be behind another one before it counts as silent, (B,).
    recent
        Ring of receive times by SYNC number, ns UTC, (B, R).
    sent_at
        Ring of send times of the own producer, ns UTC, (`SENT_AT`,); used where SYNCs are lost.
    sent
        Number of SYNCs before which ``sent_at`` is valid, (1,); -1: none.
    counts
        Counters (`COUNT_NAMES`).
    kind
        Shape and windows of each stream (`EVERY` and following), (S, 7).
    mark
        Row ordinals of each stream (`TOP` and following), (S, 4).
    bus_of
        Bus of each joint's drive, (n,).
    channel_of
        ``s n + j`` by bus and COB-ID of a TPDO, or -1, (B, 2048).
    writes_to
        Joint by bus and COB-ID of an SDO request, or -1, (B, 2048).
    head
        Rows to be answered by the SYNCs of each bus, (B, S).
    hole
        Row before which a frame is known to be missing, (B, S).
    pace
        Progress of each drive (`BEST` and following), (S, n, 7).
    settled
        Rows settled, (S, n).
    pending
        Answers received for later rows, (S, n).
    fresh
        Those received since the last SYNC, (S, n).
    wrong
        TPDOs of the wrong length, (S, n).
    behind, behind_at
        Largest recent number of outstanding answers, and its row, (S, n).
    doubt
        Row before which a match is not certain, (S, n).
    suspect
        Time span in which TPDOs may have another mapping, ns UTC, (n, 2).
    label
        Last row of the bus when each pending answer was received, (S, n, A).
    answer, answer_code
        Data as 64-bit words, (S, n, A, words), and state of each pending answer, (S, n, A).
    row_sync
        SYNC number of each row, (S, C).
    row_t
        Receive times of the SYNCs of each row, (S, C, pack, B); `NEVER` if not received.
    row_code, row_data
        State, (S, C, n), and data as 64-bit words, (S, C, n, words), of each row.
    """

    state: NDArray[np.int64]
    slack: NDArray[np.int64]
    recent: NDArray[np.int64]
    sent_at: NDArray[np.int64]
    sent: NDArray[np.int64]
    counts: NDArray[np.int64]
    kind: NDArray[np.int64]
    mark: NDArray[np.int64]
    bus_of: NDArray[np.int64]
    channel_of: NDArray[np.int64]
    writes_to: NDArray[np.int64]
    head: NDArray[np.int64]
    hole: NDArray[np.int64]
    pace: NDArray[np.int64]
    settled: NDArray[np.int64]
    pending: NDArray[np.int64]
    fresh: NDArray[np.int64]
    wrong: NDArray[np.int64]
    behind: NDArray[np.int64]
    behind_at: NDArray[np.int64]
    doubt: NDArray[np.int64]
    suspect: NDArray[np.int64]
    label: NDArray[np.int64]
    answer: NDArray[np.uint64]
    answer_code: NDArray[np.uint8]
    row_sync: NDArray[np.int64]
    row_t: NDArray[np.int64]
    row_code: NDArray[np.uint8]
    row_data: NDArray[np.uint64]


class MatchedSamples(NamedTuple):
    """Decided samples; S streams, n joints, room for N rows.

    Parameters
    ----------
    rows
        Number of rows of each stream, (S,).
    sync
        SYNC numbers, (S, N).
    t_ns
        Receive time on the first bus that received the SYNC, ns UTC, (S, N).
    code
        State of each sample, (S, N, n).
    data
        Data as 64-bit words, (S, N, n, words).
    """

    rows: NDArray[np.int64]
    sync: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    code: NDArray[np.uint8]
    data: NDArray[np.uint64]


class StreamShape(NamedTuple):
    """Frames of a stream.

    Parameters
    ----------
    every
        Number of SYNCs from one frame to the next.
    pack
        Samples in a frame.
    size
        Bytes of a sample.
    length
        Bytes of a frame.
    """

    every: int
    pack: int
    size: int
    length: int


def new_state(
    shapes: Sequence[StreamShape],
    window: list[int],
    patience: list[int],
    short: list[int],
    bus_of: Sequence[int],
    channel_of: NDArray[np.int64],
    writes_to: NDArray[np.int64],
) -> MatcherState:
    """Return the state before the first frame.

    Parameters
    ----------
    shapes
        Frames of each stream.
    window, patience, short
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
    rows = 2 * max(patience) + 8
    answers = rows + 64
    words = max(-(-shape.length // 8) for shape in shapes)
    pack = max(shape.pack for shape in shapes)
    slack = max(w * s.every for w, s in zip(window, shapes, strict=True))
    recent = RECENT if buses == 1 else RECENT + 2 * slack
    return MatcherState(
        state=np.tile(np.array([-1, -1, NEVER, 1, 0, 0, 0]), (buses, 1)),
        slack=np.full(buses, slack, np.int64),
        recent=np.full((buses, recent), NEVER, np.int64),
        sent_at=np.full(SENT_AT, NEVER, np.int64),
        sent=np.array([-1]),
        counts=np.zeros(len(COUNT_NAMES), np.int64),
        kind=np.array(
            [
                [s.every, s.pack, s.size, s.length, w, p, few]
                for s, w, p, few in zip(shapes, window, patience, short, strict=True)
            ],
            np.int64,
        ),
        mark=np.zeros((streams, 4), np.int64),
        bus_of=np.array(bus_of, np.int64),
        channel_of=channel_of,
        writes_to=writes_to,
        head=np.zeros((buses, streams), np.int64),
        hole=np.zeros((buses, streams), np.int64),
        pace=np.tile(np.array([NEVER, 0, 0, 0, 0, 0, NEVER]), (streams, n, 1)),
        settled=np.zeros((streams, n), np.int64),
        pending=np.zeros((streams, n), np.int64),
        fresh=np.zeros((streams, n), np.int64),
        wrong=np.zeros((streams, n), np.int64),
        behind=np.zeros((streams, n), np.int64),
        behind_at=np.zeros((streams, n), np.int64),
        doubt=np.zeros((streams, n), np.int64),
        suspect=np.tile(np.array([0, NEVER]), (n, 1)),
        label=np.zeros((streams, n, answers), np.int64),
        answer=np.zeros((streams, n, answers, words), np.uint64),
        answer_code=np.zeros((streams, n, answers), np.uint8),
        row_sync=np.zeros((streams, rows), np.int64),
        row_t=np.zeros((streams, rows, pack, buses), np.int64),
        row_code=np.zeros((streams, rows, n), np.uint8),
        row_data=np.zeros((streams, rows, n, words), np.uint64),
    )


def output_buffers(books: MatcherState, syncs: int) -> MatchedSamples:
    """Return buffers for all samples that can be decided after more SYNCs.

    Parameters
    ----------
    books
        State of the matcher.
    syncs
        Largest number of SYNCs to come.
    """
    streams, _, n = books.row_code.shape
    rows = int(((books.mark[:, TOP] - books.mark[:, EMITTED] + 1) * books.kind[:, PACK]).max()) + syncs
    words = int(-(-books.kind[:, SIZE] // 8).max())
    return MatchedSamples(
        rows=np.zeros(streams, np.int64),
        sync=np.empty((streams, rows), np.int64),
        t_ns=np.empty((streams, rows), np.int64),
        code=np.empty((streams, rows, n), np.uint8),
        data=np.empty((streams, rows, n, words), np.uint64),
    )
