"""Physical least squares of a set-up hypothesis, and its held-out log predictive score."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize
from scipy.linalg import lapack

from armident.identify.setup.bench import GRAMS_KEPT, Bench, make_room

Array = NDArray[np.float64]

PASSES = 3
"""Iterations between parameters and the weights of the joints."""

CONVERGED = 6
"""The same where the slope of the fit is used, which assumes that they have converged."""

SETTLED = 1e-4
"""Relative change of the shares that ends these iterations: a two-hundredth of what is worth a refinement."""

FLOOR = 1e-6
"""Least share of a joint's torque power that counts as residual."""

RIDGE = 1e-6
"""Ridge of the column-normalised normal equations: parameters that a motion does not determine stay small."""

PARTS = 4
"""Parts of the cross-validation; each consists of several blocks of time."""

KEPT = 64
"""Largest number of shifts of the torques whose products with the regressors are kept for repeated use."""

BLOCKS = 24
"""Contiguous blocks of time per experiment set: long against the memory of the residual."""


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


def grams_of(bench: Bench, h: Hypothesis) -> Array:
    """``X_m' X_m`` of all rows of the model, (n, c, c)."""
    rows, gravity = bench.rows(h.position), _gravity(h)
    key = gravity.tobytes()
    if key not in rows.grams:
        make_room(rows.grams, GRAMS_KEPT)
        rows.grams[key] = rows.under(gravity, rows.under(gravity, rows.square).transpose(0, 2, 1))
    return rows.grams[key]


def products_of(bench: Bench, h: Hypothesis) -> Array:
    """``X_m' y_k`` of all rows of the model with all recorded torques, (n, n, c)."""
    return bench.rows(h.position).under(_gravity(h), _wide_products(bench, h))


def _wide_products(bench: Bench, h: Hypothesis) -> Array:
    """The same with all columns of `Rows.wide`."""
    rows, key = bench.rows(h.position), np.round(h.shift, 9).tobytes()
    if key not in rows.products:
        make_room(rows.products, KEPT)
        rows.products[key] = (rows.wide.transpose(0, 2, 1) @ bench.torque(h.shift)).transpose(0, 2, 1)
    return rows.products[key]


def regressors(bench: Bench, h: Hypothesis) -> Array:
    """Regressors (n, M, c) of the corrected torques."""
    rows = bench.rows(h.position)
    return rows.under(_gravity(h), rows.wide)


def fit_shares(bench: Bench, h: Hypothesis) -> Array:
    """Residual share of the power of every recorded torque, in sample, (n,); see `fit`."""
    known = _of_one_joint_each(bench, h)
    return fit(bench, h).shares if known is None else _solve(*known)[1]


@dataclass(frozen=True, eq=False)
class Misfit:
    """Sum of the logarithms of the residual shares of the moving joints, nats per row, and its slopes.

    ``by_scale`` (n,): by the logarithm of the factor of each torque. ``by_gravity`` (3,): per m/s^2. ``None`` where a
    recorded torque belongs to several joints.
    """

    value: float
    by_scale: Array | None = None
    by_gravity: Array | None = None


def misfit(bench: Bench, h: Hypothesis) -> Misfit:
    """Return the misfit of a hypothesis with slopes: the fitted parameters, which minimise it, do not change them."""
    known = _of_one_joint_each(bench, h)
    if known is None:
        return Misfit(float(np.log(fit_shares(bench, h)[bench.moving]).sum()))
    theta, shares = _solve(*known, passes=CONVERGED)
    grams, products, power = known[:3]
    weights = np.where(bench.moving & (shares > FLOOR), 1.0 / (shares * power), 0.0)
    owner, own = np.abs(h.torque).argmax(axis=0), np.arange(bench.n)
    by_scale = np.zeros(bench.n)
    by_scale[owner] = 2 * weights * (products @ theta - grams @ theta @ theta)
    # What gravity adds per m/s^2, times the residual.
    rows, gravity = bench.rows(h.position), _gravity(h)
    light, heavy = theta.size, theta[rows.heavy]
    columns = np.concatenate([theta, *(g * heavy for g in gravity)])
    recorded = h.torque[owner, own, None] * _wide_products(bench, h)[owner, own, light:]
    left = rows.square[owner, light:] @ columns - recorded
    by_gravity = 2 * h.clock**2 * (weights @ left).reshape(3, -1) @ heavy
    return Misfit(float(np.log(shares[bench.moving]).sum()), by_scale, by_gravity)


