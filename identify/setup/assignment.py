"""Proposals of whole permutations: which torque does the motion of a joint explain."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from armident.arrays import Array
from armident.identify.setup.bench import Bench
from armident.identify.setup.fit import Hypothesis, regressors
from armident.identify.setup.limited_least_squares import every_column

OrderCriterion = Callable[[Array], float]


def by_rows(bench: Bench, h: Hypothesis) -> Hypothesis:
    """Return the hypothesis with the signed assignment of torques that the rows of the model explain best.

    Each row is fitted to each torque of either sign; the least sum of logarithmic residuals decides (Kuhn 1955).
    """
    n = bench.n
    x, physical_rows = regressors(bench, h), bench.rows(h.position).physical
    y = bench.torque(h.shift) @ h.torque.T
    power = np.maximum((y**2).sum(axis=0), 1e-300)
    cost, sign = np.zeros((n, n)), np.ones((n, n))
    for m in range(n):
        used = np.flatnonzero(np.abs(x[m]).max(axis=0) > 0)
        own = x[m][:, used]
        normal = every_column((own.T @ own)[None], physical_rows[m::n][:, used], np.ones(1, np.bool_))
        for k in range(n):
            right = (own.T @ y[:, k])[None]
            shares = [float(normal.solve(sign * right, power[k : k + 1], 1).shares[0]) for sign in (1.0, -1.0)]
            cost[m, k] = np.log(min(shares))
            sign[m, k] = 1.0 if shares[0] <= shares[1] else -1.0
    chosen = np.flatnonzero(bench.moving)
    model, recorded = optimize.linear_sum_assignment(cost[np.ix_(chosen, chosen)])
    taken = np.eye(n)
    taken[chosen, chosen] = 0.0
    taken[chosen[model], chosen[recorded]] = sign[chosen[model], chosen[recorded]]
    return replace(h, torque=taken @ h.torque)


def by_friction(bench: Bench, h: Hypothesis) -> Array:
    """Return the signed permutation (n, n) from recorded torques to the recorded positions that they belong to.

    Dry friction changes only the torque of its own joint where that joint turns round. Needs no model of the arm.
    """
    n = bench.n
    rows = bench.rows(np.eye(n))
    dry, slow = rows.friction[:, :, 0], rows.qd
    fast = bench.kept([s.qdd for s in bench.segments])
    q = bench.kept([s.q for s in bench.segments])
    smooth = np.concatenate([np.ones((q.shape[0], 1)), q, np.sin(q), np.cos(q), fast, slow], axis=1)
    basis, _ = np.linalg.qr(smooth)
    y = bench.torque(h.shift)
    y = y - basis @ (basis.T @ y)
    own = dry - basis @ (basis.T @ dry)
    coefficients = np.linalg.lstsq(own, y, rcond=None)[0]
    spread = np.sqrt(np.mean((y - own @ coefficients) ** 2, axis=0))
    inverse = np.sqrt(np.maximum(np.diag(np.linalg.pinv(own.T @ own)), 1e-300))
    t = coefficients / np.maximum(inverse[:, None] * spread, 1e-300)
    chosen = np.flatnonzero(bench.moving)
    joint, recorded = optimize.linear_sum_assignment(-np.abs(t[np.ix_(chosen, chosen)]))
    taken = np.eye(n)
    taken[chosen, chosen] = 0.0
    taken[chosen[joint], chosen[recorded]] = np.where(t[chosen[joint], chosen[recorded]] >= 0, 1.0, -1.0)
    return taken


def orders(moving: NDArray[np.bool_]) -> Iterator[Array]:
    """Permutation matrices (n, n) of the joints that move. ``moving``: mask (n,) of the joints that move."""
    chosen = np.flatnonzero(moving)
    for order in permutations(chosen):
        rows = np.arange(moving.size)
        rows[chosen] = order
        yield np.eye(moving.size)[rows]


def usual_orders(moving: NDArray[np.bool_]) -> list[Array]:
    """Orders from which a search by exchanges starts: as configured, reversed, and all rotations."""
    own, chosen = np.eye(moving.size), np.flatnonzero(moving)
    made = []
    for order in (chosen, chosen[::-1], *(np.roll(chosen, k) for k in range(1, chosen.size))):
        rows = np.arange(moving.size)
        rows[chosen] = order
        made.append(own[rows])
    return made


def exchanged(order: Array, first: int, second: int) -> Array:
    """Return an order, a permutation matrix (n, n), with two joints exchanged."""
    other = order.copy()
    other[[first, second]] = other[[second, first]]
    return other
