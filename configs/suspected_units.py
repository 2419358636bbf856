"""Degrees and millimetres in robot configurations, which are in rad and m: found by values that no arm has."""

import math
from collections.abc import Iterator

from armident.configs.schema.robot import Joint, RobotConfig

FULL_TURN = 2.0 * math.pi * 1.001
"""Largest angle of a geometry, rad; larger ones say the same as smaller ones, or are degrees."""

LONGEST_LINK = 30.0
"""Largest length of a geometry, m: twice that of the longest booms; larger ones are millimetres."""

FEW_TURNS = 4.0 * math.pi
"""Largest position limit that is surely in rad: two turns."""

LARGEST_DEGREES = 720.0
"""Two turns in degrees; larger position limits are meant as none."""

QUARTER_TOLERANCE = 1e-4
"""Largest relative distance of a position limit from whole quarter turns that is rounding of the written value."""

STRONGEST_GRAVITY = 100.0
"""Largest acceleration of gravity, m/s^2: four times that of Jupiter; larger ones are cm/s^2 or mm/s^2."""

LONGEST_AXIS = 200.0
"""Largest position limit of a linear axis, m: longer than the longest rails; larger ones are millimetres."""


def suspected_units(robot: RobotConfig, geometry: bool = True) -> list[str]:
    """Key, value and suspected unit of values that look like degrees or mm; ``geometry``: MDH parameters, too."""
    found: list[str] = []
    if (size := math.hypot(*robot.gravity)) > STRONGEST_GRAVITY:
        unit, factor = ("cm", 100) if size < 100 * STRONGEST_GRAVITY / 4 else ("mm", 1000)
        metres = ", ".join(f"{g / factor:g}" for g in robot.gravity)
        found.append(f"gravity: {list(robot.gravity)} looks like {unit}/s^2 (in m/s^2: [{metres}])")
    for k, joint in enumerate(robot.joints):
        place = f"joints[{k}]"
        found += [
            *(_geometry(joint, f"{place}.mdh") if geometry else ()),
            *_position(joint, f"{place}.limits.position"),
        ]
    return found


def _geometry(joint: Joint, place: str) -> Iterator[str]:
    for key in ("alpha", "theta"):
        angle = getattr(joint.mdh, key)
        if abs(angle) > FULL_TURN:
            yield f"{place}.{key}: {angle:g} looks like degrees (in rad: {math.radians(angle):.6g})"
    for key in ("d", "r"):
        length = getattr(joint.mdh, key)
        if abs(length) > LONGEST_LINK:
            yield f"{place}.{key}: {length:g} looks like millimetres (in m: {length / 1000:g})"


def _position(joint: Joint, place: str) -> Iterator[str]:
    low, high = joint.limits.position
    written = f"[{low:g}, {high:g}]"
    if joint.type == "prismatic":
        if any(LONGEST_AXIS < abs(end) < math.inf for end in (low, high)):
            yield f"{place}: {written} looks like millimetres (in m: [{low / 1000:g}, {high / 1000:g}])"
    elif any(_like_degrees(end) for end in (low, high)):
        yield f"{place}: {written} looks like degrees (in rad: [{math.radians(low):.4g}, {math.radians(high):.4g}])"


def _like_degrees(end: float) -> bool:
    """True for a position limit beyond two turns that is no multiple of a quarter turn and not meant as none."""
    if not FEW_TURNS < abs(end) <= LARGEST_DEGREES:
        return False
    quarters = abs(end) / (math.pi / 2)
    in_turns = abs(quarters - round(quarters)) < QUARTER_TOLERANCE * quarters
    return end == round(end) or not in_turns
