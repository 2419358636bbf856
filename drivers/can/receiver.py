"""All buses of a session read by one thread: frames in batches, and what happens to the buses themselves."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from armident.configs.errors import ArmidentError
from armident.drivers.can.error_frames import summarise
from armident.drivers.can.frames import ERROR_FLAG, BusDown, FrameBus, Frames, frames

BATCH = 4096
DRAINS = 16
"""Batches taken in a row from each bus before anything else is looked at."""
LOOK_AGAIN_S = 0.1
"""How often a bus that is down is looked at."""
TELL_ERRORS_S = 1.0
"""Errors of one bus are told together this often; changes of its state at once."""

BusEventKind = Literal["bus_down", "bus_up", "bus_off", "bus_restarted", "bus_state", "bus_errors"]


@dataclass(frozen=True)
class BusEvent:
    """Something that happened to a bus, not on it."""

    kind: BusEventKind
    bus: int
    text: str


class _Line:
    """One bus: its socket, whether it is up, and errors not told yet."""

    def __init__(self, open_bus: Callable[[], FrameBus]) -> None:
        self.open = open_bus
        self.bus = open_bus()
        self.batch = frames(BATCH, fd=self.bus.fd)
        self.down_since: float | None = None
        self.looked = 0.0
        self.lost_before = 0
        self.errors: list[Frames] = []
        self.error_count = 0
        self.told = 0.0


class Receiver:
    """Reads several buses, one after the other, each in whole batches.

    A bus that goes down is an event, and so is its return: its socket stays, or is opened anew where the interface
    itself was removed. Error frames are taken out, counted, and told as events.

    Parameters
    ----------
    openers
        Open one bus each.

    Raises
    ------
    ConfigError, BusDown
        As the buses do when they are opened.
    """

    def __init__(self, openers: Sequence[Callable[[], FrameBus]]) -> None:
        self._events: list[BusEvent] = []
        self._lines: list[_Line] = []
        try:
            for opener in openers:
                self._lines.append(_Line(opener))
        except BaseException:
            self.close()
            raise

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the buses."""
        return tuple(line.bus.channel for line in self._lines)

    @property
    def stamps(self) -> tuple[str, ...]:
        """Whose clock stamps the frames of each bus."""
        return tuple(line.bus.stamps for line in self._lines)

    @property
    def dropped(self) -> int:
        """Frames that the kernel dropped, of all buses."""
        return sum(line.lost_before + line.bus.drops() for line in self._lines)

    @property
    def dropped_behind(self) -> tuple[int, ...]:
        """Frames of each bus that the kernel dropped behind the last one received."""
        return tuple(line.bus.drops() - line.bus.dropped for line in self._lines)

    @property
    def error_frames(self) -> int:
        """Error frames of all buses."""
        return sum(line.error_count for line in self._lines)

    @property
    def down(self) -> tuple[bool, ...]:
        """Whether each bus is down."""
        return tuple(line.down_since is not None for line in self._lines)

    @property
    def all_down_s(self) -> float:
        """How long all buses have been down, s."""
        since = [line.down_since for line in self._lines]
        latest = max((t for t in since if t is not None), default=0.0)
        return 0.0 if None in since else time.monotonic() - latest

    def warm_up(self) -> Frames:
        """A few empty frames as they will come, for whatever has to be compiled for them."""
        return self._lines[0].batch[:2]

    def drain(self) -> Iterator[tuple[int, Frames, bool]]:
        """Bus, frames, and whether frames were lost before them, as long as there are any.

        The frames are good until the next ones are asked for.
        """
        # Bounded, so that buses faster than we are cannot keep a capture from ending.
        for _ in range(DRAINS):
            more = False
            # All of them every time: one that had nothing a moment ago must not fall behind by more than a batch.
            for k, line in enumerate(self._lines):
                before = line.bus.dropped
                got = self._receive(k, line)
                more |= got == BATCH
                if got:
                    batch = self._without_errors(line, line.batch[:got])
                    yield k, batch, line.bus.dropped > before
            if not more:
                return

    def events(self, *, last: bool = False) -> list[BusEvent]:
        """What happened since the last call; errors are told once a second, and all that are left at the ``last``."""
        now = time.monotonic()
        for k, line in enumerate(self._lines):
            if line.down_since is not None and now - line.looked >= LOOK_AGAIN_S:
                line.looked = now
                self._look(k, line)
            if line.errors:
                self._tell_errors(k, line, now, last)
        told, self._events = self._events, []
        return told

    def _receive(self, k: int, line: _Line) -> int:
        try:
            got = line.bus.receive(line.batch)
            if got and line.down_since is not None:
                self._back(k, line)
            return got
        except BusDown as error:
            if line.down_since is None:
                line.down_since = line.looked = time.monotonic()
                self._events.append(BusEvent("bus_down", k, str(error)))
            # What had arrived before is still to be read.
            with suppress(BusDown):
                return line.bus.receive(line.batch)
        return 0

    def _look(self, k: int, line: _Line) -> None:
        if line.bus.bound:
            if not line.bus.up:
                return
        else:
            try:
                fresh = line.open()
            except ArmidentError:
                return
            line.lost_before += line.bus.drops()
            line.bus.close()
            line.bus = fresh
        self._back(k, line)

    def _back(self, k: int, line: _Line) -> None:
        assert line.down_since is not None
        seconds = time.monotonic() - line.down_since
        line.down_since = None
        self._events.append(BusEvent("bus_up", k, f"bus {line.bus.channel}: is back after {seconds:.1f} s"))

    def _without_errors(self, line: _Line, batch: Frames) -> Frames:
        bad = (batch["can_id"] & np.uint32(ERROR_FLAG)) != 0
        if not bad.any():
            return batch
        line.errors.append(batch[bad])
        line.error_count += int(np.count_nonzero(bad))
        good: Frames = batch[~bad]
        return good

    def _tell_errors(self, k: int, line: _Line, now: float, last: bool) -> None:
        found = summarise(np.concatenate(line.errors))
        if not last and all(state is None for state, _ in found) and now - line.told < TELL_ERRORS_S:
            return
        line.errors, line.told = [], now
        kinds: dict[str, BusEventKind] = {"bus_off": "bus_off", "restarted": "bus_restarted"}
        for state, text in found:
            kind: BusEventKind = "bus_errors" if state is None else kinds.get(state, "bus_state")
            self._events.append(BusEvent(kind, k, f"bus {line.bus.channel}: {text}"))

    def close(self) -> None:
        """Release all buses."""
        for line in self._lines:
            line.bus.close()

    def __enter__(self) -> Self:
        """Use the receiver in a ``with`` block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release all buses."""
        self.close()
