"""Turns the frames of the bus into rows per SYNC, and accounts for every SYNC: received, or in the gap list."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.matching import (
    AMBIGUOUS,
    COUNT_NAMES,
    COUNTER,
    LOST,
    ORIGIN,
    RECEIVED,
    SYNC,
    UNSEEN,
    WRONG_LENGTH,
    Decided,
    count_sync,
    finish,
    match,
    open_books,
    room_for,
)
from daq.recording import Gap

REASONS = {LOST: "lost", WRONG_LENGTH: "wrong length", AMBIGUOUS: "ambiguous order"}
SYNC_LOST = "SYNC not received"
LATE_S = 4.0
"""A drive that owes an answer for longer than this while others have answered has lost it, s."""
PATIENCE_S = 120.0
"""The same where all drives are behind and no frame is known to be missing: a busy host can hold up virtual drives.

Only drives that owe nothing at some SYNC prove that nothing was lost, so what came since the last such SYNC is kept."""
_FEWEST_LATE = 8
_LONGEST_OUTAGE_S = 60.0


@dataclass(frozen=True)
class TpdoStream:
    """What the assembler has to know of a stream: the COB-ID of each joint's TPDO, how often, how many bytes."""

    name: str
    every: int
    cob_ids: tuple[int, ...]
    length: int


@dataclass(frozen=True)
class Rows:
    """Complete rows: ``sync`` and ``t_ns`` (N,), ``data`` (N, n, 8) the bytes of each joint's TPDO."""

    sync: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    data: NDArray[np.uint8]


@dataclass(frozen=True)
class Batch:
    """What became certain: complete rows per stream, and gaps that are over."""

    rows: dict[str, Rows]
    gaps: tuple[Gap, ...]


