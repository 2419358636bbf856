"""Free shapes of regular torques that have no name: what they depend on is known, their cause is not."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from armident.identify.effects.effect import Effect, Linear, Place, Scope, Shape
from armident.identify.effects.tables import hats, table, values
from armident.identify.robot.motion import Motion

Array = NDArray[np.float64]
Variable = Callable[[Motion, Place], Array]

NAME = "unnamed"
"""Name of these effects in documents and configurations; the law is the variable."""

TORQUE = ("N m", "N")


def _velocity(motion: Motion, place: Place) -> Array:
    return motion.qd[:, place.joint]


def _torque(motion: Motion, place: Place) -> Array:
    return motion.torque[:, place.joint]


def _acceleration(motion: Motion, place: Place) -> Array:
    return motion.qdd[:, place.joint]


def _other_velocity(motion: Motion, place: Place) -> Array:
    assert place.other is not None
    return motion.qd[:, place.other]


def _other_torque(motion: Motion, place: Place) -> Array:
    assert place.other is not None
    return motion.torque[:, place.other]


def _other_position(motion: Motion, place: Place) -> Array:
    assert place.other is not None
    return motion.q[:, place.other]


def _table_of(variable: Variable) -> Callable[..., Array]:
    """Return the columns of a table over a variable."""

    def columns(motion: Motion, place: Place, *, low: float, high: float) -> Array:
        return table(variable(motion, place), low, high)

    return columns


SIDES = (0.0, 0.04, 0.12, 0.3, 0.6, 1.0)
"""Knots of the friction curve of one direction, over its highest speed."""


def _curve(motion: Motion, place: Place, *, top: float) -> Array:
    """Return a friction curve for each direction, without its line at high speed."""
    qd, side = motion.qd[:, place.joint], motion.sign[:, place.joint, None]
    speed = hats(np.abs(qd), top * np.array(SIDES))[:, : len(SIDES) - 2]
    return np.concatenate([speed * (0.5 + 0.5 * side), speed * (0.5 - 0.5 * side)], axis=1)


def _of_time(motion: Motion, place: Place, *, duration: float) -> Array:
    return table(motion.t, 0.0, duration)


def _of_time_and_direction(motion: Motion, place: Place, *, duration: float) -> Array:
    return table(motion.t, 0.0, duration) * motion.sign[:, place.joint, None]


def _range_of(variable: Variable, unit: tuple[str, str]) -> tuple[Shape, ...]:
    """Return the first and last knot of a table: the range of the variable along the motion, widened by a tenth."""

    def ends(motion: Motion, joint: int, other: int | None) -> tuple[float, float]:
        x = variable(motion, Place(joint, other))
        low, high = np.quantile(x, (0.002, 0.998))
        return float(low), float(max(high, low + 1e-9))

    def low(motion: Motion, joint: int, other: int | None = None) -> Sequence[float]:
        return [ends(motion, joint, other)[0]]

    def high(motion: Motion, joint: int, other: int | None = None) -> Sequence[float]:
        return [ends(motion, joint, other)[1]]

    return (
        Shape("low", unit, low, continuous=(False, False)),
        Shape("high", unit, high, continuous=(False, False)),
    )


def _top(motion: Motion, joint: int) -> Sequence[float]:
    return [float(motion.top_speed[joint])]


def _duration(motion: Motion, joint: int) -> Sequence[float]:
    return [max(motion.duration, motion.dt * motion.samples)]


def _unnamed(
    law: str,
    title: str,
    columns: Callable[..., Array],
    shapes: tuple[Shape, ...],
    linear: tuple[Linear, ...] | None = None,
    *,
    scope: Scope = "joint",
    predicts: bool = False,
) -> Effect:
    return Effect(
        name=NAME,
        law=law,
        title=title,
        says=f"{title}; its cause is unknown",
        reference="Brunot 2017, section 7.3.2",
        linear=values("u", TORQUE) if linear is None else linear,
        shapes=shapes,
        columns=columns,
        scope=scope,
        predicts=predicts,
        needs="a wide range of the variable",
    )


_SECONDS = (Shape("duration", ("s", "s"), _duration, continuous=(False, False)),)

EFFECTS = (
    _unnamed(
        "velocity",
        "a torque that depends on the velocity",
        _curve,
        (Shape("top", ("rad/s", "m/s"), _top, continuous=(False, False)),),
        tuple(Linear(f"u{k}", TORQUE) for k in range(2 * (len(SIDES) - 2))),
    ),
    _unnamed("time", "a torque that changes with time", _of_time, _SECONDS),
    _unnamed("time_and_direction", "friction that changes with time", _of_time_and_direction, _SECONDS),
    _unnamed(
        "torque",
        "a torque that depends on the torque of the joint",
        _table_of(_torque),
        _range_of(_torque, TORQUE),
        predicts=True,
    ),
    _unnamed(
        "acceleration",
        "a torque that depends on the acceleration",
        _table_of(_acceleration),
        _range_of(_acceleration, ("rad/s^2", "m/s^2")),
    ),
    _unnamed(
        "velocity_of_other",
        "a torque that depends on the velocity of another joint",
        _table_of(_other_velocity),
        _range_of(_other_velocity, ("rad/s", "m/s")),
        scope="other",
    ),
    _unnamed(
        "torque_of_other",
        "a torque that depends on the torque of another joint",
        _table_of(_other_torque),
        _range_of(_other_torque, TORQUE),
        scope="other",
        predicts=True,
    ),
    _unnamed(
        "position_of_other",
        "a torque that depends on the position of another joint",
        _table_of(_other_position),
        _range_of(_other_position, ("rad", "m")),
        scope="other",
    ),
)
