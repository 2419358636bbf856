"""Refined instrumental variables for the control law of a drive (thesis section 3.2).

A controller's recorded inputs are exactly those that it uses; all noise is on its recorded output (thesis 5.2.2). The
inputs are their own instruments. That of a filter's past output is the output simulated with the last estimate (3.10).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armident.arrays import Array
from armident.configs import DataError
from armident.identify.controller.law import Stretch, Structure, columns, integral_slopes, pole_filter, simulate_law
from armident.identify.regression.ar_noise import WHITE, ArModel, fit_ar
from armident.identify.signals.recursive import recursive_filter

ITERATIONS = 40
"""Largest number of iterations."""

TOLERANCE = 1e-3
"""Change of every parameter that ends the iterations, over its standard deviation (at least 0.1 % of its value)."""

NOISE_ORDER = 20
"""Highest order of the AR noise model; Akaike's criterion chooses one below. With 10 and 40 the gains of 26 drives,
simulated ones and EMPS, change by less than 1.1e-4."""

FASTEST, SLOWEST = -0.9, 0.995
"""Range of the filter's pole; an estimate outside is moved to the bound (the thesis reflects it)."""

SETTLED = 1e-6
"""Share of a filter's initial error that may be left at the first row that is used."""

LARGEST_CONDITION = 1e13
"""Condition number of the scaled equations above which the data do not determine the law: of 16 digits three
are left."""

MISFIT = 1.5
"""Ratio of squared simulation errors with and without noise model; above it the noise model contains model error.
Without model error both fits are consistent: the ratio is 1, at most 1.25 in 26 drives; a missing filter has 1.7."""


@dataclass(frozen=True)
class LawFit:
    """Fitted parameters (size,) of a structure, with covariance (size, size)."""

    theta: Array
    covariance: Array
    noise: ArModel
    iterations: int
    converged: bool


@dataclass(frozen=True)
class _Rows:
    """Regressor and instruments (N, k), target (N,), and residual of the last estimate (N,), of one stretch."""

    x: Array
    z: Array
    y: Array
    error: Array


def fit_law(stretches: Sequence[Stretch], structure: Structure, dt: float) -> LawFit:
    """Fit the law by refined IV, or by simplified refined IV if the noise model contains model error (`MISFIT`)."""
    refined = refined_iv(stretches, structure, dt)
    simplified = refined_iv(stretches, structure, dt, noise_model=False)
    miss, least = (_miss(stretches, structure, fit.theta, dt) for fit in (refined, simplified))
    return refined if miss <= MISFIT * least else simplified


def refined_iv(
    stretches: Sequence[Stretch],
    structure: Structure,
    dt: float,
    *,
    noise_model: bool = True,
    iterations: int = ITERATIONS,
) -> LawFit:
    """Fit the law by iteration over parameters and noise model (3.2.2, steps 1 to 5).

    Let ``a'`` be the pole of the last iteration and ``w`` the filtered part of the torque. Index f denotes the filter
    ``1 / (1 - a' z^-1)``. Then ``nu + a' w_f(k-1) = U0 k + U1_f b + a w_f(k-1)`` is linear in ``k``, ``b``, ``a``. The
    regressor has the measured ``w``, the instruments the simulated one. No ``noise_model``: SRIV, sandwich covariance.
    """
    size, noise, converged = structure.size, WHITE, False
    theta = _integral_start(stretches, structure, dt) if structure.integral else np.zeros(size)
    for count in range(1, iterations + 1):
        rows = [_rows(s, i, len(stretches), structure, theta, dt, count == 1) for i, s in enumerate(stretches)]
        if count > 1:
            errors = [r.error for r in rows]
            power = max(float(np.mean(np.concatenate(errors) ** 2)), 1e-300)
            noise = fit_ar(errors, NOISE_ORDER) if noise_model else replace(WHITE, variance=power)
        solution, covariance = _instrumental(rows, noise, structure)
        before, theta = theta, solution[:size]
        if structure.filtered:
            theta[-1] = np.clip(theta[-1], FASTEST, SLOWEST)
        std = np.sqrt(np.diag(covariance)[:size])
        if count > 2 and (np.abs(theta - before) <= TOLERANCE * np.maximum(std, 1e-3 * np.abs(theta))).all():
            converged = True
            break
    if not noise_model:
        covariance = _sandwich(rows)
    return LawFit(theta, covariance[:size, :size], noise, count, converged)


