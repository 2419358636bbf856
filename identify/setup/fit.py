"""Physical least squares of a set-up hypothesis, and its held-out log predictive score."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.setup.bench import Bench
from armident.identify.setup.limited_least_squares import FLOOR, PASSES, Normal, Solution, every_column
from armident.identify.setup.torque_equations import PARTS

CONVERGED = 6
"""The same where the slope of the fit is used, which assumes that they have converged."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Corrections ``position``, ``torque`` (n, n) of the recorded signals, and of the configuration.

    ``gravity`` (3,): base frame, m/s^2. ``shift`` (n,): torque delay, s. ``clock``: true over recorded duration.
    """

    position: Array
    torque: Array
    gravity: Array
    shift: Array
    clock: float = 1.0


@dataclass(frozen=True, eq=False)
class Fit:
    """Physical fit of a hypothesis: in-sample residual shares of power (n,), residuals (M, n), N m or N."""

    shares: Array
    residual: Array
    theta: Array


def _gravity(h: Hypothesis) -> Array:
    """Gravity (3,) of the equations: accelerations scale with the clock squared, and only their proportion matters."""
    return h.gravity * h.clock**2


def regressors(bench: Bench, h: Hypothesis) -> Array:
    """Regressors (n, M, c) of the corrected torques."""
    return bench.rows(h.position).regressors(_gravity(h))


def fit_shares(bench: Bench, h: Hypothesis) -> Array:
    """Residual share of the power of every recorded torque, in sample, (n,); see `fit`."""
    given = _of_one_joint_each(bench, h)
    return fit(bench, h).shares if given is None else given.solve(PASSES).shares[given.owner]


@dataclass(frozen=True, eq=False)
class Misfit:
    """Sum of the logarithms of the residual shares of the moving joints, nats per row, and its slopes.

    ``by_scale`` (n,): by the logarithm of the factor of each torque. ``by_gravity`` (3,): per m/s^2. ``None`` where a
    recorded torque belongs to several joints, or which was not asked for.
    """

    value: float
    by_scale: Array | None = None
    by_gravity: Array | None = None


def misfit(bench: Bench, h: Hypothesis, used: NDArray[np.bool_] | None = None, *, turned: bool = False) -> Misfit:
    """Return the misfit of a hypothesis with slopes: the fitted parameters, which minimise it, do not change them.

    ``used`` (n,): joints that count where each torque belongs to one. ``turned``: with the slope by gravity.
    """
    given = _of_one_joint_each(bench, h)
    if given is not None and used is not None:
        given = replace(given, normal=given.normal.of(used))
    if given is None:
        return Misfit(float(np.log(fit_shares(bench, h)[bench.moving]).sum()))
    found = given.solve(CONVERGED)
    shares, theta = found.shares, found.theta
    value = float(np.log(shares[given.normal.used]).sum())
    weights = np.where(given.normal.used & (shares > FLOOR), 1.0 / (shares * given.power), 0.0)
    # The power of the model is the residual power less that of the torque, plus twice their product.
    by_scale = 2.0 * weights * (given.power - shares * given.power - found.explained)
    if not turned:
        return Misfit(value, by_scale)
    # What gravity adds per m/s^2, times the residual.
    rows, gravity, n = bench.rows(h.position), _gravity(h), bench.n
    c, heavy = theta.size, theta[rows.columns.heavy]
    columns = np.concatenate([theta, *(g * heavy for g in gravity)])
    wide = rows.wide_products(bench.torque(h.shift), _key(h.shift))[np.arange(n), given.recorded, c:]
    left = rows.square[:, c:] @ columns - given.scale[:, None] * wide
    by_gravity = 2 * h.clock**2 * (weights @ left).reshape(3, -1) @ heavy
    return Misfit(value, by_scale, by_gravity)


@dataclass(frozen=True, eq=False)
class _Given:
    """Normal equations of recorded torques that belong to one joint each, in the joints' order and units."""

    normal: Normal
    products: Array
    power: Array
    owner: NDArray[np.int64]
    recorded: NDArray[np.int64]
    scale: Array

    def solve(self, passes: int) -> Solution:
        return self.normal.solve(self.products, self.power, passes)


def _of_one_joint_each(bench: Bench, h: Hypothesis, *, free: bool = True) -> _Given | None:
    """Normal equations of a hypothesis in which every recorded torque belongs to one joint; else ``None``."""
    at = np.nonzero(h.torque)
    if at[0].size != bench.n or np.any(at[0] != np.arange(bench.n)):
        return None
    (own, recorded), owner = at, np.argsort(at[1])
    if np.any(recorded[owner] != own) or np.any(bench.moving[recorded] != bench.moving):
        return None
    rows, gravity, scale = bench.rows(h.position), _gravity(h), h.torque[at]
    normal = rows.normal(gravity, free=free)
    products = rows.products(gravity, bench.torque(h.shift), _key(h.shift))[own, recorded, : normal.c]
    power = bench.power(h.shift)[recorded] * scale**2
    return _Given(normal, products * scale[:, None], power, owner, recorded, scale)


