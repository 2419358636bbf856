"""Dependence of the residuals on the motion, which noise does not have.

An AR model can absorb a model error; averages over bins of position and velocity cannot. Circular shifts against the
motion keep the serial correlation and give the distribution without dependence.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.identification.equations import Prepared
from armident.identify.regression.equations import ExperimentEquations, instants, residuals

POSITION_BINS, VELOCITY_BINS = 100, 40
"""Largest number of bins of position, for each direction of motion, and of velocity."""

ROWS_PER_BIN = 8
"""Least mean number of rows in a bin."""

SHIFTS = 199
"""Number of circular shifts."""

TOGETHER = 200_000
"""Rows of all shifts that are in memory together: 1.6 MB."""

LEAST_SHIFT = 0.05
"""Least shift, as share of the length of an experiment."""


@dataclass(frozen=True)
class MotionDependence:
    """Dependence of one joint's residuals on ``position`` (and direction) or ``velocity``.

    ``share``: power explained beyond chance, 0 to 1; ``deviation``: of it from its mean under shifts, in their std.
    """

    joint: int
    variable: str
    share: float
    deviation: float


def motion_dependence(
    prepared: Prepared, blocks: Sequence[ExperimentEquations], theta: Array
) -> list[MotionDependence]:
    """Dependence of the residuals of ``theta`` (b,), SI, of every joint on its own position and velocity."""
    dt = prepared.experiments[0].dt
    errors = residuals(blocks, theta)
    pairs = [(s.q[at], s.qd[at]) for s, at in zip(prepared.signals, instants(blocks, dt), strict=True)]
    motion = [np.concatenate(each) for each in zip(*pairs, strict=True)]
    keep = [block.keep for block in blocks]
    found = []
    for j in range(errors[0].shape[1]):
        kept = [np.where(used[:, j], e[:, j], 0.0) for e, used in zip(errors, keep, strict=True)]
        q, qd = (signal[:, j] for signal in motion)
        for variable, bins in (("position", _position_bins(q, qd)), ("velocity", _velocity_bins(qd))):
            found.append(MotionDependence(j, variable, *_explained(kept, bins)))
    return found


def _position_bins(q: Array, qd: Array) -> NDArray[np.int64]:
    """Bin of each row by position and direction."""
    count = max(min(POSITION_BINS, q.size // (2 * ROWS_PER_BIN)), 1)
    width = max(float(np.ptp(q)), 1e-300)
    place = np.minimum(((q - q.min()) / width * count).astype(np.int64), count - 1)
    return np.asarray(2 * place + (qd > 0), dtype=np.int64)


def _velocity_bins(qd: Array) -> NDArray[np.int64]:
    """Bin of each row by velocity, with about the same number of rows each."""
    count = max(min(VELOCITY_BINS, qd.size // ROWS_PER_BIN), 1)
    edges = np.quantile(qd, np.linspace(0, 1, count + 1)[1:-1])
    return np.asarray(np.searchsorted(edges, qd), dtype=np.int64)


def _explained(series: Sequence[Array], bins: NDArray[np.int64]) -> tuple[float, float]:
    """Share of the power that averages over bins explain beyond chance, and its deviation in std of the shifts."""
    total = sum(float(e @ e) for e in series)
    if total <= 0.0:
        return 0.0, 0.0
    shifts = np.concatenate([[0.0], np.random.default_rng(0).uniform(LEAST_SHIFT, 1 - LEAST_SHIFT, SHIFTS)])
    # Rows of all shifts, bin after bin.
    order = np.argsort(bins, kind="stable")
    counts = np.bincount(bins)
    counts = counts[counts > 0]
    explained = []
    for some in np.array_split(shifts, max(1, min(shifts.size, shifts.size * order.size // TOGETHER))):
        rows = np.concatenate([_shifted(e, some) for e in series], axis=1)[:, order]
        sums = np.add.reduceat(rows, np.cumsum(counts) - counts, axis=1)
        explained.append(np.sum(sums**2 / counts, axis=1) / total)
    here, *shifted = np.concatenate(explained)
    usual, spread = float(np.mean(shifted)), float(np.std(shifted))
    return float(max(here - usual, 0.0) / max(1.0 - usual, 1e-300)), float((here - usual) / max(spread, 1e-300))


def _shifted(series: Array, shifts: Array) -> Array:
    """A series (M,) moved in a circle by shares of its length, (S, M)."""
    size = series.size
    every = np.lib.stride_tricks.sliding_window_view(np.concatenate([series, series]), size)
    return np.asarray(every[size - np.rint(shifts * size).astype(np.int64)])
