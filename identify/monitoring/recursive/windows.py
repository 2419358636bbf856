"""Independent estimates from windows of motion: instrumental variables with a prior from the reference."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.monitoring.recursive.equations import Instant
from armident.identify.monitoring.recursive.kernels import add_products, solve
from armident.identify.monitoring.recursive.reference import Reference


@dataclass(frozen=True)
class WindowEstimate:
    """Parameters (b,) of one window less the reference, SI, and relative change of friction (n,), 1; no motion: NaN."""

    difference: Array
    change: Array
    std: Array


class Window:
    """Products of the equations since the last estimate. ``reference``: reference with n joints and b parameters."""

    _saved = ("sums", "squares", "right", "instants")

    def __init__(self, reference: Reference) -> None:
        self._reference = reference
        self.reset()

    def reset(self) -> None:
        """Begin a new window."""
        b = self._reference.theta.size
        self.sums, self.squares, self.right = np.zeros((b, b)), np.zeros((b, b)), np.zeros(b)
        self.instants = 0

    def add(self, instant: Instant, residual: Array, variance: Array, use: NDArray[np.bool_]) -> None:
        """Add the equations of an instant; ``residual`` (n,), N m or N: torques less those of the reference."""
        add_products(self.sums, self.squares, self.right, instant.x, instant.z, residual, variance, use)
        self.instants += 1

    def estimate(self) -> WindowEstimate:
        """Return the estimate ``(Z' W X + L)^-1 Z' W r`` with the precision L of the prior, and begin a new window.

        Its covariance is ``G^-1 (Z' W Z + L) G^-T`` with ``G = Z' W X + L`` (thesis equation 2.34 with a prior).
        """
        prior = self._reference.window_precision
        matrix = self.sums + prior
        inverse = np.eye(self.right.size)
        solve(matrix.copy(), inverse)
        difference = (inverse * self.right).sum(axis=1)
        difference_covariance = _product(_product(inverse, self.squares + prior), inverse.T)
        change, std = friction_change(self._reference, difference, difference_covariance)
        self.reset()
        return WindowEstimate(difference, change, std)


def friction_change(reference: Reference, difference: Array, covariance: Array) -> tuple[Array, Array]:
    """Relative change (n,) of each joint's friction, viscous and Coulomb, and its standard deviation, 1; else NaN.

    Generalised least squares of ``d = c f``, covariance V: ``c = f' V^-1 d / f' V^-1 f``, variance ``1 / f' V^-1 f``.
    """
    n = reference.friction.shape[0]
    change, std = np.full(n, np.nan), np.full(n, np.inf)
    for j in range(n):
        members = reference.friction[j][reference.friction[j] >= 0]
        f, d = reference.theta[members], difference[members]
        v = covariance[np.ix_(members, members)]
        weighted = _weighted(v, f)
        information = float((f * weighted).sum()) if weighted is not None else 0.0
        if weighted is not None and information > 0.0 and np.isfinite(information):
            change[j] = float((d * weighted).sum()) / information
            std[j] = information**-0.5
    return change, std


def _weighted(covariance: Array, values: Array) -> Array | None:
    """``V^-1 f`` for one or two parameters."""
    if values.size == 0:
        return None
    right = values[:, None].copy()
    return right[:, 0] if solve(covariance.copy(), right) else None


def _product(a: Array, b: Array) -> Array:
    """Matrix product without BLAS, whose sums may depend on the number of threads."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for k in range(a.shape[1]):
        out += a[:, k : k + 1] * b[k]
    return out
