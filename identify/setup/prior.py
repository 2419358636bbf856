"""Mistakes of a set-up, their composition, and the prior of a hypothesis: the number of things that are wrong."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.setup.fit import Hypothesis

MISTAKE = math.log(100.0)
"""Cost of each mistake, nats: one set-up of a hundred has a mistake of a given kind."""

RAW = 1.0
"""Further cost of an exchange of raw numbers, nats: columns are meant where both explain the recordings equally."""

FACTOR = math.log(10.0)
"""Cost of each free factor of all torques, nats: it lies in one of ten intervals that the data tell apart."""

PREFERENCE = {"torque": 0.0, "both": 0.2, "position": 0.4}
"""Further cost, nats, among hypotheses that a symmetry of the arm makes equal: signs of torques are a convention."""

WIRING = ("position_sign", "torque_sign", "exchange", "assignment", "order")
"""Families that only permute signals or change their signs."""


@dataclass(frozen=True, eq=False)
class Mistake:
    """One mistake: what its correction adds to those before it.

    ``position``, ``torque`` (n, n) multiply the corrections. ``gravity`` (3,): replaces it, m/s^2. ``shift`` (n,), s,
    is added and ``clock`` multiplied. ``raw``: raw numbers of drives are exchanged.
    """

    family: str
    words: str
    position: Array
    torque: Array
    shift: Array
    gravity: Array | None = None
    clock: float = 1.0
    raw: bool = False


def between(old: Hypothesis, new: Hypothesis, family: str, words: str, raw: bool = False) -> Mistake:
    """Return the mistake that leads from one hypothesis to another."""
    return Mistake(
        family,
        words,
        new.position @ np.linalg.inv(old.position),
        new.torque @ np.linalg.inv(old.torque),
        new.shift - old.shift,
        None if np.array_equal(old.gravity, new.gravity) else new.gravity,
        new.clock / old.clock,
        raw,
    )


def composed(start: Hypothesis, mistakes: Iterable[Mistake]) -> Hypothesis:
    """Return a hypothesis with mistakes corrected one after the other."""
    h = start
    for m in mistakes:
        gravity = h.gravity if m.gravity is None else m.gravity
        h = Hypothesis(m.position @ h.position, m.torque @ h.torque, gravity, h.shift + m.shift, h.clock * m.clock)
    return h


def cost(mistakes: Iterable[Mistake], n: int) -> float:
    """Negative logarithm of the prior of a hypothesis, nats.

    Permutations and signs are judged by their product: two ways to the same wiring cost the same.
    """
    total, position, torque = 0.0, np.eye(n), np.eye(n)
    for m in mistakes:
        if m.family in WIRING and not m.raw:
            position, torque = m.position @ position, m.torque @ torque
        else:
            total += MISTAKE + _place_cost(m.position, m.torque) + (RAW if m.raw else 0.0)
            if m.family == "torque_scales":
                total += n * FACTOR
    return total + wiring_cost(position, torque)


def _place_cost(position: Array, torque: Array) -> float:
    """One joint among n, one set of joints among all of its size, or all joints."""
    n = position.shape[0]
    changed = np.any((np.abs(position - np.eye(n)) > 1e-12) | (np.abs(torque - np.eye(n)) > 1e-12), axis=1)
    return math.log(max(math.comb(n, int(changed.sum())), n))


def wiring_cost(position: Array, torque: Array) -> float:
    """Negative logarithm of the prior of signed permutations (n, n) of positions and torques, nats."""
    n = position.shape[0]
    own = np.arange(n)
    orders = [np.abs(m).argmax(axis=1) for m in (position, torque)]
    turned = [np.sign(m[own, order]) < 0 for m, order in zip((position, torque), orders, strict=True)]
    moved = [order for order in orders if not np.array_equal(order, own)]
    if len(moved) == 2 and np.array_equal(orders[0], orders[1]):
        total = _order_cost(orders[0]) + PREFERENCE["both"]
    else:
        total = sum(_order_cost(order) for order in moved)
    groups = {
        "both": turned[0] & turned[1],
        "position": turned[0] & ~turned[1],
        "torque": ~turned[0] & turned[1],
    }
    return total + sum(_sign_cost(mask) + PREFERENCE[name] for name, mask in groups.items() if mask.any())


def _order_cost(order: NDArray[np.int64]) -> float:
    """One exchange of two among all pairs, or one order among all."""
    n = order.size
    pair = int(np.sum(order != np.arange(n))) == 2
    return MISTAKE + (math.log(n * (n - 1) / 2) if pair else math.lgamma(n + 1))


def _sign_cost(mask: NDArray[np.bool_]) -> float:
    """One signal among n, all signals together, or several of them."""
    n, count = mask.size, int(mask.sum())
    return MISTAKE * (1 if count in (1, n) else min(count, n - count + 1)) + math.log(n)
