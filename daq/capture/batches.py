"""Batches of matched rows for the recording: in the order of time, and in pieces."""

from collections.abc import Iterator, Mapping

import numpy as np

from armident.daq.matching.assembler import LATE_S, Batch, Rows
from armident.daq.recording import Gap

PIECE_NS = 200_000_000
"""Longest recorded time that is written and published at once, ns."""


class SamplesFirst:
    """Holds rows and gaps of other streams until the samples of their SYNC are certain.

    Drives that lag may answer a slow stream in time and none of the samples, which decide when a file begins. Without
    this class, streams of one file would have different times.
    """

    def __init__(self) -> None:
        self._rows: dict[str, Rows] = {}
        self._gaps: tuple[Gap, ...] = ()

    def take(self, batch: Batch) -> Batch:
        """Return what can be written after a batch. ``batch``: rows and gaps from the assembler."""
        until, rows, held = batch.certain["samples"], {}, {}
        for name, new in batch.rows.items():
            waiting = self._rows.get(name)
            every = new if waiting is None or waiting.sync.size == 0 else _joined(waiting, new)
            count = every.sync.size if name == "samples" else int(np.searchsorted(every.sync, until))
            rows[name], held[name] = _part(every, slice(count)), _part(every, slice(count, None))
        gaps = sorted((*self._gaps, *batch.gaps), key=lambda gap: gap.first)
        ready = tuple(gap for gap in gaps if gap.stream == "samples" or gap.first < until)
        self._rows, self._gaps = held, tuple(gap for gap in gaps if gap.stream != "samples" and gap.first >= until)
        return Batch(rows, ready, batch.certain)

    def rest(self) -> Batch | None:
        """Return what is held after the last batch; ``None`` if there was no batch."""
        rest = Batch(self._rows, self._gaps, {}) if self._rows else None
        self._rows, self._gaps = {}, ()
        return rest


class FileBoundaries:
    """Tells where a file may begin: before samples to which the other streams are certain.

    Else unanswered last SYNCs would not be listed as a gap: they come with the next file. After ``LATE_S`` the next
    file begins anyway, so that a silent drive does not stop the files.
    """

    def __init__(self) -> None:
        self._refused_ns: int | None = None
        """Time of the first samples refused since the last that were allowed, ns UTC."""

    def allow(self, samples: Rows, certain: Mapping[str, int]) -> bool:
        """Return True if a file may begin here; ``certain``: SYNC before which all rows of a stream are known."""
        t_ns = int(samples.t_ns[0])
        if all(until >= samples.sync[0] for until in certain.values()):
            self._refused_ns = None
            return True
        if self._refused_ns is None:
            self._refused_ns = t_ns
        # The clock may have been set back.
        if 0 <= t_ns - self._refused_ns < LATE_S * 1e9:
            return False
        self._refused_ns = t_ns
        return True


def pieces(batch: Batch) -> Iterator[Batch]:
    """Yield a batch in pieces of at most `PIECE_NS`, by time of its samples: drives that lagged answer all at once."""
    samples = batch.rows["samples"]
    if samples.sync.size == 0 or samples.t_ns[-1] - samples.t_ns[0] < PIECE_NS:
        yield batch
        return
    number = (samples.t_ns - samples.t_ns[0]) // PIECE_NS
    boundaries = samples.sync[np.flatnonzero(np.diff(number) > 0) + 1]
    piece_of_gap = np.searchsorted(boundaries, [gap.first for gap in batch.gaps], side="right")
    cuts = {
        name: [0, *np.searchsorted(rows.sync, boundaries).tolist(), rows.sync.size] for name, rows in batch.rows.items()
    }
    for k in range(boundaries.size + 1):
        part = {}
        for name, rows in batch.rows.items():
            rows_of_piece = slice(cuts[name][k], cuts[name][k + 1])
            part[name] = _part(rows, rows_of_piece)
        yield Batch(
            part, tuple(gap for gap, at in zip(batch.gaps, piece_of_gap, strict=True) if at == k), batch.certain
        )


def _part(rows: Rows, part: slice) -> Rows:
    return Rows(rows.sync[part], rows.t_ns[part], rows.data[part])


def _joined(first: Rows, second: Rows) -> Rows:
    sync, t_ns, data = (
        np.concatenate([getattr(rows, name) for rows in (first, second)]) for name in ("sync", "t_ns", "data")
    )
    return Rows(sync, t_ns, data)
