"""Efforts in sign and magnitude, as some servos send them: a bit of the number is its sign."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BITS = (7, 10, 15)
"""Bits that are signs: of one byte, of the load of Feetech and Dynamixel servos (10), of two bytes."""

LEAST_ROWS = 50
"""Least number of values with the bit, and of those without it."""

SMOOTHER = 0.5
"""Most total variation of the decoded signal over that of the recorded one, which jumps wherever the sign changes."""


def sign_bit(x: Array) -> int | None:
    """Return the bit that is the sign of an effort (N,) of whole, never negative numbers; ``None`` if there is none."""
    if x.min() < 0 or np.any(x != np.rint(x)):
        return None
    for bit in BITS:
        base = 1 << bit
        negative = x >= base
        if x.max() >= 2 * base or min(int(negative.sum()), int((~negative).sum())) < LEAST_ROWS:
            continue
        decoded = np.where(negative, base - x, x)
        if np.abs(np.diff(decoded)).sum() < SMOOTHER * np.abs(np.diff(x)).sum():
            return bit
    return None
