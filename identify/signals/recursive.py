"""Recursive (infinite impulse response) filters of many columns.

scipy.signal has them as well, but its import, with all of scipy.stats, takes a command longer than all its filters.
"""

import numpy as np
from numpy.typing import ArrayLike

from armident.arrays import Array
from armident.compiled import ARITHMETIC, compiled


def recursive_filter(numerator: ArrayLike, denominator: ArrayLike, x: Array) -> Array:
    """``x`` (N, ...) through ``numerator / denominator``, from rest; polynomials in 1/z, ``denominator[0]`` is 1."""
    columns = np.ascontiguousarray(x, dtype=np.float64).reshape(x.shape[0], -1)
    out = np.empty_like(columns)
    _filter(np.array(numerator, dtype=np.float64), np.array(denominator, dtype=np.float64), columns, out)
    filtered: Array = out.reshape(x.shape)
    return filtered


def zero_phase(sections: Array, x: Array, padlen: int) -> Array:
    """``x`` (N, ...) through low-pass ``sections`` (k, 2, 3) of gain 1, to and fro; ends are continued oddly."""
    margin = [(padlen, padlen), *[(0, 0)] * (x.ndim - 1)]
    out = np.pad(x, margin, mode="reflect", reflect_type="odd")
    for _ in range(2):
        start = out[0].copy()
        out = out - start
        for numerator, denominator in sections:
            out = recursive_filter(numerator, denominator, out)
        out = (out + start)[::-1]
    return np.ascontiguousarray(out[padlen : padlen + x.shape[0]])


def butterworth_sections(order: int, cutoff: float) -> Array:
    """Sections (k, 2, 3), numerator and denominator, of a Butterworth low-pass; ``cutoff`` in Nyquist frequencies."""
    k = np.tan(0.5 * np.pi * cutoff)
    sections = []
    for number in range(order // 2):
        damping = 2.0 * np.sin(0.5 * np.pi * (2 * number + 1) / order)
        scale = 1.0 + damping * k + k**2
        gain = k**2 / scale
        sections.append([[gain, 2 * gain, gain], [1.0, 2.0 * (k**2 - 1.0) / scale, (1.0 - damping * k + k**2) / scale]])
    if order % 2:
        gain = k / (1.0 + k)
        sections.append([[gain, gain, 0.0], [1.0, (k - 1.0) / (1.0 + k), 0.0]])
    return np.array(sections)


@compiled("f8[::1], f8[::1], f8[:, ::1], f8[:, ::1]", **ARITHMETIC)
def _filter(numerator: Array, denominator: Array, x: Array, out: Array) -> None:
    for t in range(x.shape[0]):
        now = out[t]
        now[:] = 0.0
        for i in range(min(numerator.size, t + 1)):
            tap, early = numerator[i], x[t - i]
            for c in range(now.size):
                now[c] += tap * early[c]
        for i in range(1, min(denominator.size, t + 1)):
            tap, early = denominator[i], out[t - i]
            for c in range(now.size):
                now[c] -= tap * early[c]
