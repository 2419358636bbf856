"""Projection of a joint's residual on free functions orthogonal to the regressor, with its significance.

The shape is smoothed by likelihood on the training data, and tested by its prediction of the held-out residual. Block
sums contain further serial correlation (Kuensch 1989, Annals of Statistics 17(3)).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import special

from armident.arrays import Array
from armident.identify.diagnosis.excess import fisher
from armident.identify.diagnosis.free_functions import FreeFunction
from armident.identify.diagnosis.predictive_score import SUMS, block_edges, mean_square

UNPENALISED = 1e-9
"""Roughness, relative to the roughest direction, below which a direction counts as smooth altogether."""

STRENGTHS = np.geomspace(1e-8, 1e8, 65)
"""Smoothing strengths tried, relative to the data's."""


@dataclass(frozen=True, eq=False)
class Projection:
    """Projection of a joint's residual on one set of free functions; ``function`` is ``None`` for the whole motion.

    ``p_train``: probability by noise alone of so large a projection on all directions; ``p_held``: of the held-out
    residual along the trained shape. ``share``, ``size``: power share and root mean square torque (N m or N) that the
    shape removes. ``values`` (k,), ``covariance`` (k, k): smoothed coefficients. ``change`` (M,): held-out torque of
    the shape beyond the model.
    """

    function: FreeFunction | None
    columns: NDArray[np.int64]
    joint: int
    p_train: float
    p_held: float
    share: float
    size: float
    values: Array
    covariance: Array
    change: Array

    @property
    def p_value(self) -> float:
        """Both parts combined."""
        return fisher((self.p_train, self.p_held))


@dataclass(frozen=True, eq=False)
class JointResidual:
    """Residual of the model and free functions of one joint, whitened unless stated otherwise.

    ``rows``, ``held_rows``: of this joint among all. ``d`` (R_j, K): functions at the simulated motion; ``z`` (R, K),
    ``held`` (R', K): orthogonal to the model, training and held-out. ``e`` (R,), ``held_e`` (R',): residuals. ``band``
    (M', K), ``errors`` (M',): held-out functions and errors before whitening. ``regressor`` (R', b): held-out, of the
    model, with its ``covariance``. ``least``: see `Criteria.beyond_model_function`.
    """

    joint: int
    rows: slice
    held_rows: slice
    d: Array
    z: Array
    held: Array
    e: Array
    held_e: Array
    band: Array
    errors: Array
    held_joints: Sequence[slice]
    regressor: Array
    covariance: Array
    least: float
    _made: dict[FreeFunction | None, Projection | None] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def _size(self) -> Array:
        """Norm of each function at the simulated motion, (K,)."""
        return np.asarray(np.linalg.norm(self.d, axis=0))

    @cached_property
    def _scores(self) -> Array:
        """Products of the functions beyond the model with the residual, (K,)."""
        return np.asarray(self.z.T @ self.e)

    def directions(self, columns: NDArray[np.int64]) -> tuple[Array, Array, Array] | None:
        """Combinations (k, r) of functions that are orthonormal beyond the model, coefficients (k, r), powers (r,)."""
        z, scale = _taken(self.z, columns), self._size[columns]
        scale = np.where(scale > 0, scale, np.inf)
        power, right = np.linalg.eigh(z.T @ z / np.outer(scale, scale))
        kept = power > self.least**2
        if not kept.any():
            return None
        right, power = right[:, kept], power[kept]
        combined = right / np.sqrt(power) / scale[:, None]
        # The estimate with the functions as regressors and ``u`` as instruments has unit variance in these directions.
        cross = combined.T @ (z[self.rows].T @ _taken(self.d, columns)) / scale
        through = right @ np.linalg.pinv(cross @ right) / scale[:, None]
        return combined, through, power

    def beyond(self, columns: NDArray[np.int64]) -> "JointResidual":
        """Residual and functions orthogonal to the functions ``columns`` (k,), too."""
        found = self.directions(columns)
        if found is None:
            return self
        combined, through, _ = found
        u = _taken(self.z, columns) @ combined
        inside = through @ (u.T @ self.z)
        values = through @ (combined.T @ self._scores[columns])
        # Instruments: z - u c with (z - u c)' d = 0 for the functions taken in.
        own = u[self.rows].T @ self.d[:, columns] @ through
        c = np.linalg.lstsq(own.T, through.T @ self.d[:, columns].T @ self.z[self.rows], rcond=None)[0]
        return replace(
            self,
            z=self.z - u @ c,
            held=self.held - self.held[:, columns] @ inside,
            band=self.band - self.band[:, columns] @ inside,
            e=self.e - self.z[:, columns] @ values,
            held_e=self.held_e - self.held[:, columns] @ values,
            errors=self.errors - self.band[:, columns] @ values,
        )

    def projection(self, function: FreeFunction | None, columns: NDArray[np.int64]) -> Projection | None:
        """Projection of the residual on one set (``None``: on all functions); ``None`` if the model contains it."""
        if function not in self._made:
            self._made[function] = self._projection(function, columns)
        return self._made[function]

    def _projection(self, function: FreeFunction | None, columns: NDArray[np.int64]) -> Projection | None:
        found = self.directions(columns) if columns.size else None
        if found is None:
            return None
        combined, through, power = found
        estimate = combined.T @ self._scores[columns]
        own = _taken(self.z[self.rows], columns) @ combined
        p_train, inflation = significance(own, self.e[self.rows], estimate)
        weights, axes = smoothing(estimate / np.sqrt(inflation), through, power, function)
        smooth = through @ axes
        values = smooth @ (weights * (axes.T @ estimate))
        covariance = inflation * (smooth * weights) @ smooth.T
        torque = _taken(self.band, columns) @ values
        before = float(self.errors @ self.errors)
        removed = before - float(np.sum((self.errors - torque) ** 2))
        size = float(np.sqrt(max(removed, 0.0) / self.errors.size))
        p_held = self._held_out(_taken(self.held, columns) @ values)
        return Projection(
            function, columns, self.joint, p_train, p_held, removed / max(before, 1e-300), size, values, covariance,
            torque,
        )  # fmt: skip

    def _held_out(self, change: Array) -> float:
        """Probability of so large a projection of the held-out residual on a change of prediction, from noise alone."""
        if not change.any():
            return 1.0
        here, e = change[self.held_rows], self.held_e[self.held_rows]
        after = e - here * (here @ e) / max(float(here @ here), 1e-300)
        variance = sum(
            mean_square(self.held_e[rows] - change[rows]) * float(change[rows] @ change[rows])
            for rows in self.held_joints
        )
        through = self.regressor.T @ change
        variance = variance * max(1.0, inflation_of_sums(here, after)) + float(through @ self.covariance @ through)
        return float(special.stdtr(SUMS - 1, -float(change @ self.held_e) / np.sqrt(max(variance, 1e-300))))


