"""Turns the frames of the bus into rows per SYNC, and accounts for every SYNC: received, or in the gap list."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError
from armident.daq.matching.gaps import SYNC_LOST, OpenGaps
from armident.daq.matching.pdo_matching import EVER, count_sync, finish, match
from armident.daq.matching.state import (
    COUNT_NAMES,
    COUNTER,
    NEVER,
    ORIGIN,
    RECEIVED,
    SENT_AT,
    SYNC,
    SYNC_MISALIGNED,
    TIME,
    TOP,
    TORN,
    MatchedSamples,
    StreamShape,
    new_state,
    output_buffers,
)
from armident.daq.recording import Gap
from armident.drivers.canopen.objects import COB_SDO_REQUEST

UNSENT = "pack not complete"
"""SYNCs after the last packed TPDO: no drive was to send their samples any more."""
__all__ = ["LATE_S", "SYNC_LOST", "UNSENT", "Assembler", "Batch", "Rows", "TpdoStream"]

LATE_S = 4.0
"""A drive that owes an answer for longer than this while others have answered has lost it, s."""
IN_STEP_S = 0.02
"""The same where it answers every SYNC again beside a drive that owes nothing, s; twice that if it answers none at all.

Rows wait in memory for so long, and a kill costs those that do."""
PATIENCE_S = 120.0
"""The same where all drives are behind and no frame is known to be missing: a busy host can hold up virtual drives.

Only drives that owe nothing at some SYNC prove that nothing was lost, so what came since the last such SYNC is kept."""
_FEWEST_LATE = 8
_LONGEST_OUTAGE_S = 60.0
_MISALIGNED = 20
"""So many first SYNCs of a bus with another number than that of the others are another master's, fewer a late stamp."""


@dataclass(frozen=True)
class TpdoStream:
    """What the assembler has to know of a stream: the COB-ID of each joint's TPDO, how often, how many bytes.

    A frame of ``length`` bytes holds ``pack`` samples of ``size`` bytes (0: all of it), one of every SYNC.
    """

    name: str
    every: int
    cob_ids: tuple[int, ...]
    length: int
    pack: int = 1
    size: int = 0

    @property
    def shape(self) -> StreamShape:
        """How its frames come."""
        return StreamShape(max(self.every, self.pack), self.pack, self.size or self.length, self.length)


@dataclass(frozen=True)
class Rows:
    """Complete rows: ``sync`` and ``t_ns`` (N,), ``data`` (N, n, 8) or wider the bytes of each joint's sample."""

    sync: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    data: NDArray[np.uint8]


@dataclass(frozen=True)
class Batch:
    """What became certain: complete rows per stream, and gaps that are over."""

    rows: dict[str, Rows]
    gaps: tuple[Gap, ...]


