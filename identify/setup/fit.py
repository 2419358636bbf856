"""Physical least squares of a set-up hypothesis, and its held-out log predictive score."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize
from scipy.linalg import lapack

from armident.identify.setup.bench import Bench

Array = NDArray[np.float64]

PASSES = 3
"""Iterations between parameters and the weights of the joints."""

FLOOR = 1e-6
"""Least share of a joint's torque power that counts as residual."""

RIDGE = 1e-6
"""Ridge of the column-normalised normal equations: parameters that a motion does not determine stay small."""

PARTS = 4
"""Parts of the cross-validation; each consists of several blocks of time."""

KEPT = 32
"""Largest number of normal equations that are kept for repeated use."""

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


@dataclass(eq=False)
class Normal:
    """Normal equations of all rows of the model, for one assignment of positions and one gravity.

    ``grams`` (n, c, c): ``X_m' X_m`` of ``x`` (M, n, c). ``products`` (n, n, c): ``X_m' y_k``, by shifts of torques.
    """

    x: Array
    grams: Array
    physical: Array
    products: dict[bytes, Array]


def normal(bench: Bench, h: Hypothesis) -> Normal:
    """Return the normal equations of a hypothesis (not of its torques); repeated calls return the same object."""
    # Accelerations scale with the clock squared; only their proportion to gravity matters to the fit.
    gravity = h.gravity * h.clock**2
    key = np.round(np.concatenate([h.position.ravel(), gravity]), 12).tobytes()
    if key not in bench.normals:
        rows = bench.rows(h.position)
        x = rows.x.copy()
        x[:, :, : bench.rigid] += np.einsum("a,amnb->mnb", gravity, rows.gravity)
        each = np.ascontiguousarray(x.transpose(1, 0, 2))
        if len(bench.normals) > KEPT:
            bench.normals.clear()
        bench.normals[key] = Normal(x, each.transpose(0, 2, 1) @ each, rows.physical, {})
    found: Normal = bench.normals[key]
    return found


def _products(bench: Bench, found: Normal, shift: Array) -> Array:
    key = np.round(shift, 9).tobytes()
    if key not in found.products:
        y = bench.torque(shift)
        found.products[key] = np.einsum("mic,mk->ikc", found.x, y, optimize=True)
    return found.products[key]


def fit_shares(bench: Bench, h: Hypothesis) -> Array:
    """Residual share of the power of every recorded torque, in sample, (n,); see `fit`."""
    owner = np.abs(h.torque).argmax(axis=0)
    scale = h.torque[owner, np.arange(bench.n)]
    single = np.zeros_like(h.torque)
    single[owner, np.arange(bench.n)] = scale
    if not np.array_equal(single, h.torque):
        return fit(bench, h).shares
    found = normal(bench, h)
    grams = found.grams[owner] / (scale**2)[:, None, None]
    products = _products(bench, found, h.shift)[owner, np.arange(bench.n)] / scale[:, None]
    power = np.maximum((bench.torque(h.shift) ** 2).sum(axis=0), 1e-300)
    return _solve(grams, products, power, found.physical, bench.moving)[1]


def equations(bench: Bench, h: Hypothesis, *, free: bool = True) -> tuple[Array, Array, Array]:
    """Regressors (M, n, c) of the recorded torques, torques (M, n), constraints (k, c); ``free``: with free terms."""
    found = normal(bench, h)
    x, physical = (found.x, found.physical) if free else (found.x[..., : bench.rigid], found.physical[:, : bench.rigid])
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
    grams: Array, products: Array, power: Array, physical: Array, used: NDArray[np.bool_]
) -> tuple[Array, Array]:
    weights = used / power
    theta, shares = np.zeros(products.shape[1]), np.ones(power.size)
    for _ in range(PASSES):
        theta = physical_least_squares(np.tensordot(weights, grams, 1), weights @ products, physical)
        shares = np.maximum((power - 2 * products @ theta + grams @ theta @ theta) / power, FLOOR)
        weights = used / (shares * power)
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
