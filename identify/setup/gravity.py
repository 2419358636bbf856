"""Gravity and clock of a set-up: direction anywhere on the sphere, no gravity at all, torques late by one time."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from armident.arrays import Array
from armident.identify.setup.fit import Hypothesis, Misfit

Criterion = Callable[[Hypothesis], float]
SlopedCriterion = Callable[[Hypothesis], Misfit]

STANDARD = 9.81
"""Magnitude of gravity where the configuration has none, m/s^2."""

DIRECTIONS = np.array([np.array(d) / np.linalg.norm(d) for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
"""Directions from which the search starts: faces, edges and corners of a cube, (26, 3)."""

STARTS = 2
"""Number of directions that are refined."""

EQUAL = 0.02
"""Difference of the misfit, nats per row, below which two directions fit equally well: 2 % of one joint's power."""

FIRST_TILT = 0.1
"""First step of the refinement, rad: less than a third of the angle between neighbouring directions."""

FLAT, UNCHANGED = 1e-4, 1e-9
"""Slope of the misfit per first step, and its relative change, that end the refinement: far below `EQUAL`."""

DIFFERENCE = 1e-6
"""Difference, in first steps, from which a slope is computed where the misfit has none."""

SHIFTS_S = (1e-3, 2e-3, 4e-3, 8e-3, 16e-3, 32e-3, 64e-3)
"""Shifts that are tried before the refinement, s, to both sides."""


def best_direction(h: Hypothesis, criterion: SlopedCriterion) -> Hypothesis:
    """Return the hypothesis with the best direction of gravity, of the same magnitude.

    Opposite directions fit equally where first moments change sign, too: the one nearest to the configured one wins.
    """
    size = float(np.linalg.norm(h.gravity)) or STANDARD
    tried = sorted(DIRECTIONS, key=lambda d: criterion(replace(h, gravity=size * d)).value)
    starts = [*tried[:STARTS], *([h.gravity / size] if h.gravity.any() else [])]
    found = [_refined(h, size, start, criterion) for start in starts]
    least = min(value for value, _ in found)
    equal = [turned for value, turned in found if value <= least + EQUAL]
    return max(equal, key=lambda turned: float(turned.gravity @ h.gravity))


def _refined(h: Hypothesis, size: float, start: Array, criterion: SlopedCriterion) -> tuple[float, Hypothesis]:
    """Least misfit near a direction, and its hypothesis: a search along the plane that touches the sphere there."""
    across = FIRST_TILT * np.array(_across(start))

    def turned(sides: Array) -> tuple[Hypothesis, float]:
        direction = start + sides @ across
        length = float(np.linalg.norm(direction))
        return replace(h, gravity=size / length * direction), length

    def value(sides: Array) -> float:
        return criterion(turned(sides)[0]).value

    def sloped(sides: Array) -> tuple[float, Array]:
        other, length = turned(sides)
        found = criterion(other)
        if found.by_gravity is None:
            return found.value, np.asarray(optimize.approx_fprime(sides, value, DIFFERENCE))
        radial = other.gravity / size
        along = found.by_gravity - (found.by_gravity @ radial) * radial
        return found.value, np.asarray(size / length * across @ along)

    found = optimize.minimize(
        sloped,
        np.zeros(2),
        jac=True,
        method="L-BFGS-B",
        options={"ftol": UNCHANGED, "gtol": FLAT, "maxiter": 20},
    )
    return float(found.fun), turned(np.asarray(found.x))[0]


def best_shift(h: Hypothesis, criterion: Criterion, dt: float, mask: NDArray[np.bool_]) -> Hypothesis:
    """Return the hypothesis with the best common shift, up to 1000 samples, of the torques in ``mask``."""

    def late(shift: float) -> Hypothesis:
        return replace(h, shift=h.shift + shift * mask)

    steps = [s for s in (*SHIFTS_S, 2 * dt, 5 * dt, 10 * dt) if 0.5 * dt <= s <= 1000 * dt]
    grid = sorted({0.0, *steps, *(-s for s in steps)})
    values = [criterion(late(s)) for s in grid]
    k = int(np.argmin(values))
    bounds = grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)]
    found = optimize.minimize_scalar(
        lambda s: criterion(late(float(s))), bounds=bounds, method="bounded", options={"xatol": 0.1 * dt, "maxiter": 25}
    )
    return late(float(found.x)) if found.fun < values[k] else late(grid[k])


def _across(direction: Array) -> tuple[Array, Array]:
    start = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = start - (start @ direction) * direction
    first /= np.linalg.norm(first)
    return first, np.cross(direction, first)
