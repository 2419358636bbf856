"""Efforts of servos in unsigned numbers: their sign in a bit, or negative ones at the upper end (two's complement)."""

from typing import NamedTuple

import numpy as np

from armident.arrays import Array

BITS = range(7, 16)
"""Bits that may be signs: 7 of one byte, 10 of the load of Feetech and Dynamixel servos, 15 of two bytes."""

WIDTHS = (8, 16, 32)
"""Bits of unsigned numbers that hold negative ones at their upper end."""

LEAST_ROWS = 50
"""Least number of negative values, and of others."""

SMOOTHER = 0.5
"""Largest steps of the decoded signal over those of the recorded one where the sign changes, on average."""

FINEST = 1e-7
"""Smallest difference over the largest value: files have about nine digits."""


class SignBit(NamedTuple):
    """Least value that stands for a negative one, how negative ones are held, and the formula that decodes ``x``."""

    least: float
    how: str
    formula: str


def sign_bit(x: Array) -> SignBit | None:
    """Return how an effort (N,) that is never negative holds negative values; ``None`` if it holds none.

    Values are whole numbers of a step, such as 0.1 %. Of several ways, the one with the smoothest signal is taken.
    """
    step = _step(x)
    if x.min() < 0 or step is None:
        return None
    counts = x / step
    best: tuple[float, SignBit | None] = np.inf, None
    ways = [(2.0**bit, 2.0 ** (bit + 1), f"bit {bit} is the sign") for bit in BITS]
    ways += [(2.0**w / 2, 2.0**w, f"negative numbers of {w} bits are written as unsigned ones") for w in WIDTHS]
    for k, (base, top, how) in enumerate(ways):
        negative = counts >= base
        if counts.max() >= top or min(int(negative.sum()), int((~negative).sum())) < LEAST_ROWS:
            continue
        in_bit = k < len(BITS)
        decoded = np.where(negative, base - counts if in_bit else counts - top, counts)
        left, changes = np.abs(np.diff(decoded)), np.diff(negative)
        smooth = left[changes].sum() < SMOOTHER * np.abs(np.diff(counts))[changes].sum()
        if smooth and left.sum() < best[0]:
            least, end = f"{base * step:.10g}", f"{top * step:.10g}"
            formula = f"x if x < {least} else " + (f"{least} - x" if in_bit else f"x - {end}")
            best = float(left.sum()), SignBit(base * step, how, formula)
    return best[1]


def _step(x: Array) -> float | None:
    """Return the step that values (N,) are whole numbers of: 1, or their common divisor; ``None`` if there is none."""
    if np.all(x == np.rint(x)):
        return 1.0
    least = FINEST * float(np.abs(x).max())
    left = np.diff(np.unique(x))
    while left.size > 1 and left.min() > least:
        divisor = float(left.min())
        rest = np.abs(left - divisor * np.rint(left / divisor))
        left = np.append(rest[rest > least], divisor)
    return float(left[0]) if left.size == 1 else None
