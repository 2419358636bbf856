"""Schema of the bodies that an arm must not touch: capsules around its links, and boxes in its cell."""

from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from armident.configs.schema.base import FrozenModel
from armident.configs.schema.limits import Positive

BASE = "base"
"""Name of the link that no joint moves; the other links have the name of the joint that moves them."""

FARTHEST = 200.0
"""Largest coordinate of a body, m: the longest rails are shorter; larger ones are millimetres."""

Point = tuple[float, float, float]
LinkName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=64)]


class Box(FrozenModel):
    """Box that stands still.

    Parameters
    ----------
    name
        Name in messages; ``None``: by its place in the list.
    center
        Centre in the base frame, m.
    size
        Lengths of the edges along its own x, y and z, m.
    rpy
        Orientation in the base frame: fixed-axis angles as in URDF, rad.
    """

    name: str | None = None
    center: Point
    size: tuple[Positive, Positive, Positive]
    rpy: Point = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _in_metres(self) -> Self:
        _refuse_millimetres(*self.center, *self.size)
        return self


class LinkCapsule(FrozenModel):
    """Capsule that contains a link or a part of it: all points within a radius of a segment.

    Parameters
    ----------
    link
        The joint that moves the link, or ``base``.
    start, end
        Ends of the segment, m, in frame j of the link (modified Denavit-Hartenberg), or in the link's frame of a URDF.
    radius
        Radius, m.
    """

    link: LinkName
    start: Point
    end: Point
    radius: Positive

    @model_validator(mode="after")
    def _in_metres(self) -> Self:
        _refuse_millimetres(*self.start, *self.end, self.radius)
        return self


class Collision(FrozenModel):
    """Bodies of an arm and of its cell.

    Parameters
    ----------
    radius
        Radius of the capsules from joint to joint, m, for links without other geometry; ``None``: they have none.
    clearance
        Smallest distance that a designed trajectory keeps, m. The default allows for a tracking error of 10 mm at
        each of two links.
    capsules
        Capsules of links; they replace the geometry that a URDF has for these links.
    boxes
        Boxes in the cell.
    """

    radius: Positive | None = None
    clearance: Annotated[float, Field(ge=0)] = 0.02
    capsules: tuple[LinkCapsule, ...] = ()
    boxes: tuple[Box, ...] = ()


def _refuse_millimetres(*lengths: float) -> None:
    farthest = float(np.abs(lengths).max())
    if farthest > FARTHEST:
        raise ValueError(f"{farthest:g} looks like millimetres; expected m")
