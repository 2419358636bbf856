"""Conversion of a recording to another sampling rate, with an anti-alias filter."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError
from armident.daq.recording import Gap, Mark, Recording, Stream

PASS_SHARE = 0.8
"""Share of the lower of both Nyquist frequencies up to which signals are kept; from 1 on they are attenuated."""
ATTENUATION_DB = 80.0
"""Attenuation above the Nyquist frequency, dB: a ten-thousandth of the amplitude folds back."""
BETA = 0.1102 * (ATTENUATION_DB - 8.7)
"""Shape of the Kaiser window of this attenuation (Kaiser 1974)."""
SAME = 1e-9
"""Relative difference of two sampling rates that are the same number."""
_ROWS = 4096
"""Number of output rows that are computed at a time."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def at_rate(recording: Recording, rate_hz: float) -> Recording:
    """Return a recording at another sampling rate.

    Positions, velocities and efforts go through a linear-phase low-pass filter (windowed sinc) below the lower of both
    Nyquist frequencies. Demands are interpolated linearly, as a CiA 402 drive does (60C2h), and status words are held.
    Gaps, marks and pieces between gaps keep their times. So does the time from a position to the torque that belongs
    to it, as in a capture of the same drives at the new rate; in sampling periods it is another number.

    ``rate_hz``: new sampling rate, 1/s. Raises ConfigError if the rate is not a number greater than 0; DataError if the
    recording has no samples, or a value that is not finite.
    """
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise ConfigError(f"--rate: expected a sampling rate greater than 0 Hz, found {rate_hz:g}")
    if recording.samples.sync.size == 0:
        raise DataError("no samples to resample")
    ratio = rate_hz / recording.sample_rate_hz
    if abs(ratio - 1.0) < SAME:
        return recording
    streams = {name: _stream(stream, ratio) for name, stream in recording.streams.items() if stream.sync.size}
    counters: dict[str, int] = {}
    for name, stream in streams.items():
        expected = int(stream.sync[-1] - stream.sync[0]) + 1 if stream.sync.size else 0
        rows = stream.sync.size
        counters |= {f"{name}.expected": expected, f"{name}.rows": rows, f"{name}.in_gaps": expected - rows}
    skipped = recording.counters.get("sync_skipped_periods", 0)
    counters["sync_skipped_periods"] = round(skipped * ratio)
    return Recording(
        None,
        recording.robot,
        None,
        rate_hz,
        streams,
        gaps=tuple(new for gap in recording.gaps if (new := _gap(gap, ratio)) is not None),
        marks=tuple(_mark(mark, ratio) for mark in recording.marks),
        counters=counters,
        metadata={**recording.metadata, "resampled_from_hz": f"{recording.sample_rate_hz:g}"},
        missing=recording.missing,
    )


def _stream(stream: Stream, ratio: float) -> Stream:
    """Stream with one row for every new sampling instant within its pieces without gaps."""
    cuts = np.flatnonzero(np.diff(stream.sync) != stream.every) + 1
    pieces = [piece for piece in np.split(np.arange(stream.sync.size), cuts) if piece.size]
    sync: list[Ints] = []
    t_ns: list[Ints] = []
    raw: dict[str, list[NDArray[Any]]] = {name: [] for name in stream.fields}
    for piece in pieces:
        own = stream.sync[piece]
        new = np.arange(np.ceil(own[0] * ratio - SAME), np.floor(own[-1] * ratio + SAME) + 1, dtype=np.int64)
        if not new.size:
            continue
        at = np.clip((new / ratio - own[0]) / stream.every, 0, piece.size - 1)
        elapsed = stream.t_ns[piece] - stream.t_ns[piece[0]]
        t_ns.append(stream.t_ns[piece[0]] + np.rint(np.interp(at, np.arange(piece.size), elapsed)).astype(np.int64))
        sync.append(new)
        for name, field in stream.fields.items():
            raw[name].append(_values(field.quantity, stream.raw[name][piece], at, ratio * stream.every))
    if not sync:
        raise DataError(f"stream {stream.name!r} is too short for the new sampling rate")
    joined = {name: np.concatenate(values) for name, values in raw.items()}
    return Stream(stream.name, 1, np.concatenate(sync), np.concatenate(t_ns), stream.fields, joined)


def _values(quantity: str, raw: NDArray[Any], at: Floats, ratio: float) -> NDArray[Any]:
    """Raw values (M, n) of one quantity at the samples ``at`` (M,) of a piece (N, n)."""
    if quantity == "status":
        return np.ascontiguousarray(raw[np.floor(at + SAME).astype(np.int64)])
    values = raw.astype(np.float64)
    if not np.isfinite(values).all():
        raise DataError(f"{quantity} is not finite: nothing to resample")
    if quantity == "demand":
        rows = np.arange(len(values))
        return np.stack([np.interp(at, rows, column) for column in values.T], axis=1)
    return low_passed(values, at, min(1.0, ratio))


def low_passed(values: Floats, at: Floats, share: float) -> Floats:
    """Return a signal after a low-pass filter of linear phase, at any instants (M, n).

    ``values``: samples (N, n); beyond the ends they continue by point reflection. ``at``: instants (M,), in samples.
    ``share``: frequency from which on the signal is attenuated, in shares of the Nyquist frequency, at most 1.
    """
    stop, begin = 0.5 * share, 0.5 * share * PASS_SHARE
    cutoff = (stop + begin) / 2
    # Length of a Kaiser filter for this attenuation and transition band (Kaiser 1974).
    half = int(np.ceil((ATTENUATION_DB - 7.95) / (14.36 * (stop - begin)) / 2))
    padded = np.pad(values, ((half + 1, half + 1), (0, 0)), mode="reflect", reflect_type="odd")
    at = np.clip(at, -0.5, len(values) - 0.5)
    offsets = np.arange(-half, half + 1)
    parts = []
    for begin_row in range(0, at.size, _ROWS):
        part = at[begin_row : begin_row + _ROWS]
        nearest = np.floor(part + 0.5).astype(np.int64)
        distance = nearest[:, None] + offsets - part[:, None]
        window = np.i0(BETA * np.sqrt(np.maximum(1.0 - (distance / (half + 0.5)) ** 2, 0.0)))
        weights = np.sinc(2 * cutoff * distance) * window
        weights /= weights.sum(axis=1, keepdims=True)
        rows = nearest[:, None] + offsets + half + 1
        parts.append(np.stack([np.einsum("mk,mk->m", weights, column[rows]) for column in padded.T], axis=1))
    return np.concatenate(parts) if parts else np.empty((0, values.shape[1]))


def _gap(gap: Gap, ratio: float) -> Gap | None:
    """The gap at the new rate: all instants between the samples at its ends; ``None`` if there are none."""
    first = int(np.floor((gap.first - 1) * ratio + SAME)) + 1
    last = int(np.ceil((gap.last + 1) * ratio - SAME)) - 1
    first = max(first, 0)
    return replace(gap, first=first, last=last) if first <= last else None


def _mark(mark: Mark, ratio: float) -> Mark:
    if mark.sync < 0:
        return mark
    exact = mark.sync * ratio
    sync = np.ceil(exact - SAME) if mark.kind == "experiment_start" else np.floor(exact + SAME)
    return replace(mark, sync=int(sync))
