"""Compiled PDO exchange of all drives: RPDOs to set points and live values to TPDOs."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.compiled import PLAIN, compiled
from armident.drivers.can.frames import BIT_RATE_SWITCH, FD_FLAG, fd_length, frames
from armident.drivers.canopen.objects import (
    ARRAY_OFFSET,
    COB_SYNC,
    CONTROLWORD,
    CURRENT_ACTUAL,
    POSITION_ACTUAL,
    POSITION_DEMAND,
    RPDO_COMMUNICATION,
    STATUSWORD,
    TARGET_POSITION,
    TORQUE_ACTUAL,
    TPDO_COMMUNICATION,
    VELOCITY_ACTUAL,
    DriveState,
)
from armident.virtual_robot.arm import DriveBackend
from armident.virtual_robot.node import FOLLOWING_ERROR, Drive

POSITION, CURRENT, DEMAND, STATUS, VELOCITY, ERROR, CONSTANT = range(7)
"""Rows of the live values; objects with constant values follow from row ``CONSTANT`` on."""
LIVE = {
    POSITION_ACTUAL: POSITION,
    CURRENT_ACTUAL: CURRENT,
    TORQUE_ACTUAL: CURRENT,
    POSITION_DEMAND: DEMAND,
    STATUSWORD: STATUS,
    VELOCITY_ACTUAL: VELOCITY,
    FOLLOWING_ERROR: ERROR,
}
"""Row of the live values by object."""
TARGET, CONTROL, IGNORED = range(3)
"""Kinds of received objects."""
RECEIVED = {TARGET_POSITION: TARGET, CONTROLWORD: CONTROL}
"""Kind of a received object by its index."""
IDENTIFIERS = 2048
"""Number of 11-bit identifiers."""
HISTORY = 64
"""Number of SYNCs whose live values are kept for packed samples."""


@compiled(
    "u4[:], u1[:], u1[:, :], i8, i8, i8, f8, i4[::1], i4[::1], i2[::1], i4[::1], i8[:, ::1], i8[:, :, ::1], "
    "i8[::1], i8[::1], i8[::1], i8[::1], i8[::1], i8[::1], i8[::1], i8[::1], i8[::1], u4[::1], u1[::1], u4[:], u1[:], "
    "u1[:, :], "
    "i8[::1], i8[::1], i8[::1], i8[::1], i8[::1], i8[::1], i8[::1], i8[::1], u1[:, ::1], b1[::1], i8[::1], "
    "i4[::1], b1[::1], i8[::1], i8[::1]",
    **PLAIN,
)
def _exchange(  # type: ignore[no-untyped-def]
    ids, lengths, data, start, stop, sequence, period, position, before, current, demand, values, history,
    tx_kinds, tx_pause, tx_sent, tx_first, tx_row, tx_drive, tx_offset, tx_size, tx_back, tx_ids, tx_lengths,
    out_ids, out_lengths, out_data,
    rx_kinds, rx_first, rx_what, rx_drive, rx_offset, rx_size, table, need, stored, fresh, short,
    targets, targets_fresh, control, result,
):  # fmt: skip
    """Process frames from ``start`` on up to the next SYNC and answer it; return its index, or ``stop``.

    ``sequence``: counter of a SYNC without one. ``result`` (3,): frames to send, bits for set points (1) and
    controlwords (2) that take effect now, and SYNCs. ``history`` keeps live values; an entry sends those of ``tx_back``
    SYNCs ago. A TPDO is dropped within ``tx_pause`` SYNCs after the one of SYNC ``tx_sent``.
    """
    at = stop
    for k in range(start, stop):
        if ids[k] == COB_SYNC:
            at = k
            break
        if ids[k] >= IDENTIFIERS or table[ids[k]] < 0:
            continue
        p = table[ids[k]]
        if lengths[k] < need[p]:
            short[p] += 1
            continue
        for b in range(8):
            stored[p, b] = data[k, b]
        fresh[p] = True
    result[0] = result[1] = 0
    if at == stop:
        return at
    counter = np.int64(data[at, 0]) if lengths[at] else np.int64(sequence)

    for j in range(position.size):
        values[POSITION, j] = position[j]
        values[CURRENT, j] = current[j]
        values[DEMAND, j] = demand[j]
        values[VELOCITY, j] = np.int64((position[j] - before[j]) / period)
        values[ERROR, j] = np.int64(demand[j]) - position[j]
        before[j] = position[j]
    result[2] += 1
    for row in range(CONSTANT):
        for j in range(position.size):
            history[result[2] % HISTORY, row, j] = values[row, j]
    count = 0
    for p in range(tx_kinds.size):
        if counter % tx_kinds[p] or result[2] - tx_sent[p] < tx_pause[p]:
            continue
        tx_sent[p] = result[2]
        out_ids[count] = tx_ids[p]
        out_lengths[count] = tx_lengths[p]
        for e in range(tx_first[p], tx_first[p + 1]):
            if tx_back[e] > 0:
                value = history[(result[2] - tx_back[e]) % HISTORY, tx_row[e], tx_drive[e]]
            else:
                value = values[tx_row[e], tx_drive[e]]
            for b in range(tx_size[e]):
                out_data[count, tx_offset[e] + b] = np.uint8(value & 0xFF)
                value >>= 8
        count += 1
    result[0] = count

    for p in range(rx_kinds.size):
        if not fresh[p] or (0 < rx_kinds[p] <= 240 and counter % rx_kinds[p]):
            continue
        fresh[p] = False
        for e in range(rx_first[p], rx_first[p + 1]):
            value = np.int64(0)
            for b in range(rx_size[e]):
                value |= np.int64(stored[p, rx_offset[e] + b]) << (8 * b)
            if rx_what[e] == TARGET:
                targets[rx_drive[e]] = np.int32(value)
                targets_fresh[rx_drive[e]] = True
                result[1] |= 1
            elif rx_what[e] == CONTROL:
                control[rx_drive[e]] = value
                result[1] |= 2
    return at


class Exchange:
    """PDO exchange at every SYNC by the present mapping of drives; velocity (606Ch): difference over the period, s."""

    def __init__(self, drives: Sequence[Drive], motion: DriveBackend, period: float) -> None:
        n = motion.position.size
        self._drives, self._motion, self._period = drives, motion, period
        self._before = motion.position.copy()
        self._targets, self._targets_fresh = np.zeros(n, np.int32), np.zeros(n, np.bool_)
        self._control = np.full(n, -1, np.int64)
        self._result = np.zeros(3, np.int64)
        self._history = np.zeros((HISTORY, CONSTANT, n), np.int64)
        self.fd = any(drive.fd for drive in drives)
        """``True`` if the TPDOs are CAN FD frames."""
        self._follows = np.zeros(n, np.bool_)
        self.out = frames(0, fd=self.fd)
        """Frames that answer the last SYNC."""
        self.rebuild()

    def rebuild(self) -> None:
        """Rebuild the tables from mapping, NMT state and status of every drive."""
        n = self._motion.position.size
        constants: list[NDArray[np.int64]] = []
        tx: list[Pdo] = []
        pauses: list[int] = []
        rx: list[Pdo] = []
        for drive in self._drives:
            j = drive.index
            if not drive.nmt.operational:
                continue
            inhibited = drive.inhibit_times()
            for cob_id, kind, mapped in drive.pdos(TPDO_COMMUNICATION):
                if not 1 <= kind <= 240:
                    continue
                entries: list[tuple[int, ...]] = []
                offset = 0
                for index, subindex, size in mapped:
                    row, back = LIVE.get(index), 0
                    if row is None and subindex and index + ARRAY_OFFSET in LIVE:
                        row, back = LIVE[index + ARRAY_OFFSET], kind - subindex
                    elif row is None:
                        row = CONSTANT + len(constants)
                        raw = drive.get_data(index, subindex)
                        constants.append(np.full(n, int.from_bytes(raw, "little"), np.int64))
                    entries.append((row, j, offset, size, back))
                    offset += size
                tx.append((cob_id, kind, entries))
                pauses.append(math.ceil(inhibited.get(cob_id, 0.0) / self._period - 1e-6))
            for cob_id, kind, mapped in drive.pdos(RPDO_COMMUNICATION):
                entries, offset = [], 0
                for index, _, size in mapped:
                    entries.append((RECEIVED.get(index, IGNORED), j, offset, size))
                    offset += size
                rx.append((cob_id, kind, entries))
        self._tx_kinds, self._tx_first, self._tx = _flat(tx, 5)
        self._tx_pause = np.array(pauses, np.int64)
        self._tx_sent = self._result[2] - self._tx_pause
        self._tx_ids = np.array([cob_id for cob_id, _, _ in tx], np.uint32)
        sizes = [sum(e[3] for e in entries) for _, _, entries in tx]
        self._tx_lengths = np.array([fd_length(size) if self.fd else size for size in sizes], np.uint8)
        # At least two frames: smaller arrays count as contiguous and would need another compilation.
        self._out = frames(max(len(tx), 2), fd=self.fd)
        if self.fd:
            self._out["flags"] = FD_FLAG | BIT_RATE_SWITCH
        self._rx_kinds, self._rx_first, self._rx = _flat(rx, 4)
        self._table = np.full(IDENTIFIERS, -1, np.int64)
        for p, (cob_id, _, _) in enumerate(rx):
            self._table[cob_id] = p
        self._need = np.array([sum(e[3] for e in entries) for _, _, entries in rx], np.int64)
        self._stored, self._fresh = np.zeros((len(rx), 8), np.uint8), np.zeros(len(rx), np.bool_)
        self._short = np.zeros(len(rx), np.int64)
        self._rx_drive = [entries[0][1] if entries else -1 for _, _, entries in rx]
        values = np.zeros((CONSTANT + len(constants), n), np.int64)
        values[CONSTANT:] = np.array(constants).reshape(-1, n)
        self.values = values
        self.refresh_status()
        self._arrange()

    def refresh_status(self) -> None:
        """Update the statuswords; only enabled drives follow set points (a quick stop holds the last one)."""
        for drive in self._drives:
            self.values[STATUS, drive.index] = drive.status
            self._follows[drive.index] = drive.state is DriveState.ENABLED

    def _arrange(self) -> None:
        """Collect the arguments of the compiled exchange, once per mapping."""
        motion, out = self._motion, self._out
        self._arguments = (
            self._period, motion.position, self._before, motion.current, motion.demand, self.values, self._history,
            self._tx_kinds, self._tx_pause, self._tx_sent, self._tx_first, *self._tx, self._tx_ids, self._tx_lengths,
            out["can_id"], out["length"], out["data"],
            self._rx_kinds, self._rx_first, *self._rx, self._table, self._need, self._stored, self._fresh, self._short,
            self._targets, self._targets_fresh, self._control, self._result,
        )  # fmt: skip

    def take(self, ids: Any, lengths: Any, data: Any, start: int, stop: int, sequence: int) -> int:
        """Process frames up to the next SYNC, and return its index, or ``stop`` if there is none.

        Then `out` holds its answers, and `act` applies its set points. Frames: fields (N,), (N,) and (N, 8) or (N, 64).
        """
        at = int(_exchange(ids, lengths, data, start, stop, sequence, *self._arguments))
        self.out = self._out[: self._result[0]]
        return at

    def take_short(self) -> list[int]:
        """Joints with RPDOs that were ignored since the last call because they were too short."""
        joints = [self._rx_drive[p] for p in np.flatnonzero(self._short)]
        self._short[:] = 0
        return joints

    def act(self) -> None:
        """Apply the RPDOs that take effect at the last SYNC."""
        found = self._result[1]
        if found & 1:
            self._motion.set_targets(self._targets, self._targets_fresh & self._follows)
            self._targets_fresh[:] = False
        if found & 2:
            for drive in self._drives:
                word = int(self._control[drive.index])
                if word >= 0 and word != drive.control:
                    drive.apply_controlword(word)
                self._control[drive.index] = -1


Pdo = tuple[int, int, Sequence[tuple[int, ...]]]
"""COB-ID, transmission type, and entries of one PDO."""


def _flat(
    pdos: Sequence[Pdo], width: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], tuple[NDArray[np.int64], ...]]:
    """Transmission types, first entry of each PDO (one more than PDOs), and the ``width`` columns of all entries."""
    kinds = np.array([kind for _, kind, _ in pdos], np.int64)
    first = np.concatenate([[0], np.cumsum([len(entries) for _, _, entries in pdos])]).astype(np.int64)
    rows = np.array([e for _, _, entries in pdos for e in entries], np.int64).reshape(-1, width)
    return kinds, first, tuple(np.ascontiguousarray(column) for column in rows.T)
