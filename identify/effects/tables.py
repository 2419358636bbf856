"""Free shapes over one variable: piecewise linear functions between equidistant knots."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from armident.identify.effects.effect import Linear, Shape
from armident.identify.robot.motion import Motion

Array = NDArray[np.float64]

KNOTS = 9
"""Knots of a free shape over the range of its variable."""


def hats(x: Array, knots: Sequence[float] | Array) -> Array:
    """Return piecewise linear functions (N, k), one at each knot, constant beyond the outermost.

    Parameters
    ----------
    x
        Values, (N,).
    knots
        Increasing knots, (k,).
    """
    at = np.asarray(knots, dtype=np.float64)
    left = np.clip(np.searchsorted(at, x, side="right") - 1, 0, at.size - 2)
    share = np.clip((x - at[left]) / (at[left + 1] - at[left]), 0.0, 1.0)
    out, rows = np.zeros((x.size, at.size)), np.arange(x.size)
    out[rows, left] = 1.0 - share
    out[rows, left + 1] = share
    return out


def table(x: Array, low: float, high: float) -> Array:
    """Return the functions (N, `KNOTS` - 1) of a table, whose value is zero at the first knot.

    Parameters
    ----------
    x
        Values, (N,).
    low, high
        First and last knot.
    """
    return hats(x, np.linspace(low, high, KNOTS))[:, 1:]


def values(prefix: str, unit: tuple[str, str]) -> tuple[Linear, ...]:
    """Return the linear parameters of a table: its values at the knots after the first one.

    Parameters
    ----------
    prefix
        Beginning of their names.
    unit
        Units at a revolute and at a prismatic joint.
    """
    return tuple(Linear(f"{prefix}{k}", unit) for k in range(1, KNOTS))


def lowest(motion: Motion, joint: int) -> Sequence[float]:
    """Return the lowest position of a joint, rad or m.

    Parameters
    ----------
    motion
        Motion of the arm.
    joint
        Index of the joint, from 0.
    """
    return [float(motion.q[:, joint].min())]


def highest(motion: Motion, joint: int) -> Sequence[float]:
    """Return the highest position of a joint, rad or m.

    Parameters
    ----------
    motion
        Motion of the arm.
    joint
        Index of the joint, from 0.
    """
    low = float(motion.q[:, joint].min())
    return [max(float(motion.q[:, joint].max()), low + 1e-6)]


RANGE = (
    Shape("low", ("rad", "m"), lowest, continuous=(False, False)),
    Shape("high", ("rad", "m"), highest, continuous=(False, False)),
)
"""First and last knot of a table over the position: the range of the motion."""
