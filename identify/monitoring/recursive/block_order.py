"""Order of the blocks of a capture: the cache of a capture may answer after later blocks have arrived."""

from collections.abc import Iterator

from armident.daq.streaming import Block

LONGEST_HOLD_S = 1.0
"""Time for which blocks wait for an earlier one that is missing, s: a query of the cache takes less."""


class BlockOrder:
    """Hands over blocks once, in order; a missing one is given up after `LONGEST_HOLD_S` and counted in ``lost``."""

    def __init__(self) -> None:
        self._capture = ""
        self._next = 0
        self.lost = 0
        self._held: dict[int, tuple[float, Block]] = {}

    def add(self, block: Block, now_s: float) -> Iterator[Block]:
        """Take a block, and yield those whose turn has come; the first of another capture releases all that wait."""
        if block.capture != self._capture:
            yield from self._released(float("inf"))
            self._capture, self._next = block.capture, 0
        if block.sequence >= self._next:
            self._held.setdefault(block.sequence, (now_s, block))
        yield from self._released(now_s)

    def overdue(self, now_s: float) -> Iterator[Block]:
        """Yield blocks that have waited long enough, and those after them whose turn has come."""
        yield from self._released(now_s)

    def _released(self, now_s: float) -> Iterator[Block]:
        while self._held:
            if self._next not in self._held:
                if now_s - min(at for at, _ in self._held.values()) < LONGEST_HOLD_S:
                    return
                self.lost += min(self._held) - self._next
                self._next = min(self._held)
            yield self._held.pop(self._next)[1]
            self._next += 1
