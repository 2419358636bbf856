"""Sine, cosine and arctangent of short arrays, in a form that the compiler turns into vector instructions.

Calls of the C library would take most of the time of a simulated sample. Polynomials and range reductions are those of
Moshier's Cephes library. No branches; errors are a few units in the last place for arguments up to 1e5.
"""

import numpy as np

from armident.arrays import Array
from armident.compiled import inlined

LANES = 4
"""Array lengths are rounded up to a multiple of this number, so that no element needs a scalar loop."""

_TWO_OVER_PI = 2.0 / np.pi
# pi / 2 in three parts. The first two end in zero bits: their products with small integers are exact.
_HALF_PI_1, _HALF_PI_2, _HALF_PI_3 = 1.57079625129699707031, 7.54978941586159635336e-8, 5.39030252995776476554e-15
_TAN_3_PI_8 = 2.41421356237309504880
_MORE_BITS = 6.123233995736765886130e-17


@inlined
def padded(n: int) -> int:
    """Smallest multiple of `LANES` that is not below ``n``."""
    return -(-n // LANES) * LANES


@inlined
def sines_cosines(angle: Array, sine: Array, cosine: Array) -> None:
    """Compute sines and cosines of an array. ``angle``: rad, (m,); ``sine``, ``cosine``: output arrays, (m,) each."""
    for i in range(angle.size):
        x = angle[i]
        k = np.rint(x * _TWO_OVER_PI)
        r = ((x - k * _HALF_PI_1) - k * _HALF_PI_2) - k * _HALF_PI_3
        z = r * r
        s = 1.58962301576546568060e-10 * z - 2.50507477628578072866e-8
        s = s * z + 2.75573136213857245213e-6
        s = s * z - 1.98412698295895385996e-4
        s = s * z + 8.33333333332211858878e-3
        s = s * z - 1.66666666666666307295e-1
        s = r + r * z * s
        c = -1.13585365213876817300e-11 * z + 2.08757008419747316778e-9
        c = c * z - 2.75573141792967388112e-7
        c = c * z + 2.48015872888517045348e-5
        c = c * z - 1.38888888888730564116e-3
        c = c * z + 4.16666666666665929218e-2
        c = 1.0 - 0.5 * z + z * z * c
        # Quadrant, 0 to 3: an odd one gives (c, -s) instead of (s, c); quadrants 2 and 3 change both signs.
        quadrant = k - 4.0 * np.floor(0.25 * k)
        odd = quadrant - 2.0 * np.floor(0.5 * quadrant)
        upper = np.floor(0.5 * quadrant)
        sign = 1.0 - 2.0 * upper
        sine[i] = sign * (odd * c + (1.0 - odd) * s)
        cosine[i] = sign * ((1.0 - odd) * c - odd * s)


@inlined
def arctangents(x: Array, out: Array, slope: Array) -> None:
    """Compute arctangents of an array, rad, and their derivatives ``1 / (1 + x^2)``."""
    for i in range(x.size):
        t = abs(x[i])
        large = t > _TAN_3_PI_8
        middle = t > 0.66
        above = -1.0 if large else (t - 1.0 if middle else t)
        below = t if large else (t + 1.0 if middle else 1.0)
        base = 0.5 * np.pi if large else (0.25 * np.pi if middle else 0.0)
        tail = _MORE_BITS if large else (0.5 * _MORE_BITS if middle else 0.0)
        r = above / below
        z = r * r
        p = -8.750608600031904122785e-1 * z - 1.615753718733365076637e1
        p = p * z - 7.500855792314704667340e1
        p = p * z - 1.228866684490136173410e2
        p = p * z - 6.485021904942025371773e1
        q = z + 2.485846490142306297962e1
        q = q * z + 1.650270098316988542046e2
        q = q * z + 4.328810604912902668951e2
        q = q * z + 4.853903996359136964868e2
        q = q * z + 1.945506571482613964425e2
        y = base + (r + r * z * p / q + tail)
        out[i] = y if x[i] >= 0.0 else -y
        slope[i] = 1.0 / (1.0 + x[i] * x[i])
