"""Scales of single joints that may have any value: gear ratio, torque constant, encoder resolution."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.identify.setup.fit import Hypothesis, Misfit
from armident.identify.setup.moves import Move, scaled

Criterion = Callable[[Hypothesis], float]
SlopedCriterion = Callable[[Hypothesis, NDArray[np.bool_]], Misfit]

FACTORS = (0.2, 0.32, 0.5, 0.7, 0.85, 1.0, 1.18, 1.4, 2.0, 3.1, 5.0)
"""True over configured values that are tried before the refinement."""

TORQUE_FACTORS = (0.067, 0.12, *FACTORS, 8.5, 15.0)
"""The same for a torque: kgf m, kgf cm over N m, and tenths lie between them."""

WORTH_REFINING = 0.02
"""Least drop of the criterion at the tried values for a refinement, nats per row."""

LEAST_GEAR = 0.05
"""Least relative error of a gear ratio or a resolution: below it other effects of drives and links resemble it."""

LEAST_GAIN = 1.3
"""Least factor of a single torque that is corrected for the search."""

WIDEST = float(np.log(1e3))
"""Largest logarithm of a factor over its start: three decades."""

STEPS = np.log(3.0) * np.arange(-6, 9)
"""Logarithms that are tried of the torque of a joint over that of the next one farther out."""

LEAST_TORQUE = 3.0
"""Least factor of a single torque for a finding; a smaller one is an effect of the drive (`drive_gain_error`)."""


def scale_moves(
    robot: RobotConfig, joint: int, h: Hypothesis, quick: Criterion, criterion: Criterion
) -> Iterator[Move]:
    """Best factor of one joint for its gear ratio, its torque alone and its position alone; ``quick`` tries many.

    A wrong gear ratio scales the position by ``f`` and the torque by ``1 / f``: their power stays.
    """
    n, name = robot.n, robot.joints[joint].name

    def gear(f: float) -> Move:
        return Move("gear_ratio", f"gear ratio of {name}", scaled(n, joint, f), scaled(n, joint, 1.0 / f))

    def torque(f: float) -> Move:
        return Move("torque_scale", f"scale of the torque of {name}", None, scaled(n, joint, f))

    def position(f: float) -> Move:
        return Move("position_scale", f"scale of the position of {name}", scaled(n, joint, f), None)

    for made, least, tried in (
        (gear, 1.0 + LEAST_GEAR, FACTORS),
        (torque, LEAST_GAIN, TORQUE_FACTORS),
        (position, 1.0 + LEAST_GEAR, FACTORS),
    ):
        factor = _best(made, h, quick, criterion, tried)
        if abs(np.log(factor)) >= np.log(least):
            yield made(factor)


def torque_scales(
    h: Hypothesis, criterion: SlopedCriterion, near: Array | None, sizes: Array, moving: NDArray[np.bool_]
) -> Array | None:
    """Best factors (n,) of all torques together, or ``None`` if none of them is far from the others.

    Joints that carry the same links determine the proportions; the common factor is free: the median joint has 1.
    ``near`` (n,): logarithms to begin from. Without them the joints follow one by one from the tip, because the misfit
    of all has other minima; ``sizes`` (n,): of the torques.
    """

    def misfit(logs: Array, used: NDArray[np.bool_]) -> Misfit:
        return criterion(replace(h, torque=np.exp(logs)[:, None] * h.torque), used)

    def sloped(logs: Array, used: NDArray[np.bool_]) -> tuple[float, Array]:
        found = misfit(logs, used)
        return found.value, 0.0 * logs if found.by_scale is None else found.by_scale

    def refined(start: Array, used: NDArray[np.bool_]) -> Array:
        bounds = [(v - WIDEST, v + WIDEST) for v in start]
        return np.asarray(optimize.minimize(sloped, start, (used,), jac=True, method="L-BFGS-B", bounds=bounds).x)

    if near is None:
        near, used, last = -np.log(sizes), np.zeros(h.shift.size, np.bool_), 0.0
        for j in np.flatnonzero(moving)[::-1]:
            used[j] = True
            tried = [near + (last + step) * (np.arange(used.size) == j) for step in STEPS]
            near = refined(min(tried, key=lambda logs: misfit(logs, used).value), used)
            last = near[j] + np.log(sizes[j])
    else:
        near = refined(near, moving)
    logs: Array = near - np.median(near)
    return None if np.abs(logs).max() < np.log(LEAST_TORQUE) else np.exp(logs)


def _best(
    made: Callable[[float], Move], h: Hypothesis, quick: Criterion, criterion: Criterion, tried: Sequence[float]
) -> float:
    """Factor with the least misfit: the best of those tried, refined between its neighbours."""
    values = [quick(made(f)(h)) for f in tried]
    k = int(np.argmin(values))
    if values[k] > values[tried.index(1.0)] - WORTH_REFINING:
        return 1.0
    low, high = np.log(tried[max(k - 1, 0)]), np.log(tried[min(k + 1, len(tried) - 1)])
    found = optimize.minimize_scalar(
        lambda v: criterion(made(float(np.exp(v)))(h)),
        bounds=(low, high),
        method="bounded",
        options={"xatol": 2e-3, "maxiter": 15},
    )
    return float(np.exp(found.x))
