"""Frames of a bus log in arrays, with everything that was left out and the reason for it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError
from armident.daq.interchange.clocks import newest_first
from armident.drivers.can.frames import FRAME, Frames

_BATCH = 65536
"""Frames that are kept as Python objects before they become an array."""
_ODD_STEP_NS = 1_000_000_000
"""A single time stamp that differs by more from both of its neighbours is not a time of its frame, ns."""
LATEST_NS = 9_000_000_000 * 1_000_000_000
"""Upper bound of times, ns: int64 holds those up to the year 2262."""


@dataclass(frozen=True)
class LogFrames:
    """Classic data frames (N,) with 11-bit identifiers, times in ns, the oldest first, and their buses (N,).

    ``lines`` (N,): line of each frame in a text log, else its number. ``foreign``: number of CAN FD, extended, remote
    and error frames; ``skipped``: number of lines or objects left out.
    """

    frames: Frames
    bus: NDArray[np.int64]
    lines: NDArray[np.int64]
    buses: tuple[str, ...]
    foreign: int
    notes: tuple[str, ...] = ()
    skipped: int = 0

    def of(self, path: Path, bus: str, several: bool) -> NDArray[np.bool_]:
        """Return the mask (N,) of the frames of one bus; if the session has one, that of the only bus in the log."""
        if len(self.buses) < 2 and not (self.buses and several):
            return np.ones(self.frames.size, np.bool_)
        if bus not in self.buses:
            raise ConfigError(
                f"{path}: holds the buses {', '.join(self.buses)}; the session's is {bus}: "
                "name the one to read as its channel (bus.channel)"
            )
        return np.asarray(self.bus == self.buses.index(bus), np.bool_)

    def buses_with(self, identifiers: Sequence[int]) -> list[str]:
        """Return the names of the buses with frames of all identifiers."""
        wanted = np.array(identifiers)
        own = [self.frames["can_id"][self.bus == number] for number in range(len(self.buses))]
        return [name for name, found in zip(self.buses, own, strict=True) if np.isin(wanted, found).all()]


@dataclass
class FrameCollector:
    """Collects the frames of a log, and counts what it leaves out."""

    foreign: int = 0
    skipped: int = 0
    notes: list[str] = field(default_factory=list)
    line: int = 0
    """Line that is read, in a text log."""
    _numbers: dict[str, int] = field(default_factory=dict)
    _rows: list[tuple[int, int, bytes, int, int]] = field(default_factory=list)
    _parts: list[tuple[Frames, NDArray[np.int64], NDArray[np.int64]]] = field(default_factory=list)
    _done: int = 0

    @property
    def count(self) -> int:
        """Number of frames so far."""
        return self._done + len(self._rows)

    def add(self, t_ns: int, can_id: int, data: bytes, channel: str) -> None:
        """Add a classic data frame with an 11-bit identifier and at most eight bytes."""
        number = self._numbers.setdefault(channel, len(self._numbers))
        self._rows.append((t_ns, can_id, data, number, self.line or self.count + 1))
        if len(self._rows) >= _BATCH:
            self._flush()

    def length_of(self, can_id: int) -> int | None:
        """Return the length of the frame before the last one with an identifier; ``None`` if there is none."""
        self._flush()
        joined = np.concatenate([part[0] for part in self._parts]) if self._parts else np.zeros(0, FRAME)
        rows = np.flatnonzero(joined["can_id"] == can_id)
        return int(joined["length"][rows[-2]]) if rows.size > 1 else None

    def last(self) -> tuple[int, int] | None:
        """Return identifier and length of the last frame."""
        self._flush()
        return (int(self._parts[-1][0]["can_id"][-1]), int(self._parts[-1][0]["length"][-1])) if self._parts else None

    def drop_last(self) -> None:
        """Leave out the last frame."""
        self._flush()
        frames, bus, lines = self._parts[-1]
        self._parts[-1] = (frames[:-1], bus[:-1], lines[:-1])

    def finish(self, path: Path, added_up: bool | None = None) -> LogFrames:
        """Return the frames; DataError without any. ``added_up``: each time is the time since the frame before."""
        self._flush()
        if not self._parts or not sum(part[0].size for part in self._parts):
            others = f", only {self.foreign} CAN FD, extended, remote or error frames" if self.foreign else ""
            raise DataError(f"{path}: no data frames with 11-bit identifiers in it{others}")
        frames, bus, lines = (np.concatenate(parts) for parts in zip(*self._parts, strict=True))
        if newest_first(frames):
            frames, bus, lines = frames[::-1].copy(), bus[::-1], lines[::-1]
            self.notes.append("the newest frame comes first: read from the last line to the first")
        if added_up is None and _are_differences(frames["t_ns"]):
            frames["t_ns"] = np.cumsum(frames["t_ns"])
            self.notes.append("times are those since the frame before (candump -td): added up")
        # Times before a trigger are negative.
        frames["t_ns"] -= min(0, int(frames["t_ns"].min()))
        odd = _odd_times(frames["t_ns"])
        if odd.any():
            first, count = int(np.flatnonzero(odd)[0]) + 1, int(odd.sum())
            self.notes.append(
                f"frames left out because their time is far from that of both neighbours: {count}, the first is {first}"
            )
            self.skipped += count
            frames, bus, lines = frames[~odd], bus[~odd], lines[~odd]
        return LogFrames(frames, bus, lines, tuple(self._numbers), self.foreign, tuple(self.notes), self.skipped)

    def _flush(self) -> None:
        if not self._rows:
            return
        batch = np.zeros(len(self._rows), FRAME)
        t_ns, can_id, data, number, lines = zip(*self._rows, strict=True)
        batch["t_ns"], batch["can_id"] = t_ns, can_id
        batch["length"] = [len(octets) for octets in data]
        batch["data"] = np.frombuffer(b"".join(octets.ljust(8, b"\0") for octets in data), np.uint8).reshape(-1, 8)
        self._parts.append((batch, np.array(number, np.int64), np.array(lines, np.int64)))
        self._done += len(self._rows)
        self._rows.clear()


_LATEST_DIFFERENCE_NS = 1_000_000 * 1_000_000_000
"""Times above 11 days are those of a clock, not differences."""
_DESCENDING_SHARE = 0.05
"""Share of frames earlier than the one before above which times are differences, of which about half are earlier."""


def _are_differences(t_ns: NDArray[np.int64]) -> bool:
    """Return ``True`` if each time is the time since the frame before."""
    if t_ns.size < 3 or t_ns.max() > _LATEST_DIFFERENCE_NS:
        return False
    steps = np.diff(t_ns)
    constant = bool(np.all(steps[1:] == 0) and t_ns[1] > 0)
    return constant or float(np.mean(steps < 0)) > _DESCENDING_SHARE


def _odd_times(t_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return the frames whose time is far from both neighbours, which agree with each other, (N,)."""
    odd = np.zeros(t_ns.size, np.bool_)
    if t_ns.size > 2:
        steps = np.abs(np.diff(t_ns))
        around = np.abs(t_ns[2:] - t_ns[:-2])
        odd[1:-1] = (steps[:-1] > _ODD_STEP_NS) & (steps[1:] > _ODD_STEP_NS) & (around < _ODD_STEP_NS)
    return odd


def nanoseconds(seconds: str, fraction: str | None) -> int | None:
    """Return a time in ns from its digits before and after the decimal point; ``None`` if it is impossible."""
    t_ns = int(seconds.lstrip("-")[:11]) * 1_000_000_000 + int((fraction or "0")[:9].ljust(9, "0"))
    return None if t_ns >= LATEST_NS else -t_ns if seconds.startswith("-") else t_ns
