"""Equations of the rigid arm for one assignment of positions, and their normal equations under any gravity."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.robot.arm import ArmModel
from armident.identify.setup.limited_least_squares import Normal, normal_equations

Places = NDArray[np.int64]

SLOW = 0.02
"""Share of a joint's largest velocity below which the sign of its velocity is smoothed."""

BREAKAWAY = 0.1
"""Share of a joint's largest velocity over which the free friction term of low velocities decays."""

SPRING_TERMS = 2
"""Springs of every joint beside the rigid model: linear and cubic. Without the cubic one a spring that stiffens looks
like another direction of gravity."""

ROTOR_TERMS = 1
"""Rotor inertia of every joint beside the rigid model: where the configuration lacks it, its torque looks like another
unit of the positions."""

FREE_TERMS = SPRING_TERMS + ROTOR_TERMS + 3
"""Free terms of every joint beside the rigid model: springs, rotor inertia, asymmetric, quadratic and low-velocity
friction."""

NORMAL_KEPT = 4
"""Largest number of gravities whose normal equations are kept for each assignment: torques are changed one by one."""

POSTURES = 40
"""Postures over which moments of inertia are averaged."""

ODD = np.array([True, False, True, True])
"""Terms of `friction_terms` that change their sign with the velocity."""

PARTS = 4
"""Parts of the cross-validation; each consists of several blocks of time."""

POSTURE_EVERY = 15
"""Least number of instants between these postures: neighbouring ones are alike."""

BLOCKS = 24
"""Contiguous blocks of time per experiment set: long against the memory of the residual."""

REGRESSORS_KEPT = 4
"""Largest number of regressors that are kept of all hypotheses, 4 MB each for seven joints."""

PRODUCTS_KEPT = 64
"""Largest number of shifts of the torques whose products with the regressors are kept for repeated use."""


def make_room(kept: dict[Any, Any], most: int) -> None:
    """Remove the oldest entries of a cache, so that with one more it has ``most`` entries."""
    while len(kept) >= most:
        del kept[next(iter(kept))]


def friction_terms(qd: Array, top: Array) -> Array:
    """Free friction terms (W, n, 4): dry, asymmetric viscous, quadratic, and dry at low velocity only."""
    u = qd / top
    sign = 2 / np.pi * np.arctan(u / SLOW)
    return np.stack([sign, np.abs(u), u * np.abs(u), sign * np.exp(-np.abs(u) / BREAKAWAY)], axis=2)


@dataclass(frozen=True, eq=False)
class Columns:
    """Structure of the equations of n joints: b base parameters, then the free terms of each joint.

    ``named``: columns of the base parameters. ``heavy`` (h,): columns that gravity changes; ``constant``: those that an
    arm at rest without gravity has. ``acting``: columns of each joint's torque. ``own`` (n, o): those of them that act
    on no other one, -1 for none; ``shared`` (s,): the others.
    """

    named: dict[str, int]
    rigid: int
    heavy: Places
    constant: Places
    acting: tuple[Places, ...]
    own: Places
    shared: Places

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.acting)

    @property
    def c(self) -> int:
        """Number of columns."""
        return self.rigid + FREE_TERMS * self.n

    @cached_property
    def friction(self) -> Places:
        """Columns of the friction of each joint, (n, 5): viscous, then the `friction_terms`."""
        named = [[self.named[f"{kind}{j + 1}"] for kind in ("fv", "fc")] for j in range(self.n)]
        return np.concatenate([np.array(named), self.free[:, SPRING_TERMS + ROTOR_TERMS :]], axis=1)

    @cached_property
    def free(self) -> Places:
        """Columns of the free terms of each joint, (n, .): springs, rotor, friction."""
        return self.rigid + np.arange(FREE_TERMS * self.n).reshape(self.n, -1)

    @cached_property
    def squares(self) -> list[Any]:
        """Indices of the products of the columns of each joint's torque."""
        return [np.ix_(used, used) for used in self.acting]


def columns_of(model: ArmModel) -> Columns:
    """Return the structure of the equations of a model with gravity: from postures without any symmetry."""
    n, rigid = model.n, model.base.b
    q, qd, qdd = np.random.default_rng(0).uniform(-np.pi, np.pi, (3, POSTURES, n))
    still = 0.0 * q
    weightless = model.with_gravity(np.zeros(3)).rigid_regressor(q, still, still)
    heavy = np.any(model.rigid_regressor(q, still, still) != weightless, axis=(0, 1))
    constant = np.any(weightless != 0.0, axis=(0, 1))
    acts = np.zeros((n, rigid + FREE_TERMS * n), np.bool_)
    acts[:, :rigid] = np.any(model.rigid_regressor(q, qd, qdd) != 0.0, axis=0)
    for j in range(n):
        acts[j, rigid + FREE_TERMS * j + np.arange(FREE_TERMS)] = True
    alone = acts.sum(axis=0) == 1
    places = [np.flatnonzero(alone & row) for row in acts]
    own = np.full((n, max(p.size for p in places)), -1)
    for line, p in zip(own, places, strict=True):
        line[: p.size] = p
    named = {model.names[k]: column for column, k in enumerate(model.base.independent)}
    acting = tuple(np.flatnonzero(row) for row in acts)
    return Columns(named, rigid, np.flatnonzero(heavy), np.flatnonzero(constant), acting, own, np.flatnonzero(~alone))