def _taken(functions: Array, columns: NDArray[np.int64]) -> Array:
    """Some columns of functions: a view of neighbouring ones, which most sets are."""
    first, last = columns[0], columns[-1] + 1
    return functions[:, first:last] if last - first == columns.size else functions[:, columns]


def significance(u: Array, e: Array, estimate: Array) -> tuple[float, float]:
    """Return the probability of so large a projection from noise alone, and its variance over that of white noise.

    Correlated power as a chi-square scaled by block sums (Box 1954, Annals of Mathematical Statistics 25(2)).
    """
    sums, white = [], 0.0
    for begin, end in pairwise(block_edges(e != 0.0)):
        part = u[begin:end]
        gram = part.T @ part
        sums.append(part.T @ e[begin:end] - gram @ estimate)
        white += float(np.trace(gram) - np.sum(gram**2))
    spread = np.array(sums)
    covariance = spread.T @ spread
    r, free = estimate.size, SUMS - 1
    trace = float(np.trace(covariance))
    squared = free**2 / ((free - 1) * (free + 2)) * (float(np.sum(covariance**2)) - trace**2 / free)
    equivalent = float(np.clip(trace**2 / max(squared, 1e-300), 1.0, r))
    inflation = max(1.0, trace / max(white, 1e-300))
    power = float(estimate @ estimate) / (r * inflation)
    return float(special.fdtrc(equivalent, free * equivalent, power)), inflation


def inflation_of_sums(change: Array, e: Array) -> float:
    """Variance of block sums of ``change * e`` over that of white noise; ``e`` (R,) orthogonal to ``change`` (R,)."""
    blocks = [slice(begin, end) for begin, end in pairwise(block_edges(e != 0.0))]
    sums, weights = (np.array([x[own].sum() for own in blocks]) for x in (change * e, change**2))
    total = float(weights.sum())
    white = mean_square(e) * (total - float(weights @ weights) / max(total, 1e-300))
    return float(sums @ sums) / max(white, 1e-300)


def smoothing(estimate: Array, through: Array, power: Array, function: FreeFunction | None) -> tuple[Array, Array]:
    """Factor of each coordinate (r,) at the smoothing strength of the largest likelihood, and the coordinates (r, r).

    A spline penalised on its second differences, as state-dependent parameters (thesis section 7.3.2; Young, McKenna,
    Bruun 2001, Int. J. Control 74(18)); all functions together on their size. ``power`` (r,): beyond the model.
    """
    if function is None:
        roughness, axes = 1.0 / power, np.eye(power.size)
    else:
        _, _, pieces = function.on_grid()
        bends = np.concatenate([np.diff(piece @ through, 2, axis=0) for piece in pieces])
        roughness, axes = np.linalg.eigh(bends.T @ bends)
        roughness = np.maximum(roughness, 0.0)
    seen = (axes.T @ estimate) ** 2
    rough = roughness > UNPENALISED * max(float(roughness.max()), 1e-300)
    weight = np.ones_like(seen)
    if rough.any():
        relative = roughness[rough] / np.median(roughness[rough])
        spread = 1.0 + 1.0 / (STRENGTHS[:, None] * relative)
        loss = np.sum(np.log(spread) + seen[rough] / spread, axis=1)
        weight[rough] = 1.0 / (1.0 + STRENGTHS[int(np.argmin(loss))] * relative)
    return weight, axes
