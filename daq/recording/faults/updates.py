"""Signals that change less often than they are recorded, and signals in coarse steps."""

import numpy as np

from armident.arrays import Array

LEAST_CHANGES = 50
"""Changes of a signal that tell its period: a period of every second row then errs once in 2^50 recordings."""
LONGEST = 100
"""Longest period of a held signal, rows."""
EARLY = 0.05
"""Share of changes at other rows than those of the period."""
LEAST_COUNTS = 3.0
"""Usual change over the smallest one of a held signal: of a signal in coarse steps most changes are one step."""
ON_GRID = 1e-3
"""Largest distance of a value from a multiple of the smallest change, in such changes, of a signal in coarse steps."""


def held(x: Array) -> int | None:
    """Return the period of a held signal (N,), rows; ``None`` if it changes in every row, or at irregular times."""
    step = np.diff(x)
    at = np.flatnonzero(step)
    if at.size < LEAST_CHANGES or at.size > 0.6 * step.size:
        return None
    between = np.bincount(np.minimum(np.diff(at), LONGEST + 1), minlength=LONGEST + 2)[: LONGEST + 1]
    most = (1.0 - EARLY) * float(between.sum())
    whole = [k for k in range(2, LONGEST + 1) if most > 0 and between[k::k].sum() >= most]
    if whole:
        return max(whole)
    # The clocks of two sources drift: single periods are a row shorter or longer. Coarse steps come at any time.
    period = int(np.argmax(between))
    sizes = np.abs(step[at])
    near = between[period - 1 : period + 2].sum() >= most > 0
    return period if period >= 4 and near and np.median(sizes) >= LEAST_COUNTS * sizes.min() else None


def resolution(x: Array) -> float:
    """Return the step of a signal (N,) whose values lie on a coarse grid; 0 if most values differ by other amounts."""
    sizes = np.abs(np.diff(x))
    sizes = sizes[sizes > 0]
    if sizes.size < LEAST_CHANGES:
        return 0.0
    least = float(np.quantile(sizes, 0.02))
    counts = sizes / least
    return (
        least if np.median(counts) < LEAST_COUNTS and np.mean(np.abs(counts - np.rint(counts)) < ON_GRID) > 0.9 else 0.0
    )
