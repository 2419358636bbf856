"""Blocks of a recording for the recursive estimator, in the order in which a capture publishes them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.daq.recording import Recording, StreamLayout


@dataclass(frozen=True)
class RecordedBlock:
    """Consecutive rows (N,) of one recorded stream: SYNC numbers, receive times in ns UTC, raw values (N, n)."""

    layout: StreamLayout
    sync: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    raw: dict[str, NDArray[Any]]


def has_reference(recording: Recording) -> bool:
    """Return True if reference positions are recorded."""
    return any(stream.named("demand") is not None for stream in recording.streams.values())


def blocks_of(recording: Recording, syncs: int) -> Iterator[RecordedBlock]:
    """Yield the streams of a recording in pieces."""
    joints = [joint.name for joint in recording.robot.joints]
    layouts = {name: StreamLayout.of(stream, joints) for name, stream in recording.streams.items()}
    sync = recording.samples.sync
    if not sync.size:
        return
    for first in range(int(sync[0]), int(sync[-1]) + 1, syncs):
        for name, stream in recording.streams.items():
            rows = slice(*np.searchsorted(stream.sync, [first, first + syncs]).tolist())
            if rows.start < rows.stop:
                raw = {field: values[rows] for field, values in stream.raw.items()}
                yield RecordedBlock(layouts[name], stream.sync[rows], stream.t_ns[rows], raw)
