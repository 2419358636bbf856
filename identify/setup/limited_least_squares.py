"""Least squares of the torques of all joints with limits on the parameters, as fast as thousands of hypotheses need.

Friction, offset and springs of a joint act on its own torque alone. They are eliminated once for each set of equations.
What is left serves for any weights, units and signs of the torques.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array, Mask
from armident.compiled import ARITHMETIC, UNCOUNTED, compiled

Places = NDArray[np.int64]

PASSES = 3
"""Iterations between parameters and the weights of the joints."""

SETTLED = 1e-4
"""Relative change of the shares that ends these iterations: a two-hundredth of what is worth a refinement."""

FLOOR = 1e-6
"""Least share of a joint's torque power that counts as residual."""

RIDGE = 1e-6
"""Ridge of the column-normalised normal equations: parameters that a motion does not determine stay small."""

NEGLIGIBLE = 1e-24
"""Power of a column over that of the largest one below which it is zero."""

SINGULAR = "the normal equations are not positive definite"

SUMS = {**ARITHMETIC, "fastmath": {*ARITHMETIC["fastmath"], "reassoc"}}
"""Options of these kernels: sums in any order, so that several terms are added at once."""


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations of n torques with c parameters under limits, after the elimination of those of one torque each.

    ``own`` (n, o): columns of each torque alone, -1 for none; ``shared`` (s,): the others; ``used`` (n,): torques that
    count. ``parts``: see `_eliminate`.
    """

    parts: tuple[Array, Array, Array, Array, Array, Array, Array]
    own: Places
    shared: Places
    used: Mask

    @property
    def c(self) -> int:
        """Number of parameters."""
        return self.shared.size + int((self.own >= 0).sum())

    def solve(self, products: Array, power: Array, passes: int = PASSES) -> "Solution":
        """Weight every torque by its own residual power. ``products`` (n, c): ``X' y``; ``power`` (n,): ``y' y``."""
        given = np.ascontiguousarray(products), np.ascontiguousarray(power)
        theta, shares, explained, solvable = _solve(*self.parts, self.own, self.shared, self.used, *given, passes)
        if not solvable:
            raise np.linalg.LinAlgError(SINGULAR)
        return Solution(theta, shares, explained)

    def of(self, used: Mask) -> "Normal":
        """Equations of some of the torques, with the limits of these joints alone."""
        inner, outer = self.parts[5:]
        held = np.resize(used, (inner.shape[0], 1))
        return replace(self, parts=(*self.parts[:5], inner * held, outer * held), used=used)


def normal_equations(grams: Array, limits: Array, used: Mask, own: Places, shared: Places) -> Normal:
    """Eliminate from ``X_m' X_m`` (n, c, c) the parameters of one torque each, with ``limits theta >= 0``.

    ``limits`` (k, c): limit p holds parameters of torque p modulo n. Raises numpy.linalg.LinAlgError, see `Normal`.
    """
    *parts, solvable = _eliminate(np.ascontiguousarray(grams), own, shared, np.ascontiguousarray(limits), used)
    if not solvable:
        raise np.linalg.LinAlgError(SINGULAR)
    factor, across, left, own_power, shared_power, inner, outer = parts
    return Normal((factor, across, left, own_power, shared_power, inner, outer), own, shared, used)


def every_column(grams: Array, limits: Array, used: Mask) -> Normal:
    """Return equations of which no parameter acts on one torque alone."""
    n, c = grams.shape[:2]
    return normal_equations(grams, limits, used, np.zeros((n, 0), np.int64), np.arange(c))


@dataclass(frozen=True, eq=False)
class Solution:
    """Parameters (c,), residual shares of the power (n,), and products ``theta' X' y`` (n,) of each torque."""

    theta: Array
    shares: Array
    explained: Array


@compiled(nogil=False, forceinline=True, **SUMS, **UNCOUNTED)
def _factor(a: Array, size: int) -> bool:
    """Cholesky factor in the lower triangle; False if a matrix is not positive definite."""
    for j in range(size):
        for i in range(j, size):
            value = a[i, j]
            for k in range(j):
                value -= a[i, k] * a[j, k]
            if i == j:
                if not value > 0.0:
                    return False
                a[j, j] = np.sqrt(value)
            else:
                a[i, j] = value / a[j, j]
    return True


@compiled(nogil=False, forceinline=True, **SUMS, **UNCOUNTED)
def _forward(lower: Array, x: Array, size: int) -> None:
    """Divide a vector by a lower triangle."""
    for i in range(size):
        value = x[i]
        for k in range(i):
            value -= lower[i, k] * x[k]
        x[i] = value / lower[i, i]


@compiled(nogil=False, forceinline=True, **SUMS, **UNCOUNTED)
def _backward(lower: Array, x: Array, size: int) -> None:
    """Divide a vector by the transpose of a lower triangle."""
    for i in range(size - 1, -1, -1):
        x[i] /= lower[i, i]
        for k in range(i):
            x[k] -= lower[i, k] * x[i]


@compiled("f8[:, :, ::1], i8[:, ::1], i8[::1], f8[:, ::1], b1[::1]", **SUMS)
def _eliminate(
    grams: Array, own: Places, shared: Places, limits: Array, used: Mask
) -> tuple[Array, Array, Array, Array, Array, Array, Array, bool]:
    """Factors (n, o, o), what they make of the shared columns (n, o, s), what is left of these (n, s, s) and of limits.

    Also powers of own (n, o), 0 if negligible, and shared columns (n, s), and the own part of the limits (k, o).
    """
    n, o = own.shape
    s, count = shared.size, limits.shape[0]
    factor, across, left = np.zeros((n, o, o)), np.zeros((n, o, s)), np.zeros((n, s, s))
    own_power, shared_power = np.zeros((n, o)), np.zeros((n, s))
    inner, outer = np.zeros((count, o)), np.zeros((count, s))
    for p in range(count):
        for a in range(s):
            outer[p, a] = limits[p, shared[a]]
    for m in range(n):
        gram, lower = grams[m], factor[m]
        most = 0.0
        for i in range(gram.shape[0]):
            most = max(most, gram[i, i])
        for i in range(o):
            if used[m] and own[m, i] >= 0 and gram[own[m, i], own[m, i]] > NEGLIGIBLE * most:
                own_power[m, i] = gram[own[m, i], own[m, i]]
        for i in range(o):
            lower[i, i] = 1.0
            if own_power[m, i] == 0.0:
                continue
            lower[i, i] = own_power[m, i] * (1.0 + RIDGE)
            for k in range(i):
                if own_power[m, k] > 0.0:
                    lower[i, k] = gram[own[m, i], own[m, k]]
            for a in range(s):
                across[m, i, a] = gram[own[m, i], shared[a]]
        if not _factor(lower, o):
            return factor, across, left, own_power, shared_power, inner, outer, False
        for i in range(o):
            for k in range(i):
                share = lower[i, k]
                for a in range(s):
                    across[m, i, a] -= share * across[m, k, a]
            share = 1.0 / lower[i, i]
            for a in range(s):
                across[m, i, a] *= share
        for a in range(s):
            shared_power[m, a] = gram[shared[a], shared[a]]
            for b in range(s):
                left[m, a, b] = gram[shared[a], shared[b]]
        for i in range(o):
            for a in range(s):
                share = across[m, i, a]
                if share != 0.0:
                    for b in range(s):
                        left[m, a, b] -= share * across[m, i, b]
        for p in range(m, count, n):
            for i in range(o):
                if own_power[m, i] > 0.0:
                    inner[p, i] = limits[p, own[m, i]]
            _forward(lower, inner[p], o)
            for i in range(o):
                for a in range(s):
                    outer[p, a] -= inner[p, i] * across[m, i, a]
    return factor, across, left, own_power, shared_power, inner, outer, True


@compiled(
    "f8[:, :, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], i8[:, ::1], "
    "i8[::1], b1[::1], f8[:, ::1], f8[::1], i8",
    **SUMS,
)
def _solve(
    factor: Array, across: Array, left: Array, own_power: Array, shared_power: Array, inner: Array, outer: Array,
    own: Places, shared: Places, used: Mask, products: Array, power: Array, passes: int,
) -> tuple[Array, Array, Array, bool]:  # fmt: skip
    """Parameters (c,), shares (n,), explained powers (n,), and False if the equations are not positive definite."""
    n, o, s = across.shape
    count = outer.shape[0]
    theta, shares, explained = np.zeros(products.shape[1]), np.ones(n), np.zeros(n)
    within, rest, known = np.zeros((n, o)), np.zeros((n, s)), np.zeros(n)
    for m in range(n):
        for i in range(o):
            if own_power[m, i] > 0.0:
                within[m, i] = products[m, own[m, i]]
        _forward(factor[m], within[m], o)
        for a in range(s):
            rest[m, a] = products[m, shared[a]]
        known[m] = power[m]
        for i in range(o):
            known[m] -= within[m, i] * within[m, i]
            for a in range(s):
                rest[m, a] -= within[m, i] * across[m, i, a]
    weights = np.zeros(n)
    for m in range(n):
        weights[m] = 1.0 / power[m] if used[m] else 0.0
    lower, scale, right, made = np.zeros((s, s)), np.zeros(s), np.zeros(s), np.zeros((count, s))
    inverse, pushed, alone = np.zeros(n), np.zeros((n, o)), np.zeros((n, o))
    gram, linear, norms = np.zeros((count, count)), np.zeros(count), np.zeros(count)
    for _ in range(passes):
        lower[:] = 0.0
        scale[:] = 0.0
        right[:] = 0.0
        most = 0.0
        for m in range(n):
            w = weights[m]
            inverse[m] = 1.0 / w if w > 0.0 else 0.0
            if w == 0.0:
                continue
            for i in range(o):
                most = max(most, w * own_power[m, i])
            for a in range(s):
                scale[a] += w * shared_power[m, a]
                right[a] += w * rest[m, a]
                for b in range(a + 1):
                    lower[a, b] += w * left[m, a, b]
        for a in range(s):
            most = max(most, scale[a])
        for a in range(s):
            scale[a] = 1.0 / np.sqrt(scale[a]) if scale[a] > NEGLIGIBLE * most else 0.0
        for a in range(s):
            right[a] *= scale[a]
            for b in range(a + 1):
                lower[a, b] *= scale[a] * scale[b]
            lower[a, a] += RIDGE
        if not _factor(lower, s):
            return theta, shares, explained, False
        _forward(lower, right, s)
        violated = False
        for p in range(count):
            for a in range(s):
                made[p, a] = outer[p, a] * scale[a]
            _forward(lower, made[p], s)
            m = p % n
            for q in range(p + 1):
                value = 0.0
                for a in range(s):
                    value += made[p, a] * made[q, a]
                if q % n == m:
                    for i in range(o):
                        value += inner[p, i] * inner[q, i] * inverse[m]
                gram[p, q] = gram[q, p] = value
            norms[p] = np.sqrt(gram[p, p])
            value = 0.0
            for a in range(s):
                value += made[p, a] * right[a]
            for i in range(o):
                value += inner[p, i] * within[m, i]
            linear[p] = value / norms[p] if norms[p] > 1e-300 else 0.0
            violated = violated or linear[p] < 0.0
        for m in range(n):
            for i in range(o):
                pushed[m, i] = 0.0
        if violated:
            for p in range(count):
                for q in range(count):
                    size = norms[p] * norms[q]
                    gram[p, q] = gram[p, q] / size if size > 1e-300 else 0.0
                gram[p, p] = 1.0
            forces = _forces(gram, linear)
            for p in range(count):
                if forces[p] > 0.0:
                    force, m = forces[p] / norms[p], p % n
                    for a in range(s):
                        right[a] += force * made[p, a]
                    for i in range(o):
                        pushed[m, i] += force * inner[p, i] * inverse[m]
        _backward(lower, right, s)
        for a in range(s):
            right[a] *= scale[a]
        worst = 0.0
        for m in range(n):
            residual, explained[m] = known[m], 0.0
            for i in range(o):
                value = within[m, i] + pushed[m, i]
                for a in range(s):
                    value -= across[m, i, a] * right[a]
                residual += pushed[m, i] * pushed[m, i]
                explained[m] += within[m, i] * value
                alone[m, i] = value
            for a in range(s):
                value = 0.0
                for b in range(s):
                    value += left[m, a, b] * right[b]
                residual += right[a] * (value - 2.0 * rest[m, a])
                explained[m] += right[a] * products[m, shared[a]]
            _backward(factor[m], alone[m], o)
            for i in range(o):
                residual -= RIDGE * own_power[m, i] * alone[m, i] * alone[m, i]
            share = max(residual / power[m], FLOOR)
            worst = max(worst, abs(share - shares[m]) / share)
            shares[m] = share
            weights[m] = 1.0 / (share * power[m]) if used[m] else 0.0
        if worst < SETTLED:
            break
    for a in range(s):
        theta[shared[a]] = right[a]
    for m in range(n):
        for i in range(o):
            if own_power[m, i] > 0.0:
                theta[own[m, i]] = alone[m, i]
    return theta, shares, explained, True


@compiled("f8[:, ::1], f8[::1]", **SUMS)
def _forces(gram: Array, linear: Array) -> Array:
    """``min x' gram x / 2 + linear' x``, ``x >= 0`` (Lawson, Hanson, Least Squares, 1974, chapter 23)."""
    size = linear.size
    x, trial, active = np.zeros(size), np.zeros(size), np.zeros(size, np.bool_)
    places, lower, part = np.zeros(size, np.int64), np.zeros((size, size)), np.zeros(size)
    tolerance = 1e-12 * np.abs(linear).max()
    for _ in range(3 * size):
        best, most = -1, tolerance
        for p in range(size):
            if active[p]:
                continue
            slope = -linear[p]
            for q in range(size):
                slope -= gram[p, q] * x[q]
            if slope > most:
                best, most = p, slope
        if best < 0:
            break
        active[best] = True
        while True:
            count = 0
            for p in range(size):
                if active[p]:
                    places[count] = p
                    count += 1
            for i in range(count):
                part[i] = -linear[places[i]]
                for k in range(i + 1):
                    lower[i, k] = gram[places[i], places[k]]
                lower[i, i] += 1e-12
            _factor(lower, count)
            _forward(lower, part, count)
            _backward(lower, part, count)
            trial[:] = 0.0
            reach = 1.0
            for i in range(count):
                p = places[i]
                trial[p] = part[i]
                if part[i] <= 0.0:
                    reach = min(reach, x[p] / (x[p] - part[i]) if x[p] > part[i] else 0.0)
            if reach >= 1.0:
                for p in range(size):
                    x[p] = trial[p]
                break
            for p in range(size):
                x[p] += reach * (trial[p] - x[p])
                if active[p] and x[p] <= 1e-15:
                    x[p] = 0.0
                    active[p] = False
    return x