class Assembler:
    """Matches SYNC and TPDO frames; the result does not depend on how the frames are split into batches.

    Parameters
    ----------
    streams
        The TPDOs to match, all with the same joints.
    joints
        Names of the joints, in the order of the COB-IDs.
    period_ns
        SYNC period, ns.
    overflow
        Synchronous counter overflow value (CiA 301, 1019h).
    first_counter
        Counter of SYNC 0 where that is known (own producer); ``None``: the first SYNC seen is SYNC 0.
    sync_id
        COB-ID of SYNC.
    """

    def __init__(
        self,
        streams: Sequence[TpdoStream],
        joints: Sequence[str],
        period_ns: int,
        overflow: int = 240,
        first_counter: int | None = 1,
        sync_id: int = 0x80,
    ) -> None:
        self._streams, self._joints = tuple(streams), tuple(joints)
        self._timing = sync_id, period_ns, overflow
        self._longest = int(_LONGEST_OUTAGE_S * 1e9 / period_ns)
        channel_of = np.full(0x800, -1, np.int64)
        for s, stream in enumerate(streams):
            for j, cob_id in enumerate(stream.cob_ids):
                channel_of[cob_id] = s * len(joints) + j
        every = [stream.every for stream in streams]
        window, patience = (
            [max(_FEWEST_LATE, int(seconds * 1e9 / period_ns) // e) for e in every] for seconds in (LATE_S, PATIENCE_S)
        )
        self._books = open_books(every, window, patience, [s.length for s in streams], channel_of, len(joints))
        if first_counter is not None:
            self._books.state[COUNTER] = (first_counter - 1) % overflow
            self._books.state[ORIGIN] = first_counter
        self._dropped = False
        self._open: dict[tuple[str, str | None, str], tuple[int, int]] = {}
        self._totals = dict.fromkeys(
            [f"{s.name}.{what}" for s in streams for what in ("expected", "rows", "in_gaps", "discarded")], 0
        )

    @property
    def last_sync(self) -> int:
        """Number of the last SYNC known of; -1 before the first."""
        return int(self._books.state[SYNC])

    @property
    def owed(self) -> int:
        """Most SYNCs that any drive has still to answer."""
        return int((self._books.head[:, None] - self._books.settled - self._books.pending).max())

    @property
    def counters(self) -> dict[str, int]:
        """Counts of frames, SYNCs and samples.

        Per stream, ``expected`` rows are ``rows`` (complete) or ``in_gaps``; ``discarded`` counts the samples of
        single joints that did arrive for rows in gaps.
        """
        counts = dict(zip(COUNT_NAMES, (int(c) for c in self._books.counts), strict=True))
        return counts | self._totals

    def push(self, frames: NDArray[Any], sent: int | None = None, dropped: bool = False) -> Batch:
        """Take frames in the order they came.

        Parameters
        ----------
        frames
            Structured array with ``t_ns``, ``can_id``, ``length`` and ``data`` (8 bytes), as the socket gives it.
        sent
            How many SYNC were sent so far, where we send them: no gap is longer than that.
        dropped
            Whether the kernel dropped frames between the last call and the end of these.
        """
        columns = _columns(frames)
        self._dropped |= dropped
        longest = self._longest if sent is None else min(self._longest, sent - self.last_sync)
        if sent is not None and not self._dropped:
            # Our own SYNCs reach us unless the kernel drops them: time that passed is a producer held up, no loss.
            longest = 0
        syncs = _count_sync(*columns, *self._timing, longest, self._books)
        if dropped:
            self._books.hole[:] = self._books.head + syncs + 1
        out = room_for(self._books, syncs)
        _match(*columns, *self._timing, longest, self._books, out)
        return self._batch(out, False)

    def finish(self, sent: int | None = None) -> Batch:
        """No more frames come; ``sent`` SYNC were sent in all, if we know."""
        total = self.last_sync + 1 if sent is None else max(sent, self.last_sync + 1)
        out = room_for(self._books, total - self.last_sync)
        _finish(total, self._books, out)
        return self._batch(out, True)

    def warm_up(self, frames: NDArray[Any]) -> None:
        """Compile the loops for frames like these (two or more), so that no SYNC waits for the compiler."""
        every, few = self._books.every.tolist(), [_FEWEST_LATE] * self._books.every.size
        nobody = np.full(1, -1, np.int64)
        scratch = open_books(every, few, few, self._books.length.tolist(), nobody, self._books.settled.shape[1])
        columns = _columns(frames)
        out = room_for(scratch, _count_sync(*columns, *self._timing, self._longest, scratch))
        _match(*columns, *self._timing, self._longest, scratch, out)
        _finish(0, scratch, out)

    def _batch(self, out: Decided, final: bool) -> Batch:
        rows, gaps = {}, []
        for s, stream in enumerate(self._streams):
            part = slice(0, int(out.rows[s]))
            sync, t_ns, code = out.sync[s, part], out.t_ns[s, part], out.code[s, part]
            whole = (t_ns != UNSEEN) & (code == RECEIVED).all(axis=1)
            self._totals[f"{stream.name}.expected"] += whole.size
            complete = int(np.count_nonzero(whole))
            self._totals[f"{stream.name}.rows"] += complete
            if complete < whole.size:
                self._totals[f"{stream.name}.in_gaps"] += whole.size - complete
                self._totals[f"{stream.name}.discarded"] += int(np.count_nonzero(code[~whole] == RECEIVED))
                gaps += self._gaps(stream, sync[~whole], t_ns[~whole], code[~whole])
                rows[stream.name] = Rows(sync[whole], t_ns[whole], _bytes(out.data[s, part][whole]))
            else:
                rows[stream.name] = Rows(sync, t_ns, _bytes(out.data[s, part]))
            gaps += self._ended(stream, int(sync[-1]) if sync.size else None, final)
        return Batch(rows, tuple(sorted(gaps, key=lambda g: (g.first, g.stream, g.joint or ""))))

    def _gaps(
        self, stream: TpdoStream, sync: NDArray[np.int64], t_ns: NDArray[np.int64], code: NDArray[np.uint8]
    ) -> list[Gap]:
        """Gaps that are over, of the incomplete rows given; what may go on is kept open."""
        unseen = t_ns == UNSEEN
        found: list[tuple[str | None, str, NDArray[np.int64]]] = [(None, SYNC_LOST, sync[unseen])]
        for value, reason in REASONS.items():
            hit = (code == value) & ~unseen[:, None]
            everyone = hit.all(axis=1)
            found.append((None, reason, sync[everyone]))
            found += [(name, reason, sync[hit[:, j] & ~everyone]) for j, name in enumerate(self._joints)]
        gaps = []
        for joint, reason, numbers in found:
            if numbers.size == 0:
                continue
            key = stream.name, joint, reason
            breaks = np.flatnonzero(np.diff(numbers) != stream.every) + 1
            for run in np.split(numbers, breaks):
                first, last = int(run[0]), int(run[-1])
                if key in self._open:
                    before = self._open.pop(key)
                    if first - before[1] == stream.every:
                        first = before[0]
                    else:
                        gaps.append(Gap(stream.name, *before, joint, reason))
                self._open[key] = first, last
        return gaps

    def _ended(self, stream: TpdoStream, last: int | None, final: bool) -> list[Gap]:
        """Open gaps of the stream that the rows up to ``last`` do not continue."""
        gaps = []
        for key, (begin, end) in list(self._open.items()):
            if key[0] == stream.name and (final or (last is not None and last > end)):
                del self._open[key]
                gaps.append(Gap(stream.name, begin, end, key[1], key[2]))
        return gaps


# numba's dispatchers are typed by their Python signatures, which a tuple of columns cannot be checked against.
_match: Any = match
_count_sync: Any = count_sync
_finish: Any = finish


def _columns(frames: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Identifiers, lengths, times and data (as one number each) of frames."""
    return frames["can_id"], frames["length"], frames["t_ns"], frames["data"].view("<u8")[:, 0]


def _bytes(data: NDArray[np.uint64]) -> NDArray[np.uint8]:
    """Numbers (N, n) as the bytes (N, n, 8) they were read from."""
    return data.view(np.uint8).reshape(*data.shape, 8)
