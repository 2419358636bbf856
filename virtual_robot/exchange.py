"""PDO exchange of all drives, compiled: frames to set points and live values to frames."""

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from drivers.frames import frames
from drivers.objects import (
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
)
from virtual_robot.arm import Motion
from virtual_robot.node import FOLLOWING_ERROR, Drive

POSITION, CURRENT, DEMAND, STATUS, VELOCITY, ERROR, CONSTANT = range(7)
"""Rows of the live values; objects that do not move get rows of their own from ``CONSTANT`` on."""
LIVE = {
    POSITION_ACTUAL: POSITION,
    CURRENT_ACTUAL: CURRENT,
    TORQUE_ACTUAL: CURRENT,
    POSITION_DEMAND: DEMAND,
    STATUSWORD: STATUS,
    VELOCITY_ACTUAL: VELOCITY,
    FOLLOWING_ERROR: ERROR,
}
TARGET, CONTROL, IGNORED = range(3)
RECEIVED = {TARGET_POSITION: TARGET, CONTROLWORD: CONTROL}
IDENTIFIERS = 2048


@njit(cache=True, error_model="numpy")
def _answer(counter, kinds, first, row, drive, offset, size, values, due, data):  # type: ignore[no-untyped-def]
    """Write the data of every TPDO that is due at this SYNC; their numbers into ``due``, how many is returned."""
    count = 0
    for p in range(kinds.size):
        if counter % kinds[p]:
            continue
        for e in range(first[p], first[p + 1]):
            value = values[row[e], drive[e]]
            for b in range(size[e]):
                data[count, offset[e] + b] = np.uint8(value & 0xFF)
                value >>= 8
        due[count] = p
        count += 1
    return count


@njit(cache=True, error_model="numpy")
def _scan(ids, lengths, data, start, stop, table, need, stored, fresh, short):  # type: ignore[no-untyped-def]
    """Keep RPDOs from frame ``start`` on, up to the next SYNC; its place is returned, or ``stop``."""
    for k in range(start, stop):
        can_id = ids[k]
        if can_id == COB_SYNC:
            return k
        if can_id >= IDENTIFIERS:
            continue
        p = table[can_id]
        if p < 0:
            continue
        if lengths[k] < need[p]:
            short[p] += 1
            continue
        for b in range(8):
            stored[p, b] = data[k, b]
        fresh[p] = True
    return stop


@njit(cache=True, error_model="numpy")
def _accept(counter, kinds, stored, fresh, first, what, drive, offset, size, targets, targets_fresh, control):  # type: ignore[no-untyped-def]
    """Decode the RPDOs that act at this SYNC; returns whether there are targets (1) and controlwords (2)."""
    found = 0
    for p in range(kinds.size):
        if not fresh[p] or (0 < kinds[p] <= 240 and counter % kinds[p]):
            continue
        fresh[p] = False
        for e in range(first[p], first[p + 1]):
            if what[e] == IGNORED:
                continue
            value = np.int64(0)
            for b in range(size[e]):
                value |= np.int64(stored[p, offset[e] + b]) << (8 * b)
            if what[e] == TARGET:
                targets[drive[e]] = np.int32(value)
                targets_fresh[drive[e]] = True
                found |= 1
            else:
                control[drive[e]] = value
                found |= 2
    return found


