"""The books of the assembler: what every SYNC of every bus asked of every drive, and what has come."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

LOST, RECEIVED, WRONG_LENGTH, AMBIGUOUS, NO_SYNC, WRONG_MAPPING = range(6)
"""What is known of one joint's sample at one SYNC."""

NEVER = int(np.iinfo(np.int64).min)
"""The time of a SYNC that was not received."""

# Positions in Books.state, per bus: number, counter and time of the last SYNC, counter of SYNC 0, whether the last
# SYNC is one of other buses, which this one lacks, whether frames are known to be missing (1 behind the last SYNC, 2
# somewhere among those that come now), and how often SYNC has been late or early lately, times two to the `FORGOTTEN`.
SYNC, COUNTER, TIME, ORIGIN, BORROWED, TORN, STRAYED = range(7)

# Columns of Books.kind: every how many SYNCs a frame is due, its samples, their bytes, its bytes, and for how many rows
# an answer may be late: where its drive has not been in step since, where all are late, and where it is in step again
# beside others.
EVERY, PACK, SIZE, LENGTH, WINDOW, PATIENCE, SHORT = range(7)

# Columns of Books.mark, ordinals of each stream: rows asked for, row in the first slot of the ring, last row at which
# all joints owed, rows given out.
TOP, BASE, BEHIND, EMITTED = range(4)

# Columns of Books.pace, per stream and joint: answers less rows at the drive's best lately, the row at which that was
# reached, for how many rows in a row it has stood there, for how many nothing has been owed, the row at which this was
# counted last, whether answers to rows that were given up may still come, and the row at which late ones were kept
# because one of them may have been sent twice.
BEST, BEST_AT, STOOD, CALM, PACED, UNSURE, HELD = range(7)

ALIGNED_SYNCS = 8
"""A drive whose balance stands for so many rows answers each of them."""

STILL = 3
"""A drive that leaves out so many rows one after the other rather stood still than lost each of its answers."""

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
"""That a SYNC was late is forgotten bit by bit over the next two to this."""

RECENT = 256
"""Times of at least so many SYNCs are kept for packed samples: a turn of the counter and more.

Several buses keep as many as one may be behind another, twice: a bus whose frames waited finds its numbers by them."""

SENT_AT = 1 << 16
"""SYNCs of our own have the times kept at which they were sent."""


class MatcherState(NamedTuple):
    """What is owed and what has come; buses ``b``, streams ``s``, joints ``j``, a stream's own SYNCs as ordinals ``u``.

    Rows ``u`` of stream ``s`` stand in ring slots ``(u - base) % C`` until every joint has settled them; with nothing
    open the ring begins anew, so that memory is only touched where answers are late. ``head`` counts the rows that the
    SYNCs of a bus have asked for, ``TOP`` of ``mark`` those of the bus that is ahead. A bus may be ``slack`` SYNCs
    behind another one before it is taken for silent. ``behind`` is how many answers a drive has owed at once lately,
    and at which row (``behind_at``); what is placed before row ``doubt`` is not certain. Before row ``hole`` of a bus a
    frame is known to be missing on it. TPDOs that came in the time ``suspect`` (n, 2) were mapped by others. Where we
    send SYNC and lose some, ``sent_at`` is a ring of the times by which those before number ``sent`` (1,) were sent.
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
    """Samples whose fate is decided, ``rows[s]`` of each stream; ``t_ns`` is that of the first bus with the SYNC."""

    rows: NDArray[np.int64]
    sync: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    code: NDArray[np.uint8]
    data: NDArray[np.uint64]


class StreamShape(NamedTuple):
    """What a stream is made of: every how many SYNCs a frame is due, its samples, and the bytes of sample and frame."""

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
    """Empty books; ``channel_of`` (buses, identifiers) maps a COB-ID on a bus to ``s n + j``, or -1.

    ``writes_to`` maps that of an SDO request likewise to the joint ``j``.
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
    """Room for what can be decided when ``syncs`` more SYNC are known of."""
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
