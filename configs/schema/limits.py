"""Limits of a joint, of which those that are unknown or absent are infinite."""

import math
from typing import Annotated, Any, Self

from pydantic import (
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from armident.configs.schema.base import FrozenModel

Positive = Annotated[float, Field(gt=0)]

NO_LIMIT = 1e9
"""Limits from this magnitude on are no limits, SI units: SDF writes 1e16, other formats the largest number."""

WRITTEN_NO_LIMIT = 1e16
"""Magnitude that is written for an absent limit on one side; JSON has no infinity."""

ENDLESS = (-2.0 * math.pi, 2.0 * math.pi)
"""Position limits of a revolute joint that turns endlessly, rad."""


class Limits(FrozenModel):
    """Limits of a joint, joint side; infinite where the joint has none or it is not known.

    Learning from a recording needs none of them. An arm that is to be moved needs all
    (`armident.configs.schema.robot.RobotConfig.check_movable`).

    Parameters
    ----------
    position
        Lower and upper limit, rad or m.
    velocity, acceleration
        Largest magnitudes, rad/s or m/s, and rad/s^2 or m/s^2.
    torque
        Largest magnitude, N m or N.
    """

    model_config = ConfigDict(allow_inf_nan=True)

    position: tuple[float, float] = (-math.inf, math.inf)
    velocity: Positive = math.inf
    acceleration: Positive = math.inf
    torque: Positive = math.inf

    @field_validator("position")
    @classmethod
    def _bounded(cls, value: tuple[float, float]) -> tuple[float, float]:
        low, high = (math.copysign(math.inf, end) if abs(end) >= NO_LIMIT else end for end in value)
        return low, high

    @field_validator("velocity", "acceleration", "torque")
    @classmethod
    def _magnitude(cls, value: float) -> float:
        return math.inf if value >= NO_LIMIT else value

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.position[0] < self.position[1]:
            raise ValueError("position: the lower limit must be below the upper one")
        return self

    @model_serializer(mode="wrap")
    def _finite(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out limits that are infinite: JSON cannot hold them, and they are the defaults."""
        content = {k: v for k, v in handler(self).items() if not isinstance(v, float) or math.isfinite(v)}
        if "position" in content:
            ends = self.position
            if not any(map(math.isfinite, ends)):
                del content["position"]
            elif not all(map(math.isfinite, ends)):
                written = [max(-WRITTEN_NO_LIMIT, min(WRITTEN_NO_LIMIT, end)) for end in ends]
                content["position"] = type(content["position"])(written)
        return content

    def missing(self) -> tuple[str, ...]:
        """Names of the limits that are not finite."""
        names = [name for name in ("velocity", "acceleration", "torque") if not math.isfinite(getattr(self, name))]
        return (*(() if all(map(math.isfinite, self.position)) else ("position",)), *names)


def endless(position: object) -> object:
    """Position limits of a revolute joint, with one or two turns for sides that have no limit.

    Parameters
    ----------
    position
        Lower and upper limit as in a file, rad; returned as they are if they are no two numbers.

    Returns
    -------
    object
        `ENDLESS` if both sides have no limit; two turns beside the other limit if one has none.
    """
    if not isinstance(position, tuple | list) or len(position) != 2:
        return position
    if not all(isinstance(end, int | float) and not isinstance(end, bool) for end in position):
        return position
    low, high = (float(max(min(end, WRITTEN_NO_LIMIT), -WRITTEN_NO_LIMIT)) for end in position)  # NaN stays
    open_low, open_high = low <= -NO_LIMIT, high >= NO_LIMIT
    if open_low and open_high:
        return ENDLESS
    if open_low:
        return min(ENDLESS[0], high + 2.0 * ENDLESS[0]) if high <= ENDLESS[0] else ENDLESS[0], high
    if open_high:
        return low, max(ENDLESS[1], low + 2.0 * ENDLESS[1]) if low >= ENDLESS[1] else ENDLESS[1]
    return position
