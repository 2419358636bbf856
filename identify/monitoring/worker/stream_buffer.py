"""Samples of the captures that are announced on Zenoh, with bounds on their number and memory."""

import logging
import math
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from armident.configs import DataError
from armident.configs.yaml_loader import is_file
from armident.daq.recording import Recording
from armident.daq.streaming import Block, Refusals, assemble, decode_block, decode_event

log = logging.getLogger(__name__)

MAX_WAITING_S = 10.0
"""Longest wait for missing blocks after the end event of an experiment, and for the start event after a block, s."""
MOST_BYTES = 1 << 30
"""Largest size of the samples in memory: an hour of six axes at 5 kHz. A longer capture is read from its file."""
MOST_EARLY_BYTES = 64 << 20
"""Largest size of the blocks in memory whose capture was not announced yet, bytes: a minute of six axes at 5 kHz."""
MOST_CAPTURES = 8
"""Largest number of captures in memory: one per cell is usual."""
MOST_STREAMS = 8
"""Largest number of streams without a file that wait in memory, together of `MOST_BYTES`."""
MOST_NAMES = 1000
"""Number of names of finished captures that are remembered: late copies of their events are passed over."""
BLOCK_BYTES = 1024
"""Memory of a block besides its message, bytes: also blocks without rows fill it."""
LARGEST_BLOCK = 16 << 20
"""Largest block that is decoded, bytes; a block of six axes at 5 kHz over 0.2 s has 40 kB."""
LARGEST_EVENT = 16 << 20
"""Largest event that is decoded, bytes: the end event lists the gaps of its capture."""


@dataclass
class Assembly:
    """Events and blocks of one capture in any order; ``touched``: time of the last, s; ``too_long``: dropped."""

    capture: str
    start: Mapping[str, Any] | None = None
    end: Mapping[str, Any] | None = None
    blocks: dict[int, Block] = field(default_factory=dict)
    nbytes: int = 0
    touched: float = 0.0
    ended: float = math.inf
    too_long: bool = False

    @property
    def complete(self) -> bool:
        """True if both events and all blocks have arrived, or the samples will be read from the file."""
        if self.start is None or self.end is None:
            return False
        return self.too_long or len(self.blocks) >= int(self.end["blocks"])

    def files(self, folders: Sequence[Path]) -> tuple[Path, ...]:
        """Return the files of the capture if all are reachable, else none; DataError for one outside of ``folders``."""
        paths = [] if self.end is None else [str(path) for path in self.end["paths"]]
        found = tuple(Path(path) for path in paths)
        if not all(path.endswith(".mcap") for path in paths) or not all(map(is_file, found)):
            return ()
        for path in found:
            if not any(path.resolve().is_relative_to(folder.resolve()) for folder in folders):
                raise DataError(f"capture {self.capture}: {path} is not read: it is outside of {folders[0]} and --out")
        return found

    @property
    def triggered(self) -> bool:
        """True if files hold only parts of the stream, those around triggers."""
        session = (self.start or {}).get("session") or {}
        recording = session.get("recording") if isinstance(session, dict) else None
        return isinstance(recording, dict) and recording.get("trigger") is not None

    def recording(self) -> Recording:
        """Return the recording of the stream. Raises DataError if an event or blocks are missing."""
        if self.start is None or self.end is None:
            missing = "start" if self.start is None else "end"
            raise DataError(f"capture {self.capture}: its {missing} event was not received")
        if self.too_long:
            raise DataError(f"capture {self.capture}: it exceeds the memory limit")
        recording = assemble(self.start, self.blocks.values(), self.end)
        if recording.missing is not None:
            raise DataError(f"capture {self.capture}: {recording.missing}")
        return recording


