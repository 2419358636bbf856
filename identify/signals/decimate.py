"""Parallel ("decimate") filter: the same zero-phase low-pass for torque and regressor (thesis section 2.3.1)."""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import DataError

STOPBAND_DB = 70.0
"""Attenuation above the Nyquist frequency of the decimated signal, dB."""

TRANSITION = 0.5
"""Width of the transition band as a fraction of the decimated Nyquist frequency."""

WORKING_RATE = 8
"""Rate at which signals without noise are computed, in cut-offs: central differences and filters need no more."""

_ROWS = 8
"""Output rows per matrix product: fewer rows mean more calls, more rows more products with zeros off the band."""


@dataclass(frozen=True, eq=False)
class Decimation:
    """Linear-phase low-pass with symmetric ``taps`` (m,), m odd, that keeps one sample of ``factor``.

    Centred, so zero-phase; finite, so without initial state. Samples with an incomplete window are dropped.
    """

    factor: int
    taps: Array

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Decimation) and (self.factor, self._bytes) == (other.factor, other._bytes)

    def __hash__(self) -> int:
        return hash((self.factor, self._bytes))

    @property
    def _bytes(self) -> bytes:
        return self.taps.tobytes()

    @property
    def margin(self) -> int:
        """Samples dropped at each end."""
        return (self.taps.size - 1) // 2

    @property
    def passes_all(self) -> bool:
        """True if the filter is the identity and every sample is kept."""
        return self.factor == 1 and self.taps.size == 1 and self.taps[0] == 1.0

    def count(self, samples: int) -> int:
        """Number M of output samples for a record of ``samples``."""
        return max(0, (samples - self.taps.size) // self.factor + 1)

    def instants(self, samples: int) -> NDArray[np.int64]:
        """Index of the input sample at the centre of each window, shape (M,), for a record of ``samples``."""
        return self.margin + self.factor * np.arange(self.count(samples), dtype=np.int64)

    @property
    def every(self) -> int:
        """Samples from one to the next that are enough for signals without noise: a divisor of the factor."""
        most = max(self.factor // (WORKING_RATE // 2), 1)
        return max(k for k in range(1, most + 1) if self.factor % k == 0)

    def thin(self, x: Array) -> Array:
        """Means of ``every`` samples (N, n) around those that `of_thin` filters: without what would fold into its band.

        A mean has its zeros at the multiples of the new rate. The first and the last sample stand for those beyond.
        """
        taps = np.full(self.every + 1 - self.every % 2, 1.0 / self.every)
        if self.every % 2 == 0:
            taps[[0, -1]] /= 2.0
        margin = taps.size // 2
        padded = np.pad(x, ((margin, margin), (0, 0)), mode="edge")
        return Decimation(self.every, taps)(padded[self.margin % self.every :])

    @property
    def of_thin(self) -> "Decimation":
        """Filter of thinned signals with the same instants and response."""
        taps = self.taps[self.margin % self.every :: self.every]
        return Decimation(self.factor // self.every, taps / taps.sum() * self.taps.sum())

    def rows_of(self, begin: int, end: int) -> slice:
        """Output rows that depend on the input samples ``begin .. end - 1``, for a record without end."""
        return slice(max(0, -(-(begin - self.taps.size + 1) // self.factor)), (end - 1) // self.factor + 1)

    def weights(self, rows: slice, begin: int, end: int) -> Array:
        """Filter coefficients (rows, samples) of the input samples ``begin .. end - 1`` in output rows."""
        tap = np.arange(begin, end) - self.factor * np.arange(rows.start, rows.stop)[:, None]
        inside = (tap >= 0) & (tap < self.taps.size)
        return np.where(inside, self.taps[np.where(inside, tap, 0)], 0.0)

    def __call__(self, x: Array) -> Array:
        """Filter and decimate (N, ...) to (M, ...); DataError if the record is shorter than the filter."""
        count = self.count(x.shape[0])
        if count == 0:
            raise DataError(f"decimation by {self.factor} needs at least {self.taps.size} samples, got {x.shape[0]}")
        flat = np.ascontiguousarray(x, dtype=np.float64).reshape(x.shape[0], -1)
        out: Array = _filtered(flat, self.taps, self.factor, count)
        return out.reshape((count, *x.shape[1:]))


def design(dt: float, cutoff_hz: float, factor: int | None = None) -> Decimation:
    """Design a low-pass with half-amplitude frequency ``cutoff_hz`` (thesis: ``w_Fp >= 2 w_dyn``) and its decimation.

    ``factor``: 1: identity; ``None``: the largest with Nyquist frequency from the cut-off on, ``n_d = w_nyq / w_Fp``.
    """
    if factor is None:
        factor = max(1, int(0.5 / (dt * cutoff_hz) + 1e-9))
    if factor == 1:
        return Decimation(1, np.ones(1))
    width = TRANSITION * 2 * dt * cutoff_hz
    # Windowed sinc with the length and window of Kaiser (Oppenheim and Schafer, Discrete-time signal processing, 7.5).
    half = int(np.ceil((STOPBAND_DB - 7.95) / (2.285 * np.pi * width)) + 1) // 2
    k = np.arange(-half, half + 1)
    taps = np.sinc(2 * dt * cutoff_hz * k) * np.kaiser(k.size, 0.1102 * (STOPBAND_DB - 8.7))
    return Decimation(factor, taps / taps.sum())


def _filtered(x: Array, taps: Array, factor: int, count: int) -> Array:
    """Compute ``sum_i taps[i] x[factor m + i]`` for m < ``count``, as products of blocks with a banded matrix."""
    span = (_ROWS - 1) * factor + taps.size
    band = np.zeros((_ROWS, span))
    for i in range(_ROWS):
        band[i, i * factor : i * factor + taps.size] = taps
    out = np.empty((count, x.shape[1]))
    whole = count // _ROWS
    begin = whole * _ROWS
    windows = as_strided(
        x, (whole, span, x.shape[1]), (_ROWS * factor * x.strides[0], x.strides[0], x.strides[1]), writeable=False
    )
    np.matmul(band, windows, out=out[:begin].reshape(whole, _ROWS, x.shape[1]))
    left = count - begin
    if left:
        rest = (left - 1) * factor + taps.size
        np.matmul(band[:left, :rest], x[begin * factor : begin * factor + rest], out=out[begin:])
    return out
