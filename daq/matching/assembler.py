"""Assembles bus frames into rows per SYNC; every SYNC is either received or in the gap list."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError
from armident.daq.matching.gaps import SYNC_LOST, OpenGaps
from armident.daq.matching.pdo_matching import OPEN_END, count_sync, finish, match
from armident.daq.matching.state import (
    COUNT_NAMES,
    COUNTER,
    INCOMPLETE,
    NEVER,
    ORIGIN,
    PENDING,
    RECEIVED,
    SEND_TIMES,
    SETTLED,
    SYNC,
    SYNC_MISALIGNED,
    TIME,
    TOP,
    WRONG_LENGTHS,
    MatchedSamples,
    StreamShape,
    new_state,
    output_buffers,
)
from armident.daq.recording import Gap
from armident.drivers.canopen.objects import COB_SDO_REQUEST, COB_SYNC

INCOMPLETE_PACK = "pack not complete"
"""Reason of the gap after the last packed TPDO: no drive had to send these samples."""
__all__ = ["INCOMPLETE_PACK", "LATE_S", "SYNC_LOST", "Assembler", "Batch", "Rows", "TpdoStream"]

LATE_S = 4.0
"""Time after which a missing answer counts as lost while other drives have answered, s."""
IN_STEP_S = 0.02
"""The same if the drive answers every SYNC again beside a drive without missing answers, s; twice that if it is silent.

Rows wait in memory for this time; a killed process loses them."""
ALL_BEHIND_S = 120.0
"""The same if all drives lag and no frame is known to be missing, s: a busy host can delay virtual drives.