class StreamBuffer:
    """Collects events and blocks by capture, up to ``most_bytes``; reports messages that cannot be used."""

    def __init__(self, most_bytes: int | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self._most_bytes, self._clock = MOST_BYTES if most_bytes is None else most_bytes, clock
        self._captures: dict[str, Assembly] = {}
        self._finished: OrderedDict[str, None] = OrderedDict()
        self.refuse = Refusals(log).refuse
        """Reports a message that cannot be used, with its kind and the reason."""

    @property
    def nbytes(self) -> int:
        """Memory of all blocks, bytes."""
        return sum(assembly.nbytes for assembly in self._captures.values())

    def take_event(self, data: bytes | None, size: int) -> Mapping[str, Any] | None:
        """Take an encoded event (``None``: too large); return it if it starts or ends a capture not yet finished."""
        try:
            if data is None:
                raise DataError(f"an event of {size} bytes, more than {LARGEST_EVENT}")
            event = decode_event(data)
        except DataError as error:
            self.refuse("events", str(error))
            return None
        if event["kind"] not in ("experiment_start", "experiment_end") or event["capture"] in self._finished:
            return None
        assembly = self._assembly(event["capture"])
        if event["kind"] == "experiment_start":
            assembly.start = assembly.start or event
        elif assembly.end is None:
            assembly.end, assembly.ended = event, self._clock()
        return event

    def take_block(self, data: bytes | None, size: int) -> None:
        """Take an encoded block. ``data``: the block; ``None`` if it is too large to be decoded."""
        try:
            if data is None:
                raise DataError(f"a block of {size} bytes, more than {LARGEST_BLOCK}")
            block = decode_block(data)
            if not block.capture:
                raise DataError("a block of no capture")
        except DataError as error:
            self.refuse("samples", str(error))
            return
        if block.capture in self._finished:
            return
        assembly = self._assembly(block.capture)
        if assembly.too_long or block.sequence in assembly.blocks:
            return
        kept = len(data) + BLOCK_BYTES
        early = sum(each.nbytes for each in self._captures.values() if each.start is None) + kept
        if assembly.start is None and early > MOST_EARLY_BYTES:
            self.refuse("unknown", f"samples of capture {block.capture}, which nobody announced, fill the memory")
            return
        assembly.blocks[block.sequence] = block
        assembly.nbytes += kept
        if self.nbytes > self._most_bytes:
            self._give_up(max(self._captures.values(), key=lambda each: each.nbytes))

    def take_ended(self) -> list[Assembly]:
        """Return and forget ended captures that are complete or waited `MAX_WAITING_S`; drop unannounced blocks."""
        now = self._clock()
        ended = []
        for assembly in list(self._captures.values()):
            waited = now - assembly.ended > MAX_WAITING_S
            if assembly.complete or waited:
                ended.append(assembly)
                self._forget(assembly.capture)
            elif assembly.start is None and assembly.end is None and now - assembly.touched > MAX_WAITING_S:
                self.refuse("unknown", f"{len(assembly.blocks)} blocks of capture {assembly.capture}: not announced")
                del self._captures[assembly.capture]
        return ended

    def keep(self, assembly: Assembly) -> None:
        """Keep a capture for another `MAX_WAITING_S`: its end was announced, but its file is still being written."""
        self._finished.pop(assembly.capture, None)
        assembly.end, assembly.ended = None, math.inf
        self._captures[assembly.capture] = assembly

    def _assembly(self, capture: str) -> Assembly:
        if capture not in self._captures:
            if len(self._captures) >= MOST_CAPTURES:
                # A capture under way has samples; names that somebody only makes up have few or none.
                least = min(
                    self._captures.values(), key=lambda each: (each.start is not None, each.nbytes, each.touched)
                )
                self.refuse("captures", f"more than {MOST_CAPTURES} captures at once; {least.capture} is given up")
                del self._captures[least.capture]
            self._captures[capture] = Assembly(capture)
        assembly = self._captures[capture]
        assembly.touched = self._clock()
        return assembly

    def _give_up(self, assembly: Assembly) -> None:
        assembly.too_long = True
        assembly.blocks.clear()
        assembly.nbytes = 0

    def _forget(self, capture: str) -> None:
        del self._captures[capture]
        self._finished[capture] = None
        while len(self._finished) > MOST_NAMES:
            self._finished.popitem(last=False)


def drop_oldest(streams: dict[str, Recording]) -> None:
    """Remove the oldest streams while there are more than `MOST_STREAMS`, or several with more than `MOST_BYTES`."""
    sizes = {digest: _samples_nbytes(recording) for digest, recording in streams.items()}
    while len(sizes) > MOST_STREAMS or (len(sizes) > 1 and sum(sizes.values()) > MOST_BYTES):
        oldest = next(iter(sizes))
        del sizes[oldest], streams[oldest]
        log.warning("captures without a file fill the memory; the oldest one that waits is given up")


def _samples_nbytes(recording: Recording) -> int:
    return sum(
        stream.sync.nbytes + stream.t_ns.nbytes + sum(values.nbytes for values in stream.raw.values())
        for stream in recording.streams.values()
    )