def _integral_start(stretches: Sequence[Stretch], structure: Structure, dt: float) -> Array:
    """Start values (size,) by least squares with independent integrals: the error has several minima."""
    plain = replace(structure, integral=False, filtered=None)
    rows, targets = [], []
    for number, s in enumerate(stretches):
        # The integral of the velocity is the position, the reference less the error.
        integrals = [dt * np.cumsum(s.r - s.q), *((s.r,) if structure.velocity != "error" else ())]
        late = slice(structure.lead - structure.delay, s.q.size - structure.delay)
        own = np.zeros((s.q.size - structure.lead, len(stretches)))
        own[:, number] = 1.0
        rows.append(np.column_stack([columns(s, plain, np.zeros(plain.size), dt), *(x[late] for x in integrals), own]))
        targets.append(s.nu[structure.lead :])
    x = np.concatenate(rows)
    scale = np.maximum(np.abs(x).max(axis=0), 1e-300)
    found = np.linalg.lstsq(x / scale, np.concatenate(targets), rcond=None)[0] / scale
    theta, rest = found[: plain.size], found[plain.size : -len(stretches)]
    kv, e = sum(theta[plain.names.index(f"v{i}")] for i in range(structure.velocity_taps)), plain.names.index("e")
    if structure.velocity == "position":
        integral = -rest[1]
        theta[e] -= integral
    else:
        # The gain at the error is kv kp + ki, that at its integral ki kp.
        kp = (theta[e] + np.sqrt(max(theta[e] ** 2 - 4 * kv * rest[0], 0.0))) / (2 * kv)
        integral = rest[0] / kp
        theta[e] = kv * kp
    start: Array = np.insert(theta, structure.names.index("integral"), integral)
    return np.append(start, 0.0) if structure.filtered else start


def _rows(
    stretch: Stretch, number: int, stretches: int, structure: Structure, theta: Array, dt: float, first: bool
) -> _Rows:
    m, split, pole = len(structure.names), structure.unfiltered, structure.pole(theta)
    u, y = columns(stretch, structure, theta, dt), stretch.nu[structure.lead :]
    x = np.concatenate([u[:, :split], pole_filter(u[:, split:], pole)], axis=1)
    z = x.copy()
    error = y - x @ theta[:m]
    if structure.filtered:
        measured = _past(pole_filter(y - u[:, :split] @ theta[:split], pole))
        simulated = measured if first else _past(pole_filter(pole_filter(u[:, split:] @ theta[split:m], pole), pole))
        x, z = np.column_stack([x, measured]), np.column_stack([z, simulated])
        y = y + pole * measured
    if structure.integral:
        slopes = integral_slopes(stretch, structure, theta, dt)
        x[:, :m], z[:, :m] = x[:, :m] + slopes, z[:, :m] + slopes
        own = np.zeros((y.size, stretches))
        own[:, number] = 1.0
        x, z = np.column_stack([x, own]), np.column_stack([z, own])
        error = error - error.mean()
    settled = _settling(pole, y.size)
    return _Rows(x[settled:], z[settled:], y[settled:], error[settled:])


def _instrumental(rows: Sequence[_Rows], noise: ArModel, structure: Structure) -> tuple[Array, Array]:
    """``(Z' X)^-1 Z' y`` and ``(Z' Z)^-1`` of the whitened rows (3.10, 3.11)."""
    used = [r for r in rows if r.y.size > 2 * noise.order]
    if not used:
        raise DataError(f"too few samples for a law of this structure ({structure})")
    k = used[0].x.shape[1]
    zx, zz, zy = np.zeros((k, k)), np.zeros((k, k)), np.zeros(k)
    for r in used:
        x, z, y = noise.whiten(r.x), noise.whiten(r.z), noise.whiten(r.y)
        zx, zz, zy = zx + z.T @ x, zz + z.T @ z, zy + z.T @ y
    scale = np.sqrt(np.maximum(np.diag(zz), 1e-300))
    weights = np.outer(scale, scale)
    zx, zz = zx / weights, zz / weights
    finite = bool(np.isfinite(zx).all() and np.isfinite(zz).all())
    if not finite or max(np.linalg.cond(zz), np.linalg.cond(zx)) > LARGEST_CONDITION:
        raise DataError(f"the motion does not determine a law of this structure ({structure})")
    solution: Array = np.linalg.solve(zx, zy / scale) / scale
    covariance: Array = np.linalg.inv(zz) / weights
    return solution, covariance


def _sandwich(rows: Sequence[_Rows]) -> Array:
    """Covariance ``(Z' X)^-1 Z' S Z (X' Z)^-1`` with S the autocovariance of the errors as an AR process."""
    noise = fit_ar([r.error for r in rows], NOISE_ORDER)
    poles = np.concatenate([[1.0], noise.coefficients])
    k = rows[0].x.shape[1]
    zx, middle = np.zeros((k, k)), np.zeros((k, k))
    for r in rows:
        coloured = recursive_filter([np.sqrt(noise.variance)], poles, r.z[::-1])
        zx, middle = zx + r.z.T @ r.x, middle + coloured.T @ coloured
    bread = np.linalg.inv(zx)
    covariance: Array = bread @ middle @ bread.T
    return covariance


def _miss(stretches: Sequence[Stretch], structure: Structure, theta: Array, dt: float) -> float:
    return sum(float(np.sum((s.nu[structure.lead :] - simulate_law(s, structure, theta, dt)) ** 2)) for s in stretches)


def _past(x: Array) -> Array:
    return np.concatenate([x[:1], x[:-1]])


def _settling(pole: float, samples: int) -> int:
    """Number of rows until the initial state of the filter has decayed to `SETTLED`, at most a quarter of them."""
    if abs(pole) < 1e-3:
        return 1
    return min(1 + int(np.log(SETTLED) / np.log(abs(pole))), samples // 4)
