"""Modified Denavit-Hartenberg parameters of any serial chain of joint axes (thesis section 2.1.1)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from armident.arrays import Array
from armident.configs.errors import ConfigError
from armident.configs.schema.robot import Mdh

PARALLEL = 1e-6
"""Largest angle (rad) of parallel axes: a micrometre per metre, below the tolerance of any arm."""

DIGITS = 12
"""Significant decimals of a length (m) and of an angle's deviation from a right angle (rad); the rest is rounding."""

COINCIDENT = 10.0**-DIGITS
"""Largest distance (m) of coincident points, and largest rounding error of an angle (rad)."""

FARTHEST = 100.0
"""Largest distance of a common normal, as a multiple of the chain's size. Beyond it the parameters about the normal are
not distinguishable numerically."""


@dataclass(frozen=True, eq=False)
class MdhChain:
    """A serial chain in MDH parameters; offsets of the variables are in ``theta`` (revolute) or ``r`` (prismatic).

    ``base`` (4, 4): frame 0 in the frame of the axes, z along the first; ``frames`` (n, 4, 4): 1 to n in it, at zero.
    """

    base: Array
    parameters: tuple[Mdh, ...]
    frames: Array


def modified_dh(axes: ArrayLike, points: ArrayLike, names: Sequence[str]) -> MdhChain:
    """Modified Denavit-Hartenberg parameters of a serial chain (Khalil and Kleinfinger 1986, thesis section 2.1.1).

    ``z_j`` is the axis of joint j, ``x_j`` the common normal of axes j and j+1: with the smaller ``|theta_j|``, between
    parallel axes that with ``r_j = 0``. Further, ``theta_n = r_n = alpha_1 = d_1 = 0``, and ``x_0`` is towards the
    given x. ``axes``: unit vectors (n, 3); ``points``: one on each axis (n, 3), m.
    """
    z = np.array(axes, dtype=np.float64)
    p = np.asarray(points, dtype=np.float64)
    n = z.shape[0]
    reach = FARTHEST * float(np.linalg.norm(p - p[0], axis=1).max()) + COINCIDENT
    x = _across(z[0])
    # The point of axis j that is the origin of frame j if r_j = 0.
    foot = p[0] - float(p[0] @ z[0]) * z[0]
    base = _frame(x, z[0], foot)
    alpha, d = 0.0, 0.0
    parameters, frames = [], np.empty((n, 4, 4))
    for j in range(n):
        normal, origin, parallel = _common_normal(z, p, j, x, foot)
        theta = _angle(x, normal, z[j])
        ahead = p[min(j + 1, n - 1)] - origin
        if abs(theta) > np.pi / 2 + COINCIDENT or (abs(theta) > np.pi / 2 - COINCIDENT and ahead @ normal < 0.0):
            normal = -normal
            theta = _angle(x, normal, z[j])
        r = float((origin - foot) @ z[j])
        if abs(r) > reach:
            raise ConfigError(
                f"the axes of {names[j]} and {names[j + 1]} are nearly parallel "
                f"({np.linalg.norm(np.cross(z[j], z[j + 1])):.2g} rad): make them parallel, "
                "writing angles to six digits or more"
            )
        parameters.append(Mdh(alpha=_neat(alpha), d=_length(d), theta=_neat(theta), r=_length(r)))
        frames[j] = _frame(normal, z[j], origin)
        if j + 1 < n:
            if parallel:
                z[j + 1] = np.copysign(1.0, z[j] @ z[j + 1]) * z[j]
            alpha, d = _angle(z[j], z[j + 1], normal), float(ahead @ normal)
            x, foot = normal, origin + d * normal
    return MdhChain(base, tuple(parameters), frames)


def _common_normal(z: Array, p: Array, j: int, x: Array, foot: Array) -> tuple[Array, Array, bool]:
    """Direction of the normal of axes j and j+1, its point on axis j, and True if the axes are parallel."""
    if j + 1 == z.shape[0]:
        return x, foot, False
    gap = p[j + 1] - foot
    cross = np.cross(z[j], z[j + 1])
    sine = float(np.linalg.norm(cross))
    if sine > PARALLEL:
        along = float(np.cross(gap, z[j + 1]) @ cross) / sine**2
        return cross / sine, foot + along * z[j], False
    across = gap - (gap @ z[j]) * z[j]
    distance = float(np.linalg.norm(across))
    return (across / distance if distance > COINCIDENT else x), foot, True


def _across(z: Array) -> Array:
    """Unit vector orthogonal to ``z``: the given x made orthogonal, or y where x is too close to ``z``."""
    unit = np.eye(3)[0 if abs(z[0]) < np.sqrt(0.75) else 1]
    across: Array = unit - (unit @ z) * z
    return across / np.linalg.norm(across)


def _frame(x: Array, z: Array, origin: Array) -> Array:
    frame = np.eye(4)
    frame[:3] = np.column_stack([x, np.cross(z, x), z, origin])
    return frame


def _angle(a: Array, b: Array, about: Array) -> float:
    """Angle from ``a`` to ``b``, both orthogonal to ``about``, rad."""
    return float(np.arctan2(np.cross(a, b) @ about, a @ b))


def _neat(angle: float) -> float:
    """``angle`` without rounding errors near multiples of a right angle."""
    right = round(angle / (np.pi / 2)) * (np.pi / 2)
    return float(right if abs(angle - right) < COINCIDENT else angle)


def _length(value: float) -> float:
    return round(value, DIGITS) + 0.0