class Assembler:
    """Matches SYNC and TPDO frames; the result does not depend on how a bus's frames are split into batches.

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
    bus_of
        Number of the bus that each joint's drive is on; empty: all on one.
    nodes
        Node of each joint's drive, if SDO requests are looked at: whoever writes there what a TPDO holds makes it
        suspect, until :meth:`suspect` says how long.
    """

    def __init__(
        self,
        streams: Sequence[TpdoStream],
        joints: Sequence[str],
        period_ns: int,
        overflow: int = 240,
        first_counter: int | None = 1,
        sync_id: int = 0x80,
        bus_of: Sequence[int] = (),
        nodes: Sequence[int] = (),
    ) -> None:
        self._streams, self._joints = tuple(streams), tuple(joints)
        self._timing = sync_id, period_ns, overflow
        self._longest = int(_LONGEST_OUTAGE_S * 1e9 / period_ns)
        where = tuple(bus_of) or (0,) * len(joints)
        channel_of = np.full((max(where) + 1, 0x800), -1, np.int64)
        for s, stream in enumerate(streams):
            for j, cob_id in enumerate(stream.cob_ids):
                channel_of[where[j], cob_id] = s * len(joints) + j
        writes_to = np.full((max(where) + 1, 0x800), -1, np.int64)
        for j, node in enumerate(nodes):
            writes_to[where[j], COB_SDO_REQUEST + node] = j
        self._shapes = [stream.shape for stream in streams]
        window, patience, short = (
            [max(_FEWEST_LATE, int(seconds * 1e9 / period_ns) // shape.every) for shape in self._shapes]
            for seconds in (LATE_S, PATIENCE_S, IN_STEP_S)
        )
        self._books = new_state(self._shapes, window, patience, short, where, channel_of, writes_to)
        self._slack = int(self._books.slack[0])
        if first_counter is not None:
            self._books.state[:, COUNTER] = (first_counter - 1) % overflow
            self._books.state[:, ORIGIN] = first_counter
        self._lossy = np.zeros(len(channel_of), bool)
        self.when_sent: Callable[[int], tuple[int, NDArray[np.int64]]] | None = None
        """Where we send SYNC: tells when, as :meth:`SyncProducer.sent_at` does."""
        self._asked_from = 0
        self._gaps = OpenGaps(self._joints)
        self._given = [0] * len(streams)
        self._totals = dict.fromkeys(
            [f"{s.name}.{what}" for s in streams for what in ("expected", "rows", "in_gaps", "discarded")], 0
        )

    @property
    def last_sync(self) -> int:
        """Number of the last SYNC known of; -1 before the first."""
        return int(self._books.state[:, SYNC].max())

    @property
    def owed(self) -> int:
        """Most SYNCs that any drive has still to answer."""
        return int(self._debts().max())

    @property
    def owed_by_all(self) -> int:
        """SYNCs that every drive has still to answer, in every stream: they are behind together."""
        return max(int(self._debts().min()), 0)

    def _debts(self) -> NDArray[np.int64]:
        """SYNCs that are not answered yet, (streams, drives)."""
        debts: NDArray[np.int64] = self._books.head[self._books.bus_of].T - self._books.settled - self._books.pending
        return debts

    @property
    def wrong_lengths(self) -> dict[tuple[str, str], int]:
        """How many TPDOs of another length than their mapping's have come, by stream and joint; those that did."""
        return {
            (self._streams[s].name, self._joints[j]): int(self._books.wrong[s, j])
            for s, j in np.argwhere(self._books.wrong > 0)
        }

    @property
    def counters(self) -> dict[str, int]:
        """Counts of frames, SYNCs and samples.

        Per stream, ``expected`` rows are ``rows`` (complete) or ``in_gaps``; ``discarded`` counts the samples of
        single joints that did arrive for rows in gaps.
        """
        counts = dict(zip(COUNT_NAMES, (int(c) for c in self._books.counts), strict=True))
        return counts | self._totals

    def push(self, frames: NDArray[Any], sent: int | None = None, dropped: bool = False, bus: int = 0) -> Batch:
        """Take frames of one bus in the order they came.

        Parameters
        ----------
        frames
            Structured array with ``t_ns``, ``can_id``, ``length`` and ``data`` (8 or 64 bytes), as the socket gives it.
        sent
            How many SYNC were sent so far, where we send them: no gap is longer than that.
        dropped
            Whether frames of this bus were lost between the last call and the end of these, as the kernel knows.
        bus
            The bus they came from.

        Raises
        ------
        DataError
            If the SYNC counters of two buses do not agree.
        """
        arguments = (*_columns(frames), *self._timing, bus)
        self._lossy[bus] |= dropped
        if frames.size:
            # Whoever speaks is not silent.
            self._books.slack[bus] = self._slack
        last = int(self._books.state[bus, SYNC])
        longest = self._longest if sent is None else min(self._longest, sent - last)
        if sent is not None and not self._lossy[bus]:
            # Our own SYNCs reach us unless the kernel drops them: time that passed is a producer held up, no loss.
            longest = 0
        self._look_when_sent(self._lossy[bus])
        if dropped:
            self._books.state[bus, TORN] = 2
        syncs = _count_sync(*arguments, longest, self._books)
        if dropped:
            self._books.hole[bus] = self._books.mark[:, TOP] + syncs + 1
        out = output_buffers(self._books, syncs)
        _match(*arguments, longest, self._books, out)
        if dropped:
            self.torn(bus)
        if self._books.counts[SYNC_MISALIGNED] >= _MISALIGNED:
            raise DataError(
                f"bus {bus + 1}: its SYNC counter says another number than that of another bus at the same time; "
                "buses of one session need SYNC from one master"
            )
        return self._batch(out, False)

    def _look_when_sent(self, lossy: bool) -> None:
        """Where frames are lost, have at hand when we sent what has come: a producer held up keeps to no period."""
        sent = self._books.sent
        sent[0] = -1
        if lossy and self.when_sent is not None:
            first, times = self.when_sent(self._asked_from)
            numbers = first + np.arange(times.size)[-SENT_AT:]
            self._books.sent_at[numbers % SENT_AT] = times[-SENT_AT:]
            sent[0] = self._asked_from = first + times.size

    def silence(self, bus: int, silent: bool) -> None:
        """Say that a bus is known to be down, or back: its drives owe nothing meanwhile, and the others go on."""
        self._books.slack[bus] = 0 if silent else self._slack
        self._lossy[bus] |= silent
        self.torn(bus)

    def torn(self, bus: int) -> None:
        """Say that frames of a bus may be missing behind the last one, however its SYNC counter goes on."""
        self._books.state[bus, TORN] = 1

    def suspect(self, joint: str, since_ns: int, until_ns: int) -> None:
        """Say that TPDOs of a joint that came in this time (ns, UTC) hold something else than the session says."""
        span = self._books.suspect[self._joints.index(joint)]
        if span[0] < span[1] and span[1] == EVER:
            since_ns = min(since_ns, int(span[0]))
        span[:] = since_ns, until_ns

    def unseen(self, dropped: Sequence[int], now_ns: int) -> int:
        """SYNCs that there may have been at most behind the last one.

        Parameters
        ----------
        dropped
            Frames of each bus that were lost behind the last one received, as the kernel knows.
        now_ns
            Time of the kernel's stamps, ns UTC.
        """
        numbers, times = self._books.state[:, SYNC], self._books.state[:, TIME]
        known = times != NEVER
        periods = np.maximum(0, now_ns - times[known]) // self._timing[1]
        last = numbers[known] + np.minimum(np.asarray(dropped)[known], periods)
        return int(max(0, last.max(initial=self.last_sync) - self.last_sync))

    def finish(self, sent: int | None = None) -> Batch:
        """No more frames come; ``sent`` SYNC were sent in all, if we know."""
        total = self.last_sync + 1 if sent is None else max(sent, self.last_sync + 1)
        out = output_buffers(self._books, total - self.last_sync)
        _finish(total, self._books, out)
        return self._batch(out, True)

    def warm_up(self, frames: NDArray[Any]) -> None:
        """Compile the loops for frames like these, so that no SYNC waits for the compiler."""
        few = [_FEWEST_LATE] * len(self._shapes)
        nobody = np.full((self._lossy.size, 1), -1, np.int64)
        scratch = new_state(self._shapes, few, few, few, self._books.bus_of.tolist(), nobody, nobody)
        arguments = (*_columns(frames), *self._timing, 0)
        out = output_buffers(scratch, _count_sync(*arguments, self._longest, scratch))
        _match(*arguments, self._longest, scratch, out)
        _finish(0, scratch, out)

    def _batch(self, out: MatchedSamples, final: bool) -> Batch:
        rows, gaps = {}, []
        for s, stream in enumerate(self._streams):
            part = slice(0, int(out.rows[s]))
            sync, t_ns, code = out.sync[s, part], out.t_ns[s, part], out.code[s, part]
            data = out.data[s, part, :, : -(-self._shapes[s].size // 8)]
            whole = (code == RECEIVED).all(axis=1)
            self._totals[f"{stream.name}.expected"] += whole.size
            complete = int(np.count_nonzero(whole))
            self._totals[f"{stream.name}.rows"] += complete
            if complete < whole.size:
                self._totals[f"{stream.name}.in_gaps"] += whole.size - complete
                self._totals[f"{stream.name}.discarded"] += int(np.count_nonzero(code[~whole] == RECEIVED))
                gaps += self._gaps.add(stream.name, stream.every, sync[~whole], code[~whole])
                rows[stream.name] = Rows(sync[whole], t_ns[whole], _bytes(data[whole]))
            else:
                rows[stream.name] = Rows(sync, t_ns, _bytes(data))
            if sync.size:
                self._given[s] = int(sync[-1]) + 1
            if final and stream.pack > 1:
                gaps += self._unsent(s)
            gaps += self._gaps.over(stream.name, int(sync[-1]) if sync.size else None, final)
        return Batch(rows, tuple(sorted(gaps, key=lambda g: (g.first, g.stream, g.joint or ""))))

    def _unsent(self, s: int) -> list[Gap]:
        """The SYNCs since the last packed TPDO, as a gap."""
        stream, first, last = self._streams[s], self._given[s], self.last_sync
        if first > last:
            return []
        self._totals[f"{stream.name}.expected"] += last - first + 1
        self._totals[f"{stream.name}.in_gaps"] += last - first + 1
        return [Gap(stream.name, first, last, None, UNSENT)]


# numba's dispatchers are typed by their Python signatures, which a tuple of columns cannot be checked against.
_match: Any = match
_count_sync: Any = count_sync
_finish: Any = finish


def _columns(frames: NDArray[Any]) -> tuple[Any, ...]:
    """Count of frames, and their identifiers, lengths, times and data (as numbers of eight bytes)."""
    count = frames.size
    if count < 2:
        # Columns of one frame or none count as contiguous, which would compile the loops anew.
        room = np.zeros(2, frames.dtype)
        room[:count] = frames
        frames = room
    return count, frames["can_id"], frames["length"], frames["t_ns"], frames["data"].view("<u8")


def _bytes(data: NDArray[np.uint64]) -> NDArray[np.uint8]:
    """Numbers (N, n, words) as the bytes (N, n, 8 words) they were read from."""
    return np.ascontiguousarray(data).view(np.uint8)
