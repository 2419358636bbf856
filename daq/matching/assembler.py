"""Assembles bus frames into rows per SYNC; every SYNC is either received or in the gap list."""

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
"""Reason of the gap after the last packed TPDO: no drive had to send these samples."""
__all__ = ["LATE_S", "SYNC_LOST", "UNSENT", "Assembler", "Batch", "Rows", "TpdoStream"]

LATE_S = 4.0
"""Time after which a missing answer counts as lost while other drives have answered, s."""
IN_STEP_S = 0.02
"""The same if the drive answers every SYNC again beside a drive without missing answers, s; twice that if it is silent.

Rows wait in memory for this time; a killed process loses them."""
PATIENCE_S = 120.0
"""The same if all drives are behind and no frame is known to be missing, s: a busy host can delay virtual drives.

Only a SYNC without missing answers proves that nothing was lost, so answers since the last such SYNC are kept."""
_FEWEST_LATE = 8
_LONGEST_OUTAGE_S = 60.0
_MISALIGNED = 20
"""Number of mismatched first SYNCs of a bus from which they come from another master; fewer are late time stamps."""


@dataclass(frozen=True)
class TpdoStream:
    """TPDOs of a stream on the bus.

    A frame of ``length`` bytes holds ``pack`` samples of ``size`` bytes, one of every SYNC.

    Parameters
    ----------
    name
        Name of the stream.
    every
        Number of SYNCs from one sample to the next.
    cob_ids
        COB-ID of each joint's TPDO.
    length
        Bytes of a frame.
    pack
        Samples in a frame.
    size
        Bytes of a sample; 0: all of the frame.
    """

    name: str
    every: int
    cob_ids: tuple[int, ...]
    length: int
    pack: int = 1
    size: int = 0

    @property
    def shape(self) -> StreamShape:
        """Shape of the stream's frames for the matcher."""
        return StreamShape(max(self.every, self.pack), self.pack, self.size or self.length, self.length)


@dataclass(frozen=True)
class Rows:
    """Complete rows.

    Parameters
    ----------
    sync
        SYNC numbers, (N,).
    t_ns
        Receive times of the SYNCs, ns UTC, (N,).
    data
        Bytes of each joint's sample, (N, n, 8) or wider.
    """

    sync: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    data: NDArray[np.uint8]


@dataclass(frozen=True)
class Batch:
    """Result of a batch of frames.

    Parameters
    ----------
    rows
        Complete rows by stream.
    gaps
        Gaps that have ended.
    """

    rows: dict[str, Rows]
    gaps: tuple[Gap, ...]