def _of_one_joint_each(bench: Bench, h: Hypothesis) -> tuple[Array, Array, Array, Array, NDArray[np.bool_]] | None:
    """Normal equations of recorded torques that belong to one joint each, in its units; else ``None``."""
    owner, own = np.abs(h.torque).argmax(axis=0), np.arange(bench.n)
    scale = h.torque[owner, own]
    if np.count_nonzero(h.torque) != np.count_nonzero(scale):
        return None
    grams = grams_of(bench, h)
    if not np.array_equal(owner, own):
        grams = grams[owner]
    products = products_of(bench, h)[owner, own] * scale[:, None]
    power = np.maximum((bench.torque(h.shift) ** 2).sum(axis=0), 1e-300) * scale**2
    return grams, products, power, bench.rows(h.position).physical, bench.moving


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
    x, y, physical = equations(bench, h, free=free)
    grams, products, power = _normal(x, y)
    theta, shares = _solve(grams, products, power, physical, bench.moving)
    return Fit(shares, y - x @ theta, theta)


def fit_rows(x: Array, y: Array, used: NDArray[np.bool_], physical: Array, moving: NDArray[np.bool_]) -> Array:
    """Parameters (c,) of a fit to equations ``used`` (M, n), with ``x`` (M, n, c) and ``y`` (M, n)."""
    theta, _ = _solve(*_normal(x * used[:, :, None], y * used), physical, moving)
    return theta


def joint_errors(bench: Bench, h: Hypothesis, *, free: bool = False) -> tuple[Array, Array]:
    """Relative error (n,) of the rigid model at every joint, and correlation (n,) of neighbouring residuals."""
    residual = fit(bench, h, free=free).residual @ h.torque.T
    torque = bench.torque(h.shift) @ h.torque.T
    power = np.maximum((residual**2).sum(axis=0), 1e-300)
    errors = np.sqrt(power / np.maximum((torque**2).sum(axis=0), 1e-300))
    return errors, (residual[1:] * residual[:-1]).sum(axis=0) / power


def held_out(bench: Bench, h: Hypothesis) -> Array:
    """Residual share of the power of every recorded torque (n,) on blocks of time that were not fitted."""
    x, y, physical = equations(bench, h)
    block = (np.arange(y.shape[0]) * BLOCKS // y.shape[0]) % PARTS
    parts = [_normal(x[block == k], y[block == k]) for k in range(PARTS)]
    total = [sum(part[i] for part in parts) for i in range(3)]
    left = np.zeros(bench.n)
    for grams, products, power in parts:
        theta, _ = _solve(total[0] - grams, total[1] - products, total[2] - power, physical, bench.moving)
        left += power - 2 * products @ theta + grams @ theta @ theta
    return np.maximum(left / total[2], FLOOR)


def _normal(x: Array, y: Array) -> tuple[Array, Array, Array]:
    """``X_k' X_k`` (n, c, c), ``X_k' y_k`` (n, c) and ``y_k' y_k`` (n,) of every recorded torque."""
    each = np.ascontiguousarray(x.transpose(1, 0, 2))
    grams = each.transpose(0, 2, 1) @ each
    products = np.einsum("kmc,mk->kc", each, y)
    return grams, products, np.maximum((y**2).sum(axis=0), 1e-300)


def _solve(
    grams: Array, products: Array, power: Array, physical: Array, used: NDArray[np.bool_], passes: int = PASSES
) -> tuple[Array, Array]:
    weights, flat = used / power, grams.reshape(power.size, -1)
    theta, shares = np.zeros(products.shape[1]), np.ones(power.size)
    for _ in range(passes):
        theta = physical_least_squares((weights @ flat).reshape(grams.shape[1:]), weights @ products, physical)
        before, shares = shares, np.maximum((power - 2 * products @ theta + grams @ theta @ theta) / power, FLOOR)
        weights = used / (shares * power)
        if np.all(np.abs(shares - before) < SETTLED * shares):
            break
    return theta, shares


def physical_least_squares(gram: Array, right: Array, physical: Array) -> Array:
    """``min theta' gram theta / 2 - right' theta`` subject to ``physical theta >= 0``, through the dual problem.

    Lawson, Hanson, Solving Least Squares Problems, 1974, chapter 23.
    """
    scale = np.sqrt(np.diag(gram))
    scale[scale <= 1e-12 * scale.max(initial=0.0)] = np.inf
    # LAPACK itself: scipy's checks of the arguments take as long, thousands of times in a search.
    lower, failed = lapack.dpotrf(gram / np.outer(scale, scale) + RIDGE * np.eye(scale.size), lower=1)
    if failed:
        raise np.linalg.LinAlgError("the normal equations are not positive definite")
    free = lapack.dtrtrs(lower, right / scale, lower=1)[0]
    limits = lapack.dtrtrs(lower, (physical / scale).T, lower=1)[0]
    limits /= np.maximum(np.linalg.norm(limits, axis=0), 1e-300)
    if np.any(limits.T @ free < 0):
        free = free + limits @ optimize.nnls(limits, -free)[0]
    theta: Array = lapack.dtrtrs(lower, free, lower=1, trans=1)[0] / scale
    return theta
