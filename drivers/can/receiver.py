"""Reception of all buses of a session in one thread: frames in batches, and events of the buses."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from armident.configs.errors import ArmidentError
from armident.drivers.can.error_frames import summarise
from armident.drivers.can.frames import ERROR_FLAG, BusDown, FrameBus, Frames, counts_by_length, frames

BATCH = 4096
"""Maximum number of frames per batch."""
DRAINS = 16
"""Maximum number of batches per bus that one call of `Receiver.drain` reads."""
RETRY_S = 0.1
"""Interval at which a bus that is down is checked, s."""
REPORT_ERRORS_S = 1.0
"""Interval at which errors of one bus are reported, s; changes of its state are reported at once."""

BusEventKind = Literal["bus_down", "bus_up", "bus_off", "bus_restarted", "bus_state", "bus_errors"]


@dataclass(frozen=True)
class BusEvent:
    """Event of a bus. ``text``: message that names the bus."""

    kind: BusEventKind
    bus: int
    text: str


class _BusState:
    """One bus: its socket, its state and the errors that are not reported yet."""

    def __init__(self, open_bus: Callable[[], FrameBus]) -> None:
        self.open = open_bus
        self.bus = open_bus()
        self.batch = frames(BATCH, fd=self.bus.fd)
        self.down_since: float | None = None
        self.checked = 0.0
        self.lost_before = 0
        self.errors: list[Frames] = []
        self.error_count = 0
        self.reported = 0.0
        self.traffic = counts_by_length(self.batch[:0])


class Receiver(AbstractContextManager["Receiver", None]):
    """Reads several buses in turn, each in whole batches.

    A bus that goes down or comes back is an event; it is reopened if its interface was removed. Error frames are taken
    out of the batches, counted, and reported as events.
    """

    def __init__(self, openers: Sequence[Callable[[], FrameBus]]) -> None:
        self._events: list[BusEvent] = []
        self._buses: list[_BusState] = []
        try:
            for opener in openers:
                self._buses.append(_BusState(opener))
        except BaseException:
            self.close()
            raise

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the buses."""
        return tuple(entry.bus.channel for entry in self._buses)

    @property
    def timestamp_sources(self) -> tuple[str, ...]:
        """Clock of each bus's time stamps: ``hardware`` or ``software``."""
        return tuple(entry.bus.timestamp_source for entry in self._buses)

    @property
    def dropped(self) -> int:
        """Number of frames dropped by the kernel, all buses."""
        return sum(entry.lost_before + entry.bus.drops() for entry in self._buses)

    @property
    def dropped_behind(self) -> tuple[int, ...]:
        """Number of frames of each bus that the kernel dropped after the last received one."""
        return tuple(entry.bus.drops() - entry.bus.dropped for entry in self._buses)

    @property
    def error_frames(self) -> int:
        """Number of error frames, all buses."""
        return sum(entry.error_count for entry in self._buses)

    @property
    def traffic(self) -> tuple[NDArray[np.int64], ...]:
        """Number of frames of each bus, as `counts_by_length`."""
        return tuple(entry.traffic for entry in self._buses)

    @property
    def down(self) -> tuple[bool, ...]:
        """``True`` for each bus that is down."""
        return tuple(entry.down_since is not None for entry in self._buses)

    @property
    def all_down_s(self) -> float:
        """Time for which all buses have been down, s; 0 if a bus is up."""
        since = [entry.down_since for entry in self._buses]
        latest = max((t for t in since if t is not None), default=0.0)
        return 0.0 if None in since else time.monotonic() - latest

    def warm_up(self) -> Frames:
        """Two empty frames of the received type, for the compilation of loops before the first frame."""
        return self._buses[0].batch[:2]

    def drain(self) -> Iterator[tuple[int, Frames, bool]]:
        """Yield bus number, frames (N,) valid until the next iteration, and whether the kernel dropped any before."""
        # Bounded, so that a bus faster than this loop cannot keep a capture from ending.
        for _ in range(DRAINS):
            more = False
            # All buses in every round, so that none falls behind by more than a batch.
            for k, entry in enumerate(self._buses):
                before = entry.bus.dropped
                got = self._receive(k, entry)
                more |= got == BATCH
                if got:
                    batch = self._without_errors(entry, entry.batch[:got])
                    entry.traffic += counts_by_length(batch)
                    yield k, batch, entry.bus.dropped > before
            if not more:
                return

    def events(self, *, last: bool = False) -> list[BusEvent]:
        """Events since the last call; errors are reported once per second, all remaining ones by the ``last`` call."""
        now = time.monotonic()
        for k, entry in enumerate(self._buses):
            if entry.down_since is not None and now - entry.checked >= RETRY_S:
                entry.checked = now
                self._check(k, entry)
            if entry.errors:
                self._report_errors(k, entry, now, last)
        pending, self._events = self._events, []
        return pending

    def _receive(self, k: int, entry: _BusState) -> int:
        try:
            got = entry.bus.receive(entry.batch)
            if got and entry.down_since is not None:
                self._report_up(k, entry)
            return got
        except BusDown as error:
            if entry.down_since is None:
                entry.down_since = entry.checked = time.monotonic()
                self._events.append(BusEvent("bus_down", k, str(error)))
            # Frames that arrived before are still readable.
            with suppress(BusDown):
                return entry.bus.receive(entry.batch)
        return 0

    def _check(self, k: int, entry: _BusState) -> None:
        if entry.bus.bound:
            if not entry.bus.up:
                return
        else:
            try:
                reopened = entry.open()
            except ArmidentError:
                return
            entry.lost_before += entry.bus.drops()
            entry.bus.close()
            entry.bus = reopened
        self._report_up(k, entry)

    def _report_up(self, k: int, entry: _BusState) -> None:
        assert entry.down_since is not None
        seconds = time.monotonic() - entry.down_since
        entry.down_since = None
        self._events.append(BusEvent("bus_up", k, f"bus {entry.bus.channel}: is back after {seconds:.1f} s"))

    def _without_errors(self, entry: _BusState, batch: Frames) -> Frames:
        bad = (batch["can_id"] & np.uint32(ERROR_FLAG)) != 0
        if not bad.any():
            return batch
        entry.errors.append(batch[bad])
        entry.error_count += int(np.count_nonzero(bad))
        good: Frames = batch[~bad]
        return good

    def _report_errors(self, k: int, entry: _BusState, now: float, last: bool) -> None:
        found = summarise(np.concatenate(entry.errors))
        if not last and all(state is None for state, _ in found) and now - entry.reported < REPORT_ERRORS_S:
            return
        entry.errors, entry.reported = [], now
        kinds: dict[str, BusEventKind] = {"bus_off": "bus_off", "restarted": "bus_restarted"}
        for state, text in found:
            kind: BusEventKind = "bus_errors" if state is None else kinds.get(state, "bus_state")
            self._events.append(BusEvent(kind, k, f"bus {entry.bus.channel}: {text}"))

    def close(self) -> None:
        """Release all buses."""
        for entry in self._buses:
            entry.bus.close()

    def __exit__(self, *_: object) -> None:
        """Release all buses."""
        self.close()