class Assembler:
    """Matches SYNC and TPDO frames; the result does not depend on the division of a bus's frames into batches.

    Parameters
    ----------
    streams
        TPDOs to match, all with the same joints.
    joints
        Names of the joints, in the order of the COB-IDs.
    period_ns
        SYNC period, ns.
    overflow
        Synchronous counter overflow value (CiA 301, 1019h).
    first_counter
        Counter of SYNC 0 if it is known (own producer); ``None``: the first SYNC received is SYNC 0.
    sync_id
        COB-ID of SYNC.
    bus_of
        Number of the bus of each joint's drive; empty: all on one bus.
    nodes
        Node ID of each joint's drive, if SDO requests are watched: a write to TPDO parameters makes the TPDOs suspect
        until :meth:`suspect` gives the time span.
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
        """Send times of the own SYNC producer (:meth:`SyncProducer.sent_at`); ``None`` if there is none."""
        self._asked_from = 0
        self._gaps = OpenGaps(self._joints)
        self._given = [0] * len(streams)
        self._totals = dict.fromkeys(
            [f"{s.name}.{what}" for s in streams for what in ("expected", "rows", "in_gaps", "discarded")], 0
        )

    @property
    def last_sync(self) -> int:
        """Number of the last SYNC known; -1 before the first."""
        return int(self._books.state[:, SYNC].max())

    @property
    def owed(self) -> int:
        """Largest number of SYNCs that a drive has not answered yet."""
        return int(self._debts().max())

    @property
    def owed_by_all(self) -> int:
        """Number of SYNCs that no drive has answered yet, in any stream: the bus or the host is delayed."""
        return max(int(self._debts().min()), 0)

    def _debts(self) -> NDArray[np.int64]:
        """Return the number of unanswered SYNCs, (streams, drives)."""
        debts: NDArray[np.int64] = self._books.head[self._books.bus_of].T - self._books.settled - self._books.pending
        return debts

    @property
    def wrong_lengths(self) -> dict[tuple[str, str], int]:
        """Number of TPDOs whose length differs from the mapping, by stream and joint, where not zero."""
        return {
            (self._streams[s].name, self._joints[j]): int(self._books.wrong[s, j])
            for s, j in np.argwhere(self._books.wrong > 0)
        }

    @property
    def counters(self) -> dict[str, int]:
        """Counters of frames, SYNCs and samples.

        Per stream, ``expected`` rows are ``rows`` (complete) or ``in_gaps``. ``discarded`` is the number of samples of
        single joints that were received for rows in gaps.
        """
        counts = dict(zip(COUNT_NAMES, (int(c) for c in self._books.counts), strict=True))
        return counts | self._totals

    def push(self, frames: NDArray[Any], sent: int | None = None, dropped: bool = False, bus: int = 0) -> Batch:
        """Match frames of one bus, in the order of reception.

        Parameters
        ----------
        frames
            Structured array (N,) with ``t_ns``, ``can_id``, ``length`` and ``data`` (8 or 64 bytes), as received.
        sent
            Number of SYNCs sent so far by the own producer, an upper limit for gaps; ``None``: another producer.
        dropped
            Frames of this bus were lost between the last call and the end of these, according to the kernel.
        bus
            Number of the bus.

        Returns
        -------
        Batch
            Rows and gaps that are certain now.

        Raises
        ------
        DataError
            If the SYNC counters of two buses do not agree.
        """
        arguments = (*_columns(frames), *self._timing, bus)
        self._lossy[bus] |= dropped
        if frames.size:
            # A bus with frames is not silent.
            self._books.slack[bus] = self._slack
        last = int(self._books.state[bus, SYNC])
        longest = self._longest if sent is None else min(self._longest, sent - last)
        if sent is not None and not self._lossy[bus]:
            # Own SYNCs are received unless the kernel drops frames: a long time is a delayed producer, no loss.
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
        """Get the send times of own SYNCs if frames are lost: a delayed producer keeps no period."""
        sent = self._books.sent
        sent[0] = -1
        if lossy and self.when_sent is not None:
            first, times = self.when_sent(self._asked_from)
            numbers = first + np.arange(times.size)[-SENT_AT:]
            self._books.sent_at[numbers % SENT_AT] = times[-SENT_AT:]
            sent[0] = self._asked_from = first + times.size

    def silence(self, bus: int, silent: bool) -> None:
        """Set whether a bus is known to be down: its drives have nothing to answer, and other buses do not wait for it.

        Parameters
        ----------
        bus
            Number of the bus.
        silent
            The bus is down.
        """
        self._books.slack[bus] = 0 if silent else self._slack
        self._lossy[bus] |= silent
        self.torn(bus)

    def torn(self, bus: int) -> None:
        """Note that frames of a bus may be missing after the last one, even if its SYNC counter is consecutive."""
        self._books.state[bus, TORN] = 1

    def suspect(self, joint: str, since_ns: int, until_ns: int) -> None:
        """Set the time span in which TPDOs of a joint may have another mapping than that of the session.

        Parameters
        ----------
        joint
            Name of the joint.
        since_ns, until_ns
            Begin and end, ns UTC.
        """
        span = self._books.suspect[self._joints.index(joint)]
        if span[0] < span[1] and span[1] == EVER:
            since_ns = min(since_ns, int(span[0]))
        span[:] = since_ns, until_ns

    def unseen(self, dropped: Sequence[int], now_ns: int) -> int:
        """Return the largest number of SYNCs that may have been sent after the last one received.

        Parameters
        ----------
        dropped
            Frames of each bus lost after the last one received, according to the kernel.
        now_ns
            Present time of the kernel's clock, ns UTC.
        """
        numbers, times = self._books.state[:, SYNC], self._books.state[:, TIME]
        known = times != NEVER
        periods = np.maximum(0, now_ns - times[known]) // self._timing[1]
        last = numbers[known] + np.minimum(np.asarray(dropped)[known], periods)
        return int(max(0, last.max(initial=self.last_sync) - self.last_sync))

    def finish(self, sent: int | None = None) -> Batch:
        """Return the remaining rows and gaps after the last frame.

        Parameters
        ----------
        sent
            Total number of SYNCs sent; ``None`` if unknown.
        """
        total = self.last_sync + 1 if sent is None else max(sent, self.last_sync + 1)
        out = output_buffers(self._books, total - self.last_sync)
        _finish(total, self._books, out)
        return self._batch(out, True)

    def warm_up(self, frames: NDArray[Any]) -> None:
        """Compile the loops for frames of this dtype, so that no SYNC waits for the compiler."""
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
        """Return the SYNCs since the last packed TPDO as a gap."""
        stream, first, last = self._streams[s], self._given[s], self.last_sync
        if first > last:
            return []
        self._totals[f"{stream.name}.expected"] += last - first + 1
        self._totals[f"{stream.name}.in_gaps"] += last - first + 1
        return [Gap(stream.name, first, last, None, UNSENT)]


# mypy checks numba functions by their Python signatures, which a tuple of columns does not match.
_match: Any = match
_count_sync: Any = count_sync
_finish: Any = finish


def _columns(frames: NDArray[Any]) -> tuple[Any, ...]:
    """Return the number of frames, and their identifiers, lengths, times and data (as 64-bit words)."""
    count = frames.size
    if count < 2:
        # Columns of fewer than two frames count as contiguous, which would compile the loops again.
        room = np.zeros(2, frames.dtype)
        room[:count] = frames
        frames = room
    return count, frames["can_id"], frames["length"], frames["t_ns"], frames["data"].view("<u8")


def _bytes(data: NDArray[np.uint64]) -> NDArray[np.uint8]:
    """Return 64-bit words (N, n, words) as the bytes (N, n, 8 words) they were read from."""
    return np.ascontiguousarray(data).view(np.uint8)
