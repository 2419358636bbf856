"""Free shapes of regular torques that have no name: what they depend on is known, their cause is not."""

from collections.abc import Mapping
from itertools import product

import numpy as np

from armident.arrays import Array
from armident.identify.effects.effect import POSITION, TORQUE, VELOCITY, Linear, Place, Shape, TorqueDependent, Trials
from armident.identify.effects.free_shapes import TOP_SPEED, FreeShape, ends, hats, table, values
from armident.identify.robot.motion import Motion

NAME = "unnamed"
"""Name of these effects in documents and configurations; the law is the variable."""


class Unnamed(FreeShape):
    """Torque that depends on a variable, by a free shape."""

    name = NAME
    reference = "Brunot 2017, section 7.3.2"
    required_motion = "a wide range of the variable"

    def __init__(self) -> None:
        self.description = f"{self.title}; its cause is unknown"


class OfVelocity(Unnamed):
    """Friction curve for each direction, without its line at high speed."""

    KNOTS = (0.0, 0.04, 0.12, 0.3, 0.6, 1.0)
    """Knots of one direction over the highest speed."""

    law = "velocity"
    title = "a torque that depends on the velocity"
    linear = tuple(
        Linear(f"u{k}", TORQUE, f"Torque at {share:.0%} of the speed `top`, {way} velocity; linear in between.")
        for k, (way, share) in enumerate(product(("positive", "negative"), KNOTS[:-2]))
    )
    shapes = TOP_SPEED

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the functions of the speed of either direction."""
        qd, side = motion.qd[:, place.joint], motion.sign[:, place.joint, None]
        speed = hats(np.abs(qd), shapes["top"] * np.array(self.KNOTS))[:, : len(self.KNOTS) - 2]
        return np.concatenate([speed * (0.5 + 0.5 * side), speed * (0.5 - 0.5 * side)], axis=1)

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return the joint's top speed."""
        return ([motion.top_speed[place.joint]],)


class OfTime(Unnamed):
    """Torque that changes with time."""

    law = "time"
    title = "a torque that changes with time"
    linear = values("u", TORQUE, "torque over the time")
    shapes = (Shape("duration", ("s", "s"), "Last knot.", continuous=(False, False)),)

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the functions of the time."""
        return table(motion.t, 0.0, shapes["duration"])

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return the time of all recordings."""
        return ([motion.whole_time],)


class OfTimeAndDirection(OfTime):
    """Friction that changes with time."""

    law = "time_and_direction"
    title = "friction that changes with time"
    linear = values("u", TORQUE, "friction over the time")

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the functions of the time, times ``sign(qd)``."""
        return super().columns(motion, place, shapes) * motion.sign[:, place.joint, None]


class OverSignal(Unnamed):
    """Torque by a table over a signal ``signal`` (N, n) of the joint, or of another one."""

    signal: str

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> Array:
        """Return the functions of the signal."""
        return table(self._values(motion, place), shapes["low"], shapes["high"])

    def trial_values(self, motion: Motion, place: Place) -> Trials:
        """Return the range of the signal along the motion, without its outermost 0.2 %."""
        low, high = np.quantile(self._values(motion, place), (0.002, 0.998))
        return [low], [max(high, low + 1e-9)]

    def _values(self, motion: Motion, place: Place) -> Array:
        values: Array = getattr(motion, self.signal)[:, place.joint if place.other is None else place.other]
        return values


class OfTorque(TorqueDependent, OverSignal):
    """Torque that depends on the predicted torque of the joint."""

    law = "torque"
    title = "a torque that depends on the torque of the joint"
    linear = values("u", TORQUE, "torque over the torque of the joint")
    shapes = ends(TORQUE)
    signal = "torque"


class OfAcceleration(OverSignal):
    """Torque that depends on the acceleration."""

    law = "acceleration"
    title = "a torque that depends on the acceleration"
    linear = values("u", TORQUE, "torque over the acceleration")
    shapes = ends(("rad/s^2", "m/s^2"))
    signal = "qdd"


class OfOtherVelocity(OverSignal):
    """Torque that depends on the velocity of another joint."""

    law = "velocity_of_other"
    title = "a torque that depends on the velocity of another joint"
    linear = values("u", TORQUE, "torque over the velocity of the other joint")
    scope = "other"
    shapes = ends(VELOCITY)
    signal = "qd"


class OfOtherTorque(TorqueDependent, OverSignal):
    """Torque that depends on the predicted torque of another joint."""

    law = "torque_of_other"
    title = "a torque that depends on the torque of another joint"
    linear = values("u", TORQUE, "torque over the torque of the other joint")
    scope = "other"
    shapes = ends(TORQUE)
    signal = "torque"


class OfOtherPosition(OverSignal):
    """Torque that depends on the position of another joint."""

    law = "position_of_other"
    title = "a torque that depends on the position of another joint"
    linear = values("u", TORQUE, "torque over the position of the other joint")
    scope = "other"
    shapes = ends(POSITION)
    signal = "q"
