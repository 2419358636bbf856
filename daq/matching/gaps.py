"""Gaps that extend over several batches, reported when they end."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from armident.daq.matching.state import AMBIGUOUS, LOST, NO_SYNC, WRONG_LENGTH, WRONG_MAPPING
from armident.daq.recording import Gap

SYNC_LOST = "SYNC not received"
REASONS = {
    NO_SYNC: SYNC_LOST,
    LOST: "lost",
    WRONG_LENGTH: "wrong length",
    WRONG_MAPPING: "mapping changed",
    AMBIGUOUS: "ambiguous order",
}


class OpenGaps:
    """Gaps that may still continue, by stream, joint (``None``: all joints) and reason."""

    def __init__(self, joints: Sequence[str]) -> None:
        self._joints = tuple(joints)
        self._open: dict[tuple[str, str | None, str], tuple[int, int]] = {}

    def add(self, stream: str, every: int, sync: NDArray[np.int64], code: NDArray[np.uint8]) -> list[Gap]:
        """Add incomplete rows, SYNCs (N,) and states (N, n) such as `state.LOST`; return the gaps that have ended."""
        found: list[tuple[str | None, str, NDArray[np.int64]]] = []
        for value, reason in REASONS.items():
            hit = code == value
            all_joints = hit.all(axis=1)
            found.append((None, reason, sync[all_joints]))
            found += [(name, reason, sync[hit[:, j] & ~all_joints]) for j, name in enumerate(self._joints)]
        gaps = []
        for joint, reason, numbers in found:
            if numbers.size == 0:
                continue
            key = stream, joint, reason
            breaks = np.flatnonzero(np.diff(numbers) != every) + 1
            for run in np.split(numbers, breaks):
                first, last = int(run[0]), int(run[-1])
                if key in self._open:
                    before = self._open.pop(key)
                    if first - before[1] == every:
                        first = before[0]
                    else:
                        gaps.append(Gap(stream, *before, joint, reason))
                self._open[key] = first, last
        return gaps

    def ended(self, stream: str, last: int | None, final: bool) -> list[Gap]:
        """Return a stream's gaps that end before the SYNC ``last``, or all of them if no rows follow (``final``)."""
        gaps = []
        for key, (begin, end) in list(self._open.items()):
            if key[0] == stream and (final or (last is not None and last > end)):
                del self._open[key]
                gaps.append(Gap(stream, begin, end, key[1], key[2]))
        return gaps
