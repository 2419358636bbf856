"""Presliding: the stiffness with which dry friction builds up after a reversal."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armident.arrays import Array
from armident.identify.characterisation.estimates import RATE_HZ, SEEN, averaged, fitted, solved
from armident.identify.characterisation.motion import KNOTS, Alone
from armident.identify.effects.friction import dahl

DISPLACEMENTS = (1e-5, 0.1)
"""Displacements to try over the joint's range of motion; the largest is that of a diagnosis."""
GRID = 25
"""Displacements of the first search, evenly spaced in their logarithm."""
ITERATIONS, FURTHEST = 8, 0.3
"""Gauss-Newton steps, and the largest change of the logarithm of the stiffness by one of them."""
STEP = 0.01
"""Relative change of a parameter for the derivative of the torque."""
LEAST = 0.2
"""Least friction at any speed over the usual one, for the displacement at that speed."""
OFTEN = 0.5
"""Least reversals per second of a recording over those of the one with most: others show the speeds between them."""
DRAWN, TRAVEL = 600, 20.0
"""Most points that are drawn, and their travel over the displacement in which friction builds up."""


@dataclass(frozen=True, eq=False)
class Reversals:
    """Logarithm of the stiffness of resting friction, N m/rad or N/m, with its standard deviation.

    ``friction``: dry friction at the slowest speed, N m or N. ``seen``: False if the sign of the velocity explains the
    reversals as well. ``drawn`` (L, 3): travel since a reversal, and friction against it, measured and of the model.
    """

    log_stiffness: float
    std: float
    friction: float
    seen: bool
    drawn: Array


def reversals(motions: Sequence[Alone], smoothing: float, orders: Sequence[float] = ()) -> Reversals | None:
    """Return the stiffness of presliding friction; ``None`` if the joint does not reverse alone.

    Friction is that of a bristle (LuGre: Canudas de Wit et al. 1995, IEEE TAC 40(3)), which slides at a level for each
    speed. ``smoothing``: of the sign of the velocity, s/rad or s/m, for the explanation without a bristle.
    ``orders``: of the ripples of the joint, cycles per rad or m.
    """
    often = [float(np.mean(m.turns & m.alone)) / m.dt for m in motions]
    if max(often) == 0.0:
        return None
    used = [m for m, rate in zip(motions, often, strict=True) if rate >= OFTEN * max(often)]
    top = max(float(np.abs(m.speed).max()) for m in used)
    span = max(float(np.ptp(m.q[m.alone])) for m in used)
    shapes = [m.friction(top) for m in used]

    def rows(each: Sequence[Array]) -> list[Array]:
        return [averaged(x[m.alone], m.block(RATE_HZ)) for x, m in zip(each, used, strict=True)]

    torques = rows([m.tau for m in used])
    waves = [2.0 * np.pi * m.q[:, None] * np.array(orders) for m in used]
    linear = rows([np.column_stack([m.rigid(), m.qd, np.cos(w), np.sin(w)]) for m, w in zip(used, waves, strict=True)])

    def unexplained(sides: Sequence[Array], whiten: bool = True) -> tuple[float, Array]:
        parts = rows([shape * side[:, None] for shape, side in zip(shapes, sides, strict=True)])
        columns = [np.hstack(pair) for pair in zip(linear, parts, strict=True)]
        a, y = (fit.whiten(x) if whiten else np.concatenate(x) for x in (columns, torques))
        theta = solved(a, y)
        return float(np.sum((y - a @ theta) ** 2)), theta[-len(KNOTS) :]

    def bristles(p: Array) -> list[Array]:
        levels = [shape @ p[1:] for shape in shapes]
        least = LEAST * float(np.median(np.concatenate(levels)))
        ways = [np.diff(m.q, prepend=m.q[0]) / np.maximum(f, least) for m, f in zip(used, levels, strict=True)]
        return [dahl(np.cumsum(way), float(np.exp(-p[0]))) for way in ways]

    def friction(p: Array) -> list[Array]:
        return [shape @ p[1:] * side for shape, side in zip(shapes, bristles(p), strict=True)]

    trials = span * np.geomspace(*DISPLACEMENTS, GRID)
    tried = [unexplained([dahl(m.q, float(trial)) for m in used], whiten=False) for trial in trials]
    best = min(range(GRID), key=lambda k: tried[k][0])
    level = max(float(np.median(tried[best][1])), 1e-9)
    p = np.append(np.log(level / trials[best]), tried[best][1])
    for _ in range(ITERATIONS):
        now = friction(p)
        here = rows(now)
        steps = STEP * np.append(1.0, np.full(len(KNOTS), np.abs(p[1:]).max()))
        moved = [rows(friction(p + step)) for step in np.diag(steps)]
        slopes = [
            np.stack([(change[k] - f) / step for change, step in zip(moved, steps, strict=True)], axis=1)
            for k, f in enumerate(here)
        ]
        damped = rows([np.gradient(f, m.dt) for f, m in zip(now, used, strict=True)])
        beside = [np.column_stack(pair) for pair in zip(linear, damped, strict=True)]
        aims = [y - f + slope @ p for y, f, slope in zip(torques, here, slopes, strict=True)]
        fit = fitted([np.hstack(pair) for pair in zip(beside, slopes, strict=True)], aims)
        move = fit.theta[-p.size :] - p
        p = p + move / max(1.0, abs(float(move[0])) / FURTHEST)
    rest = [y - a @ fit.theta[: -p.size] for y, a in zip(torques, beside, strict=True)]
    signs = [np.sign(m.qd) for m in used], [2.0 / np.pi * np.arctan(smoothing * m.qd) for m in used]
    gain = min(unexplained(sides)[0] for sides in signs) - unexplained(bristles(p))[0]
    directions = rows([np.sign(m.speed) for m in used])
    travel = rows([m.travel for m in used])
    drawn = np.concatenate(
        [
            np.stack([d, side * y, side * f], axis=1)
            for d, side, y, f in zip(travel, directions, rest, here, strict=True)
        ]
    )
    near = drawn[(drawn[:, 0] <= TRAVEL * level * np.exp(-p[0])) & (np.abs(np.concatenate(directions)) == 1.0)]
    drawn = near[np.linspace(0, len(near) - 1, min(len(near), DRAWN)).astype(int)]
    seen = gain > SEEN and float(p[1]) > 0.0 and bool(np.isfinite(fit.std[-p.size]))
    return Reversals(float(p[0]), float(fit.std[-p.size]), float(p[1]), seen, drawn[np.argsort(drawn[:, 0])])