@dataclass(eq=False)
class Rows:
    """Equations of all joints along a motion ``q``, ``qd``, ``qdd`` (M, n) with ``friction`` terms (M, n, 4).

    ``under``: model under a gravity (3,), m/s^2; ``moving`` (n,): joints that move. ``kept``: regressors of some
    assignments, of which this one has a ``key``. Equations under the gravity of the first call are direct; others are
    made from products with what gravity adds.
    """

    columns: Columns
    under: Callable[[Array], ArmModel]
    moving: NDArray[np.bool_]
    q: Array
    qd: Array
    qdd: Array
    friction: Array
    key: bytes
    kept: dict[bytes, Array] = field(repr=False)
    _first: Array | None = field(default=None, repr=False)
    _normal: dict[tuple[bytes, bool], Normal] = field(default_factory=dict, repr=False)
    _products: dict[bytes, Array] = field(default_factory=dict, repr=False)

    def regressors(self, gravity: Array) -> Array:
        """Regressors (n, M, c) of the torques: base parameters and free terms."""
        key = self.key + gravity.tobytes()
        if key not in self.kept:
            make_room(self.kept, REGRESSORS_KEPT)
            self.kept[key] = self._regressors(self.under(gravity))
        return self.kept[key]

    def _regressors(self, model: ArmModel) -> Array:
        columns, joints = self.columns, np.arange(self.columns.n)[:, None]
        x = np.zeros((columns.n, self.q.shape[0], columns.c))
        x[:, :, : columns.rigid] = model.rigid_regressor(self.q, self.qd, self.qdd).transpose(1, 0, 2)
        x[:, :, columns.friction[:, 1]] = 0.0
        stroke = (self.q - self.q.mean(axis=0)).T
        most = np.maximum(np.abs(stroke).max(axis=1, keepdims=True), 1e-12)
        x[joints, :, columns.friction[:, 1:]] = self.friction.transpose(1, 2, 0)
        x[joints, :, columns.free[:, : SPRING_TERMS + ROTOR_TERMS]] = np.stack(
            [stroke, stroke**3 / most**2, self.qdd.T], axis=1
        )
        return x

    @cached_property
    def weights_of_gravity(self) -> Array:
        """Columns (n, M, 3 h) that gravity along each base axis adds to the heavy ones, per m/s^2."""
        still, heavy = np.zeros_like(self.q), self.columns.heavy
        at_rest, *along = (
            self.under(g).rigid_regressor(self.q, still, still)[:, :, heavy] for g in (np.zeros(3), *np.eye(3))
        )
        parts = np.concatenate([x - at_rest for x in along], axis=2)
        return np.ascontiguousarray(parts.transpose(1, 0, 2))

    def of_gravity(self, values: Array) -> Array:
        """Torques (n, M, 3) of gravity along each base axis, per m/s^2, with values of the columns (c,)."""
        parts, h = self.weights_of_gravity, self.columns.heavy.size
        return np.asarray(parts.reshape(*parts.shape[:2], 3, h) @ values[self.columns.heavy])

    @cached_property
    def physical(self) -> Array:
        """Rows (3 n, c) with products that are not negative: mean inertia, friction power, rotor inertia."""
        columns, joints = self.columns, np.arange(self.columns.n)
        physical = np.zeros((3, columns.n, columns.c))
        physical[0, :, : columns.rigid] = self._mean_inertia()
        physical[[[0], [2]], joints, columns.free[:, SPRING_TERMS]] = 1.0
        terms = np.concatenate([self.qd[:, :, None], self.friction], axis=2)
        physical[1, joints[:, None], columns.friction] = np.einsum("mj,mjk->jk", self.qd, terms) / self.q.shape[0]
        return physical.reshape(3 * columns.n, -1)

    def _mean_inertia(self) -> Array:
        """Torque of each joint per unit of its own acceleration, mean over postures, (n, b)."""
        n, rigid = self.columns.n, self.columns.rigid
        q = self.q[:: max(1, self.q.shape[0] // POSTURES, POSTURE_EVERY)]
        postures, still = np.tile(q, (n, 1)), np.zeros((n * q.shape[0], n))
        push = np.repeat(np.eye(n), q.shape[0], axis=0)
        moved = self.under(np.zeros(3)).rigid_regressor(postures, still, push).reshape(n, -1, n, rigid)
        own = moved[np.arange(n), :, np.arange(n)].mean(axis=1)
        own[:, self.columns.constant] = 0.0
        return np.asarray(own)

    def normal(self, gravity: Array, *, free: bool = True) -> Normal:
        """Normal equations under a gravity; ``free``: with the free terms."""
        key = gravity.tobytes(), free
        if key not in self._normal:
            make_room(self._normal, NORMAL_KEPT)
            if self._is_first(gravity) or not free:
                grams = self._grams(self.regressors(gravity))
            else:
                grams = self._turned(gravity, self._turned(gravity, self.square).transpose(0, 2, 1))
            self._normal[key] = self._of(grams, free)
        return self._normal[key]

    def parts(self, gravity: Array) -> list[Normal]:
        """Normal equations of all rows but those of each part of the cross-validation."""
        x = self.regressors(gravity)
        own = [self._grams(x[:, self.part == k]) for k in range(PARTS)]
        whole = sum(own)
        return [self._of(whole - grams) for grams in own]

    @property
    def part(self) -> Places:
        """Part of the cross-validation of every row, (M,)."""
        m = self.q.shape[0]
        return np.asarray((np.arange(m) * BLOCKS // m) % PARTS)

    def products(self, gravity: Array, torque: Array, shift: bytes) -> Array:
        """``X_m' y_k`` of all rows of the model with all torques (M, n), (n, n, c); ``shift``: key of the torques."""
        if not self._is_first(gravity):
            return self._turned(gravity, self.wide_products(torque, shift))
        if shift not in self._products:
            make_room(self._products, PRODUCTS_KEPT)
            self._products[shift] = (self.regressors(gravity).transpose(0, 2, 1) @ torque).transpose(0, 2, 1)
        return self._products[shift]

    def wide_products(self, torque: Array, shift: bytes) -> Array:
        """The same without gravity, then of what gravity adds along each base axis, (n, n, c + 3 h)."""
        key = b"wide" + shift
        if key not in self._products:
            make_room(self._products, PRODUCTS_KEPT)
            self._products[key] = (self._wide.transpose(0, 2, 1) @ torque).transpose(0, 2, 1)
        return self._products[key]

    @cached_property
    def square(self) -> Array:
        """Products of all columns without gravity and of what gravity adds, (n, c + 3 h, c + 3 h)."""
        columns, wide = self.columns, self._wide
        h, c = columns.heavy.size, columns.c
        felt = [np.flatnonzero(np.isin(columns.heavy, own)) for own in columns.acting]
        acting = [
            np.concatenate([own, *(c + a * h + f for a in range(3))])
            for own, f in zip(columns.acting, felt, strict=True)
        ]
        return _grams(wide, acting, [np.ix_(used, used) for used in acting])

    @cached_property
    def _wide(self) -> Array:
        weightless = self._regressors(self.under(np.zeros(3)))
        return np.concatenate([weightless, self.weights_of_gravity], axis=2)

    def _turned(self, gravity: Array, wide: Array) -> Array:
        """Regressors, or products with them, (..., c) under a gravity from those with all columns."""
        heavy = self.columns.heavy
        h, c = heavy.size, wide.shape[-1] - 3 * heavy.size
        found = wide[..., :c].copy()
        found[..., heavy] += sum(g * wide[..., c + a * h : c + (a + 1) * h] for a, g in enumerate(gravity))
        return found

    def _is_first(self, gravity: Array) -> bool:
        if self._first is None:
            self._first = gravity.copy()
        return np.array_equal(self._first, gravity)

    def _grams(self, x: Array) -> Array:
        return _grams(x, self.columns.acting, self.columns.squares)

    def _of(self, grams: Array, free: bool = True) -> Normal:
        own, c = self.columns.own, self.columns.c if free else self.columns.rigid
        own = np.where(own < c, own, -1)
        return normal_equations(grams[:, :c, :c], self.physical[:, :c], self.moving, own, self.columns.shared)


def _grams(x: Array, acting: Sequence[Places], squares: Sequence[Any]) -> Array:
    """Products of the columns (n, M, c) that act on each torque, (n, c, c)."""
    made = np.zeros((x.shape[0], x.shape[2], x.shape[2]))
    for gram, rows, used, square in zip(made, x, acting, squares, strict=True):
        # A joint feels the links beyond it only, and its own friction.
        felt = rows[:, used]
        gram[square] = felt.T @ felt
    return made
