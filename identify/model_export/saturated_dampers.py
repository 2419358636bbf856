"""Friction over the velocity as a sum of saturated dampers, which simulators have where they lack its law."""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from armident.identify.model_export.exported_model import ExportedModel, JointCoupling
from armident.identify.model_export.formulas import evaluate
from armident.identify.robot.chain import Floats

TOLERANCE = 0.01
"""Error of the sum where the law is curved, relative to the largest friction; at inflections it is twice as large."""

SLOWEST = 1e-6
"""Least velocity of the grid, relative to the highest one."""

GRID = 1500
"""Velocities at which the sum is compared with the law."""

FASTEST = 10.0
"""Highest velocity of a joint without a limit, rad/s or m/s."""

NEGLIGIBLE = 1e-4
"""Torque of a damper that is left out, relative to the largest friction."""


@dataclass(frozen=True)
class SaturatedDamper:
    """Damper with the torque ``clip(-slope qd, low, high)`` on its joint; slope in N m s/rad or N s/m."""

    slope: float
    low: float
    high: float


def saturated_dampers(friction: Callable[[Floats], Floats], top: float) -> list[SaturatedDamper]:
    """Return dampers whose sum opposes the motion by ``friction`` (N m or N) up to the velocity ``top``.

    ``friction`` maps velocities (N,) to torques (N,), zero at rest. Beyond ``top`` the sum is constant.
    """
    v = np.concatenate([[0.0], np.geomspace(SLOWEST * top, top, GRID)])
    forward, backward = friction(v), -friction(-v)
    size = max(float(np.abs(np.concatenate([forward, backward])).max()), 1e-300)
    if np.abs(forward - backward).max() <= TOLERANCE * size:
        return [SaturatedDamper(slope, -abs(force), abs(force)) for slope, force in _chords(v, forward, size)]
    ahead = [SaturatedDamper(slope, *sorted((0.0, -force))) for slope, force in _chords(v, forward, size)]
    return ahead + [SaturatedDamper(slope, *sorted((0.0, force))) for slope, force in _chords(v, backward, size)]


def _chords(v: Floats, friction: Floats, size: float) -> Iterator[tuple[float, float]]:
    """Slope and limit of each damper: changes of slope of a polygon close to the friction at the velocities v."""
    allowed, corners, sides = 2.0 * TOLERANCE * size, [0], [0.0]
    while corners[-1] < v.size - 1:
        first, low, high = corners[-1], corners[-1] + 1, v.size
        while high - low > 1:  # the longest chord that is close enough, by halving
            middle = (low + high) // 2
            close = np.abs(_above(v, friction, first, middle)).max() <= allowed
            low, high = (middle, high) if close else (low, middle)
        corners.append(low)
        sides.append(float(np.sign(_above(v, friction, first, low).sum())))
    # Corners move to the side of the law, which halves the error, unless its curvature changes there.
    moved = [a if a == b else 0.0 for a, b in zip(sides[1:], [*sides[2:], sides[-1]], strict=True)]
    heights = np.concatenate([[0.0], friction[corners[1:]] + 0.5 * allowed * np.array(moved)])
    slopes = np.append(np.diff(heights) / np.diff(v[corners]), 0.0)
    for slope, end in zip(-np.diff(slopes), v[corners[1:]], strict=True):
        if abs(slope * end) > NEGLIGIBLE * size:
            yield float(slope), float(slope * end)


def _above(v: Floats, friction: Floats, first: int, last: int) -> Floats:
    """Return the friction above the chord between two velocities, at those in between."""
    ends = [first, last]
    above: Floats = friction[first : last + 1] - np.interp(v[first : last + 1], v[ends], friction[ends])
    return above


def friction_laws(
    model: ExportedModel, torques: Mapping[int, Mapping[int, str]]
) -> tuple[list[Callable[[Floats], Floats]], set[int]]:
    """Return the friction of each joint over its velocity, without the viscous part, and the effects it contains.

    ``torques``: formulas by number of the effect and joint, of `armident.identify.model_export.formulas`. An effect is
    contained if its formulas depend on the velocity of their joint alone.
    """
    texts: list[list[str]] = [[] for _ in model.joints]
    contained = set()
    for number, formulas in torques.items():
        if all(set(re.findall(r"[a-z]+\[\d+\]", text)) <= {f"dq[{j}]", f"sign[{j}]"} for j, text in formulas.items()):
            contained.add(number)
            for j, text in formulas.items():
                texts[j].append(text)
    return [_law(model, (k,), joint.coulomb, " + ".join(texts[k])) for k, joint in enumerate(model.joints)], contained


def coupling_law(model: ExportedModel, coupling: JointCoupling) -> Callable[[Floats], Floats]:
    """Return the friction of a coupling over the sum of the velocities of both joints."""
    return _law(model, coupling.joints, coupling.coulomb, "")


def _law(model: ExportedModel, joints: tuple[int, ...], coulomb: float, text: str) -> Callable[[Floats], Floats]:
    """Return Coulomb friction with the smoothed sign of the model, and the torque of a formula of the first joint."""
    k = joints[0]

    def law(v: Floats) -> Floats:
        sign = model.arm.smooth_sign(v, joints)
        rows = zip(v, sign, strict=True)
        further = [evaluate(text, {"dq": {k: x}, "sign": {k: s}}) if text else 0.0 for x, s in rows]
        torque: Floats = coulomb * sign + np.array(further)
        return torque

    return law


def top_speed(model: ExportedModel, k: int) -> float:
    """Return the highest velocity of joint k, rad/s or m/s: its limit, or `FASTEST`."""
    limit = float(model.robot.joints[k].limits.velocity)
    return limit if np.isfinite(limit) else FASTEST