def _key(shift: Array) -> bytes:
    return np.round(shift, 9).tobytes()


def equations(bench: Bench, h: Hypothesis, *, free: bool = True) -> tuple[Array, Array, Array]:
    """Regressors (M, n, c) of the recorded torques, torques (M, n), constraints (k, c); ``free``: with free terms."""
    x, physical = regressors(bench, h).transpose(1, 0, 2), bench.rows(h.position).physical
    if not free:
        x, physical = x[..., : bench.rigid], physical[:, : bench.rigid]
    if not np.array_equal(h.torque, np.eye(bench.n)):
        x = np.linalg.inv(h.torque) @ x
    return x, bench.torque(h.shift), physical


def fit(bench: Bench, h: Hypothesis, *, free: bool = True) -> Fit:
    """Fit with non-negative mean inertias and dissipative friction; ``free``: with free friction and springs."""
    given = _of_one_joint_each(bench, h, free=free)
    if given is None:
        x, y, physical = equations(bench, h, free=free)
        grams, products, power = _normal(x, y)
        found = every_column(grams, physical, bench.moving).solve(products, power)
        return Fit(found.shares, y - x @ found.theta, found.theta)
    found = given.solve(PASSES)
    made = regressors(bench, h)[:, :, : found.theta.size] @ found.theta / given.scale[:, None]
    return Fit(found.shares[given.owner], bench.torque(h.shift) - made[given.owner].T, found.theta)


def fit_rows(x: Array, y: Array, used: NDArray[np.bool_], physical: Array, moving: NDArray[np.bool_]) -> Array:
    """Parameters (c,) of a fit to equations ``used`` (M, n), with ``x`` (M, n, c) and ``y`` (M, n)."""
    grams, products, power = _normal(x * used[:, :, None], y * used)
    return every_column(grams, physical, moving).solve(products, power).theta


def joint_errors(bench: Bench, h: Hypothesis, *, free: bool = False) -> tuple[Array, Array]:
    """Relative error (n,) of the rigid model at every joint, and correlation (n,) of neighbouring residuals."""
    residual = fit(bench, h, free=free).residual @ h.torque.T
    torque = bench.torque(h.shift) @ h.torque.T
    power = np.maximum((residual**2).sum(axis=0), 1e-300)
    errors = np.sqrt(power / np.maximum((torque**2).sum(axis=0), 1e-300))
    return errors, (residual[1:] * residual[:-1]).sum(axis=0) / power


def held_out(bench: Bench, h: Hypothesis) -> Array:
    """Residual share of the power of every recorded torque (n,) on blocks of time that were not fitted."""
    rows, given = bench.rows(h.position), _of_one_joint_each(bench, h)
    left = np.zeros(bench.n)
    if given is None:
        x, y, physical = equations(bench, h)
        parts = [_normal(x[rows.part == k], y[rows.part == k]) for k in range(PARTS)]
        grams, products, power = (sum(part[i] for part in parts) for i in range(3))
        for gram, product, own_power in parts:
            normal = every_column(grams - gram, physical, bench.moving)
            theta = normal.solve(products - product, power - own_power).theta
            left += own_power - 2 * product @ theta + gram @ theta @ theta
        return np.maximum(left / power, FLOOR)
    x, y = regressors(bench, h), bench.torque(h.shift)[:, given.recorded] * given.scale
    for k, normal in enumerate(rows.parts(_gravity(h))):
        x_k, y_k = x[:, rows.part == k], y[rows.part == k]
        product = np.einsum("kmc,mk->kc", x_k, y_k)
        theta = normal.solve(given.products - product, given.power - (y_k**2).sum(axis=0)).theta
        left += ((y_k.T - x_k @ theta) ** 2).sum(axis=1)
    return np.maximum(left / given.power, FLOOR)[given.owner]


def _normal(x: Array, y: Array) -> tuple[Array, Array, Array]:
    """``X_k' X_k`` (n, c, c), ``X_k' y_k`` (n, c) and ``y_k' y_k`` (n,) of every recorded torque."""
    each = np.ascontiguousarray(x.transpose(1, 0, 2))
    grams = each.transpose(0, 2, 1) @ each
    products = np.einsum("kmc,mk->kc", each, y)
    return grams, products, np.maximum((y**2).sum(axis=0), 1e-300)
