"""Growing arrays for the rows of a stream that is being read; every value is copied once."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.daq.recording.layout import StreamLayout

_FEWEST = 4096


class GrowingRows:
    """Rows of one stream read so far; memory is reserved for the ``expected`` number (0: unknown)."""

    def __init__(self, layout: StreamLayout, expected: int = 0) -> None:
        self.size = 0
        self._layout = layout
        n = len(layout.joints)
        room = max(expected, _FEWEST)
        self._sync, self._t_ns = np.empty(room, np.int64), np.empty(room, np.int64)
        self._raw: dict[str, NDArray[Any]] = {
            field.name: np.empty((room, n), dtype) for field, dtype in zip(layout.fields, layout.dtypes, strict=True)
        }

    def append(self, records: NDArray[Any]) -> None:
        """Add message records (N,) in the dtype of the layout; DataError if one does not have that layout."""
        end = self.size + len(records)
        if end > self._sync.size:
            self._resize(max(end, 2 * self._sync.size))
        part = slice(self.size, end)
        raw = {name: values[part] for name, values in self._raw.items()}
        self._layout.unpack(records, self._sync[part], self._t_ns[part], raw)
        self.size = end

    def arrays(self) -> tuple[NDArray[np.int64], NDArray[np.int64], dict[str, NDArray[Any]]]:
        """Return ``sync`` and ``t_ns`` (N,) and the raw values (N, n) by field; nothing may be added afterwards."""
        self._resize(self.size)
        return self._sync, self._t_ns, self._raw

    def _resize(self, room: int) -> None:
        # In place where the allocator can; there are no other references to these arrays.
        for values in (self._sync, self._t_ns, *self._raw.values()):
            values.resize((room, *values.shape[1:]), refcheck=False)
