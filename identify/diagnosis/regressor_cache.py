"""Cache of the regressors that the models of one diagnosis share, limited in memory."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

Arrays = tuple[NDArray[Any], ...]

MOST_BYTES = 2**28
"""Memory for the arrays of the cache, bytes. It changes no result."""


@dataclass
class RegressorCache:
    """Arrays computed from signals, the most recently used ones. ``most_bytes``: memory for the arrays, bytes."""

    most_bytes: int = MOST_BYTES
    _kept: dict[Hashable, Arrays] = field(default_factory=dict)
    _bytes: int = 0

    def get(self, key: Hashable, made: Callable[[], Arrays]) -> Arrays:
        """Return the arrays of a key, computed if absent; signals in the key are equal only to themselves."""
        kept = self._kept.pop(key, None)
        if kept is None:
            kept = made()
            self._bytes += _size(kept)
        self._kept[key] = kept
        while self._bytes > self.most_bytes and len(self._kept) > 1:
            # The one that was not used for the longest time: of a simulation of a model that was rejected.
            self._bytes -= _size(self._kept.pop(next(iter(self._kept))))
        return kept


def _size(arrays: Arrays) -> int:
    return sum(array.nbytes for array in arrays)
