"""Free shapes over one variable: piecewise linear functions between equidistant knots."""

from collections.abc import Sequence

import numpy as np

from armident.arrays import Array
from armident.identify.effects.effect import POSITION, VELOCITY, Effect, Linear, Place, Shape, Trials
from armident.identify.robot.motion import Motion

KNOTS = 9
"""Knots of a free shape over the range of its variable."""


def hats(x: Array, knots: Sequence[float] | Array) -> Array:
    """Return piecewise linear functions (N, k), one at each of the increasing knots, constant beyond them."""
    at = np.asarray(knots, dtype=np.float64)
    if x.dtype == object:
        # Symbols in place of numbers: a formula is derived, see `armident.identify.model_export.formulas`.
        return np.array([symbol.hats(at) for symbol in x])
    if not at[-1] > at[0]:
        return np.ones((x.size, at.size))
    left = np.clip(np.searchsorted(at, x, side="right") - 1, 0, at.size - 2)
    share = np.clip((x - at[left]) / (at[left + 1] - at[left]), 0.0, 1.0)
    out, rows = np.zeros((x.size, at.size)), np.arange(x.size)
    out[rows, left] = 1.0 - share
    out[rows, left + 1] = share
    return out


def table(x: Array, low: float, high: float) -> Array:
    """Return the functions (N, `KNOTS` - 1) of a table, whose value is zero at the first knot."""
    return hats(x, np.linspace(low, high, KNOTS))[:, 1:]


def values(prefix: str, unit: tuple[str, str], curve: str) -> tuple[Linear, ...]:
    """Return the linear parameters of a table: its values at the knots after the first one."""
    quantity, variable = curve.split(" over ")
    return tuple(
        Linear(
            f"{prefix}{k}", unit, f"Change of the {quantity} from knot 0 to knot {k} of {KNOTS - 1} over {variable}."
        )
        for k in range(1, KNOTS)
    )


def ends(unit: tuple[str, str]) -> tuple[Shape, ...]:
    """Return the nonlinear parameters of a table, its first and last knot, of a unit."""
    return tuple(
        Shape(name, unit, f"{end} knot.", continuous=(False, False))
        for name, end in (("low", "First"), ("high", "Last"))
    )


TOP_SPEED = (Shape("top", VELOCITY, "Highest speed of the joint in the recordings.", continuous=(False, False)),)
"""Nonlinear parameter of a table over the speed."""


class FreeShape(Effect):
    """Law without a formula, whose linear parameters are torques at knots."""

    law = "table"


class OverPosition(FreeShape):
    """Table over the position of the joint."""

    shapes = ends(POSITION)

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return the range of the motion."""
        q = motion.q[:, place.joint]
        low = float(q.min())
        return (low,), (max(float(q.max()), low + 1e-6),)