class Exchange:
    """Tables of the PDOs as the drives have them mapped now, and the exchange at every SYNC.

    Parameters
    ----------
    drives
        The drives, in any order.
    motion
        What moves behind them.
    period
        SYNC period, s: velocity actual (606Ch) is a difference of positions over it.
    """

    def __init__(self, drives: Sequence[Drive], motion: Motion, period: float) -> None:
        n = motion.position.size
        self._drives, self._motion, self._period = drives, motion, period
        self._before = motion.position.copy()
        self._targets, self._targets_fresh = np.zeros(n, np.int32), np.zeros(n, np.bool_)
        self._control = np.full(n, -1, np.int64)
        self.rebuild()

    def rebuild(self) -> None:
        """Read mapping, NMT state and status of every drive again."""
        n = self._motion.position.size
        constants: list[NDArray[np.int64]] = []
        tx: list[tuple[int, int, list[tuple[int, int, int, int]]]] = []
        rx: list[tuple[int, int, list[tuple[int, int, int, int]]]] = []
        for drive in self._drives:
            j = drive.index
            if not drive.nmt.operational:
                continue
            for cob_id, kind, mapped in drive.pdos(TPDO_COMMUNICATION):
                if not 1 <= kind <= 240:
                    continue
                entries, offset = [], 0
                for index, subindex, size in mapped:
                    row = LIVE.get(index)
                    if row is None:
                        row = CONSTANT + len(constants)
                        raw = drive.get_data(index, subindex)
                        constants.append(np.full(n, int.from_bytes(raw, "little"), np.int64))
                    entries.append((row, j, offset, size))
                    offset += size
                tx.append((cob_id, kind, entries))
            for cob_id, kind, mapped in drive.pdos(RPDO_COMMUNICATION):
                entries, offset = [], 0
                for index, _, size in mapped:
                    entries.append((RECEIVED.get(index, IGNORED), j, offset, size))
                    offset += size
                rx.append((cob_id, kind, entries))
        self._tx_kinds, self._tx_first, self._tx = _flat(tx)
        self._tx_ids = np.array([cob_id for cob_id, _, _ in tx], np.uint32)
        self._tx_lengths = np.array([sum(e[3] for e in entries) for _, _, entries in tx], np.uint8)
        self._due = np.zeros(len(tx), np.int64)
        self._out = frames(len(tx))
        self._out_data = self._out["data"]
        self._rx_kinds, self._rx_first, self._rx = _flat(rx)
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
        self._fill()

    def refresh(self) -> None:
        """Take over what the motion has become."""
        self._fill()
        np.copyto(self._before, self._motion.position)

    def refresh_status(self) -> None:
        """Take over the statuswords."""
        for drive in self._drives:
            self.values[STATUS, drive.index] = drive.status

    def _fill(self) -> None:
        motion, values = self._motion, self.values
        values[POSITION] = motion.position
        values[CURRENT] = motion.current
        values[DEMAND] = motion.demand
        values[VELOCITY] = (motion.position - self._before) / self._period
        values[ERROR] = motion.demand - motion.position

    def scan(self, batch: NDArray[np.void], start: int, stop: int) -> int:
        """Take RPDOs from ``batch[start:stop]`` up to the next SYNC; its place, or ``stop``."""
        return int(
            _scan(
                batch["can_id"], batch["length"], batch["data"], start, stop,
                self._table, self._need, self._stored, self._fresh, self._short,
            )
        )  # fmt: skip

    def answer(self, counter: int) -> NDArray[np.void]:
        """Frames of the TPDOs due at the SYNC with this counter."""
        count = _answer(
            counter, self._tx_kinds, self._tx_first, *self._tx, self.values, self._due, self._out_data
        )  # fmt: skip
        out = self._out[:count]
        if count < self._due.size:
            out["can_id"] = self._tx_ids[self._due[:count]]
            out["length"] = self._tx_lengths[self._due[:count]]
        else:
            out["can_id"] = self._tx_ids
            out["length"] = self._tx_lengths
        return out

    def take_short(self) -> list[int]:
        """Joints whose RPDOs were ignored for having too few bytes since the last call."""
        joints = [self._rx_drive[p] for p in np.flatnonzero(self._short)]
        self._short[:] = 0
        return joints

    def accept(self, counter: int) -> None:
        """Let the RPDOs act that are due at the SYNC with this counter."""
        found = _accept(
            counter, self._rx_kinds, self._stored, self._fresh, self._rx_first, *self._rx,
            self._targets, self._targets_fresh, self._control,
        )  # fmt: skip
        if found & 1:
            self._motion.set_targets(self._targets, self._targets_fresh)
            self._targets_fresh[:] = False
        if found & 2:
            for drive in self._drives:
                word = int(self._control[drive.index])
                if word >= 0 and word != drive.control:
                    drive.obey(word)
                self._control[drive.index] = -1


Entries = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]


def _flat(
    pdos: Sequence[tuple[int, int, Sequence[tuple[int, int, int, int]]]],
) -> tuple[NDArray[np.int64], NDArray[np.int64], Entries]:
    """Transmission types, first entry of each PDO (one more than PDOs), and columns of all entries."""
    kinds = np.array([kind for _, kind, _ in pdos], np.int64)
    first = np.concatenate([[0], np.cumsum([len(entries) for _, _, entries in pdos])]).astype(np.int64)
    rows = np.array([e for _, _, entries in pdos for e in entries], np.int64).reshape(-1, 4)
    a, b, c, d = (np.ascontiguousarray(column) for column in rows.T)
    return kinds, first, (a, b, c, d)