Only a SYNC without missing answers proves that nothing was lost, so answers since the last such SYNC are kept."""
_FEWEST_LATE = 8
_LONGEST_OUTAGE_S = 60.0
_MISALIGNED = 20
"""Number of mismatched first SYNCs of a bus that proves another master; fewer are explained by late time stamps."""


@dataclass(frozen=True)
class TpdoStream:
    """TPDOs of a stream, a sample per ``every`` SYNCs; frames hold ``pack`` samples of ``size`` bytes (0: all)."""

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
    """Complete rows: SYNC numbers (N,), their receive times (N,), ns UTC, bytes by joint (N, n, 8) or wider."""

    sync: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    data: NDArray[np.uint8]


@dataclass(frozen=True)
class Batch:
    """Complete rows and ended gaps; ``certain``: SYNC by stream before which all rows are complete or in a gap."""

    rows: dict[str, Rows]
    gaps: tuple[Gap, ...]
    certain: dict[str, int]


class Assembler:
    """Matches SYNC and TPDO frames; the division of a bus's frames into batches does not matter.

    Drives on several buses are compared as far as these have been read: the time of reading decides if late answers are
    assigned, or a gap ``ambiguous order``. ``overflow``: of the SYNC counter (CiA 301, 1019h; 0: none).
    ``first_counter``: of SYNC 0; ``None``: the first received. ``bus_of`` empty: all on one. ``nodes``: if SDO requests
    are watched: a write to TPDO parameters makes TPDOs unverified until :meth:`mark_unverified`.
    """

    def __init__(
        self,
        streams: Sequence[TpdoStream],
        joints: Sequence[str],
        period_ns: int,
        overflow: int = 240,
        first_counter: int | None = 1,
        bus_of: Sequence[int] = (),
        nodes: Sequence[int] = (),
    ) -> None:
        self._streams, self._joints = tuple(streams), tuple(joints)
        self._timing = COB_SYNC, period_ns, overflow
        self._longest_gap = int(_LONGEST_OUTAGE_S * 1e9 / period_ns)
        buses = tuple(bus_of) or (0,) * len(joints)
        channel_of = np.full((max(buses) + 1, 0x800), -1, np.int64)
        for s, stream in enumerate(streams):
            for j, cob_id in enumerate(stream.cob_ids):
                channel_of[buses[j], cob_id] = s * len(joints) + j
        writes_to = np.full((max(buses) + 1, 0x800), -1, np.int64)
        for j, node in enumerate(nodes):
            writes_to[buses[j], COB_SDO_REQUEST + node] = j
        self._shapes = [stream.shape for stream in streams]
        window, long_window, short_window = (
            [max(_FEWEST_LATE, int(seconds * 1e9 / period_ns) // shape.every) for shape in self._shapes]
            for seconds in (LATE_S, ALL_BEHIND_S, IN_STEP_S)
        )
        self._state = new_state(self._shapes, window, long_window, short_window, buses, channel_of, writes_to)
        self._slack = int(self._state.slack[0])
        if first_counter is not None:
            self._state.bus_state[:, COUNTER] = (first_counter - 1) % overflow if overflow else -1
            self._state.bus_state[:, ORIGIN] = first_counter
        self._lossy = np.zeros(len(channel_of), bool)
        self.send_times: Callable[[int], tuple[int, NDArray[np.int64]]] | None = None
        """Returns the send times of the own SYNC producer (:meth:`SyncProducer.sent_at`); ``None`` without one."""
        self._sends_loaded = 0
        self._gaps = OpenGaps(self._joints)
        self._emitted = [0] * len(streams)
        self._totals = dict.fromkeys(
            [f"{s.name}.{what}" for s in streams for what in ("expected", "rows", "in_gaps", "discarded")], 0
        )

    def ignore_counter(self) -> None:
        """Take SYNC as one without a counter; call it before the first frame."""
        self._timing = (*self._timing[:2], 0)
        self._state.bus_state[:, COUNTER] = -1

    @property
    def has_counter(self) -> bool:
        """True if SYNC with a counter was received, or is sent by this program."""
        return bool((self._state.bus_state[:, COUNTER] >= 0).any())

    @property
    def last_sync(self) -> int:
        """Number of the last SYNC known; -1 before the first."""
        return int(self._state.bus_state[:, SYNC].max())

    @property
    def outstanding(self) -> int:
        """Largest number of outstanding answers of a drive, SYNCs."""
        return int(self._outstanding().max())

    @property
    def outstanding_by_all(self) -> int:
        """Number of SYNCs that no drive has answered yet, in any stream; above zero the bus or the host is delayed."""
        return max(int(self._outstanding().min()), 0)

    def _outstanding(self) -> NDArray[np.int64]:
        """Return the number of outstanding answers, (streams, drives)."""
        drives = self._state.drives
        outstanding: NDArray[np.int64] = (
            self._state.head[self._state.bus_of].T - drives[:, :, SETTLED] - drives[:, :, PENDING]
        )
        return outstanding

    @property
    def wrong_lengths(self) -> dict[tuple[str, str], int]:
        """Number of TPDOs whose length differs from the mapping, by stream and joint, where not zero."""
        counts = self._state.drives[:, :, WRONG_LENGTHS]
        return {(self._streams[s].name, self._joints[j]): int(counts[s, j]) for s, j in np.argwhere(counts > 0)}

    @property
    def counters(self) -> dict[str, int]:
        """Counters of frames, SYNCs and samples; ``discarded``: samples of single joints received for rows in gaps."""
        counts = dict(zip(COUNT_NAMES, (int(c) for c in self._state.counts), strict=True))
        return counts | self._totals

    def push(self, frames: NDArray[Any], sent: int | None = None, dropped: bool = False, bus: int = 0) -> Batch:
        """Match frames (N,) of one bus in the order of reception; return rows and gaps that are certain now.

        ``sent``: SYNCs sent so far by the own producer, or ``None``. ``dropped``: frames of this bus were lost since
        the last call. Raises DataError if the SYNC counters of two buses do not agree.
        """
        arguments = (*_columns(frames), *self._timing, bus)
        self._lossy[bus] |= dropped
        if frames.size:
            # A bus with frames is not silent.
            self._state.slack[bus] = self._slack
        last = int(self._state.bus_state[bus, SYNC])
        longest = self._longest_gap if sent is None else min(self._longest_gap, sent - last)
        if sent is not None and not self._lossy[bus]:
            # Own SYNCs are received unless the kernel drops frames: a long interval is a delayed producer, no loss.
            longest = 0
        self._load_send_times(self._lossy[bus])
        if dropped:
            self._state.bus_state[bus, INCOMPLETE] = 2
        syncs = _count_sync(*arguments, longest, self._state.bus_state.copy(), self._state)
        if dropped:
            self._state.gap_end[bus] = self._state.watermark[:, TOP] + syncs + 1
        out = output_buffers(self._state, syncs)
        _match(*arguments, longest, self._state, out)
        if dropped:
            self.mark_incomplete(bus)
        if self._state.counts[SYNC_MISALIGNED] >= _MISALIGNED:
            raise DataError(
                f"bus {bus + 1}: its SYNC counter differs from that of another bus at the same time; "
                "connect all buses of the session to one SYNC master"
            )
        return self._batch(out, False)

    def _load_send_times(self, lossy: bool) -> None:
        """Load the send times of own SYNCs if frames are lost, since a delayed producer keeps no period."""
        sent = self._state.sends_known
        sent[0] = -1
        if lossy and self.send_times is not None:
            first, times = self.send_times(self._sends_loaded)
            numbers = first + np.arange(times.size)[-SEND_TIMES:]
            self._state.send_times[numbers % SEND_TIMES] = times[-SEND_TIMES:]
            sent[0] = self._sends_loaded = first + times.size

    def set_bus_down(self, bus: int, down: bool) -> None:
        """Mark a bus as down or up; while it is down, its drives have nothing to answer and no bus waits for it."""
        self._state.slack[bus] = 0 if down else self._slack
        self._lossy[bus] |= down
        self.mark_incomplete(bus)

    def mark_incomplete(self, bus: int) -> None:
        """Note that frames of a bus may be missing after the last one, even if its SYNC counter is consecutive."""
        self._state.bus_state[bus, INCOMPLETE] = 1

    def mark_unverified(self, joint: str, since_ns: int, until_ns: int) -> None:
        """Set the time span, ns UTC, in which TPDOs of a joint may have another mapping than the session."""
        span = self._state.unverified[self._joints.index(joint)]
        if span[0] < span[1] and span[1] == OPEN_END:
            since_ns = min(since_ns, int(span[0]))
        span[:] = since_ns, until_ns

    def most_unreceived(self, dropped: Sequence[int], now_ns: int) -> int:
        """Return the most SYNCs that may follow the last one received, by each bus's ``dropped`` frames and ns UTC."""
        numbers, times = self._state.bus_state[:, SYNC], self._state.bus_state[:, TIME]
        known = times != NEVER
        periods = np.maximum(0, now_ns - times[known]) // self._timing[1]
        last = numbers[known] + np.minimum(np.asarray(dropped)[known], periods)
        return int(max(0, last.max(initial=self.last_sync) - self.last_sync))

    def finish(self, sent: int | None = None) -> Batch:
        """Return the remaining rows and gaps after the last frame; ``sent``: number of SYNCs, if it is known."""
        total = self.last_sync + 1 if sent is None else max(sent, self.last_sync + 1)
        out = output_buffers(self._state, total - self.last_sync)
        _finish(total, self._state, out)
        return self._batch(out, True)

    def warm_up(self, frames: NDArray[Any]) -> None:
        """Compile the loops for frames of this dtype, so that no SYNC waits for the compiler."""
        windows = [_FEWEST_LATE] * len(self._shapes)
        no_channel = np.full((self._lossy.size, 1), -1, np.int64)
        scratch = new_state(
            self._shapes, windows, windows, windows, self._state.bus_of.tolist(), no_channel, no_channel
        )
        arguments = (*_columns(frames), *self._timing, 0)
        out = output_buffers(scratch, _count_sync(*arguments, self._longest_gap, scratch.bus_state.copy(), scratch))
        _match(*arguments, self._longest_gap, scratch, out)
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
                self._emitted[s] = int(sync[-1]) + 1
            if final and stream.pack > 1:
                gaps += self._incomplete_pack(s)
            gaps += self._gaps.ended(stream.name, int(sync[-1]) if sync.size else None, final)
        certain = {
            stream.name: emitted - 1 + stream.every if emitted else 0
            for stream, emitted in zip(self._streams, self._emitted, strict=True)
        }
        return Batch(rows, tuple(sorted(gaps, key=lambda g: (g.first, g.stream, g.joint or ""))), certain)

    def _incomplete_pack(self, s: int) -> list[Gap]:
        """Return the SYNCs since the last packed TPDO as a gap."""
        stream, first, last = self._streams[s], self._emitted[s], self.last_sync
        if first > last:
            return []
        self._totals[f"{stream.name}.expected"] += last - first + 1
        self._totals[f"{stream.name}.in_gaps"] += last - first + 1
        return [Gap(stream.name, first, last, None, INCOMPLETE_PACK)]


# mypy checks numba functions by their Python signatures, which a tuple of columns does not match.
_match: Any = match
_count_sync: Any = count_sync
_finish: Any = finish


def _columns(frames: NDArray[Any]) -> tuple[Any, ...]:
    """Return the number of frames, and their identifiers, lengths, times and data (as 64-bit words)."""
    count = frames.size
    if count < 2:
        # Columns of fewer than two frames count as contiguous, which would compile the loops again.
        padded = np.zeros(2, frames.dtype)
        padded[:count] = frames
        frames = padded
    return count, frames["can_id"], frames["length"], frames["t_ns"], frames["data"].view("<u8")


def _bytes(data: NDArray[np.uint64]) -> NDArray[np.uint8]:
    """Return 64-bit words (N, n, words) as the bytes (N, n, 8 words) they were read from."""
    return np.ascontiguousarray(data).view(np.uint8)
