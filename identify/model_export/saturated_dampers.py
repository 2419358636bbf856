"""Friction over the velocity as a sum of saturated dampers, which simulators have where they lack its law."""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from armident.identify.effects.free_shapes import hats
from armident.identify.model_export.exported_model import ExportedModel, JointCoupling
from armident.identify.model_export.formulas import evaluate
from armident.identify.robot.chain import Floats

TOLERANCE = 0.01
"""Largest error of the sum, relative to the largest friction: the mean error is half of it, and friction is a part of
the torque."""

SLOWEST = 1e-6
"""Least velocity of the grid, relative to the highest one."""

GRID = 1500
"""Velocities at which the sum is compared with the law."""

FASTEST = 10.0
"""Highest velocity of a joint without a limit, rad/s or m/s."""


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
    """Slope and limit of each damper: changes of slope of the polygon that fits friction at the velocities v."""
    corners, first = [0], 0
    while first < v.size - 1:
        low, high = first + 1, v.size
        while high - low > 1:  # the longest chord that keeps the tolerance, by halving
            middle = (low + high) // 2
            line = np.interp(v[first : middle + 1], v[[first, middle]], friction[[first, middle]])
            # The fit puts the corners between both sides of the law, which halves the error.
            close = np.abs(line - friction[first : middle + 1]).max() <= 2.0 * TOLERANCE * size
            low, high = (middle, high) if close else (low, middle)
        corners.append(low)
        first = low
    at = v[corners]
    heights = np.concatenate([[0.0], np.linalg.lstsq(hats(v, at)[:, 1:], friction, rcond=None)[0]])
    slopes = np.append(np.diff(heights) / np.diff(at), 0.0)
    for slope, end in zip(slopes[:-1] - slopes[1:], at[1:], strict=True):
        if abs(slope * end) > 1e-9 * size:
            yield float(slope), float(slope * end)


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
        return coulomb * sign + np.array([evaluate(text or "0.0", {"dq": {k: x}, "sign": {k: s}}) for x, s in rows])

    return law


def top_speed(model: ExportedModel, k: int) -> float:
    """Return the highest velocity of joint k, rad/s or m/s: its limit, or `FASTEST`."""
    limit = float(model.robot.joints[k].limits.velocity)
    return limit if np.isfinite(limit) else FASTEST
